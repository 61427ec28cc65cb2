"""Checks and descriptions of model folders, and measurements of their speed on this machine."""

from pathlib import Path

import numpy as np

from hilsplat.base.artifacts import read_json, write_json
from hilsplat.base.errors import ArtifactError
from hilsplat.embed.clip import ClipModel
from hilsplat.models.folder import ModelFolder, input_side_px, open_model_folder
from hilsplat.models.int8 import int8_network, may_be_int8
from hilsplat.models.network import execution_providers, require_one_space
from hilsplat.segment.sam import SamModel

CACHE = Path("results/.cache")
"""Folder for measured timings, and for int8 networks if the models are read-only."""

LARGEST_PROVIDER_DIFFERENCE = 0.02
"""Largest relative difference attributed to rounding, such as that of TF32 products on CUDA."""

Seconds = dict[str, float]
"""Timings. SAM: per "image", and per prompt for "masks" and the optional "preview". CLIP: per "crop"."""


def check_model(folder: Path, variant: str = "") -> str:
    """Run each network of a model on an empty input, also in int8, and describe the model.

    Args:
        folder: model folder in a layout of `models.layouts`.
        variant: suffix of the network names, such as `fp16`.

    Returns:
        kind, image size, shapes, digest, execution provider and time, one per line.

    Raises:
        ModelError: as in `open_model_folder` and `Network`.
    """
    model = open_model_folder(folder, variant=variant)
    side = input_side_px(model)
    lines = [f"folder     {model.folder}", f"kind       {model.layout}", f"image      {side} x {side} px"]
    opened = SamModel(model) if model.kind == "sam" else ClipModel(model)
    seconds = {precision: _measure(opened, precision) for precision in _precisions(model)}
    times = "; ".join(
        f"{precision}: " + ", ".join(f"{value:.4f} s per {what}" for what, value in each.items())
        for precision, each in seconds.items()
    )
    if isinstance(opened, SamModel):
        encoded = opened.encode(np.zeros((side, side, 3), np.uint8))
        _, masks = opened.decode(encoded, np.full((opened.prompts_per_call(1, 1), 2), side / 2))
        sizes = (" x ".join(map(str, value.shape[1:])) for value in encoded.features.values())
        lines += [
            f"embedding  {', '.join(sizes)}",
            f"thresholds predicted IoU {opened.own.predicted_iou_min}, stability {opened.own.stability_min}, "
            f"score {opened.own.nms_score}",
            f"masks      3 heads (subpart, part, whole) of {masks.shape[-2]} x {masks.shape[-1]} px",
            f"decoder    {'factored' if opened.factored else 'onnxruntime'}",
        ]
        providers = opened.encoder.providers
    else:
        vectors = opened.embed_crops(np.zeros((1, side, side, 3), np.uint8))
        require_one_space(model.folder, vectors.shape[1], opened.embed_texts(["object"]).shape[1])
        lines += [f"vectors    {vectors.shape[1]} numbers"]
        providers = opened.vision.providers
    for precision, each in seconds.items():
        _remember(folder, variant, precision, each)
    lines += [f"time       {times}", f"runs on    {', '.join(providers)}", f"digest     {model.digest}"]
    return "\n".join(lines)


def provider_disagreement(folder: Path) -> str | None:
    """Describe how outputs of the image network for a random image differ between providers, or return None.

    Raises:
        ModelError: as in `open_model_folder` and `Network`.
    """
    model = open_model_folder(folder)
    name = "vision_encoder" if model.kind == "sam" else "vision_model"
    side = input_side_px(model)
    pixels = np.random.default_rng(0).normal(size=(1, 3, side, side)).astype(np.float32)
    providers = execution_providers()
    if len(providers) < 2:
        return None
    outputs = {
        provider: model.network(name, provider=provider)(pixel_values=pixels) for provider in providers
    }
    reference = outputs.pop("CPUExecutionProvider")
    for provider, found in outputs.items():
        pairs = zip(reference, found, strict=True)
        apart = max(float(np.linalg.norm(a - b)) / max(float(np.linalg.norm(a)), 1e-12) for a, b in pairs)
        if not apart <= LARGEST_PROVIDER_DIFFERENCE:
            return f"{provider} differs from the CPU by {apart:.2g} of the output's norm"
    return None


def seconds_of(folder: Path, variant: str, precision: str, cache: Path) -> Seconds:
    """Return the timings of a model, from an earlier measurement if there is one.

    Args:
        folder: the model folder.
        variant: as in `check_model`.
        precision: "fp32", or "auto" or "int8" for int8 where possible.
        cache: folder of the measurements.

    Raises:
        ModelError: the model cannot be opened.
    """
    model = open_model_folder(folder, variant=variant)
    requested = "fp32" if precision == "fp32" else _precisions(model)[-1]
    found = _known(cache).get(_key(folder, variant, requested))
    if found is None:
        found = _measure(SamModel(model) if model.kind == "sam" else ClipModel(model), requested)
        _remember(folder, variant, requested, found, cache)
    return found


def _precisions(model: ModelFolder) -> list[str]:
    return ["fp32", "int8"] if may_be_int8(model) else ["fp32"]


def _measure(model: SamModel | ClipModel, precision: str) -> Seconds:
    if isinstance(model, SamModel):
        encoder = model.int8_encoder(CACHE) if precision == "int8" else model.encoder
        side = input_side_px(model.model)
        return model.seconds(np.zeros((side, side, 3), np.uint8), encoder)
    is_int8 = precision == "int8"
    network = int8_network(model.model, "vision_model", CACHE) if is_int8 else model.vision
    return {"crop": model.seconds(network)}


def _key(folder: Path, variant: str, precision: str) -> str:
    return f"{Path(folder).name} {variant} {precision}"


def _known(cache: Path) -> dict[str, Seconds]:
    try:
        return read_json(cache / "model_seconds.json")
    except ArtifactError:
        return {}


def _remember(folder: Path, variant: str, precision: str, found: Seconds, cache: Path = CACHE) -> None:
    write_json(cache / "model_seconds.json", {**_known(cache), _key(folder, variant, precision): found})
