"""Check that a model folder works, and describe it."""

from pathlib import Path

import numpy as np

from hilsplat.embed.clip import ClipModel
from hilsplat.models.folder import input_side_px, open_model_folder
from hilsplat.models.int8 import int8_network, may_be_int8
from hilsplat.models.network import require_one_space
from hilsplat.segment.sam import SamModel

CACHE = Path("results/.cache")
"""Stores int8 networks of a model whose folder is read-only."""


def check_model(folder: Path, variant: str = "") -> str:
    """Describe a model folder after running each of its networks on an empty input, also in int8.

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
        sam, blank = SamModel(model), np.zeros((side, side, 3), np.uint8)
        seconds = sam.seconds(blank, sam.encoder)
        times = (
            f"{seconds['image']:.3f} s for one image, {seconds['masks']:.4f} s for the masks of one prompt"
        )
        if "preview" in seconds:
            times += f", {seconds['preview']:.4f} s for its preview"
        if may_be_int8(model):
            times += f"; int8: {sam.seconds(blank, sam.int8_encoder(CACHE))['image']:.3f} s for one image"
        encoded = sam.encode(blank)
        _, masks = sam.decode(encoded, np.full((sam.prompts_per_call(1, 1), 2), side / 2))
        sizes = (" x ".join(map(str, value.shape[1:])) for value in encoded.features.values())
        lines += [
            f"embedding  {', '.join(sizes)}",
            f"thresholds predicted IoU {sam.own.predicted_iou_min}, stability {sam.own.stability_min}, "
            f"score {sam.own.nms_score}",
            f"masks      3 heads (subpart, part, whole) of {masks.shape[-2]} x {masks.shape[-1]} px",
            f"decoder    {'factored' if sam.factored else 'onnxruntime'}",
            f"time       {times}",
        ]
        providers = sam.encoder.providers
    else:
        clip = ClipModel(model)
        vision, blank = clip.vision, np.zeros((1, side, side, 3), np.uint8)
        image_embeds, encode_s = clip.embed_crops(blank), clip.seconds(clip.vision)
        times = f"{encode_s:.3f} s for one image"
        if may_be_int8(model):
            times += f"; int8: {clip.seconds(int8_network(model, 'vision_model', CACHE)):.3f} s"
        require_one_space(model.folder, image_embeds.shape[1], clip.embed_texts(["object"]).shape[1])
        lines += [
            f"vectors    {image_embeds.shape[1]} numbers",
            f"time       {times}",
        ]
        providers = vision.providers
    lines += [f"runs on    {', '.join(providers)}", f"digest     {model.digest}"]
    return "\n".join(lines)
