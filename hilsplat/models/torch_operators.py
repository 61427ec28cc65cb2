"""The ONNX operators of published and embedded exports, as functions of torch.

A function takes an operator's inputs in ONNX's order (opset 13 or later), and by name the attributes that
differ from ONNX's default. It raises TypeError for unknown attributes, and NotImplementedError for values.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

DTYPES = {
    1: torch.float32,
    6: torch.int32,
    7: torch.int64,
    9: torch.bool,
    10: torch.float16,
    11: torch.float64,
    16: torch.bfloat16,
}
"""Types by their number in ONNX."""

ON_HOST: dict[str, tuple[int, ...]] = {
    "Clip": (1, 2),
    "ConstantOfShape": (0,),
    "Expand": (1,),
    "NonZero": (0,),
    "OneHot": (1,),
    "Pad": (1, 2, 3),
    "Range": (0, 1, 2),
    "ReduceL2": (1,),
    "ReduceMax": (1,),
    "ReduceMean": (1,),
    "ReduceMin": (1,),
    "ReduceSum": (1,),
    "Reshape": (1,),
    "Resize": (1, 2, 3),
    "Slice": (1, 2, 3, 4),
    "Split": (1,),
    "Squeeze": (1,),
    "Tile": (1,),
    "Unsqueeze": (1,),
}
"""Positions of the inputs that are passed as numbers or lists: they determine the result's shape, or must not
depend on the network's inputs."""


Ints = Sequence[int]
Function = Callable[..., Any]


def require(condition: bool, what: str) -> None:
    if not condition:
        raise NotImplementedError(what)


def _constant(**value: Any) -> Tensor:
    ((name, content),) = value.items()
    require(name in ("value", "value_float", "value_floats", "value_int", "value_ints"), name)
    return content if isinstance(content, Tensor) else torch.tensor(content)


def _divide(a: Tensor, b: Tensor) -> Tensor:
    return a / b if a.is_floating_point() else torch.div(a, b, rounding_mode="trunc")


def _cast(x: Tensor, to: int) -> Tensor:
    require(to in DTYPES, f"type {to}")
    return x.to(DTYPES[to])


def _gemm(
    a: Tensor, b: Tensor, c: Tensor | float = 0, *, alpha: float = 1, beta: float = 1, **turned: int
) -> Tensor:
    require(turned.keys() <= {"transA", "transB"}, f"{turned}")
    a, b = (x.T if turned.get(name) else x for x, name in ((a, "transA"), (b, "transB")))
    return alpha * (a @ b) + beta * c


def _convolution(by_axes: dict[int, Function], transposed: bool = False) -> Function:
    def run(
        x: Tensor, weight: Tensor, bias: Tensor | None = None, *, kernel_shape: Ints = (), pads: Ints = (),
        strides: Ints | int = 1, dilations: Ints | int = 1, group: int = 1, auto_pad: str = "VALID",
        output_padding: Ints = (),
    ) -> Tensor:  # fmt: skip
        require(auto_pad == "VALID" and not (transposed and any(pads)), "pads")
        require(not any(output_padding), "output_padding")
        if any(pads):
            half = len(pads) // 2
            x = _pad(x, [0, 0, *pads[:half], 0, 0, *pads[half:]])
        if transposed:
            return by_axes[weight.ndim](x, weight, bias, strides, 0, 0, group, dilations)
        return by_axes[weight.ndim](x, weight, bias, strides, 0, dilations, group)

    return run


def _pool(function: Function) -> Function:
    def run(
        x: Tensor, kernel_shape: Ints, *, pads: Ints = (0,) * 4, strides: Ints = (1, 1), dilations: Ints = ()
    ) -> Tensor:
        require(x.ndim == 4 and list(pads[:2]) == list(pads[2:]), "pads")
        require({*dilations} <= {1}, "dilations")
        require(function is F.max_pool2d or not any(pads), "pads")
        return function(x, tuple(kernel_shape), tuple(strides), tuple(pads[:2]))

    return run


def _pad(
    x: Tensor, pads: Ints, value: float | None = None, axes: Ints | None = None, *, mode: str = "constant"
) -> Tensor:
    require(mode in ("constant", "edge", "reflect"), f"mode {mode}")
    axes = range(x.ndim) if axes is None else axes
    begin_and_end = zip(pads[: len(axes)], pads[len(axes) :], strict=True)
    by_axis = dict(zip([axis % x.ndim for axis in axes], begin_and_end, strict=True))
    ends = [end for axis in reversed(range(x.ndim)) for end in by_axis.get(axis, (0, 0))]
    if mode == "constant":
        return F.pad(x, ends, value=value or 0)
    while len(ends) > 2 and ends[-2:] == [0, 0]:  # torch refuses these modes for all axes
        ends = ends[:-2]
    return F.pad(x, ends, {"edge": "replicate"}.get(mode, mode))


