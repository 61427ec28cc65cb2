"""Vectors of 16 lanes as one numba value, so that a block of 4 x 4 pixels is a single vector.

numba vectorises a loop over 16 pixels only if it can prove that arrays do not overlap, and it spills every
temporary to memory. A value of type `LANES` is an LLVM `<16 x float>`, and one of type `WIDE` a
`<16 x double>`: arithmetic on them is vector arithmetic, and accumulators stay in registers. LLVM splits them
into the machine's registers (16 floats are one register with AVX-512, two with AVX2, four with NEON).

Operations, for use inside `numba.njit` functions: `+ - * /` between lanes or with a float, and the functions
below. The order of sums is fixed.
"""

import functools
import operator
from typing import Any, no_type_check

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, register_model

from cpusplat.compiled import compiled

WIDTH = 16
_FLOAT, _DOUBLE, _INT = ir.FloatType(), ir.DoubleType(), ir.IntType(32)
_VECTOR = ir.VectorType(_FLOAT, WIDTH)
_INTS = ir.VectorType(_INT, WIDTH)
# A product and a sum may be fused into one operation with one rounding; reordering is not allowed.
_FLAGS = ("contract",)
_RECIPROCAL_BITS = 0x7EF311C7
"""Twice the exponent bits of 1, minus a correction that balances the signs of the first guess's errors."""
_MASKED_STORE = f"llvm.masked.store.v{WIDTH}f32.p0"


class LanesType(types.Type):
    """Numba type of a vector of numbers of the same type."""

    def __init__(self, dtype: types.Float, width: int = WIDTH) -> None:
        self.dtype = dtype
        self.vector = ir.VectorType(_FLOAT if dtype == types.float32 else _DOUBLE, width)
        super().__init__(name=f"Lanes{width}({dtype})")


LANES = LanesType(types.float32)
WIDE = LanesType(types.float64)
QUAD = LanesType(types.float32, 4)
"""Four lanes, for rows of a few numbers: `quad`, `load_quad`, `store`, `plus` and `signs_of_difference`."""


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, fe_type.vector)


@lower_cast(types.Float, LanesType)
def _all_equal(context: Any, builder: Any, scalar_type: Any, kind: Any, scalar: ir.Value) -> ir.Value:
    return splat(builder, context.cast(builder, scalar, scalar_type, kind.dtype))


def _binary(python_operator: Any, emit: Any) -> None:
    """Register an operator with numba for two lane values, or for a lane value and a scalar."""

    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            kinds = {arg for arg in args if isinstance(arg, LanesType)}
            if len(kinds) != 1 or not all(isinstance(arg, (LanesType, types.Float)) for arg in args):
                return None
            return signature(*kinds, *kinds, *kinds)

    infer_global(python_operator)(Template)
    lower_builtin(python_operator, LanesType, LanesType)(
        lambda context, builder, sig, args: emit(builder)(*args, flags=_FLAGS)
    )


_binary(operator.add, lambda builder: builder.fadd)
_binary(operator.sub, lambda builder: builder.fsub)
_binary(operator.mul, lambda builder: builder.fmul)
_binary(operator.truediv, lambda builder: builder.fdiv)


@compiled
@no_type_check
def aligned(count):
    """Allocate a float32 array that starts at a cache line, so that no vector spans two lines."""
    room = np.empty(count + WIDTH, np.float32)
    skip = (-(room.ctypes.data // 4)) % WIDTH
    return room[skip : skip + count]


def operation(result: Any, *kinds: types.Type) -> Any:
    """Make an intrinsic from a function of the IR builder and the operands, with the addresses of arrays.

    Args:
        result: type of the result, or a function of the operands' types that returns it.
        kinds: types to which operands are cast; without them, only integers are cast (to intp).
    """

    def decorate(emit: Any) -> Any:
        @functools.wraps(emit)
        def typed(typingctx, *operands):
            given = kinds or [types.intp if isinstance(kind, types.Integer) else kind for kind in operands]
            returned = result if isinstance(result, types.Type) else result(*operands)

            def codegen(context, builder, sig, args):
                values = [
                    context.make_array(kind)(context, builder, value).data
                    if isinstance(kind, types.Array)
                    else value
                    for kind, value in zip(sig.args, args, strict=True)
                ]
                emitted = emit(builder, *values)
                return context.get_dummy_value() if returned == types.void else emitted

            return returned(*given), codegen

        return intrinsic(typed)

    return decorate


def _first(kind: types.Type, *_: types.Type) -> types.Type:
    return kind


def _lanes_of(array: types.Array, *_: types.Type) -> types.Type:
    return {types.float32: LANES, types.float64: WIDE}[array.dtype]


def _constant(value: float | int, kind: ir.VectorType = _VECTOR) -> ir.Constant:
    return ir.Constant(kind, [ir.Constant(kind.element, value)] * WIDTH)


def splat(builder: ir.IRBuilder, scalar: ir.Value, count: int = WIDTH) -> ir.Value:
    """Return a vector whose elements all equal a scalar."""
    undefined = ir.Constant(ir.VectorType(scalar.type, count), ir.Undefined)
    one = builder.insert_element(undefined, scalar, ir.Constant(_INT, 0))
    return builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(_INT, count), [0] * count))


