"""Read and change ONNX graphs: parts, row-wise attention, prompts without boxes, halves of CLIP models.

`model.onnx`, as exported by optimum from CLIP or SigLIP, accepts an image and a text together. The image
vectors depend only on the image and the text vectors only on the text, so each half is a subgraph.
"""

import copy
import mmap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hilsplat.base.atomic import atomic_path
from hilsplat.base.errors import ModelError, first_line, foreign
from hilsplat.base.files import regular
from hilsplat.base.lineage import sha256_of_bytes, sha256_of_json

WHOLE = "model.onnx"  # network with both halves, in the model folder itself or in its subfolder `onnx/`
HALVES = {
    "vision_model": (["pixel_values"], "image_embeds"),
    "text_model": (["input_ids", "attention_mask"], "text_embeds"),
}
"""Inputs and output of each half."""
POINTER_BYTES = 1024  # size below which a file may be a pointer from a clone without Git LFS
SMALL_BYTES = 1024
"""Size below which external values are stored in the network; constants of shapes must be there."""
OPTIONAL = {"attention_mask"}
"""Inputs that a network may lack; SigLIP's text network reads the padding instead."""


class Graph:
    """An ONNX network in memory; its external weights stay in their files, mapped into memory.

    Unlike the onnx package, this class accepts links to weights in other folders, as in the hub's cache.

    Attributes:
        model: the network as an `onnx.ModelProto`, without the external weights.
        weights: external weights by name.
    """

    def __init__(self, model: Any, weights: dict[str, np.ndarray]) -> None:
        self.model = model
        self.weights = weights

    @staticmethod
    def read(path: Path) -> "Graph":
        """Read a network; raise a ModelError if it or its external weights are damaged."""
        import onnx
        from google.protobuf.message import DecodeError

        refuse_pointer(path)
        try:
            model = onnx.load(str(path), load_external_data=False)
            initializers = {tensor.name for tensor in model.graph.initializer}
            weights = {}
            for tensor in tensors_of(model.graph):
                if (location := location_of(tensor)) is None:
                    continue
                content, dtype = _external_bytes(path, tensor, location), _native_dtype(tensor)
                # constants of nodes and packed types cannot be passed to onnxruntime separately
                if dtype is None or tensor.name not in initializers or content.size < SMALL_BYTES:
                    _inline(tensor, content)
                else:
                    weights[tensor.name] = content.view(dtype).reshape(tuple(tensor.dims))
        except (DecodeError, ValueError, KeyError, OSError) as error:
            problem = f"network {path} cannot be opened: {first_line(error)}"
            found = f"a file of {path.stat().st_size} bytes"
            raise ModelError(problem, found=found, fix="fetch a complete copy, or export it again") from error
        return Graph(model, weights)

    def serialized(self) -> bytes:
        return bytes(self.model.SerializeToString())

    @property
    def digest(self) -> str:
        """SHA-256 of the network and its weights."""
        weights = [(name, sha256_of_bytes(value.tobytes())) for name, value in self.weights.items()]
        return sha256_of_json([sha256_of_bytes(self.serialized()), weights])

    def complete(self) -> Any:
        """Return a copy of the network that contains its external weights (at most 2 GiB)."""
        model = copy.deepcopy(self.model)
        for tensor in model.graph.initializer:
            if tensor.name in self.weights:
                _inline(tensor, self.weights[tensor.name])
        return model

    def reduced(self, outputs: Sequence[str]) -> "Graph":
        """Return the nodes that compute the given values, which become the outputs."""
        model = reduced(copy.deepcopy(self.model), outputs)
        names = {tensor.name for tensor in model.graph.initializer}
        return Graph(model, {name: value for name, value in self.weights.items() if name in names})


def location_of(tensor: Any) -> str | None:
    """Return the name of the file with a tensor's values, or None if the network contains them."""
    from onnx.external_data_helper import ExternalDataInfo, uses_external_data

    return ExternalDataInfo(tensor).location if uses_external_data(tensor) else None


