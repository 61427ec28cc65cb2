"""Products of a matrix that has few rows and one that has 16 or 32 columns; all sums stay in registers."""

from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from cpusplat.lanes import LANES, WIDTH, splat

_HAS_AVX512 = bool(binding.get_host_cpu_features().get("avx512f"))
"""With AVX-512, a core has 32 registers of 16 numbers each; without it, 16 registers of at most 8 numbers."""

MAX_ROWS = 8 if _HAS_AVX512 else 6
WIDE_COLUMNS = 2 * WIDTH if _HAS_AVX512 else WIDTH  # rows and columns whose sums fit into the registers


def rows_of_products(rows: int) -> Any:
    """Return a function that computes y[r, c] = sum over k of a[r, k] x[k, c] for a fixed number of rows.

    Each element of `x` is loaded once for all rows, and each element of `a` once for all columns. Terms are
    added in the order of k. A plain numba loop would spill this many sums to memory.

    Returns:
        A numba function of (y, y0, y_step, a, a0, a_step, x, x0, x_step, inner, begin, wide): flat float32
        arrays, each followed by the index of its first element and the step between rows; the number of terms
        per sum; whether sums start at zero, not at y; whether there are `WIDE_COLUMNS` columns, not `WIDTH`.
    """

    @intrinsic
    def add_products(typingctx, y, y0, y_step, a, a0, a_step, x, x0, x_step, inner, begin, wide):
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            y_data, a_data, x_data = (
                context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 3, 6)
            )
            (y_first, y_next), (a_first, a_next), (x_first, x_next) = args[1:3], args[4:6], args[7:9]
            many, from_zero, both = args[9:]
            zero = ir.Constant(LANES.vector, None)

            def vectors(data: Any, start: Any, count: int) -> list[Any]:
                places = [builder.add(start, ir.Constant(start.type, k * WIDTH)) for k in range(count)]
                return [builder.bitcast(builder.gep(data, [at]), LANES.vector.as_pointer()) for at in places]

            def emit(count: int) -> None:
                starts, row = [a_first], y_first
                sums: list[Any] = []
                targets: list[Any] = []
                for _ in range(rows):
                    targets += vectors(y_data, row, count)
                    row = builder.add(row, y_next)
                    starts.append(builder.add(starts[-1], a_next))
                for target in targets:
                    before = builder.select(from_zero, zero, builder.load(target, align=4))
                    sums.append(cgutils.alloca_once_value(builder, before))
                with cgutils.for_range(builder, many) as loop:
                    at = builder.add(x_first, builder.mul(loop.index, x_next))
                    loaded = [builder.load(each, align=4) for each in vectors(x_data, at, count)]
                    for number, total in enumerate(sums):
                        index = builder.add(starts[number // count], loop.index)
                        factor = builder.load(builder.gep(a_data, [index]))
                        same = splat(builder, factor)
                        product = builder.fmul(same, loaded[number % count], flags=("contract",))
                        added = builder.fadd(builder.load(total), product, flags=("contract",))
                        builder.store(added, total)
                for target, total in zip(targets, sums, strict=True):
                    builder.store(builder.load(total), target, align=4)

            with builder.if_else(both) as (then, otherwise):
                with then:
                    emit(WIDE_COLUMNS // WIDTH)
                with otherwise:
                    emit(1)
            return context.get_dummy_value()

        arguments = (y, y0, y_step, a, a0, a_step, x, x0, x_step, inner)
        numbers = (types.intp if isinstance(each, types.Integer) else each for each in arguments)
        return types.void(*numbers, types.boolean, types.boolean), codegen

    return add_products
