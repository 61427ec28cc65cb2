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
_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
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
        self.vector = ir.VectorType(_FLOAT if dtype == types.float32 else ir.DoubleType(), width)
        super().__init__(name=f"Lanes{width}({dtype})")


LANES = LanesType(types.float32)
WIDE = LanesType(types.float64)
QUAD = LanesType(types.float32, 4)
"""Four lanes, for rows of a few numbers: `quad`, `load_quad`, `store`, `plus` and `signs_of_difference`."""
_OF = {types.float32: LANES, types.float64: WIDE}


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


def _constant(value: float | int, kind: ir.VectorType = _VECTOR) -> ir.Constant:
    return ir.Constant(kind, [ir.Constant(kind.element, value)] * WIDTH)


def splat(builder: ir.IRBuilder, scalar: ir.Value, count: int = WIDTH) -> ir.Value:
    """Return a vector whose elements all equal a scalar."""
    undefined = ir.Constant(ir.VectorType(scalar.type, count), ir.Undefined)
    one = builder.insert_element(undefined, scalar, ir.Constant(_INT, 0))
    return builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(_INT, count), [0] * count))


def _pointer(
    context: Any, builder: ir.IRBuilder, array_type: Any, array: ir.Value, index: ir.Value, kind: Any
) -> ir.Value:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), kind.vector.as_pointer())