def external_files(path: Path) -> list[str]:
    """Return the names of the files to which a network refers; empty for a damaged network."""
    if not has_external_weights(path):
        return []
    import onnx  # takes longer than opening a small network
    from google.protobuf.message import DecodeError

    try:
        graph = onnx.load(str(path), load_external_data=False).graph
    except DecodeError:
        return []  # opening the network reports it
    return sorted({name for tensor in tensors_of(graph) if (name := location_of(tensor)) is not None})


def has_external_weights(path: Path) -> bool:
    """Return whether a network may refer to other files, without reading its weights."""
    if not path.stat().st_size:
        return False
    with regular(path).open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        return content.find(b"location") >= 0  # key of every tensor stored outside the graph


def tensors_of(graph: Any) -> Iterator[Any]:
    """Yield all weights and constants of a graph and its subgraphs."""
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            yield from (attribute.t, *attribute.tensors)
            for inner in (attribute.g, *attribute.graphs):
                yield from tensors_of(inner)


def refuse_pointer(path: Path) -> None:
    """Raise a ModelError if a network is a pointer from a clone without Git LFS."""
    if path.stat().st_size < POINTER_BYTES and path.read_bytes().startswith(b"version https://git-lfs"):
        raise ModelError(
            f"network {path} is a Git LFS pointer, not the network",
            found=f"a text file of {path.stat().st_size} bytes",
            fix="fetch the file itself: git lfs pull, or download it from the model's page",
        )


def _external_bytes(network: Path, tensor: Any, location: str) -> np.ndarray:
    from onnx.external_data_helper import ExternalDataInfo

    info, path = ExternalDataInfo(tensor), network.parent / location
    start, available = info.offset or 0, path.stat().st_size
    size = info.length or available - start
    if available < start + size:
        raise ModelError(
            f"network {network} cannot be opened: its weights file {location} is too short",
            expected=f"at least {start + size} bytes",
            found=f"{available} bytes",
            fix="fetch a complete copy",
        )
    return np.memmap(path, np.uint8, "r", start, (size,)) if size else np.zeros(0, np.uint8)


def _native_dtype(tensor: Any) -> np.dtype | None:
    """Return a tensor's type if numpy has it, else None (such as bfloat16 and packed 4-bit integers)."""
    import onnx

    dtype = onnx.helper.tensor_dtype_to_np_dtype(tensor.data_type)
    return dtype if dtype.kind in "fiub" and dtype.isbuiltin else None


def _inline(tensor: Any, content: np.ndarray) -> None:
    import onnx

    tensor.raw_data = content.tobytes()
    tensor.data_location = onnx.TensorProto.DEFAULT
    del tensor.external_data[:]


def reduced(model: Any, outputs: Sequence[str]) -> Any:
    """Reduce a model in place to the nodes that compute the given values, its new outputs, and return it."""
    import onnx

    graph = model.graph
    needed = needed_names(graph, outputs)
    declared = {value.name: value for value in graph.output}
    untyped = onnx.TensorProto.FLOAT, None
    fields = {
        "node": [node for node in graph.node if needed & set(node.output)],
        "initializer": [tensor for tensor in graph.initializer if tensor.name in needed],
        "input": [value for value in graph.input if value.name in needed],
        "output": [
            declared.get(name) or onnx.helper.make_tensor_value_info(name, *untyped) for name in outputs
        ],
    }
    for field, values in fields.items():
        target = getattr(graph, field)
        del target[:]
        target.extend(values)
    return model


def needed_names(graph: Any, outputs: Sequence[str]) -> set[str]:
    """Return the names of the given values and of all values that they are computed from."""
    makers = {name: node for node in graph.node for name in node.output}
    needed, waiting = set[str](), list(outputs)
    while waiting:
        name = waiting.pop()
        if name in makers and name not in needed:
            waiting += inputs_of(makers[name])
        needed.add(name)
    return needed


def inputs_of(node: Any) -> list[str]:
    """Return the names that a node and its subgraphs read."""
    subgraphs = [graph for attribute in node.attribute for graph in (attribute.g, *attribute.graphs)]
    return [*node.input, *(name for graph in subgraphs for inner in graph.node for name in inputs_of(inner))]


