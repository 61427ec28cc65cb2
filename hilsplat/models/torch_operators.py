"""The ONNX operators of published and embedded exports, as functions of torch.

A function takes an operator's inputs and attributes (opset 13 or later) by ONNX's names and in its order. It
raises TypeError for an unknown attribute, and NotImplementedError for an unsupported value of one.
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


def require(condition: bool, what: str) -> None:
    if not condition:
        raise NotImplementedError(what)


def _constant(**value: Any) -> Tensor:
    ((name, content),) = value.items()
    require(name in ("value", "value_float", "value_floats", "value_int", "value_ints"), name)
    return content if isinstance(content, Tensor) else torch.tensor(content)


def _divide(a: Tensor, b: Tensor) -> Tensor:
    return a / b if a.is_floating_point() else torch.div(a, b, rounding_mode="trunc")


def _modulo(a: Tensor, b: Tensor, fmod: int = 0) -> Tensor:
    return torch.fmod(a, b) if fmod else torch.remainder(a, b)


def _cast(x: Tensor, to: int, saturate: int = 1) -> Tensor:
    require(to in DTYPES, f"type {to}")
    return x.to(DTYPES[to])


def _gemm(
    a: Tensor,
    b: Tensor,
    c: Tensor | None = None,
    alpha: float = 1,
    beta: float = 1,
    transA: int = 0,
    transB: int = 0,
) -> Tensor:
    product = alpha * ((a.T if transA else a) @ (b.T if transB else b))
    return product if c is None else product + beta * c


def _padded(x: Tensor, weight: Tensor, pads: Sequence[int], auto_pad: str) -> tuple[Tensor, list[int]]:
    """Return a convolution's input and the padding that the convolution itself adds at both ends."""
    axes = weight.ndim - 2
    require(auto_pad in ("NOTSET", "VALID"), f"auto_pad {auto_pad}")
    begin, end = (list(pads[:axes]), list(pads[axes:])) if pads else ([0] * axes, [0] * axes)
    if begin == end:
        return x, begin
    return _pad(x, [0, 0, *begin, 0, 0, *end]), [0] * axes


def _conv(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    kernel_shape: Sequence[int] = (),
    pads: Sequence[int] = (),
    strides: Sequence[int] | int = 1,
    dilations: Sequence[int] | int = 1,
    group: int = 1,
    auto_pad: str = "NOTSET",
) -> Tensor:
    function = (F.conv1d, F.conv2d, F.conv3d)[weight.ndim - 3]
    x, padding = _padded(x, weight, pads, auto_pad)
    return function(x, weight, bias, strides, padding, dilations, group)


def _conv_transpose(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    kernel_shape: Sequence[int] = (),
    pads: Sequence[int] = (),
    strides: Sequence[int] | int = 1,
    dilations: Sequence[int] | int = 1,
    output_padding: Sequence[int] | int = 0,
    group: int = 1,
    auto_pad: str = "NOTSET",
) -> Tensor:
    require(auto_pad == "NOTSET" and not any(pads), "pads")
    function = (F.conv_transpose1d, F.conv_transpose2d, F.conv_transpose3d)[weight.ndim - 3]
    return function(x, weight, bias, strides, 0, output_padding, group, dilations)