def _load(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> ir.Value:
    address = _pointer(context, builder, sig.args[0], args[0], args[1], sig.return_type)
    return builder.load(address, align=sig.args[0].dtype.bitwidth // 8)


def _is_flat(array: Any) -> bool:
    return isinstance(array, types.Array) and array.dtype in _OF and array.ndim == 1


@compiled
@no_type_check
def aligned(count):
    """Allocate a float32 array that starts at a cache line, so that no vector spans two lines."""
    room = np.empty(count + WIDTH, np.float32)
    skip = (-(room.ctypes.data // 4)) % WIDTH
    return room[skip : skip + count]


def _operation(result: types.Type, *kinds: types.Type) -> Any:
    """Make an intrinsic for operands of these types from a function of the IR builder and their values."""

    def decorate(emit: Any) -> Any:
        @functools.wraps(emit)
        def typed(typingctx, *operands):
            return result(*kinds), lambda context, builder, sig, args: emit(builder, *args)

        return intrinsic(typed)

    return decorate


@_operation(LANES, types.float32)
def lanes(builder, scalar):
    """Return lanes that all contain the same float32 number."""
    return splat(builder, scalar)


@_operation(QUAD, types.float32)
def quad(builder, scalar):
    """Return four lanes that all contain the same float32 number."""
    return splat(builder, scalar, 4)


@intrinsic
def load(typingctx, array, index):
    """Load 16 consecutive numbers from a flat float32 or float64 array."""
    return (_OF[array.dtype](array, types.intp), _load) if _is_flat(array) else None


@intrinsic
def load_quad(typingctx, array, index):
    """Load four consecutive numbers from a flat float32 array."""
    return QUAD(array, types.intp), _load


@intrinsic
def load_same(typingctx, array, index):
    """Load one element of a flat array into all lanes; the index must not be negative."""
    if not _is_flat(array):
        return None

    def codegen(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return splat(builder, builder.load(builder.gep(data, [args[1]])))

    return _OF[array.dtype](array, types.intp), codegen


@intrinsic
def store(typingctx, array, index, value):
    """Store the lanes as consecutive numbers of a flat array of the same type."""
    if not (_is_flat(array) and isinstance(value, LanesType) and value.dtype == array.dtype):
        return None

    def codegen(context, builder, sig, args):
        address = _pointer(context, builder, sig.args[0], args[0], args[1], value)
        builder.store(args[2], address, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


@intrinsic
def plus(typingctx, total, scales, values):
    """Return total + scales * values; each product is rounded before it is added, as in plain loops."""

    def codegen(context, builder, sig, args):
        return builder.fadd(args[0], builder.fmul(args[1], args[2]))  # without flags, so never fused

    return total(total, total, total), codegen


@_operation(QUAD, QUAD, QUAD, types.float32)
def signs_of_difference(builder, a, b, scale):
    """Return scale where a > b, -scale where a < b, and 0 where a == b; NaN is preserved."""
    zeros = ir.Constant(QUAD.vector, None)
    apart, up = builder.fsub(a, b), splat(builder, scale, 4)
    above = builder.fcmp_ordered(">", apart, zeros)
    below = builder.fcmp_ordered("<", apart, zeros)
    return builder.select(above, up, builder.select(below, builder.fneg(up), apart))


@intrinsic
def add_products(typingctx, sums, at, a, b, c, scale):
    """Add scale * (a, b, c, 0) to four float64 sums from index `at`, as one vector and never fused.

    Returns the previous value of the first sum.
    """

    def codegen(context, builder, sig, args):
        number, lane = ir.DoubleType(), ir.IntType(32)
        four = ir.VectorType(number, 4)
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        address = builder.bitcast(builder.gep(data, [args[1]]), four.as_pointer())
        weights = ir.Constant(four, [ir.Constant(number, 0.0)] * 4)
        for index, value in enumerate(args[2:5]):
            weights = builder.insert_element(weights, value, ir.Constant(lane, index))
        before = builder.load(address, align=8)
        products = builder.fmul(weights, splat(builder, args[5], 4))
        builder.store(builder.fadd(before, products), address, align=8)
        return builder.extract_element(before, ir.Constant(lane, 0))

    return types.float64(sums, types.intp, *[types.float64] * 4), codegen


@_operation(WIDE, LANES)
def wide(builder, value):
    """Convert the lanes to float64."""
    return builder.fpext(value, WIDE.vector)


@_operation(LANES, WIDE)
def narrow(builder, value):
    """Round the lanes to float32."""
    return builder.fptrunc(value, LANES.vector)


@_operation(LANES, LANES)
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


def _select(condition: str, doc: str) -> Any:
    def keep(typingctx, left, right, value):
        if not (isinstance(value, LanesType) and left == right == value):
            return None

        def codegen(context, builder, sig, args):
            mask = builder.fcmp_ordered(condition, args[0], args[1])
            return builder.select(mask, args[2], ir.Constant(value.vector, None))

        return value(left, right, value), codegen

    keep.__doc__ = doc
    return intrinsic(keep)


keep_ge = _select(">=", "Lanes of `value` where left >= right, 0 elsewhere.")
keep_gt = _select(">", "Lanes of `value` where left > right, 0 elsewhere.")
keep_lt = _select("<", "Lanes of `value` where left < right, 0 elsewhere.")


def _pick(condition: str, doc: str) -> Any:
    def pick(typingctx, left, right):
        if not (isinstance(left, LanesType) and left == right):
            return None

        return left(left, right), lambda context, builder, sig, args: _chosen(builder, condition, *args)

    pick.__doc__ = doc
    return intrinsic(pick)


def _chosen(builder: ir.IRBuilder, condition: str, left: ir.Value, right: ir.Value) -> ir.Value:
    return builder.select(builder.fcmp_ordered(condition, left, right), left, right)


smaller = _pick("<", "Lane-wise minimum.")
larger = _pick(">", "Lane-wise maximum.")


@_operation(types.boolean, LANES, LANES)
def any_ge(builder, left, right):
    """Return whether left >= right in any lane."""
    mask = builder.bitcast(builder.fcmp_ordered(">=", left, right), ir.IntType(WIDTH))
    return builder.icmp_unsigned("!=", mask, ir.Constant(ir.IntType(WIDTH), 0))


@_operation(types.int64, LANES, LANES)
def bits_ge(builder, left, right):
    """Return a bit mask in which bit k is 0 if left < right in lane k, else 1 (also if either is NaN)."""
    mask = builder.bitcast(builder.fcmp_unordered(">=", left, right), ir.IntType(WIDTH))
    return builder.zext(mask, ir.IntType(64))


@intrinsic
def prefetch(typingctx, array, index):
    """Start loading the cache line of an array element; the index may be outside the array."""

    def codegen(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        byte = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, _INT, _INT, _INT])
        fetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        address = builder.bitcast(builder.gep(data, [args[1]]), byte)
        builder.call(fetch, [address, *(ir.Constant(_INT, flag) for flag in (0, 3, 1))])
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen


@intrinsic
def column_bits(typingctx, words, index, bit):
    """Collect bit `bit` of words[index + k] as bit k of the result, for 64 words of a flat uint16 array."""
    count = 64

    def codegen(context, builder, sig, args):
        kind = ir.VectorType(ir.IntType(16), count)
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        held = builder.load(builder.bitcast(builder.gep(data, [args[1]]), kind.as_pointer()), align=2)
        one = builder.shl(ir.Constant(ir.IntType(16), 1), builder.trunc(args[2], ir.IntType(16)))
        tested = builder.and_(held, splat(builder, one, count))
        mask = builder.icmp_unsigned("!=", tested, ir.Constant(kind, None))
        return builder.bitcast(mask, ir.IntType(count))

    return types.int64(words, types.intp, types.intp), codegen


@_operation(types.int64, types.int64)
def first_bit(builder, bits):
    """Return the index of the lowest set bit; `bits` must not be 0."""
    return builder.cttz(bits, ir.Constant(ir.IntType(1), 1))


@intrinsic
def store_sums(typingctx, array, index, vectors):
    """Store the lane sums of up to 16 vectors (a tuple) at consecutive indices.

    Each step merges pairs of vectors and halves the number of lanes per partial sum. This takes half as many
    instructions as a `lane_sum` of each vector.
    """
    if not isinstance(vectors, types.UniTuple) or vectors.dtype != LANES or not 2 <= len(vectors) <= WIDTH:
        return None
    count = len(vectors)

    def codegen(context, builder, sig, args):
        nothing = ir.Constant(_VECTOR, ir.Undefined)
        # each vector, with the number of the input vector that each lane belongs to
        held = [(cgutils.unpack_tuple(builder, args[2])[k], [k] * WIDTH) for k in range(count)]
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
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], LANES)
        bits = ir.VectorType(ir.IntType(1), WIDTH)
        mask = ir.Constant(bits, [ir.Constant(bits.element, int(k < count)) for k in range(WIDTH)])
        kind = ir.FunctionType(ir.VoidType(), [_VECTOR, _VECTOR.as_pointer(), _INT, bits])
        write = cgutils.get_or_insert_function(builder.module, kind, _MASKED_STORE)
        builder.call(write, [total, pointer, ir.Constant(_INT, 4), mask])
        return context.get_dummy_value()

    return types.void(array, types.intp, vectors), codegen


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


@_operation(types.float32, LANES)
def lane_sum(builder, value):
    return _halved(builder, value, builder.fadd)


@_operation(types.float32, LANES)
def lane_max(builder, value):
    return _halved(builder, value, lambda low, high: _chosen(builder, ">", low, high))


@intrinsic
def transpose(typingctx, source, source_index, source_step, target, target_index, target_step):
    """Transpose a 16 x 16 block while copying it between flat float32 arrays.

    Each array is followed by the index of the block's first element and the step between rows.
    """

    def codegen(context, builder, sig, args):
        def place(array, index, step, row):
            row_index = builder.add(args[index], builder.mul(args[step], ir.Constant(args[step].type, row)))
            return _pointer(context, builder, sig.args[array], args[array], row_index, LANES)

        rows = [builder.load(place(0, 1, 2, r), align=4) for r in range(WIDTH)]
        for bit in (1, 2, 4, 8):  # exchange the off-diagonal blocks of each size
            for r in range(WIDTH):
                if not r & bit:
                    one, other = rows[r], rows[r | bit]
                    low = [k if not k & bit else WIDTH + (k ^ bit) for k in range(WIDTH)]
                    high = [k | bit if not k & bit else WIDTH + k for k in range(WIDTH)]
                    rows[r] = builder.shuffle_vector(one, other, ir.Constant(_INTS, low))
                    rows[r | bit] = builder.shuffle_vector(one, other, ir.Constant(_INTS, high))
        for r in range(WIDTH):
            builder.store(rows[r], place(3, 4, 5, r), align=4)
        return context.get_dummy_value()

    return types.void(source, types.intp, types.intp, target, types.intp, types.intp), codegen


@_operation(LANES, LANES)
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


@intrinsic
def root(typingctx, value):
    """Compute the square root of every lane."""

    def codegen(context, builder, sig, args):
        kind = ir.FunctionType(value.vector, [value.vector])
        name = f"llvm.sqrt.v{WIDTH}f{value.dtype.bitwidth}"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)

    return value(value), codegen
