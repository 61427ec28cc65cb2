"""Checks and descriptions of model folders, and speed measurements of models on this machine."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
from pydantic import Field

from hilsplat.base.artifacts import read_memo, write_json
from hilsplat.base.cache import writable
from hilsplat.base.errors import HilsplatError, MemoryLimitError, in_one_line
from hilsplat.embed.clip import ClipModel
from hilsplat.models.card import card_shortage, in_turn
from hilsplat.models.folder import input_side_px, open_model_folder
from hilsplat.models.int8 import int8_network, reduced_precision
from hilsplat.models.layouts import SECTIONS
from hilsplat.models.memory import card_mib
from hilsplat.models.network import require_one_space
from hilsplat.models.repeatable import random_pixels
from hilsplat.models.store import broken_models, present_models
from hilsplat.segment.sam import SamModel

CACHE = Path("results/.cache")
"""Folder for measured timings, and for int8 networks if the models folder is read-only."""
IMAGE_NETWORKS = {"sam": "vision_encoder", "clip": "vision_model"}
MAX_CARD_DIFFERENCE = 0.02
"""Maximum relative difference attributed to rounding, such as that of TF32 convolutions."""
Measured = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Result = TypeVar("Result")
Seconds = dict[str, float]
"""Timings (s). SAM: "image" per image; "masks" and optional "preview" per prompt. CLIP: "crop" per crop."""


def check_model(folder: Path, variant: str = "") -> str:
    """Run each network of a model on a blank input, also in int8, and return a description of the model.

    Errors as in `open_model_folder` and `Network`.
    """
    model = open_model_folder(folder, variant=variant)
    side = input_side_px(model)
    lines = [f"folder     {model.folder}", f"kind       {model.layout}", f"image      {side} x {side} px"]
    opened = SamModel(model) if model.kind == "sam" else ClipModel(model)
    precisions = ["fp32", *filter(None, [reduced_precision("auto", model, IMAGE_NETWORKS[model.kind])])]
    seconds = {name: times for name in precisions if (times := _measure(opened, name))}
    listed = "; ".join(
        f"{precision}: " + ", ".join(f"{value:.4f} s per {what}" for what, value in times.items())
        for precision, times in seconds.items()
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
    else:
        vectors = opened.embed_crops(np.full((1, side, side, 3), 128, np.uint8))
        require_one_space(model.folder, vectors.shape[1], opened.embed_texts(["object"]).shape[1])
        lines += [f"vectors    {vectors.shape[1]} dimensions"]
    _remember(folder, variant, seconds, writable(CACHE))
    lines += [f"time       {listed}", f"digest     {model.digest}"]
    return "\n".join(lines)


def check_models() -> tuple[str, int]:
    """Return the `check_model` reports of all installed models, and the number of broken models."""
    texts, num_failed = [], 0
    for folder in [*(model.folder for model in present_models()), *broken_models()]:
        try:
            texts.append(check_model(folder))
        except HilsplatError as error:
            texts.append(f"{folder} does not work: {error}")
            num_failed += 1
    return "\n\n".join(texts) or "no model is installed", num_failed


def card_disagreement(folder: Path, device: str = "cuda") -> str | None:
    """Return how a model's image network differs between a card and the CPU, or why it fails on the card.

    None means that both agree.

    Raises:
        MemoryLimitError: the card has too little free memory.
    """
    model = open_model_folder(folder)
    try:
        if device == "cuda" and (problem := card_shortage(card_mib(model))):
            raise MemoryLimitError(problem)
        is_sam = model.kind == "sam"
        on_card = SamModel(model, device).encoder if is_sam else ClipModel(model, device=device).vision
        pixels = random_pixels(on_card, input_side_px(model))
        on_device = in_turn(device, SECTIONS[model.kind], lambda: on_card(**pixels))
    except MemoryLimitError:
        raise
    except HilsplatError as error:
        return f"{device}: {in_one_line(error)}"
    pairs = zip(model.network(IMAGE_NETWORKS[model.kind])(**pixels), on_device, strict=True)
    difference = max(float(np.linalg.norm(a - b)) / max(float(np.linalg.norm(a)), 1e-12) for a, b in pairs)
    if difference <= MAX_CARD_DIFFERENCE:
        return None
    return f"{device} differs from the CPU by {difference:.2g} times the output's norm"


def seconds_of(folder: Path, variant: str, precision: str, cache: Path) -> Seconds:
    """Return the timings of a model, from an earlier measurement in `cache` if available.

    `precision` is "fp32", or "auto" or "int8", which both mean int8 where possible.
    """
    model = open_model_folder(folder, variant=variant)
    requested = reduced_precision(precision, model, IMAGE_NETWORKS[model.kind]) or "fp32"
    seconds = _known(cache).get(_key(folder, variant, requested), {})
    if not seconds.keys() >= ({"crop"} if model.kind == "clip" else {"image", "masks"}):
        opened = SamModel(model) if model.kind == "sam" else ClipModel(model)
        seconds = _measure(opened, requested) or _measure(opened, "fp32")
        _remember(folder, variant, {requested: seconds}, writable(cache))
    return seconds


def _measure(model: SamModel | ClipModel, precision: str) -> Seconds:
    """Measure a model; the result is empty if it has no int8 network."""
    side, is_int8 = input_side_px(model.model), precision == "int8"
    if isinstance(model, ClipModel):
        network = int8_network(model.model, "vision_model", writable(CACHE)) if is_int8 else model.vision
        if network is None:
            return {}
        crops = np.zeros((model.crops_per_call or 1, side, side, 3), np.uint8)
        _, seconds = _second_call(lambda: network(**{model.pixels: model.prepare(crops)}))
        return {"crop": seconds / len(crops)}
    encoder = model.int8_encoder(writable(CACHE)) if is_int8 else model.encoder
    if encoder is None:
        return {}
    encoded, image_s = _second_call(lambda: model.encode(np.zeros((side, side, 3), np.uint8), encoder))
    points = np.full((model.prompts_per_call(1, 1), 2), side / 2)
    _, masks_s = _second_call(lambda: model.decode(encoded, points))
    times = {"image": image_s, "masks": masks_s / len(points)}
    if model.previews:
        _, preview_s = _second_call(lambda: model.preview(encoded, points))
        times["preview"] = preview_s / len(points)
    return times


def _second_call(call: Callable[[], Result]) -> tuple[Result, float]:
    """Return the result and duration (s) of a second call; the first call compiles and fills caches."""
    call()
    start = time.perf_counter()
    return call(), time.perf_counter() - start


def _key(folder: Path, variant: str, precision: str) -> str:
    return f"{folder.name} {variant} {precision}"


def _known(cache: Path) -> dict[str, Seconds]:
    return read_memo(cache / "model_seconds.json", dict[str, dict[str, Measured]])


def _remember(folder: Path, variant: str, by_precision: dict[str, Seconds], cache: Path) -> None:
    measured = {_key(folder, variant, precision): seconds for precision, seconds in by_precision.items()}
    write_json(cache / "model_seconds.json", _known(cache) | measured)
