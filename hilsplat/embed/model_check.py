"""Check that a model folder works, and describe it."""

import time
from pathlib import Path

import numpy as np

from hilsplat.embed.clip import ClipModel
from hilsplat.models.folder import input_side_px, open_model_folder
from hilsplat.models.network import require_one_space, require_three_heads
from hilsplat.segment.sam import own_thresholds


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
    pixels = np.zeros((1, 3, side, side), dtype=np.float32)
    lines = [f"folder     {model.folder}", f"kind       {model.layout}", f"image      {side} x {side} px"]
    if model.kind == "sam":
        own = own_thresholds(model)
        encoder, decoder, *_ = (model.network(name) for name in model.networks)
        start = time.perf_counter()
        features = dict(zip(encoder.spec.outputs, encoder(pixel_values=pixels), strict=True))
        encode_s = time.perf_counter() - start
        prompts = decoder.fixed_axis("input_points", 1) or 1
        start = time.perf_counter()
        scores, masks = decoder(
            input_points=np.full((1, prompts, 1, 2), side / 2),
            input_labels=np.ones((1, prompts, 1)),
            input_boxes=np.zeros((1, 0, 4)),
            **features,
        )
        decode_s = time.perf_counter() - start
        require_three_heads(decoder.path, scores, masks)
        lines += [
            f"embedding  {', '.join(' x '.join(map(str, value.shape[1:])) for value in features.values())}",
            f"thresholds predicted IoU {own.predicted_iou_min}, stability {own.stability_min}, "
            f"score {own.nms_score}",
            f"masks      3 heads (subpart, part, whole) of {masks.shape[-2]} x {masks.shape[-1]} px",
            f"time       {encode_s:.3f} s for one image, {decode_s / prompts:.4f} s for one prompt",
        ]
        providers = encoder.providers
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
