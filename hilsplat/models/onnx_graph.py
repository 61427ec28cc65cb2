"""Changes to ONNX graphs: extraction of parts, row-wise global attention, and splitting of CLIP models.

`model.onnx`, as exported by optimum from CLIP or SigLIP, accepts an image and a text together. The image
vectors depend only on the image and the text vectors only on the text, so each half is a subgraph.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hilsplat.base.artifacts import atomic_path
from hilsplat.base.errors import ModelError

WHOLE = "model.onnx"
"""Network with both halves, in the model folder itself or in its subfolder `onnx/`."""
HALVES = {
    "vision_model": (["pixel_values"], "image_embeds"),
    "text_model": (["input_ids", "attention_mask"], "text_embeds"),
}
"""Inputs and output of each half."""
OPTIONAL = {"attention_mask"}
"""Inputs that a network may lack; SigLIP's text network reads the padding instead."""


def keep_only(model: Any, outputs: Sequence[str]) -> None:
    """Reduce a model to the nodes that compute the given values, and make these values its outputs."""
    import onnx

    graph = model.graph
    needed = needed_names(graph, outputs)
    kept = {
        "node": [node for node in graph.node if needed & set(node.output)],
        "initializer": [each for each in graph.initializer if each.name in needed],
        "input": [each for each in graph.input if each.name in needed],
    }
    if list(outputs) != [each.name for each in graph.output]:
        unknown = onnx.TensorProto.FLOAT, None
        kept["output"] = [onnx.helper.make_tensor_value_info(name, *unknown) for name in outputs]
    for field, values in kept.items():
        target = getattr(graph, field)
        del target[:]
        target.extend(values)


def needed_names(graph: Any, outputs: Sequence[str]) -> set[str]:
    """Return the names of the given values and of all values that they are computed from."""
    makers = {name: node for node in graph.node for name in node.output}
    needed, waiting = set[str](), list(outputs)
    while waiting:
        name = waiting.pop()
        if name in makers and name not in needed:
            waiting += _inputs(makers[name])
        needed.add(name)
    return needed


def _inputs(node: Any) -> list[str]:
    """Return the names that a node and its subgraphs read."""
    inner = [each for attribute in node.attribute for each in (attribute.g, *attribute.graphs)]
    return [*node.input, *(name for graph in inner for part in graph.node for name in _inputs(part))]


