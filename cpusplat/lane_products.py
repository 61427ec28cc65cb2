"""Products of a matrix that has few rows and one that has 16 or 32 columns; all sums stay in registers."""

from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils

from cpusplat.lanes import LANES, WIDTH, address_of, operation, splat

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

    @operation(types.void)
    def add_products(builder, y, y0, y_step, a, a0, a_step, x, x0, x_step, inner, begin, wide):
        def vectors(array: Any, start: Any, count: int) -> list[Any]:
            starts = [builder.add(start, ir.Constant(start.type, k * WIDTH)) for k in range(count)]
            return [address_of(builder, array, index, LANES.vector) for index in starts]

        def emit(count: int) -> None:
            starts, row = [a0], y0
            targets: list[Any] = []
            for _ in range(rows):
                targets += vectors(y, row, count)
                row = builder.add(row, y_step)
                starts.append(builder.add(starts[-1], a_step))
            zero, sums = ir.Constant(LANES.vector, None), []
            for target in targets:
                before = builder.select(begin, zero, builder.load(target, align=4))
                sums.append(cgutils.alloca_once_value(builder, before))
            with cgutils.for_range(builder, inner) as loop:
                at = builder.add(x0, builder.mul(loop.index, x_step))
                loaded = [builder.load(address, align=4) for address in vectors(x, at, count)]
                for number, total in enumerate(sums):
                    index = builder.add(starts[number // count], loop.index)
                    factor = splat(builder, builder.load(builder.gep(a, [index])))
                    product = builder.fmul(factor, loaded[number % count], flags=("contract",))
                    builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)
            for target, total in zip(targets, sums, strict=True):
                builder.store(builder.load(total), target, align=4)

        with builder.if_else(wide) as (then, otherwise):
            with then:
                emit(WIDE_COLUMNS // WIDTH)
            with otherwise:
                emit(1)

    return add_products
