"""Four float32 channels of a Gaussian as one numba value, for loops over the entries of a sparse matrix.

`hilsplat.base.lanes` has sixteen lanes; codes of three channels would waste thirteen. Operations are
neither fused nor reordered, so results are bit-identical to plain loops over the channels.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, register_model

WIDTH = 4
_FLOAT = ir.FloatType()
_VECTOR = ir.VectorType(_FLOAT, WIDTH)
_ZEROS = ir.Constant(_VECTOR, [ir.Constant(_FLOAT, 0.0)] * WIDTH)


class QuadType(types.Type):
    """numba type of four float32 values."""

    def __init__(self) -> None:
        super().__init__(name="Quad")


QUAD = QuadType()


@register_model(QuadType)
class _QuadModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _VECTOR.as_pointer())


def _all(builder: Any, scalar: Any) -> Any:
    vector = ir.Constant(_VECTOR, ir.Undefined)
    for lane in range(WIDTH):
        vector = builder.insert_element(vector, scalar, ir.Constant(ir.IntType(32), lane))
    return vector


@intrinsic
def load(typingctx, array, index):
    """Return four consecutive numbers of a flat float32 array."""

    def codegen(context, builder, sig, args):
        return builder.load(_pointer(context, builder, sig.args[0], *args), align=4)

    return QUAD(array, types.intp), codegen


@intrinsic
def store(typingctx, array, index, value):
    """Write four consecutive numbers of a flat float32 array."""

    def codegen(context, builder, sig, args):
        builder.store(args[2], _pointer(context, builder, sig.args[0], args[0], args[1]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, QUAD), codegen


@intrinsic
def plus(typingctx, total, scale, row):
    """Return total + scale * row; each product is rounded before the addition."""

    def codegen(context, builder, sig, args):
        return builder.fadd(args[0], builder.fmul(_all(builder, args[1]), args[2]))

    return QUAD(QUAD, types.float32, QUAD), codegen


@intrinsic
def zeros(typingctx):
    """Return four zeros."""
    return QUAD(), lambda context, builder, sig, args: _ZEROS


@intrinsic
def signs_of_difference(typingctx, a, b, scale):
    """Return scale where a > b, -scale where a < b, 0 where they are equal; NaN is kept."""

    def codegen(context, builder, sig, args):
        apart, up = builder.fsub(args[0], args[1]), _all(builder, args[2])
        above = builder.fcmp_ordered(">", apart, _ZEROS)
        below = builder.fcmp_ordered("<", apart, _ZEROS)
        return builder.select(above, up, builder.select(below, builder.fneg(up), apart))

    return QUAD(QUAD, QUAD, types.float32), codegen