def with_rowwise_attention(path: Path, layers: Iterable[int], heads: int, side: int) -> bytes | None:
    """Return the graph of SAM's encoder with global attention computed for one row of patches at a time.

    The result is None if a layer has an unexpected form, or weights are external or 16-bit.

    As exported, such a layer writes the weights of all pairs of patches (800 MB) and reads them four times.
    The weights of one row fit into the processor's cache. onnxruntime loops over rows (operator Scan);
    results differ by rounding at most.

    Args:
        path: the `.onnx` file of a ViT encoder exported from transformers.
        layers: layers with global attention.
        side: patches per side of the image.
    """
    import onnx

    model = onnx.load(str(path), load_external_data=False)
    graph = model.graph
    if any(
        each.data_location == onnx.TensorProto.EXTERNAL or each.data_type == onnx.TensorProto.FLOAT16
        for each in graph.initializer
    ):
        return None
    makers = {name: node for node in graph.node for name in node.output}
    for layer in layers:
        ending = f"/layers.{layer}/attn/Softmax"
        found = [node for node in graph.node if node.name.endswith(ending)]
        sums = _scores(found[0], makers) if len(found) == 1 else None
        readers = [node for node in graph.node if found and found[0].output[0] in node.input]
        if sums is None or len(readers) != 1 or readers[0].op_type != "MatMul":
            return None
        (queries, keys), positions = sums
        values, output = readers[0].input[1], readers[0].output[0]
        nodes = _row_loop(f"rowwise.{layer}", queries, keys, values, positions, output, heads, side)
        place = list(graph.node).index(readers[0])
        graph.node.remove(readers[0])
        for offset, node in enumerate(nodes):
            graph.node.insert(place + offset, node)
    keep_only(model, [each.name for each in graph.output])
    return bytes(model.SerializeToString())


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
    name: str,
    queries: str,
    keys: str,
    values: str,
    positions: Sequence[str],
    output: str,
    heads: int,
    side: int,
) -> list[Any]:
    """Return the nodes of attention in a loop over rows of queries; positions have rows on axis 1."""
    from onnx import TensorProto, helper, numpy_helper

    def shape(of: str, *sides: int) -> Any:
        value = numpy_helper.from_array(np.array(sides, np.int64))
        return helper.make_node("Constant", [], [f"{name}.{of}"], value=value)

    def inside(of: str) -> Any:
        return helper.make_tensor_value_info(f"{name}.{of}", TensorProto.FLOAT, None)

    body = helper.make_graph(
        [
            helper.make_node("MatMul", [f"{name}.row", f"{name}.k"], [f"{name}.product"]),
            helper.make_node("Add", [f"{name}.row_y", f"{name}.row_x"], [f"{name}.position"]),
            shape("row_shape", heads, side, side * side),
            helper.make_node("Reshape", [f"{name}.position", f"{name}.row_shape"], [f"{name}.bias"]),
            helper.make_node("Add", [f"{name}.product", f"{name}.bias"], [f"{name}.score"]),
            helper.make_node("Softmax", [f"{name}.score"], [f"{name}.weight"], axis=-1),
            helper.make_node("MatMul", [f"{name}.weight", f"{name}.v"], [f"{name}.mean"]),
        ],
        f"{name}.body",
        [inside("row"), inside("row_y"), inside("row_x")],
        [inside("mean")],
    )
    return [
        shape("q_shape", heads, side, side, -1),
        shape("k_shape", heads, -1, side * side),
        shape("v_shape", heads, side * side, -1),
        helper.make_node("Reshape", [queries, f"{name}.q_shape"], [f"{name}.q"]),
        helper.make_node("Reshape", [keys, f"{name}.k_shape"], [f"{name}.k"]),
        helper.make_node("Reshape", [values, f"{name}.v_shape"], [f"{name}.v"]),
        helper.make_node(
            "Scan",
            [f"{name}.q", *positions],
            [f"{name}.rows"],
            body=body,
            num_scan_inputs=3,
            scan_input_axes=[1, 1, 1],
            scan_output_axes=[1],
        ),
        helper.make_node("Shape", [queries], [f"{name}.whole_shape"]),
        helper.make_node("Reshape", [f"{name}.rows", f"{name}.whole_shape"], [output]),
    ]


def whole_clip(folder: Path) -> Path | None:
    """Return the path of a folder's network with both halves, or None."""
    places = (folder / WHOLE, folder / "onnx" / WHOLE)
    return next((place for place in places if place.is_file()), None)


def split_clip(folder: Path) -> list[Path]:
    """Write `vision_model.onnx` and `text_model.onnx` beside a CLIP model's `model.onnx`, which is kept.

    A network above 2 GiB has its weights in a separate file (`model.onnx_data`), to which both halves refer.

    Raises:
        ModelError: `model.onnx` is missing, cannot be read, or lacks an input or output.
    """
    import onnx
    from onnx.utils import Extractor

    whole = whole_clip(folder)
    if whole is None:
        raise ModelError(
            f"model folder {folder} has no {WHOLE} to split",
            fix="export the model first: optimum-cli export onnx --model NAME FOLDER (docs/models.md)",
        )
    try:
        model = onnx.load(str(whole), load_external_data=False)
    except Exception as error:  # protobuf and onnx raise errors without a common base
        raise ModelError(f"network {whole} cannot be read: {error}", fix="export it again") from error
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
    # Shapes inside the graph are not needed, and inferring them fails above 2 GiB.
    extractor = Extractor(model)
    written = []
    for name, (needed, output) in HALVES.items():
        path = whole.with_name(f"{name}.onnx")
        with atomic_path(path) as temporary:
            half = extractor.extract_model([input for input in needed if input in inputs], [output])
            temporary.write_bytes(half.SerializeToString())
        written.append(path)
    return written