def address_of(builder: ir.IRBuilder, array: ir.Value, index: ir.Value, kind: ir.Type) -> ir.Value:
    """Return the address of an array element, as that of a value of another type."""
    return builder.bitcast(builder.gep(array, [index]), kind.as_pointer())


def _load(builder: ir.IRBuilder, array: ir.Value, index: ir.Value, count: int) -> ir.Value:
    kind = ir.VectorType(array.type.pointee, count)
    return builder.load(address_of(builder, array, index, kind), align=_bytes(array))


def _bytes(array: ir.Value) -> int:
    return 8 if array.type.pointee == _DOUBLE else 4


@operation(LANES, types.float32)
def lanes(builder, scalar):
    """Return lanes that all contain the same float32 number."""
    return splat(builder, scalar)


@operation(QUAD, types.float32)
def quad(builder, scalar):
    """Return four lanes that all contain the same float32 number."""
    return splat(builder, scalar, 4)


@operation(_lanes_of)
def load(builder, array, index):
    """Load 16 consecutive numbers from a flat float32 or float64 array."""
    return _load(builder, array, index, WIDTH)


@operation(QUAD)
def load_quad(builder, array, index):
    """Load four consecutive numbers from a flat float32 array."""
    return _load(builder, array, index, 4)


@operation(_lanes_of)
def load_same(builder, array, index):
    """Load one element of a flat array into all lanes; the index must not be negative."""
    return splat(builder, builder.load(builder.gep(array, [index])))


@operation(types.void)
def store(builder, array, index, value):
    """Store the lanes as consecutive numbers of a flat array of the same type."""
    builder.store(value, address_of(builder, array, index, value.type), align=_bytes(array))


@operation(_first)
def plus(builder, total, scales, values):
    """Return total + scales * values; each product is rounded before it is added, as in plain loops."""
    return builder.fadd(total, builder.fmul(scales, values))  # without flags, so never fused


@operation(QUAD, QUAD, QUAD, types.float32)
def signs_of_difference(builder, a, b, scale):
    """Return scale where a > b, -scale where a < b, and 0 where a == b; NaN is preserved."""
    zeros = ir.Constant(QUAD.vector, None)
    apart, up = builder.fsub(a, b), splat(builder, scale, 4)
    above = builder.fcmp_ordered(">", apart, zeros)
    below = builder.fcmp_ordered("<", apart, zeros)
    return builder.select(above, up, builder.select(below, builder.fneg(up), apart))


@operation(types.float64)
def add_products(builder, sums, at, a, b, c, scale):
    """Add scale * (a, b, c, 0) to four float64 sums from index `at`, as one vector and never fused.

    Returns the previous value of the first sum.
    """
    four = ir.VectorType(_DOUBLE, 4)
    address, weights = address_of(builder, sums, at, four), ir.Constant(four, None)
    for index, value in enumerate((a, b, c)):
        weights = builder.insert_element(weights, value, ir.Constant(_INT, index))
    before = builder.load(address, align=8)
    products = builder.fmul(weights, splat(builder, scale, 4))
    builder.store(builder.fadd(before, products), address, align=8)
    return builder.extract_element(before, ir.Constant(_INT, 0))


@operation(WIDE, LANES)
def wide(builder, value):
    """Convert the lanes to float64."""
    return builder.fpext(value, WIDE.vector)


@operation(LANES, WIDE)
def narrow(builder, value):
    """Round the lanes to float32."""
    return builder.fptrunc(value, LANES.vector)