def _layer_norm(
    x: Tensor, scale: Tensor, shift: Tensor | None = None, *, axis: int = -1, epsilon: float = 1e-5
) -> Tensor:
    return F.layer_norm(x, x.shape[axis:], scale, shift, epsilon)


def _reduction(function: Function) -> Function:
    # before opset 18, the axes are an attribute
    def run(x: Tensor, of: Ints | None = None, *, axes: Ints | None = None, keepdims: int = 1) -> Tensor:
        return function(x, dim=list(of or axes or range(x.ndim)), keepdim=bool(keepdims))

    return run


def _reshape(x: Tensor, shape: Ints, *, allowzero: int = 0) -> Tensor:
    return x.reshape([n if n or allowzero else x.shape[axis] for axis, n in enumerate(shape)])


def _unsqueeze(x: Tensor, axes: Ints) -> Tensor:
    rank = x.ndim + len(axes)
    for axis in sorted(axis % rank for axis in axes):
        x = x.unsqueeze(axis)
    return x


def _split(
    x: Tensor, sizes: Ints | None = None, *, axis: int = 0, num_outputs: int = 0, outputs: int = 1
) -> tuple[Tensor, ...]:
    return x.split(list(sizes) if sizes else -(-x.shape[axis] // outputs), axis)


def _slice(
    x: Tensor, starts: Ints, ends: Ints, axes: Ints | None = None, steps: Ints | None = None
) -> Tensor:
    axes, steps = axes or range(len(starts)), steps or [1] * len(starts)
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        rows = range(*slice(start, end, step).indices(x.shape[axis]))
        if step > 0:
            x = x[(slice(None),) * (axis % x.ndim) + (slice(rows.start, rows.stop, step),)]
        else:
            x = x.index_select(axis, torch.tensor(list(rows), device=x.device))
    return x


def _gather(x: Tensor, indices: Tensor, *, axis: int = 0) -> Tensor:
    axis %= x.ndim
    rows = torch.where(indices < 0, indices + x.shape[axis], indices).reshape(-1)
    return x.index_select(axis, rows).reshape(x.shape[:axis] + indices.shape + x.shape[axis + 1 :])


def _one_hot(indices: Tensor, depth: int | list[int], values: Tensor, *, axis: int = -1) -> Tensor:
    number = depth[0] if isinstance(depth, list) else depth
    rows, places = torch.arange(number, device=indices.device), indices.unsqueeze(-1)
    is_hot = (places == rows) | (places + number == rows)
    return torch.where(is_hot, values[1], values[0]).movedim(-1, axis)


def _constant_of_shape(shape: Ints, *, value: Tensor | None = None) -> Tensor:
    return torch.zeros(list(shape)) if value is None else value.expand(list(shape))


RESIZERS = {
    ("nearest", "asymmetric", "floor"): {3: "nearest", 4: "nearest"},
    ("linear", "half_pixel", ""): {3: "linear", 4: "bilinear"},
    ("linear", "pytorch_half_pixel", ""): {3: "linear", 4: "bilinear"},
    ("cubic", "half_pixel", ""): {4: "bicubic"},
    ("cubic", "pytorch_half_pixel", ""): {4: "bicubic"},
}
"""Mode, coordinates and rounding of Resize -> number of axes -> torch's mode."""


def _resize(
    x: Tensor, roi: Any = None, scales: Sequence[float] | None = None, sizes: Ints | None = None, *,
    mode: str = "nearest", coordinate_transformation_mode: str = "half_pixel", nearest_mode: str = "",
) -> Tensor:  # fmt: skip
    key = mode, coordinate_transformation_mode, nearest_mode if mode == "nearest" else ""
    form = RESIZERS.get(key, {}).get(x.ndim, "")
    require(bool(form), f"{' '.join(key)} of {x.ndim} axes")
    if sizes:
        require(list(sizes[:2]) == list(x.shape[:2]), f"sizes {sizes}")
        return F.interpolate(x, size=list(sizes[2:]), mode=form)
    assert scales
    require(list(scales[:2]) == [1, 1], f"scales {scales}")
    return F.interpolate(x, scale_factor=list(scales[2:]), mode=form)


def _grid_sample(
    x: Tensor, grid: Tensor, *, mode: str = "bilinear", padding_mode: str = "zeros", align_corners: int = 0
) -> Tensor:
    mode = {"linear": "bilinear", "cubic": "bicubic"}.get(mode, mode)
    return F.grid_sample(x, grid, mode, padding_mode, bool(align_corners))


def _depth_to_space(x: Tensor, blocksize: int, mode: str = "DCR") -> Tensor:
    require(mode == "CRD", f"mode {mode}")
    return F.pixel_shuffle(x, blocksize)


OPERATORS: dict[str, Function] = {
    "Add": lambda a, b: a + b,
    "And": torch.logical_and,
    "ArgMax": lambda x, *, axis=0, keepdims=1: x.argmax(axis, keepdim=bool(keepdims)),
    "AveragePool": _pool(F.avg_pool2d),
    "Cast": _cast,
    "Clip": lambda x, low=None, high=None: x.clamp(low, high) if (low, high) != (None, None) else x,
    "Concat": lambda *parts, axis: torch.cat(parts, axis),
    "Constant": _constant,
    "ConstantOfShape": _constant_of_shape,
    "Conv": _convolution({3: F.conv1d, 4: F.conv2d, 5: F.conv3d}),
    "ConvTranspose": _convolution({4: F.conv_transpose2d}, transposed=True),
    "Cos": torch.cos,
    "DepthToSpace": _depth_to_space,
    "Div": _divide,
    "Einsum": lambda *parts, equation: torch.einsum(equation, *parts),
    "Equal": torch.eq,
    "Erf": torch.erf,
    "Exp": torch.exp,
    "Expand": lambda x, shape: x.expand(torch.broadcast_shapes(x.shape, tuple(shape))),
    "Flatten": lambda x, *, axis=1: x.reshape(math.prod(x.shape[:axis]), -1),
    "Gather": _gather,
    "GatherND": lambda x, indices: x[indices.unbind(-1)],
    "Gelu": lambda x, approximate="none": F.gelu(x, approximate=approximate),
    "Gemm": _gemm,
    "Greater": torch.gt,
    "GreaterOrEqual": torch.ge,
    "GridSample": _grid_sample,
    "Identity": lambda x: x,
    "LayerNormalization": _layer_norm,
    "Less": torch.lt,
    "LessOrEqual": torch.le,
    "MatMul": torch.matmul,
    "MaxPool": _pool(F.max_pool2d),
    "Mod": torch.remainder,
    "Mul": lambda a, b: a * b,
    "Neg": torch.neg,
    "NonZero": lambda x: torch.tensor(x).nonzero().T,
    "Not": torch.logical_not,
    "OneHot": _one_hot,
    "Or": torch.logical_or,
    "Pad": _pad,
    "Pow": torch.pow,
    "Range": lambda start, limit, delta: torch.arange(start, limit, delta),
    "ReduceL2": _reduction(torch.linalg.vector_norm),
    "ReduceMax": _reduction(torch.amax),
    "ReduceMean": _reduction(torch.mean),
    "ReduceMin": _reduction(torch.amin),
    "ReduceSum": _reduction(torch.sum),
    "Relu": torch.relu,
    "Reshape": _reshape,
    "Resize": _resize,
    "ScatterElements": lambda x, indices, updates, *, axis=0: x.scatter(axis, indices, updates),
    "ScatterND": lambda x, indices, updates: x.index_put(indices.unbind(-1), updates),
    "Shape": lambda x, start=0, end=None: torch.tensor(x.shape[start:end], dtype=torch.int64),
    "Sigmoid": torch.sigmoid,
    "Sin": torch.sin,
    "Size": lambda x: torch.tensor(x.numel()),
    "Slice": _slice,
    "Softmax": lambda x, *, axis=-1: torch.softmax(x, axis),
    "Split": _split,
    "Sqrt": torch.sqrt,
    "Squeeze": lambda x, axes=None: x.squeeze() if axes is None else x.squeeze(tuple(axes)),
    "Sub": lambda a, b: a - b,
    "Tanh": torch.tanh,
    "Tile": lambda x, repeats: x.repeat(repeats),
    "Transpose": lambda x, *, perm=None: x.permute(list(perm or reversed(range(x.ndim)))),
    "Unsqueeze": _unsqueeze,
    "Where": torch.where,
}
