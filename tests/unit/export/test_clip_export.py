"""A CLIP exported by optimum, cut into its two halves, gives through our code what transformers gives."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from hilsplat.base.errors import ModelError
from hilsplat.embed.clip import ClipModel
from hilsplat.models.onnx_graph import split_clip
from hilsplat.segment.masks import HierarchicalMasks

TOLERANCE = 1e-4
TEXTS = ["red mug", "a mug on the table", "x" * 40, "object"]


@pytest.fixture(scope="module")
def folder(clip_parts, tmp_path_factory) -> Path:
    copy = tmp_path_factory.mktemp("cut") / "clip"
    shutil.copytree(clip_parts[2], copy)
    with pytest.raises(ModelError, match=r"lacks onnx/vision_model.onnx(.|\n)*hilsplat models split"):
        ClipModel.load(copy)
    assert [path.name for path in split_clip(copy)] == ["vision_model.onnx", "text_model.onnx"]
    return copy


@pytest.fixture(scope="module")
def ours(folder) -> ClipModel:
    return ClipModel.load(folder)


def unit(vectors) -> np.ndarray:
    return (vectors / vectors.norm(dim=-1, keepdim=True)).numpy()


def test_crops_are_prepared_and_embedded_as_by_transformers(ours, clip_parts):
    import torch

    model, processor, _ = clip_parts
    crops = np.random.default_rng(0).integers(0, 255, (5, 32, 32, 3), dtype=np.uint8)
    inputs = processor.image_processor(list(crops), return_tensors="pt")
    np.testing.assert_allclose(ours.prepare(crops), inputs["pixel_values"].numpy(), atol=TOLERANCE)
    with torch.no_grad():
        expected = unit(model.get_image_features(inputs["pixel_values"]))
    assert np.abs(expected[0] - expected[1]).max() > 0.01
    np.testing.assert_allclose(ours.embed_crops(crops), expected, atol=TOLERANCE)


def test_texts_are_tokenised_and_embedded_as_by_transformers(ours, clip_parts):
    import torch

    model, processor, _ = clip_parts
    for text in TEXTS:  # one by one, as our code does; the third is longer than the model reads
        inputs = processor.tokenizer([text], truncation=True, return_tensors="pt")
        assert ours.tokenizer.encode(text).ids == inputs["input_ids"][0].tolist()
        with torch.no_grad():
            expected = unit(model.get_text_features(**inputs))
        np.testing.assert_allclose(ours.embed_texts([text]), expected, atol=TOLERANCE)


def test_a_mask_over_a_square_image_is_the_image_itself(ours, clip_parts):
    import torch

    model, processor, _ = clip_parts
    image = np.random.default_rng(1).integers(0, 255, (32, 32, 3), dtype=np.uint8)
    one = np.ones(1, np.float32)
    masks = HierarchicalMasks.from_dense(np.ones((1, 32, 32), bool), np.ones(1, np.uint8), one, one)
    with torch.no_grad():
        pixels = processor.image_processor(image, return_tensors="pt")["pixel_values"]
        expected = unit(model.get_image_features(pixels))
    # stored as float16, whose steps below 1 are at most 2**-11
    np.testing.assert_allclose(ours.embed_masks(image, masks), expected, atol=TOLERANCE + 2**-11)


def test_a_folder_without_an_export_cannot_be_cut(tmp_path):
    with pytest.raises(ModelError, match=r"has no model.onnx to split"):
        split_clip(tmp_path)