def without_joined(graph: Graph, name: str, other: str) -> Graph | None:
    """Return a network that no longer concatenates values of the input `name` with values of `other`.

    Other uses of the input, such as its length, remain. The result is None if no such operator exists.

    Published SAM 2 decoders join the tokens of boxes to those of points. Without boxes, onnxruntime 1.31
    joins tokens that were never computed, so results change from call to call.
    """
    model = copy.deepcopy(graph.model)
    from_name, from_other = computed_from(graph, name), computed_from(graph, other)
    is_changed = False
    for node in model.graph.node:
        others = [value for value in node.input if value not in from_name]
        if node.op_type == "Concat" and 0 < len(others) < len(node.input) and from_other.intersection(others):
            node.input[:] = others
            is_changed = True
    if not is_changed:
        return None
    return Graph(model, graph.weights).reduced([output.name for output in model.graph.output])


def computed_from(graph: Graph, name: str) -> set[str]:
    """Return a value's name and those of all values computed from its numbers, not only from its shape."""
    names, before = {name}, 0
    while len(names) > before:  # converters to float16 append nodes in any order
        before = len(names)
        for node in graph.model.graph.node:
            if node.op_type != "Shape" and names.intersection(inputs_of(node)):
                names.update(node.output)
    return names


def reads_through(graph: Graph, name: str, operators: Iterable[str]) -> bool:
    """Return whether an input is passed to one of these operators, directly or after a cast."""
    waiting = [name]
    while waiting:
        value = waiting.pop()
        for node in graph.model.graph.node:
            if value in node.input:
                if node.op_type in operators:
                    return True
                if node.op_type in ("Cast", "Identity"):
                    waiting += node.output
    return False


def with_rowwise_attention(path: Path, layers: Iterable[int], heads: int, side: int) -> Graph:
    """Return the graph of SAM's encoder with global attention computed for one row of patches at a time.

    As exported, such a layer writes the weights of all pairs of patches (800 MB) and reads them four times.
    The weights of one row fit into the processor's cache. onnxruntime loops over rows (operator Scan);
    results differ by rounding at most.

    Args:
        path: the `.onnx` file of a ViT encoder exported from transformers.
        layers: layers with global attention.
        side: patches per side of the image.

    Raises:
        ModelError: a layer has an unexpected form, or weights are 16-bit.
    """
    import onnx

    network = Graph.read(path)
    graph = network.model.graph
    if any(tensor.data_type == onnx.TensorProto.FLOAT16 for tensor in graph.initializer):
        raise ModelError("its weights are float16")
    makers = {name: node for node in graph.node for name in node.output}
    for layer in layers:
        ending = f"/layers.{layer}/attn/Softmax"
        softmaxes = [node for node in graph.node if node.name.endswith(ending)]
        scores = _scores(softmaxes[0], makers) if len(softmaxes) == 1 else None
        readers = _readers(graph, softmaxes[0].output[0]) if softmaxes else []
        if scores is None or len(readers) != 1 or readers[0].op_type != "MatMul":
            raise ModelError(f"layer {layer} has no global attention in the form of transformers")
        (queries, keys), positions = scores
        values, output = readers[0].input[1], readers[0].output[0]
        nodes = _row_loop(f"rowwise_{layer}_", queries, keys, values, positions, output, heads, side)
        number = list(graph.node).index(readers[0])
        graph.node.remove(readers[0])
        for offset, node in enumerate(nodes):
            graph.node.insert(number + offset, node)
    reduced(network.model, [output.name for output in graph.output])
    return network


def _readers(graph: Any, value: str) -> list[Any]:
    """Return the nodes that read a value, directly or after casts."""
    nodes = []
    for node in graph.node:
        if value in node.input:
            nodes += _readers(graph, node.output[0]) if node.op_type == "Cast" else [node]
    return nodes


def _scores(softmax: Any, makers: dict[str, Any]) -> tuple[list[str], list[str]] | None:
    """Return the inputs of the product and the two positional terms in the sum before a softmax, or None."""
    product, positions, waiting = None, [], [softmax.input[0]]
    while waiting:
        node = makers.get(waiting.pop())
        if node is None:
            return None
        if node.op_type == "MatMul":
            product = list(node.input)
        elif node.op_type == "Unsqueeze":
            positions.append(node.output[0])
        elif node.op_type in ("Add", "Reshape"):
            waiting += node.input if node.op_type == "Add" else node.input[:1]
        else:
            return None
    return (product, positions) if product and len(positions) == 2 else None


