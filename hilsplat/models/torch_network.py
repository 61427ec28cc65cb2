"""ONNX networks in torch, for NVIDIA cards: the same files as in onnxruntime, equal results up to rounding.

A network's first call with inputs of given shapes computes everything that depends only on weights and shapes
on the host, such as the arithmetic with which exporters compute the arguments of `Reshape`. The result is a
list of torch calls, which later calls repeat without waiting for the card.
"""

import copy
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from torch import Tensor

from hilsplat.base.errors import HilsplatError, ModelError, first_line
from hilsplat.models.card import is_out_of_memory
from hilsplat.models.network import DTYPES, Declared, Network
from hilsplat.models.onnx_graph import Graph, inputs_of
from hilsplat.models.torch_operators import ON_HOST, OPERATORS

MIN_OPSET = 13  # earlier versions define Softmax differently
PLANS = 16  # maximum number of input shapes for which a network keeps its list of calls


class Name(str):
    """Name of a value that depends on the network's inputs."""


@dataclass(frozen=True)
class Step:
    """A call of an operator."""

    operator: str
    arguments: list[Any]
    attributes: dict[str, Any]
    outputs: list[str]
    last_used: list[str]  # values that no later step reads

    def run(self, values: dict[str, Tensor]) -> Any:
        given = [values[argument] if isinstance(argument, Name) else argument for argument in self.arguments]
        return OPERATORS[self.operator](*given, **self.attributes)


class Constants(dict[str, Tensor]):
    """Values that don't depend on the network's inputs, on the host; weights are converted when read."""

    def __init__(self, graph: Graph) -> None:
        super().__init__()
        self._weights = graph.weights
        self.initializers = {tensor.name: tensor for tensor in graph.model.graph.initializer}

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or name in self.initializers

    def __missing__(self, name: str) -> Tensor:
        if name in self._weights:
            return torch.from_numpy(np.array(self._weights[name]))  # torch warns about read-only arrays
        return host_tensor(self.initializers[name])


