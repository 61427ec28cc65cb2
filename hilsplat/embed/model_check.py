"""Check that a model folder works, and describe it."""

import time
from pathlib import Path

import numpy as np

from hilsplat.embed.clip import ClipModel
from hilsplat.models.folder import input_side_px, open_model_folder
from hilsplat.models.network import require_one_space
from hilsplat.segment.sam import SamModel


def check_model(folder: Path, variant: str = "") -> str:
    """Describe a model folder after running each of its networks once on an empty input.

    Args:
        folder: in a layout of `models.layouts`.
        variant: ending of the networks' names, such as `fp16`.

    Returns:
        kind, image size, shapes, digest, execution provider and time, one per line.

    Raises:
        ModelError: as for `open_model_folder` and `Network`.
    """
    model = open_model_folder(folder, variant=variant)
    side = input_side_px(model)
    lines = [f"folder     {model.folder}", f"kind       {model.layout}", f"image      {side} x {side} px"]
    if model.kind == "sam":
        sam = SamModel(model)
        start = time.perf_counter()
        encoded = sam.encode(np.zeros((side, side, 3), np.uint8))
        encode_s = time.perf_counter() - start
        prompts = sam.prompts_per_call(1, 1)
        points = np.full((prompts, 2), side / 2)
        start = time.perf_counter()
        _, masks = sam.decode(encoded, points)
        per_prompt = f"{(time.perf_counter() - start) / prompts:.4f} s for the masks of one prompt"
        if sam.previews:
            start = time.perf_counter()
            sam.preview(encoded, points)
            per_prompt += f", {(time.perf_counter() - start) / prompts:.4f} s for its preview"
        sizes = (" x ".join(map(str, value.shape[1:])) for value in encoded.features.values())
        lines += [
            f"embedding  {', '.join(sizes)}",
            f"thresholds predicted IoU {sam.own.predicted_iou_min}, stability {sam.own.stability_min}, "
            f"score {sam.own.nms_score}",
            f"masks      3 heads (subpart, part, whole) of {masks.shape[-2]} x {masks.shape[-1]} px",
            f"decoder    {'factored' if sam.factored else 'onnxruntime'}",
            f"time       {encode_s:.3f} s for one image, {per_prompt}",
        ]
        providers = sam.encoder.providers
    else:
        clip = ClipModel(model)
        vision = clip.vision
        start = time.perf_counter()
        image_embeds = clip.embed_crops(np.zeros((1, side, side, 3), np.uint8))
        encode_s = time.perf_counter() - start
        require_one_space(model.folder, image_embeds.shape[1], clip.embed_texts(["object"]).shape[1])
        lines += [
            f"vectors    {image_embeds.shape[1]} numbers",
            f"time       {encode_s:.3f} s for one image",
        ]
        providers = vision.providers
    lines += [f"runs on    {', '.join(providers)}", f"digest     {model.digest}"]
    return "\n".join(lines)
