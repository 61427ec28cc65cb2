"""Read the mask decoder of an ONNX export: weights by module, and subgraphs."""

import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from hilsplat.base.errors import ModelError
from hilsplat.base.lanes import WIDTH
from hilsplat.models.onnx_graph import reduced
from hilsplat.segment import decoder_kernels as kernels

EPS = 1e-6
"""Epsilon of layer norms that the export splits into basic operators; the default of transformers."""


@dataclass(frozen=True)
class Linear:
    """A linear layer: weights (out, in) and bias (out)."""

    weight: Float32[np.ndarray, "o i"]
    bias: Float32[np.ndarray, " o"]

    @cached_property
    def _packed(self) -> tuple[np.ndarray, np.ndarray]:
        """Weights and bias in the layout of `decoder_kernels.linear`."""
        more = -len(self.bias) % WIDTH
        weight = np.pad(self.weight, ((0, more), (0, 0)))
        panels = weight.reshape(-1, WIDTH, weight.shape[1]).transpose(0, 2, 1)
        return np.ascontiguousarray(panels).reshape(-1), np.pad(self.bias, (0, more))

    def __call__(self, x: Float32[np.ndarray, "*n i"]) -> Float32[np.ndarray, "*n o"]:
        panels, bias = self._packed
        rows = np.ascontiguousarray(x, np.float32).reshape(-1, x.shape[-1])
        found = np.empty((len(rows), len(bias)), np.float32)
        kernels.linear(rows.reshape(-1), panels, bias, *rows.shape, found.reshape(-1))
        return found[:, : len(self.bias)].reshape(*x.shape[:-1], -1)


@dataclass(frozen=True)
class Norm:
    """A layer norm over the last axis."""

    scale: Float32[np.ndarray, " c"]
    shift: Float32[np.ndarray, " c"]
    eps: float

    def __call__(self, x: Float32[np.ndarray, "*n c"]) -> Float32[np.ndarray, "*n c"]:
        x = x - x.mean(axis=-1, keepdims=True)
        variance = np.square(x).mean(axis=-1, keepdims=True)
        return x / np.sqrt(variance + np.float32(self.eps)) * self.scale + self.shift


@dataclass(frozen=True)
class Attention:
    """The four projections of an attention block."""

    q: Linear
    k: Linear
    v: Linear
    out: Linear


class DecoderGraph:
    """Graph of a decoder exported from transformers; its nodes are named after the modules.

    Raises:
        ModelError: if the graph lacks expected nodes, or weights are not float32.
    """

    def __init__(self, path: Path) -> None:
        import onnx

        self.path = path
        self.model = onnx.load(str(path))
        graph = self.model.graph
        self._initializers = {each.name: each for each in graph.initializer}
        self._nodes = {node.name: node for node in graph.node}
        self._aliases = {node.output[0]: node.input[0] for node in graph.node if node.op_type == "Identity"}

    def linear(self, module: str) -> Linear:
        """Return a linear layer from the constants of its MatMul and Add nodes."""
        product, total = self._node(f"{module}/MatMul"), self._node(f"{module}/Add")
        (bias,) = [value for name in total.input if (value := self._constant(name)) is not None]
        weight = self._constant(product.input[1])
        if weight is None:
            raise self._unusual(f"{module} has no constant weights")
        return Linear(np.ascontiguousarray(weight.T), bias)

    def attention(self, module: str) -> Attention:
        out = "out" if self._find(f"{module}/out_proj/MatMul") is not None else "o"  # SAM, SAM 2
        return Attention(*(self.linear(f"{module}/{part}_proj") for part in ("q", "k", "v", out)))

    def perceptron(self, module: str) -> list[Linear]:
        """Return the linear layers of a perceptron, in order."""
        names = ["proj_in", *(f"layers.{number}" for number in range(8)), "proj_out", "lin1", "lin2"]
        found = [name for name in names if self._find(f"{module}/{name}/MatMul") is not None]
        if not found:
            raise self._unusual(f"it has no layers in {module}")
        return [self.linear(f"{module}/{name}") for name in found]

    def norm(self, module: str) -> Norm:
        node = self._find(f"{module}/LayerNormalization")
        eps = [each.f for each in node.attribute if each.name == "epsilon"] if node is not None else []
        scale, shift = (self.parameter(f"{module}/{name}") for name in ("weight", "bias"))
        return Norm(scale, shift, eps[0] if eps else EPS)

    def parameter(self, name: str) -> Float32[np.ndarray, "..."]:
        """Return a parameter that the export left unchanged; `name` is its path with slashes."""
        ending = name.replace("/", ".")
        found = [each for each in [*self._initializers, *self._aliases] if each.endswith(ending)]
        value = self._constant(found[0]) if found else None
        if value is None:
            raise self._unusual(f"it has no parameter {ending}")
        return value

    def has(self, module: str, operator: str) -> bool:
        """Return whether a module has a node of the given operator type."""
        return any(f"{module}/" in name and node.op_type == operator for name, node in self._nodes.items())

    def until(self, *modules: str) -> bytes:
        """Return the serialised subgraph whose outputs are the inputs of the given modules."""
        ends = [self._node(f"{module}/MatMul").input[0] for module in modules]
        return reduced(copy.deepcopy(self.model), ends)

    def _find(self, ending: str) -> Any:
        matches = [node for name, node in self._nodes.items() if name.endswith(f"/{ending}")]
        return matches[0] if len(matches) == 1 else None

    def _node(self, ending: str) -> Any:
        if (node := self._find(ending)) is None:
            raise self._unusual(f"it has no node {ending}")
        return node

    def _constant(self, name: str) -> np.ndarray | None:
        from onnx import numpy_helper

        found = self._initializers.get(self._aliases.get(name, name))
        if found is None:
            return None
        value = numpy_helper.to_array(found)
        if value.dtype != np.float32:
            raise self._unusual(f"its weights are {value.dtype}")
        return value

    def _unusual(self, why: str) -> ModelError:
        return ModelError(f"{self.path.name} cannot be factored: {why}")
