"""Operators and networks in torch give what onnxruntime gives."""

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx.parser import parse_model

from hilsplat.base.errors import ModelError
from hilsplat.models.folder import open_model_folder
from hilsplat.models.layouts import NetworkSpec
from hilsplat.models.network import one_thread_session
from hilsplat.models.repeatable import random_pixels
from hilsplat.models.torch_network import TorchNetwork
from tests.conftest import PROJECT

HERE = "cpu:0"  # the CPU as a device of torch; `cpu` means onnxruntime
TOLERANCE = 1e-5

BRANCHES = (
    "then_branch = g () => (float[] t) { t = Neg (x) }, else_branch = h () => (float[] e) { e = Exp (x) }"
)
GRAPHS = [
    "w = ConstantOfShape <value = float[1] {3}> (s) y = Conv <pads = [1, 0, 2, 1], strides = [2, 1]> (x, w)",
    "w = ConstantOfShape <value = float[1] {3}> (s) y = ConvTranspose <strides = [2, 2], "
    "output_padding = [0, 0]> (x, w)",
    "y = MaxPool <kernel_shape = [2, 2], strides = [2, 2], dilations = [1, 1]> (x)",
    "y = AveragePool <kernel_shape = [2, 3]> (x)",
    "y = LayerNormalization <axis = 2, epsilon = 1e-3> (x, half)",
    "y = Resize <mode = 'linear'> (x, , , sizes)",
    "y = Resize <mode = 'cubic', coordinate_transformation_mode = 'half_pixel'> (x, , scales)",
    "y = Resize <mode = 'nearest', coordinate_transformation_mode = 'asymmetric', nearest_mode = 'floor'> "
    "(x, , scales)",
    "y = Slice (x, starts, ends, axes, steps)",
    "y = Pad <mode = 'reflect'> (x, pads)",
    "y = Pad <mode = 'edge'> (x, pads)",
    "y = Pad (x, pads, three)",
    "a, b, c = Split <axis = 1, num_outputs = 3> (x) y = Concat <axis = -1> (c, a, b)",
    "i = ArgMax <axis = 3, keepdims = 0> (x) y = Gather <axis = 1> (x, minus)",
    "i = ArgMax <axis = 2> (x) z = Cast <to = 1> (i) y = Mul (z, x)",
    "a = Transpose <perm = [0, 2, 3, 1]> (x) y = MatMul (a, square)",
    "a = Flatten <axis = 2> (x) y = Gemm <alpha = 0.5, transB = 1> (a, a)",
    "y = Einsum <equation = 'abij,acij->abc'> (x, x)",
    "a = ReduceMean <keepdims = 0> (x, axes) b = ReduceL2 (x) c = ReduceMax (x, axes) "
    "d = Add (a, b) y = Add (c, d)",
    "a = Tile (x, tiles) b = Shape <start = 2> (a) c = Cast <to = 1> (b) d = ReduceSum (c) y = Div (a, d)",
    "a = Greater (x, half0) b = Cast <to = 7> (a) c = Mod (b, two) d = Cast <to = 1> (c) y = Where (a, d, x)",
    "a = Relu (x) b = Sqrt (a) c = Erf (b) d = Tanh (c) e = Exp (d) f = Pow (e, three) "
    "g = Sigmoid (f) y = Clip (g, half0)",
    "a = Reshape <allowzero = 0> (x, rows) b = Unsqueeze (a, outer) c = Squeeze (b, outer) y = Softmax (c)",
    "n = NonZero (tiles) s2 = Shape (n) z = Cast <to = 1> (s2) t = ReduceSum (z) y = Mul (x, t)",
    f"c = Equal (two, two) d = Squeeze (c) y = If <{BRANCHES}> (d)",
    "o = OneHot <axis = 1> (minus, four, zero_one) p = ReduceSum (o) y = Add (x, p)",
    "o = OneHot (index, four, zero_one) p = ReduceSum (o) y = Add (x, p)",  # 4 is out of range
    "i = ScatterElements <axis = 3> (x, index, updates) y = Add (i, x)",
    "a = Shape (three) b = Concat <axis = 0> (a, tiles) y = Tile (x, b)",  # a number has no axes
    "d = ScatterND (x, at, rows3) g = GatherND (d, at) r = ReduceSum (g) y = Add (d, r)",
    "y = DepthToSpace <blocksize = 2, mode = 'CRD'> (four_deep)",
    "y = GridSample <padding_mode = 'border'> (x, grid)",
]
CONSTANTS = """
    s = Constant <value = int64[4] {3, 3, 2, 2}> ()
    half = Constant <value = float[2,5] {0.5, 1, 2, 3, 4, 0.5, 1, 2, 3, 4}> ()
    sizes = Constant <value = int64[4] {2, 3, 7, 9}> ()
    scales = Constant <value = float[4] {1, 1, 2, 1.5}> ()
    starts = Constant <value = int64[2] {-1, 1}> ()
    ends = Constant <value = int64[2] {-100, 100}> ()
    axes = Constant <value = int64[2] {3, 1}> ()
    steps = Constant <value = int64[2] {-2, 1}> ()
    pads = Constant <value = int64[8] {0, 0, 1, 2, 0, 0, 1, 0}> ()
    three = Constant <value_float = 3.0> ()
    half0 = Constant <value_float = 0.5> ()
    minus = Constant <value = int64[2] {-1, 0}> ()
    two = Constant <value = int64[1] {2}> ()
    four = Constant <value = int64 {4}> ()
    zero_one = Constant <value = float[2] {0, 1}> ()
    tiles = Constant <value = int64[4] {1, 2, 1, 3}> ()
    rows = Constant <value = int64[3] {0, -1, 5}> ()
    outer = Constant <value = int64[2] {0, -1}> ()
    square = Constant <value = float[3,2] {1, 2, 3, 4, 5, 6}> ()
    index = Constant <value = int64[1,1,1,2] {4, 0}> ()
    updates = Constant <value = float[1,1,1,2] {7, 8}> ()
    at = Constant <value = int64[2,3] {0, 1, 1, 1, 2, 0}> ()
    rows3 = Constant <value = float[2,5] {1, 2, 3, 4, 5, 6, 7, 8, 9, 10}> ()
    deep = Constant <value = int64[4] {1, 4, 3, 5}> ()
    four_deep = Reshape (x, deep)
    grid = Constant <value = float[2,1,2,2] {0.1, -0.7, 1.4, 0, -1, 1, 0.3, 0.2}> ()
"""