def _row_loop(
    n: str, queries: str, keys: str, values: str, positions: Sequence[str], output: str, heads: int, side: int
) -> list[Any]:
    """Return the nodes of attention in a loop over rows of queries; positions have rows on axis 1.

    The names of values outside the loop begin with `n`.
    """
    from onnx.parser import parse_graph

    graph = f"""rowwise () => () {{
        {n}q_shape = Constant <value = int64[4] {{{heads}, {side}, {side}, -1}}> ()
        {n}k_shape = Constant <value = int64[3] {{{heads}, -1, {side * side}}}> ()
        {n}v_shape = Constant <value = int64[3] {{{heads}, {side * side}, -1}}> ()
        {n}q = Reshape ("{queries}", {n}q_shape)
        {n}k = Reshape ("{keys}", {n}k_shape)
        {n}v = Reshape ("{values}", {n}v_shape)
        {n}rows = Scan <
            body = of_row (float[] row, float[] row_y, float[] row_x) => (float[] mean) {{
                product = MatMul (row, {n}k)
                position = Add (row_y, row_x)
                shape = Constant <value = int64[3] {{{heads}, {side}, {side * side}}}> ()
                bias = Reshape (position, shape)
                score = Add (product, bias)
                weight = Softmax <axis = -1> (score)
                mean = MatMul (weight, {n}v)
            }},
            num_scan_inputs = 3, scan_input_axes = [1, 1, 1], scan_output_axes = [1]
        > ({n}q, "{positions[0]}", "{positions[1]}")
        {n}whole_shape = Shape ("{queries}")
        "{output}" = Reshape ({n}rows, {n}whole_shape)
    }}"""
    return list(parse_graph(graph).node)


def whole_clip(folder: Path) -> Path | None:
    """Return the path of a folder's network with both halves, or None."""
    return next(filter(Path.is_file, (folder / WHOLE, folder / "onnx" / WHOLE)), None)


def split_clip(folder: Path) -> list[Path]:
    """Write `vision_model.onnx` and `text_model.onnx` beside a CLIP model's `model.onnx`, which is kept.

    A network above 2 GiB has its weights in a separate file (`model.onnx_data`), to which both halves refer.

    Raises:
        ModelError: `model.onnx` is missing, cannot be read, or lacks an input or output, or a half exists
            that differs.
    """
    import onnx

    whole = whole_clip(folder)
    if whole is None:
        raise ModelError(
            f"model folder {folder} has no {WHOLE} to split",
            fix="export the model first: optimum-cli export onnx --model NAME FOLDER (docs/models.md)",
        )
    with foreign(f"network {whole}", ModelError):
        model = onnx.load(str(whole), load_external_data=False)
    inputs, outputs = ({value.name for value in part} for part in (model.graph.input, model.graph.output))
    missing = {name for needed, _ in HALVES.values() for name in needed} - inputs - OPTIONAL
    missing |= {output for _, output in HALVES.values()} - outputs
    if missing:
        raise ModelError(
            f"network {whole} is not a complete CLIP model: it lacks {', '.join(sorted(missing))}",
            expected="; ".join(f"{' and '.join(needed)} -> {output}" for needed, output in HALVES.values()),
            found=f"{', '.join(sorted(inputs))} -> {', '.join(sorted(outputs))}",
            fix="export it with optimum's task feature-extraction",
        )
    halves = {
        whole.with_name(f"{name}.onnx"): reduced(copy.deepcopy(model), [output]).SerializeToString()
        for name, (_, output) in HALVES.items()
    }
    for path, content in halves.items():
        if path.exists() and path.read_bytes() != content:
            raise ModelError(
                f"{path} exists, and is not the half of {whole.name} that would replace it",
                fix="move it elsewhere, then split again",
            )
    for path, content in halves.items():
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
    return list(halves)
