"""Exports of CLIP, SigLIP and open_clip give through our code what transformers gives."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from hilsplat.base.errors import ModelError
from hilsplat.embed.clip import ClipModel
from hilsplat.embed.model_check import check_model
from hilsplat.models.onnx_graph import split_clip
from tests.published_models.exports import Call, declared_axes, trace

TOLERANCE = 1e-4
TEXTS = ["red mug", "a Mug on red", "x" * 40, "object"]
"""The third is longer than the CLIP of these tests reads."""
CROPS = np.random.default_rng(0).integers(0, 255, (5, 32, 32, 3), dtype=np.uint8)


def unit(vectors) -> np.ndarray:
    return (vectors / vectors.norm(dim=-1, keepdim=True)).numpy()


def assert_same_vectors(ours: ClipModel, model, images, inputs_of: Callable[[str], dict]) -> None:
    """Compare vectors of crops and texts; texts one by one, as our code embeds them."""
    pixels = images(list(CROPS), return_tensors="pt")["pixel_values"]
    with torch.no_grad():
        expected = unit(model.get_image_features(pixels))
        texts = [(text, unit(model.get_text_features(**inputs_of(text)))) for text in TEXTS]
    assert np.abs(expected[0] - expected[1]).max() > 0.01
    np.testing.assert_allclose(ours.prepare(CROPS), pixels.numpy(), atol=TOLERANCE)
    np.testing.assert_allclose(ours.embed_crops(CROPS), expected, atol=TOLERANCE)
    for text, expected in texts:
        np.testing.assert_allclose(ours.embed_texts([text]), expected, atol=TOLERANCE)


@pytest.fixture(scope="module")
def ours(clip_parts, tmp_path_factory) -> ClipModel:
    copy = tmp_path_factory.mktemp("cut") / "clip"
    shutil.copytree(clip_parts[2], copy)
    with pytest.raises(ModelError, match=r"lacks onnx/vision_model.onnx(.|\n)*hilsplat models split"):
        ClipModel.load(copy)
    assert [path.name for path in split_clip(copy)] == ["vision_model.onnx", "text_model.onnx"]
    return ClipModel.load(copy)


def test_splitting_replaces_only_the_same_halves(clip_parts, tmp_path: Path):
    folder = Path(shutil.copytree(clip_parts[2], tmp_path / "clip"))
    vision, text = split_clip(folder)
    assert split_clip(folder) == [vision, text]
    text.unlink()
    vision.write_text("of the user")
    with pytest.raises(ModelError, match=r"vision_model\.onnx exists, and is not the half"):
        split_clip(folder)
    assert vision.read_text() == "of the user" and not text.exists()
    with pytest.raises(ModelError, match=r"has no model.onnx to split"):
        split_clip(tmp_path)


def test_clip_gives_what_transformers_gives(ours, clip_parts):
    model, processor, _ = clip_parts

    def inputs_of(text: str) -> dict:
        inputs = processor.tokenizer([text], truncation=True, return_tensors="pt")
        assert ours.tokenizer.encode(text).ids == inputs["input_ids"][0].tolist()
        return inputs

    assert_same_vectors(ours, model, processor.image_processor, inputs_of)


def test_the_published_clip_gives_what_transformers_gives(clip_parts, tmp_path):
    """Its text network accepts only ids, of fixed length."""
    model, processor, exported = clip_parts
    for file in exported.glob("*.json"):
        shutil.copy(file, tmp_path)
    pixels, ids = torch.zeros(1, 3, 32, 32), torch.ones((1, 16)).long()
    for name, network, inputs, output in (
        ("vision_model", model.get_image_features, {"pixel_values": pixels}, "image_embeds"),
        ("text_model", model.get_text_features, {"input_ids": ids}, "text_embeds"),
    ):
        dynamic = {each: {0: "batch_size"} for each in (*inputs, output)}
        trace(Call(model, network), inputs, [output], dynamic, tmp_path / f"onnx/{name}.onnx")
    assert declared_axes(tmp_path / "onnx/text_model.onnx") == {"input_ids": ["batch_size", 16]}

    def inputs_of(text: str) -> dict:
        return {"input_ids": processor.tokenizer([text], truncation=True, return_tensors="pt")["input_ids"]}

    assert_same_vectors(ClipModel.load(tmp_path), model, processor.image_processor, inputs_of)


@pytest.mark.parametrize("split", [False, True])
def test_siglip_gives_what_transformers_gives(siglip_parts, tmp_path, split):
    model, images, folder = siglip_parts
    shutil.copytree(folder / ("optimum" if split else "js"), tmp_path / "siglip")
    if split:
        split_clip(tmp_path / "siglip")
        minimal = {"size": {"height": 32, "width": 32}}  # the rest has the defaults of SigLIP's processor
        (tmp_path / "siglip/preprocessor_config.json").write_text(json.dumps(minimal))

    def inputs_of(text: str) -> dict:
        ids = [{"red": 1, "mug": 2, "on": 3}.get(word, 0) for word in text.lower().split()]
        return {"input_ids": torch.tensor([ids + [4] * (64 - len(ids))])}  # </s> ends and pads the text

    assert_same_vectors(ClipModel.load(tmp_path / "siglip"), model, images, inputs_of)
    assert "kind       siglip" in check_model(tmp_path / "siglip")


def test_open_clip_in_two_folders_gives_what_transformers_gives_and_cleans_texts(
    open_clip_folder, clip_parts
):
    model, processor, _ = clip_parts
    ours = ClipModel.load(open_clip_folder)

    def inputs_of(text: str) -> dict:
        return processor.tokenizer([text], truncation=True, return_tensors="pt")

    assert_same_vectors(ours, model, processor.image_processor, inputs_of)
    assert ours.width == 12
    names = {path.relative_to(open_clip_folder).as_posix() for path in ours.model.files}
    assert {"visual/model.onnx", "textual/model.onnx", "textual/tokenizer.json"} < names
    config = json.loads((open_clip_folder / "config.json").read_text())
    config["text_cfg"]["tokenizer_kwargs"] = {"clean": "canonicalize"}  # of SigLIP
    (open_clip_folder / "config.json").write_text(json.dumps(config))
    vectors = ClipModel.load(open_clip_folder).embed_texts(
        ["red mug", "A Red_Mug  (here)!", "a red mug here"]
    )
    np.testing.assert_array_equal(vectors[1], vectors[2])
    assert (vectors[0] != vectors[1]).any()
