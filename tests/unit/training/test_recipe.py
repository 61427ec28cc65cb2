"""The recipe of both small models: scenes, cameras, phrases, and a training of two steps each."""

import numpy as np
import pytest

from hilsplat.base.artifacts import read_json
from hilsplat.base.errors import SceneError, SettingsError
from hilsplat.datasets.hierarchy import AnnotatedNode
from hilsplat_world.render import label_view
from hilsplat_world.scenes.kinds import KINDS
from models.training import render
from models.training.cameras import training_camera
from models.training.card import RECORD, digests
from models.training.settings import TrainingSettings
from models.training.train import train_models
from tests.unit.world.scenes import built


def test_no_scene_is_both_trained_and_measured_on():
    with pytest.raises(SceneError, match="not in the training split"):
        render.scene_of_seed(201)
    trained, measured = render.training_seeds(5, 3)
    assert trained == [1_000_000, 1_000_001, 1_000_002, 1_000_003, 1_000_004]
    assert measured == [1_999_997, 1_999_998, 1_999_999]


@pytest.mark.parametrize("kind", KINDS)
def test_training_cameras_show_several_objects_and_half_are_close_ups(kind):
    scene, rng = built(kind), np.random.default_rng(0)
    close = 0
    for _ in range(24):
        whole, part, _ = label_view(scene, training_camera(scene, rng, 32))
        # From inside a wall or an object, everything belongs to it.
        assert len(np.unique(whole)) > 1 and len(np.unique(part)) > 2
        close += np.isin(whole[10:22, 10:22], list(scene.background), invert=True).mean() > 0.3
    assert close >= 9


def test_a_part_may_be_named_without_its_object():
    nodes = (
        AnnotatedNode(0, 1, -1, "bear", ("teddy",)),
        AnnotatedNode(1, 2, 0, "bear head", ("head of the bear", "head of the teddy")),
    )
    whole, part = render.phrases_of(nodes)
    assert whole.phrases == ("bear", "teddy")
    assert part.phrases == ("bear head", "head of the bear", "head of the teddy", "head")


def test_an_unknown_stage_of_training_is_refused(tmp_path):
    with pytest.raises(SettingsError, match="unknown training step"):
        train_models(tmp_path, tmp_path, TrainingSettings(), stages=["sams"])


@pytest.mark.slow
def test_the_recipe_writes_both_models_and_resumes_from_its_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(render, "DRAWS", 1)  # of the vocabulary
    small = TrainingSettings(
        scenes=2, views=1, validation_scenes=1, sam_minutes=0, sam_steps=2, clip_minutes=0, clip_steps=2,
        segmented_views=1,
    )  # fmt: skip
    train_models(tmp_path / "models", tmp_path / "cache", small, threads=1)
    first = {name: read_json(tmp_path / "models" / name / RECORD) for name in ("sam-tiny", "clip-tiny")}
    for name, record in first.items():
        assert digests(tmp_path / "models" / name) == record["sha256"]
        assert (tmp_path / "models" / name / "curve.png").is_file()
    assert set(first["sam-tiny"]["metrics"]["points"]["all"]) == {"whole", "part", "subpart"}
    assert np.isfinite(first["clip-tiny"]["curve"][-1]["contrastive_loss"])
    train_models(tmp_path / "models", tmp_path / "cache", small, threads=1, stages=["sam"])
    again = read_json(tmp_path / "models" / "sam-tiny" / RECORD)
    assert again["sha256"] == first["sam-tiny"]["sha256"]
