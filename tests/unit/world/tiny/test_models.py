"""The committed small models are the files their cards describe, and they run."""

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from tokenizers import Tokenizer

from hilsplat.base.artifacts import read_json
from hilsplat.world.objects.catalogue import GENERATOR_VERSION
from hilsplat.world.render import render_view
from hilsplat.world.scenes.kinds import build_scene, scene_cameras
from hilsplat.world.seeds import TRAINING_SEEDS
from hilsplat.world.tiny.card import CARD, RECORD, digests
from hilsplat.world.tiny.data import normalised

MODELS = Path(__file__).resolve().parents[4] / "models"
NAMES = ("sam-tiny", "clip-tiny")


@pytest.mark.parametrize("name", NAMES)
def test_files_have_the_digests_of_the_card(name):
    folder = MODELS / name
    record = read_json(folder / RECORD)
    assert digests(folder) == record["sha256"]
    card = (folder / CARD).read_text(encoding="utf-8")
    assert all(digest in card for digest in record["sha256"].values())


@pytest.mark.parametrize("name", NAMES)
def test_models_were_trained_on_training_scenes_of_this_generator(name):
    recipe = read_json(MODELS / name / RECORD)["recipe"]
    assert recipe["generator"].split("-")[0] == str(GENERATOR_VERSION)
    for seed in (*recipe["training_seeds"], *recipe["validation_seeds"]):
        assert seed in TRAINING_SEEDS
    assert recipe["training_seeds"][1] < recipe["validation_seeds"][0]


def test_both_models_are_small_enough_to_commit():
    size = sum(path.stat().st_size for name in NAMES for path in (MODELS / name).rglob("*") if path.is_file())
    assert size < 12 * 2**20


def test_the_committed_segmenter_loads_and_predicts_from_fine_to_coarse():
    folder = MODELS / "sam-tiny" / "onnx"
    providers = ["CPUExecutionProvider"]
    vision = onnxruntime.InferenceSession(str(folder / "vision_encoder.onnx"), providers=providers)
    decoder = onnxruntime.InferenceSession(
        str(folder / "prompt_encoder_mask_decoder.onnx"), providers=providers
    )
    seed = read_json(MODELS / "sam-tiny" / RECORD)["recipe"]["validation_seeds"][0]
    scene = build_scene("tabletop", seed, 6)
    camera = scene_cameras(scene, 8, 256, 360)
    image = render_view(scene, camera[camera.names[0]], 1)
    pixels = normalised(image[None])
    embeddings, positional = vision.run(None, {"pixel_values": pixels})
    steps = (np.arange(8, dtype=np.float32) + 0.5) * 32
    points = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(1, 64, 1, 2)
    scores, masks = decoder.run(
        ["iou_scores", "pred_masks"],
        {
            "input_points": points,
            "input_labels": np.ones((1, 64, 1), np.int64),
            "image_embeddings": embeddings,
            "image_positional_embeddings": positional,
        },
    )
    assert scores.shape == (1, 64, 3)
    assert masks.shape == (1, 64, 3, 128, 128)
    area = (masks > 0).mean(axis=(0, 1, 3, 4))
    assert area[0] < area[1] < area[2]


def test_the_committed_clip_tells_texts_apart():
    folder = MODELS / "clip-tiny"
    text = onnxruntime.InferenceSession(
        str(folder / "onnx" / "text_model.onnx"), providers=["CPUExecutionProvider"]
    )
    tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
    encoded = tokenizer.encode_batch(["bear", "teddy bear", "a photo of a bear", "car", "object"])
    (vectors,) = text.run(
        None,
        {
            "input_ids": np.array([row.ids for row in encoded], np.int64),
            "attention_mask": np.array([row.attention_mask for row in encoded], np.int64),
        },
    )
    similarity = vectors @ vectors.T
    assert np.allclose(np.diag(similarity), 1, atol=1e-3)
    for same in (1, 2):
        assert similarity[0, same] > max(similarity[0, 3], similarity[0, 4])
