"""CLIP networks with the published signature."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from hilsplat.embed.clip import ClipModel
from tests.published_models.exports import Call, declared_axes, trace


@pytest.fixture
def published(clip_parts, tmp_path) -> Path:
    """The CLIP of `clip_parts` in two networks; the text network accepts only ids, of fixed length."""
    model, _, exported = clip_parts
    folder = tmp_path / "clip"
    folder.mkdir()
    for file in exported.glob("*.json"):
        shutil.copy(file, folder)
    length = model.config.text_config.max_position_embeddings
    pixels, ids = torch.zeros(1, 3, 32, 32), torch.ones((1, length), dtype=torch.int64)
    for name, network, inputs, output in (
        (
            "vision_model",
            model.get_image_features,
            {"pixel_values": pixels},
            "image_embeds",
        ),
        ("text_model", model.get_text_features, {"input_ids": ids}, "text_embeds"),
    ):
        dynamic = {each: {0: "batch_size"} for each in (*inputs, output)}
        trace(Call(model, network), inputs, [output], dynamic, folder / f"onnx/{name}.onnx")
    return folder


def test_the_published_clip_gives_what_transformers_gives(published, clip_parts):
    model, processor, _ = clip_parts
    axes = declared_axes(published / "onnx/text_model.onnx")
    assert axes == {"input_ids": ["batch_size", 16]}
    ours, crops = (
        ClipModel.load(published),
        np.random.default_rng(0).integers(0, 255, (3, 32, 32, 3), np.uint8),
    )
    inputs = processor(text=["red mug"], images=list(crops), return_tensors="pt")
    with torch.no_grad():
        texts = model.get_text_features(inputs["input_ids"])
        images = model.get_image_features(inputs["pixel_values"])
    for found, expected in ((ours.embed_texts(["red mug"]), texts), (ours.embed_crops(crops), images)):
        np.testing.assert_allclose(found, torch.nn.functional.normalize(expected).numpy(), atol=1e-4)