@operation(LANES, LANES)
def exp2_negative(builder, value):
    """Compute 2**x for x in [-126, 0], with a relative error below 3e-7.

    Truncation gives x = k + f with f in (-1, 0]; a degree-6 polynomial approximates 2**f, and k is added to
    the exponent bits. Lanes outside the range get an arbitrary, possibly infinite number and no trap.
    """
    whole = builder.fptosi(value, _INTS)
    fraction = builder.fsub(value, builder.sitofp(whole, _VECTOR))
    # Chebyshev fit of 2**f over [-1, 0], degree 6
    result = _constant(_EXP2[-1])
    for coefficient in reversed(_EXP2[:-1]):
        product = builder.fmul(result, fraction, flags=_FLAGS)
        result = builder.fadd(product, _constant(coefficient), flags=_FLAGS)
    bits = builder.shl(builder.add(whole, _constant(127, _INTS)), _constant(23, _INTS))
    return builder.fmul(result, builder.bitcast(bits, _VECTOR))


_fit = np.polynomial.chebyshev.Chebyshev.interpolate(np.exp2, 6, domain=[-1, 0])
_EXP2 = [float(np.float32(c)) for c in _fit.convert(kind=np.polynomial.Polynomial).coef]
"""Coefficients, constant first, of the polynomial for 2**f on [-1, 0]."""


def _keep(condition: str) -> Any:
    def keep(builder, left, right, value):
        mask = builder.fcmp_ordered(condition, left, right)
        return builder.select(mask, value, ir.Constant(value.type, None))

    return operation(_first)(keep)


keep_ge, keep_gt, keep_lt = map(_keep, (">=", ">", "<"))
"""Keep the lanes of a third value where the first is >=, > or < the second; others become 0."""


def _smaller(builder, left, right):
    return builder.select(builder.fcmp_ordered("<", left, right), left, right)


def _larger(builder, left, right):
    return builder.select(builder.fcmp_ordered(">", left, right), left, right)


smaller, larger = map(operation(_first), (_smaller, _larger))
"""Lane-wise minimum and maximum."""


@operation(types.boolean, LANES, LANES)
def any_ge(builder, left, right):
    """Return whether left >= right in any lane."""
    mask = builder.bitcast(builder.fcmp_ordered(">=", left, right), ir.IntType(WIDTH))
    return builder.icmp_unsigned("!=", mask, ir.Constant(ir.IntType(WIDTH), 0))


@operation(types.int64, LANES, LANES)
def bits_ge(builder, left, right):
    """Return a bit mask in which bit k is 0 if left < right in lane k, else 1 (also if either is NaN)."""
    mask = builder.bitcast(builder.fcmp_unordered(">=", left, right), ir.IntType(WIDTH))
    return builder.zext(mask, ir.IntType(64))


@operation(types.void)
def prefetch(builder, array, index):
    """Start loading the cache line of an array element; the index may be outside the array."""
    byte = ir.IntType(8).as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [byte, _INT, _INT, _INT])
    fetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
    address = address_of(builder, array, index, ir.IntType(8))
    builder.call(fetch, [address, *(ir.Constant(_INT, flag) for flag in (0, 3, 1))])


@operation(types.int64)
def column_bits(builder, words, index, bit):
    """Collect bit `bit` of words[index + k] as bit k of the result, for 64 words of a flat uint16 array."""
    count, word = 64, ir.IntType(16)
    kind = ir.VectorType(word, count)
    held = builder.load(address_of(builder, words, index, kind), align=2)
    one = builder.shl(ir.Constant(word, 1), builder.trunc(bit, word))
    tested = builder.and_(held, splat(builder, one, count))
    return builder.bitcast(builder.icmp_unsigned("!=", tested, ir.Constant(kind, None)), ir.IntType(count))


@operation(types.int64, types.int64)
def first_bit(builder, bits):
    """Return the index of the lowest set bit; `bits` must not be 0."""
    return builder.cttz(bits, ir.Constant(ir.IntType(1), 1))


