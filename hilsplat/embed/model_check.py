"""Check that a model folder works, and describe it."""

import time
from pathlib import Path

import numpy as np

from hilsplat.base.onnx_models import (
    KINDS,
    input_side_px,
    open_model_folder,
    require_one_space,
    require_three_heads,
)


def check_model(folder: Path) -> str:
    """Describe a model folder after running each of its networks once on an empty input.

    Returns:
        kind, image size, shapes, digest, execution provider and time, one per line.

    Raises:
        ModelError: as for `open_model_folder` and `Network`.
    """
    model = open_model_folder(folder)
    side = input_side_px(model)
    pixels = np.zeros((1, 3, side, side), dtype=np.float32)
    lines = [f"folder     {model.folder}", f"kind       {model.kind}", f"image      {side} x {side} px"]
    if model.kind == "sam":
        encoder, decoder = (model.network(name) for name in KINDS["sam"])
        start = time.perf_counter()
        embeddings, positional = encoder(pixel_values=pixels)
        encode_s = time.perf_counter() - start
        prompts = decoder.fixed_axis("input_points", 1) or 1
        start = time.perf_counter()
        scores, masks = decoder(
            input_points=np.full((1, prompts, 1, 2), side / 2),
            input_labels=np.ones((1, prompts, 1)),
            image_embeddings=embeddings,
            image_positional_embeddings=positional,
        )
        decode_s = time.perf_counter() - start
        require_three_heads(decoder.path, scores, masks)
        lines += [
            f"embedding  {' x '.join(map(str, embeddings.shape[1:]))}",
            f"masks      3 heads (subpart, part, whole) of {masks.shape[-2]} x {masks.shape[-1]} px",
            f"time       {encode_s:.3f} s for one image, {decode_s / prompts:.4f} s for one prompt",
        ]
        providers = encoder.providers
    else:
        vision, text = (model.network(name) for name in KINDS["clip"])
        start = time.perf_counter()
        (image_embeds,) = vision(pixel_values=pixels)
        encode_s = time.perf_counter() - start
        length = text.fixed_axis("input_ids", 1) or 8
        tokens = np.ones((1, length), dtype=np.int64)
        (text_embeds,) = text(input_ids=tokens, attention_mask=tokens)
        require_one_space(model.folder, image_embeds.shape[1], text_embeds.shape[1])
        lines += [
            f"vectors    {image_embeds.shape[1]} numbers",
            f"time       {encode_s:.3f} s for one image",
        ]
        providers = vision.providers
    lines += [f"runs on    {', '.join(providers)}", f"digest     {model.digest}"]
    return "\n".join(lines)
