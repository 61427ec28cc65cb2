"""Splitting of the single network that optimum exports for a CLIP or a SigLIP.

`model.onnx` takes an image and a text together. The image vectors depend only on the image and the text
vectors only on the text, so each half is a subgraph.
"""

from pathlib import Path

from hilsplat.base.artifacts import atomic_path
from hilsplat.base.errors import ModelError

WHOLE = "model.onnx"
"""Network with both halves, in the model folder itself or in its subfolder `onnx/`."""

HALVES = {
    "vision_model": (("pixel_values",), ("image_embeds",)),
    "text_model": (("input_ids", "attention_mask"), ("text_embeds",)),
}
"""Inputs and outputs of each half."""

OPTIONAL = {"attention_mask"}
"""Inputs that a network may lack; SigLIP's text network reads the padding instead."""


def whole_clip(folder: Path) -> Path | None:
    """Return the path of a folder's network with both halves, or None."""
    places = (Path(folder) / WHOLE, Path(folder) / "onnx" / WHOLE)
    return next((place for place in places if place.is_file()), None)


def split_clip(folder: Path) -> list[Path]:
    """Write `vision_model.onnx` and `text_model.onnx` beside a CLIP's `model.onnx`.

    A network above 2 GiB has its weights in a separate file (`model.onnx_data`), to which both halves refer.
    `model.onnx` itself is kept but not needed.

    Raises:
        ModelError: there is no `model.onnx`, it cannot be read, or it lacks an input or output.
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
    missing = set[str]()
    for needed, given in HALVES.values():
        missing |= (set(needed) - inputs - OPTIONAL) | (set(given) - outputs)
    if missing:
        raise ModelError(
            f"network {whole} is not a whole CLIP: it lacks {', '.join(sorted(missing))}",
            expected="; ".join(f"{' and '.join(a)} -> {b[0]}" for a, b in HALVES.values()),
            found=f"{', '.join(sorted(inputs))} -> {', '.join(sorted(outputs))}",
            fix="export it with optimum's task feature-extraction",
        )
    # Shapes inside the graph are not needed, and inferring them fails above 2 GiB.
    extractor = Extractor(model)
    written = []
    for name, (needed, given) in HALVES.items():
        path = whole.with_name(f"{name}.onnx")
        with atomic_path(path) as temporary:
            half = extractor.extract_model([input for input in needed if input in inputs], list(given))
            temporary.write_bytes(half.SerializeToString())
        written.append(path)
    return written


def split_whole(folder: Path) -> None:
    """Replace a CLIP's `model.onnx` with the networks of `split_clip`; its weight file, if any, is kept."""
    vision, _ = split_clip(folder)
    vision.with_name(WHOLE).unlink()
