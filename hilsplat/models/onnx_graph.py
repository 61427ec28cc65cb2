"""Changes to ONNX graphs: extraction of parts, row-wise global attention, and splitting of CLIP models.

`model.onnx`, as exported by optimum from CLIP or SigLIP, accepts an image and a text together. The image
vectors depend only on the image and the text vectors only on the text, so each half is a subgraph.
"""

import copy
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

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


def reduced(model: Any, outputs: Sequence[str]) -> bytes:
    """Reduce a model to the nodes that compute the given values, its new outputs, and return its bytes."""
    import onnx

    graph = model.graph
    needed = needed_names(graph, outputs)
    kept = {
        "node": [node for node in graph.node if needed & set(node.output)],
        "initializer": [each for each in graph.initializer if each.name in needed],
        "input": [each for each in graph.input if each.name in needed],
    }
    known = {each.name: each for each in graph.output}
    unknown = onnx.TensorProto.FLOAT, None
    kept["output"] = [
        known.get(name) or onnx.helper.make_tensor_value_info(name, *unknown) for name in outputs
    ]
    for field, values in kept.items():
        target = getattr(graph, field)
        del target[:]
        target.extend(values)
    return bytes(model.SerializeToString())


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
        nodes = _row_loop(f"rowwise_{layer}_", queries, keys, values, positions, output, heads, side)
        place = list(graph.node).index(readers[0])
        graph.node.remove(readers[0])
        for offset, node in enumerate(nodes):
            graph.node.insert(place + offset, node)
    return reduced(model, [each.name for each in graph.output])


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
    return next((place for place in (folder / WHOLE, folder / "onnx" / WHOLE) if place.is_file()), None)


def split_clip(folder: Path) -> list[Path]:
    """Write `vision_model.onnx` and `text_model.onnx` beside a CLIP model's `model.onnx`, which is kept.

    A network above 2 GiB has its weights in a separate file (`model.onnx_data`), to which both halves refer.

    Raises:
        ModelError: `model.onnx` is missing, cannot be read, or lacks an input or output.
    """
    import onnx

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
    written = []
    for name, (_, output) in HALVES.items():
        path = whole.with_name(f"{name}.onnx")
        with atomic_path(path) as temporary:
            temporary.write_bytes(reduced(copy.deepcopy(model), [output]))
        written.append(path)
    return written