def graph(text: str, folder: Path, opset: int = 18) -> Path:
    """Write a network that computes y from x (2, 3, 2, 5)."""
    quoted = (CONSTANTS + text).replace("'", '"')
    opsets = f'["" : {opset}, "com.other" : 1]'
    model = parse_model(
        f"<ir_version: 8, opset_import: {opsets}> net (float[2,3,2,5] x) => (float[] y) {{{quoted}}}"
    )
    model.graph.output[0].type.tensor_type.ClearField("shape")
    onnx.save(model, folder / "net.onnx")
    return folder / "net.onnx"


def opened(path: Path) -> TorchNetwork:
    return TorchNetwork(path, NetworkSpec({"x": (None,) * 4}, {}), device=HERE)


@pytest.mark.parametrize("text", GRAPHS, ids=lambda text: text[:40])
def test_operators(tmp_path, text):
    path = graph(text, tmp_path)
    x = np.random.default_rng(0).standard_normal((2, 3, 2, 5), np.float32)
    (expected,) = one_thread_session(path).run(None, {"x": x})
    network = opened(path)
    for _ in range(2):  # the second call repeats the steps of the first
        (found,) = network.values({"x": x}, ["y"])
        np.testing.assert_allclose(found, expected, atol=TOLERANCE, rtol=TOLERANCE)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("y = Selu (x)", "the operator Selu is not implemented in torch"),
        ("y = com.other.Add (x, x)", "the operator com.other.Add is not implemented"),
        (
            "y = AveragePool <kernel_shape = [2, 2], pads = [0, 0, 1, 1]> (x)",
            "AveragePool in an unknown form",
        ),
        ("y = Resize <mode = 'nearest'> (x, , scales)", "nearest half_pixel"),
        ("y = ArgMax <axis = 1, select_last_index = 1> (x)", "ArgMax in an unknown form"),
        ("n = NonZero (x) y = Cast <to = 1> (n)", "NonZero depends on values of its inputs"),
        (
            f"r = ReduceMax <keepdims = 0> (x) c = Greater (r, three) y = If <{BRANCHES}> (c)",
            "If depends on values of its inputs",
        ),
    ],
)
def test_unknown_operators_and_forms_are_refused_with_the_way_out(tmp_path, text, words):
    x = np.ones((2, 3, 2, 5), np.float32)
    with pytest.raises(ModelError, match=rf"cannot run on a GPU: .*{words}(.|\n)*device: cpu"):
        opened(graph(text, tmp_path)).values({"x": x}, ["y"])


def test_old_opsets_are_refused(tmp_path):
    with pytest.raises(ModelError, match=r"opset 12 is older than 13(.|\n)*device: cpu"):
        opened(graph("y = Relu (x)", tmp_path, opset=12))


def test_inputs_of_a_wrong_shape_name_the_network(tmp_path):
    path = graph("y = MatMul (x, square)", tmp_path)
    with pytest.raises(ModelError, match=r"net.onnx failed(.|\n)*x \(2, 3, 2, 5\)"):
        opened(path).values({"x": np.ones((2, 3, 2, 5), np.float32)}, ["y"])


def test_networks_in_half_precision_are_close():
    network = open_model_folder(PROJECT / "models/clip-tiny").network("vision_model", device=HERE)
    pixels = random_pixels(network, 64)
    (full,) = network(**pixels)
    halved = network.in_half()
    (half,) = halved(**pixels)
    np.testing.assert_array_equal(halved(**pixels)[0], half)
    assert 0 < np.abs(half - full).max() < 0.01 * np.abs(full).max()
    np.testing.assert_array_equal(network(**pixels)[0], full)