def _pool(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    def pooled(
        x: Tensor,
        kernel_shape: Sequence[int],
        pads: Sequence[int] = (0, 0, 0, 0),
        strides: Sequence[int] = (1, 1),
        dilations: Sequence[int] = (1, 1),
        ceil_mode: int = 0,
        count_include_pad: int = 0,
        storage_order: int = 0,
        auto_pad: str = "NOTSET",
    ) -> Tensor:
        require(x.ndim == 4 and tuple(dilations) == (1, 1), "another form")
        require(auto_pad in ("NOTSET", "VALID") and list(pads[:2]) == list(pads[2:]), "pads")
        more = {"count_include_pad": bool(count_include_pad)} if function is F.avg_pool2d else {}
        return function(
            x, tuple(kernel_shape), tuple(strides), tuple(pads[:2]), ceil_mode=bool(ceil_mode), **more
        )

    return pooled


def _pad(
    x: Tensor,
    pads: Sequence[int],
    value: float | None = None,
    axes: Sequence[int] | None = None,
    mode: str = "constant",
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
    x: Tensor,
    scale: Tensor,
    shift: Tensor | None = None,
    axis: int = -1,
    epsilon: float = 1e-5,
    stash_type: int = 1,
) -> Tensor:
    return F.layer_norm(x, x.shape[axis:], scale, shift, epsilon)


def _reduction(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    def reduced(
        x: Tensor,
        of: Sequence[int] | None = None,
        axes: Sequence[int] | None = None,  # an attribute before opset 18
        keepdims: int = 1,
        noop_with_empty_axes: int = 0,
    ) -> Tensor:
        axes = of or axes
        if not axes and noop_with_empty_axes:
            return x
        return function(x, dim=list(axes or range(x.ndim)), keepdim=bool(keepdims))

    return reduced


def _reshape(x: Tensor, shape: Sequence[int], allowzero: int = 0) -> Tensor:
    if allowzero:
        return x.reshape(list(shape))
    return x.reshape([length or x.shape[axis] for axis, length in enumerate(shape)])


def _transpose(x: Tensor, perm: Sequence[int] | None = None) -> Tensor:
    return x.permute(list(perm or reversed(range(x.ndim))))


def _squeeze(x: Tensor, axes: Sequence[int] | None = None) -> Tensor:
    return x.squeeze() if axes is None else x.squeeze(tuple(axes))


def _unsqueeze(x: Tensor, axes: Sequence[int]) -> Tensor:
    rank = x.ndim + len(axes)
    for axis in sorted(axis % rank for axis in axes):
        x = x.unsqueeze(axis)
    return x


def _flatten(x: Tensor, axis: int = 1) -> Tensor:
    return x.reshape(math.prod(x.shape[:axis]), -1)


def _split(
    x: Tensor, sizes: Sequence[int] | None = None, axis: int = 0, num_outputs: int = 0, outputs: int = 0
) -> tuple[Tensor, ...]:
    return x.split(list(sizes) if sizes else -(-x.shape[axis] // outputs), axis)


def _slice(
    x: Tensor,
    starts: Sequence[int],
    ends: Sequence[int],
    axes: Sequence[int] | None = None,
    steps: Sequence[int] | None = None,
) -> Tensor:
    axes, steps = axes or range(len(starts)), steps or [1] * len(starts)
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        rows = range(*slice(start, end, step).indices(x.shape[axis]))
        if step > 0:
            index = [slice(None)] * (axis % x.ndim) + [slice(rows.start, rows.stop, step)]
            x = x[tuple(index)]
        else:
            x = x.index_select(axis, torch.tensor(list(rows), device=x.device))
    return x


def _gather(x: Tensor, indices: Tensor, axis: int = 0) -> Tensor:
    axis %= x.ndim
    rows = torch.where(indices < 0, indices + x.shape[axis], indices).reshape(-1)
    shape = (*x.shape[:axis], *indices.shape, *x.shape[axis + 1 :])
    return x.index_select(axis, rows).reshape(shape)


def _gather_nd(x: Tensor, indices: Tensor, batch_dims: int = 0) -> Tensor:
    require(not batch_dims, "batch_dims")
    return x[indices.unbind(-1)]


def _scatter_nd(x: Tensor, indices: Tensor, updates: Tensor, reduction: str = "none") -> Tensor:
    require(reduction == "none", f"reduction {reduction}")
    return x.index_put(indices.unbind(-1), updates)


def _scatter(x: Tensor, indices: Tensor, updates: Tensor, axis: int = 0, reduction: str = "none") -> Tensor:
    require(reduction == "none", f"reduction {reduction}")
    return x.scatter(axis, indices, updates)


def _one_hot(indices: Tensor, depth: int | list[int], values: Tensor, axis: int = -1) -> Tensor:
    number = depth[0] if isinstance(depth, list) else depth
    rows = torch.arange(number, device=indices.device)
    hot = torch.where(indices.unsqueeze(-1) % number == rows, values[1], values[0])
    return hot.movedim(-1, axis)


def _constant_of_shape(shape: Sequence[int], value: Tensor | None = None) -> Tensor:
    return torch.zeros(list(shape)) if value is None else value.expand(list(shape))


def _expand(x: Tensor, shape: Sequence[int]) -> Tensor:
    return x.expand(torch.broadcast_shapes(x.shape, tuple(shape)))


def _argmax(x: Tensor, axis: int = 0, keepdims: int = 1, select_last_index: int = 0) -> Tensor:
    require(not select_last_index, "select_last_index")
    return x.argmax(axis, keepdim=bool(keepdims))


RESIZERS = {
    ("nearest", "asymmetric"): {3: "nearest", 4: "nearest"},
    ("linear", "half_pixel"): {3: "linear", 4: "bilinear"},
    ("linear", "pytorch_half_pixel"): {3: "linear", 4: "bilinear"},
    ("cubic", "half_pixel"): {4: "bicubic"},
    ("cubic", "pytorch_half_pixel"): {4: "bicubic"},
}
"""Mode and coordinates of Resize -> number of axes -> torch's mode."""


def _resize(
    x: Tensor,
    roi: Sequence[float] | None = None,
    scales: Sequence[float] | None = None,
    sizes: Sequence[int] | None = None,
    mode: str = "nearest",
    coordinate_transformation_mode: str = "half_pixel",
    nearest_mode: str = "round_prefer_floor",
    cubic_coeff_a: float = -0.75,
    exclude_outside: int = 0,
    antialias: int = 0,
    extrapolation_value: float = 0,
    keep_aspect_ratio_policy: str = "stretch",
) -> Tensor:
    form = RESIZERS.get((mode, coordinate_transformation_mode), {}).get(x.ndim, "")
    require(bool(form), f"{mode} with coordinates {coordinate_transformation_mode}")
    require(mode != "nearest" or nearest_mode == "floor", f"nearest_mode {nearest_mode}")
    require(cubic_coeff_a == -0.75 and not exclude_outside and not antialias, "the given filter")
    require(keep_aspect_ratio_policy == "stretch", keep_aspect_ratio_policy)
    if sizes:
        require(list(sizes[:2]) == list(x.shape[:2]), f"sizes {sizes}")
        return F.interpolate(x, size=list(sizes[2:]), mode=form)
    assert scales
    require(list(scales[:2]) == [1, 1], f"scales {scales}")
    return F.interpolate(x, scale_factor=list(scales[2:]), mode=form)


def _grid_sample(
    x: Tensor, grid: Tensor, mode: str = "linear", padding_mode: str = "zeros", align_corners: int = 0
) -> Tensor:
    mode = {"linear": "bilinear", "cubic": "bicubic"}.get(mode, mode)
    return F.grid_sample(x, grid, mode, padding_mode, bool(align_corners))


def _depth_to_space(x: Tensor, blocksize: int, mode: str = "DCR") -> Tensor:
    require(mode == "CRD", f"mode {mode}")
    return F.pixel_shuffle(x, blocksize)


OPERATORS: dict[str, Callable[..., Any]] = {
    "Add": lambda a, b: a + b,
    "And": torch.logical_and,
    "ArgMax": _argmax,
    "AveragePool": _pool(F.avg_pool2d),
    "Cast": _cast,
    "Clip": lambda x, low=None, high=None: x.clamp(low, high) if (low, high) != (None, None) else x,
    "Concat": lambda *parts, axis: torch.cat(parts, axis),
    "Constant": _constant,
    "ConstantOfShape": _constant_of_shape,
    "Conv": _conv,
    "ConvTranspose": _conv_transpose,
    "Cos": torch.cos,
    "DepthToSpace": _depth_to_space,
    "Div": _divide,
    "Einsum": lambda *parts, equation: torch.einsum(equation, *parts),
    "Equal": torch.eq,
    "Erf": torch.erf,
    "Exp": torch.exp,
    "Expand": _expand,
    "Flatten": _flatten,
    "Gather": _gather,
    "GatherND": _gather_nd,
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
    "Mod": _modulo,
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
    "ScatterElements": _scatter,
    "ScatterND": _scatter_nd,
    "Shape": lambda x, start=0, end=None: torch.tensor(x.shape[start:end]),
    "Sigmoid": torch.sigmoid,
    "Sin": torch.sin,
    "Size": lambda x: torch.tensor(x.numel()),
    "Slice": _slice,
    "Softmax": lambda x, axis=-1: torch.softmax(x, axis),
    "Split": _split,
    "Sqrt": torch.sqrt,
    "Squeeze": _squeeze,
    "Sub": lambda a, b: a - b,
    "Tanh": torch.tanh,
    "Tile": lambda x, repeats: x.repeat(repeats),
    "Transpose": _transpose,
    "Unsqueeze": _unsqueeze,
    "Where": torch.where,
}