class TorchNetwork(Network):
    """A `Network` in torch; several threads must not call it at once.

    Args:
        network: arguments of `Network`.
        device: torch device, such as "cuda".
    """

    half = False  # see `in_half`

    def __init__(self, *network: Any, device: str) -> None:
        self.device = torch.device(device)
        self._plans: dict[tuple[Any, ...], list[Step]] = {}
        self._uploaded: dict[str, Tensor] = {}
        super().__init__(*network)
        self.version = torch.__version__
        self.runs_on = ["torch", self.device.type]

    def _open(self, source: Graph | Path) -> None:
        self._graph = source if isinstance(source, Graph) else Graph.read(source)
        graph = self._graph.model.graph
        self._opset = opset = max(
            entry.version for entry in self._graph.model.opset_import if not entry.domain
        )
        if opset < MIN_OPSET:
            raise self._refused(f"its opset {opset} is older than {MIN_OPSET}")
        constants = {tensor.name for tensor in graph.initializer}
        inputs, outputs = map(
            _declared,
            ([declared for declared in graph.input if declared.name not in constants], graph.output),
        )
        self.inputs, self.outputs = inputs, outputs

    def run(self, **feeds: np.ndarray | Tensor) -> list[Tensor]:
        """Run the network as `__call__` does, but leave the outputs on the device."""
        return self._with_right_axes(self.values(feeds, list(self.spec.outputs)))

    def values(self, feeds: Mapping[str, np.ndarray | Tensor], names: Sequence[str]) -> list[Tensor]:
        """Return outputs of the network, float32 on the device."""
        given = {
            name: tensor_of(value, DTYPES[self.inputs[name].type]).to(self.device)
            for name, value in feeds.items()
            if name in self.inputs
        }
        shapes = tuple((name, *value.shape) for name, value in given.items())
        try:
            with torch.inference_mode(), torch.autocast(self.device.type, torch.float16, self.half):
                if shapes in self._plans:
                    values = _repeat(self._plans[shapes], dict(given))
                else:
                    self._plans[shapes], values = self._first_call(dict(given))
                    if len(self._plans) > PLANS:
                        del self._plans[next(iter(self._plans))]
                return [values[name].float() for name in names]
        except Exception as error:  # torch raises many types
            if isinstance(error, HilsplatError) or is_out_of_memory(error):
                raise
            raise self._failed(error, given) from error

    def in_half(self) -> "TorchNetwork":
        """Return a network with the same weights whose products are float16, as in torch's autocast."""
        other = copy.copy(self)
        other.half, other._plans, other.runs_on = True, {}, [*self.runs_on, "half"]
        return other

    def __call__(self, **feeds: np.ndarray | Tensor) -> list[np.ndarray]:
        return [output.cpu().numpy() for output in self.run(**feeds)]

    def _refused(self, why: str) -> ModelError:
        fix = "run it on the CPU (device: cpu), or use another export of the model"
        return ModelError(f"network {self.path} cannot run on a GPU: {why}", fix=fix)

    def _first_call(self, values: dict[str, Tensor]) -> tuple[list[Step], dict[str, Tensor]]:
        """Run the network on the inputs in `values`; return the steps for inputs of these shapes, and values.

        Only the outputs remain in `values`.
        """
        graph, known, steps = self._graph.model.graph, Constants(self._graph), list[Step]()
        final = {value.name for value in graph.output}
        uses = Counter(name for node in graph.node for name in inputs_of(node))
        nodes = deque(graph.node)
        while nodes:
            node = nodes.popleft()
            if node.op_type == "If":
                chosen = self._branch(node, known)
                uses.subtract(inputs_of(node))
                uses.update(name for chosen_node in chosen for name in inputs_of(chosen_node))
                nodes.extendleft(reversed(chosen))
                continue
            # the result is known if the inputs are, or if it depends only on their shapes
            is_known = node.op_type in ("Shape", "Size") or not any(name in values for name in node.input)
            step = self._step(node, known, values, is_known)
            try:
                with torch.autocast(self.device.type, torch.float16, self.half and not is_known):
                    outputs = step.run(values)
            except (TypeError, NotImplementedError) as error:
                raise self._refused(f"{node.op_type} in an unknown form ({first_line(error)})") from error
            outputs = outputs if isinstance(outputs, tuple | list) else [outputs]
            (known if is_known else values).update(zip(step.outputs, outputs, strict=True))
            uses.subtract(inputs_of(node))
            step.last_used.extend(
                name
                for name in {*node.input, *node.output}
                if name in values and uses[name] <= 0 and name not in final
            )
            for name in step.last_used:
                del values[name]
            if not is_known:
                steps.append(step)
            elif step.last_used and steps:
                steps[-1].last_used.extend(step.last_used)
        for name in sorted(final - values.keys()):
            values[name] = known[name].to(self.device)
            steps.append(Step("Identity", [values[name]], {}, [name], []))
        return steps, values

    def _branch(self, node: Any, known: Constants) -> list[Any]:
        """Return the nodes of an If's branch, and nodes that pass its results on."""
        (condition,) = node.input
        if condition not in known:
            raise self._refused("the operator If depends on values of its inputs")
        chosen = "then_branch" if known[condition].item() else "else_branch"
        (graph,) = (attribute.g for attribute in node.attribute if attribute.name == chosen)
        known.initializers |= {tensor.name: tensor for tensor in graph.initializer}
        results = zip(graph.output, node.output, strict=True)
        return [
            *graph.node,
            *(onnx.helper.make_node("Identity", [result.name], [name]) for result, name in results),
        ]

    def _step(self, node: Any, known: Constants, values: dict[str, Tensor], is_known: bool) -> Step:
        """Return the call of a node: with names of values, constants on the device, numbers and lists."""
        name = f"{node.domain}.{node.op_type}" if node.domain else node.op_type
        if name not in OPERATORS:
            raise self._refused(f"the operator {name} is not implemented in torch")
        arguments: list[Any] = []
        for position, name in enumerate(node.input):
            if not name:
                arguments.append(None)
            elif name in values and position in ON_HOST.get(node.op_type, ()):
                raise self._refused(f"the operator {node.op_type} depends on values of its inputs")
            elif name in values:
                arguments.append(Name(name))
            elif position in ON_HOST.get(node.op_type, ()):
                arguments.append(known[name].tolist())
            else:
                arguments.append(known[name] if is_known else self._upload(name, known))
        schema = onnx.defs.get_schema(node.op_type, self._opset, node.domain)
        attributes = {attribute.name: _value(attribute) for attribute in node.attribute}
        for key, known_attribute in schema.attributes.items():
            default = known_attribute.default_value
            if default.type and attributes.get(key) == _value(default):
                del attributes[key]
        if node.op_type == "Split":
            attributes["outputs"] = len(node.output)
        return Step(node.op_type, arguments, attributes, [name for name in node.output if name], [])

    def _upload(self, name: str, known: Constants) -> Tensor:
        """Return a constant on the device; weights are uploaded once for all shapes of inputs."""
        if name not in known.initializers:
            return known[name].to(self.device)
        if name not in self._uploaded:
            self._uploaded[name] = known[name].to(self.device)
        return self._uploaded[name]


def _repeat(steps: list[Step], values: dict[str, Tensor]) -> dict[str, Tensor]:
    for step in steps:
        outputs = step.run(values)
        if isinstance(outputs, tuple | list):
            values.update(zip(step.outputs, outputs, strict=True))
        else:
            values[step.outputs[0]] = outputs
        for name in step.last_used:
            del values[name]
    return values


def host_tensor(tensor: Any) -> Tensor:
    return torch.from_numpy(np.array(onnx.numpy_helper.to_array(tensor)))


def _value(attribute: Any) -> Any:
    """Return the value of a node's attribute; texts as str, tensors on the host."""
    value = onnx.helper.get_attribute_value(attribute)
    if isinstance(value, onnx.TensorProto):
        return host_tensor(value)
    return value.decode() if isinstance(value, bytes) else value


def tensor_of(value: np.ndarray | Tensor, dtype: type) -> Tensor:
    """Return a tensor, or a copy of an array as a tensor, with a NumPy type."""
    if isinstance(value, Tensor):
        return value.to(torch.from_numpy(np.empty(0, dtype)).dtype)
    return torch.from_numpy(np.array(value, dtype))


def _declared(values: Any) -> dict[str, Declared]:
    """Return the inputs or outputs that a graph declares, as onnxruntime describes them."""
    declared = {}
    for value in values:
        kind = value.type.tensor_type
        axes = [
            dim.dim_value if dim.HasField("dim_value") else dim.dim_param or None for dim in kind.shape.dim
        ]
        declared[value.name] = Declared(
            f"tensor({onnx.TensorProto.DataType.Name(kind.elem_type).lower()})", axes
        )
    return declared