@operation(types.void)
def store_sums(builder, array, index, vectors):
    """Store the lane sums of 2 to 16 vectors (a tuple) at consecutive indices.

    Each step merges pairs of vectors and halves the number of lanes per partial sum. This takes half as many
    instructions as a `lane_sum` of each vector.
    """
    count, nothing = vectors.type.count, ir.Constant(_VECTOR, ir.Undefined)
    # each vector, with the number of the input vector that each lane belongs to
    held = [(builder.extract_value(vectors, k), [k] * WIDTH) for k in range(count)]
    width = WIDTH
    while width > 1:
        width //= 2
        low = [g * 2 * width + k for g in range(WIDTH // (2 * width)) for k in range(width)]
        high = [lane + width for lane in low]
        merged = []
        for k in range(0, len(held), 2):
            one, ones = held[k]
            other, others = held[k + 1] if k + 1 < len(held) else (nothing, [-1] * WIDTH)
            parts = [
                builder.shuffle_vector(
                    one, other, ir.Constant(_INTS, [*take, *(lane + WIDTH for lane in take)])
                )
                for take in (low, high)
            ]
            merged.append((builder.fadd(*parts), [*(ones[i] for i in low), *(others[i] for i in low)]))
        held = merged
    total, owner = held[0]
    order = [owner.index(k) if k < count else 0 for k in range(WIDTH)]
    total = builder.shuffle_vector(total, nothing, ir.Constant(_INTS, order))
    bits = ir.VectorType(ir.IntType(1), WIDTH)
    mask = ir.Constant(bits, [ir.Constant(bits.element, int(k < count)) for k in range(WIDTH)])
    kind = ir.FunctionType(ir.VoidType(), [_VECTOR, _VECTOR.as_pointer(), _INT, bits])
    write = cgutils.get_or_insert_function(builder.module, kind, _MASKED_STORE)
    builder.call(write, [total, address_of(builder, array, index, _VECTOR), ir.Constant(_INT, 4), mask])


def _halved(builder: ir.IRBuilder, vector: ir.Value, combine: Any) -> ir.Value:
    """Combine the two halves of a vector repeatedly until one number is left, in a fixed order."""
    width = WIDTH
    while width > 1:
        width //= 2
        undefined = ir.Constant(vector.type, ir.Undefined)
        half = ir.VectorType(_INT, width)
        low = builder.shuffle_vector(vector, undefined, ir.Constant(half, list(range(width))))
        high = builder.shuffle_vector(vector, undefined, ir.Constant(half, list(range(width, 2 * width))))
        vector = combine(low, high)
    return builder.extract_element(vector, ir.Constant(_INT, 0))


@operation(types.float32, LANES)
def lane_sum(builder, value):
    return _halved(builder, value, builder.fadd)


@operation(types.float32, LANES)
def lane_max(builder, value):
    return _halved(builder, value, functools.partial(_larger, builder))


@operation(types.void)
def transpose(builder, source, source_index, source_step, target, target_index, target_step):
    """Transpose a 16 x 16 block while copying it between flat float32 arrays.

    Each array is followed by the index of the block's first element and the step between rows.
    """

    def addresses(array: ir.Value, index: ir.Value, step: ir.Value) -> list[ir.Value]:
        starts = [builder.add(index, builder.mul(step, ir.Constant(step.type, row))) for row in range(WIDTH)]
        return [address_of(builder, array, start, _VECTOR) for start in starts]

    rows = [builder.load(address, align=4) for address in addresses(source, source_index, source_step)]
    for bit in (1, 2, 4, 8):  # exchange the off-diagonal blocks of each size
        for r in range(WIDTH):
            if not r & bit:
                one, other = rows[r], rows[r | bit]
                low = [k if not k & bit else WIDTH + (k ^ bit) for k in range(WIDTH)]
                high = [k | bit if not k & bit else WIDTH + k for k in range(WIDTH)]
                rows[r] = builder.shuffle_vector(one, other, ir.Constant(_INTS, low))
                rows[r | bit] = builder.shuffle_vector(one, other, ir.Constant(_INTS, high))
    for row, address in zip(rows, addresses(target, target_index, target_step), strict=True):
        builder.store(row, address, align=4)


@operation(LANES, LANES)
def reciprocal(builder, value):
    """Compute 1 / x in every lane, for positive normal numbers, with a relative error below 3e-7.

    Negating the exponent bits gives a first guess within 12 %, and each of three Newton steps squares the
    error. A division of 16 numbers would take as long as 30 such instructions.
    """
    start = builder.sub(_constant(_RECIPROCAL_BITS, _INTS), builder.bitcast(value, _INTS))
    result = builder.bitcast(start, _VECTOR)
    for _ in range(3):
        error = builder.fsub(_constant(2.0), builder.fmul(value, result, flags=_FLAGS), flags=_FLAGS)
        result = builder.fmul(result, error)
    return result


@operation(_first)
def root(builder, value):
    """Compute the square root of every lane."""
    kind = ir.FunctionType(value.type, [value.type])
    name = f"llvm.sqrt.v{WIDTH}f{32 if value.type == _VECTOR else 64}"
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [value])
