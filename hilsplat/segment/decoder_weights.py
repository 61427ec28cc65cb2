"""Read the mask decoder of an ONNX export: weights by module, and subgraphs."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float32

from cpusplat.lanes import WIDTH
from hilsplat.base.errors import ModelError
from hilsplat.models.network import Array
from hilsplat.models.onnx_graph import Graph
from hilsplat.segment import decoder_kernels as kernels

DEFAULT_EPS = 1e-5  # of ONNX's LayerNormalization


@dataclass(frozen=True)
class Linear:
    """A linear layer: weights (out, in) and bias (out)."""

    weight: Float32[Array, "o i"]
    bias: Float32[Array, " o"]

    @cached_property
    def _packed(self) -> tuple[np.ndarray, np.ndarray]:
        """Weights and bias in the layout of `decoder_kernels.linear`."""
        more = -len(self.bias) % WIDTH
        weight = np.pad(self.weight, ((0, more), (0, 0)))
        panels = weight.reshape(-1, WIDTH, weight.shape[1]).transpose(0, 2, 1)
        return np.ascontiguousarray(panels).reshape(-1), np.pad(self.bias, (0, more))

    def __call__(self, x: Float32[Array, "*n i"]) -> Float32[Array, "*n o"]:
        if not isinstance(x, np.ndarray):  # on a card
            from torch.nn.functional import linear

            return linear(x, self.weight, self.bias)
        panels, bias = self._packed
        rows = np.ascontiguousarray(x, np.float32).reshape(-1, x.shape[-1])
        products = np.empty((len(rows), len(bias)), np.float32)
        kernels.linear(rows.reshape(-1), panels, bias, *rows.shape, products.reshape(-1))
        return products[:, : len(self.bias)].reshape(*x.shape[:-1], -1)


@dataclass(frozen=True)
class Norm:
    """A layer norm over the last axis."""

    scale: Float32[Array, " c"]
    shift: Float32[Array, " c"]
    eps: float

    def __call__(self, x: Float32[Array, "*n c"]) -> Float32[Array, "*n c"]:
        if not isinstance(x, np.ndarray):  # on a card
            from torch.nn.functional import layer_norm

            return layer_norm(x, self.scale.shape, self.scale, self.shift, self.eps)
        x = x - x.mean(axis=-1, keepdims=True)
        variance = np.square(x).mean(axis=-1, keepdims=True)
        return x / np.sqrt(variance + np.float32(self.eps)) * self.scale + self.shift


@dataclass(frozen=True)
class Attention:
    """Projections of an attention block."""

    q: Linear
    k: Linear
    v: Linear
    out: Linear


class DecoderGraph:
    """Graph of a decoder exported from transformers; its nodes are named after the modules.

    Weights are found by the nodes that use them, because exporters rename weights and merge equal ones.

    Raises:
        ModelError: if the graph lacks expected nodes, or weights are not float32.
    """

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        model = graph.model.graph
        self._initializers = {tensor.name: tensor for tensor in model.initializer}
        self._nodes = {node.name: node for node in model.node}
        self._makers = {name: node for node in model.node for name in node.output}
        self._readers = {name: node for node in model.node for name in node.input}

    def linear(self, module: str) -> Linear:
        """Return a linear layer from the constants of its MatMul and Add nodes."""
        product = self._node(f"{module}/MatMul")
        total = self._readers.get(product.output[0])
        adds = [total] if total is not None and total.op_type == "Add" else []
        weight, bias = self._weights(module, 2, product, *adds)
        return Linear(np.ascontiguousarray(weight.T), bias)

    def attention(self, module: str) -> Attention:
        out = "out" if self._find(f"{module}/out_proj/MatMul") is not None else "o"  # SAM, SAM 2
        return Attention(*(self.linear(f"{module}/{part}_proj") for part in ("q", "k", "v", out)))

    def perceptron(self, module: str) -> list[Linear]:
        names = ["proj_in", *(f"layers.{number}" for number in range(8)), "proj_out", "lin1", "lin2"]
        layers = [f"{module}/{name}" for name in names if self._find(f"{module}/{name}/MatMul") is not None]
        if not layers:
            raise _unusual(f"it has no layers in {module}")
        return [self.linear(layer) for layer in layers]

    def norm(self, module: str) -> Norm:
        """Return a layer norm, which is one node since opset 17, or several nodes."""
        node = self._find(f"{module}/LayerNormalization")
        if node is not None:
            scale, shift = self._weights(module, 2, node)
            eps = next((entry.f for entry in node.attribute if entry.name == "epsilon"), DEFAULT_EPS)
            return Norm(scale, shift, eps)
        nodes = [self._node(f"{module}/{name}") for name in ("Mul", "Add_1", "Add")]
        scale, shift, addend = self._weights(module, 3, *nodes)
        return Norm(scale.reshape(-1), shift.reshape(-1), addend.item())

    def upscaling(self, module: str) -> tuple[Float32[np.ndarray, "i o 2 2"], Float32[np.ndarray, " o"]]:
        """Return weights and bias of a transposed convolution."""
        weight, bias = self._weights(module, 2, self._node(f"{module}/ConvTranspose"))
        return weight, bias

    def has_sigmoid(self, module: str) -> bool:
        return any(f"{module}/" in name and node.op_type == "Sigmoid" for name, node in self._nodes.items())

    def until(self, *modules: str) -> Graph:
        """Return the subgraph whose outputs are the inputs of the given modules."""
        return self._graph.reduced([self._node(f"{module}/MatMul").input[0] for module in modules])

    def _find(self, ending: str) -> Any:
        matches = [node for name, node in self._nodes.items() if name.endswith(f"/{ending}")]
        return matches[0] if len(matches) == 1 else None

    def _node(self, ending: str) -> Any:
        if (node := self._find(ending)) is None:
            raise _unusual(f"it has no node {ending}")
        return node

    def _weights(self, module: str, number: int, *nodes: Any) -> list[np.ndarray]:
        """Return the constant inputs of a module's nodes; there must be `number` in total."""
        names = [name for node in nodes for name in node.input]
        values = [value for name in names if (value := self._constant(name)) is not None]
        if len(values) != number:
            raise _unusual(f"{module} has no constant weights")
        return values

    def _constant(self, name: str) -> np.ndarray | None:
        """Return a weight, or None for a value that depends on an input; axes of length 1 may be missing."""
        from onnx import numpy_helper

        maker = self._makers.get(name)
        while maker is not None and maker.op_type in ("Identity", "Unsqueeze"):
            name = maker.input[0]
            maker = self._makers.get(name)
        if name in self._graph.weights:
            value: np.ndarray = self._graph.weights[name]
        elif name in self._initializers:
            value = numpy_helper.to_array(self._initializers[name])
        elif maker is not None and maker.op_type == "Constant" and maker.attribute[0].name == "value":
            value = numpy_helper.to_array(maker.attribute[0].t)
        else:
            return None
        if value.dtype != np.float32:
            raise _unusual(f"its weights are {value.dtype}")
        return np.asarray(value)


def _unusual(why: str) -> ModelError:
    return ModelError(f"the decoder cannot be factored: {why}")
