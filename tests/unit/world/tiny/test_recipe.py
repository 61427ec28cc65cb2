"""The whole recipe, as small as it gets: two scenes, a step each."""

import numpy as np
import pytest

from hilsplat.base.artifacts import read_json
from hilsplat.base.errors import SceneError
from hilsplat.datasets.hierarchy import AnnotatedNode
from hilsplat.world.tiny.card import RECORD, digests
from hilsplat.world.tiny.render import phrases_of, scene_of_seed, training_seeds
from hilsplat.world.tiny.train import train_models


def test_only_training_scenes_are_rendered_for_training():
    with pytest.raises(SceneError, match="not of the training split"):
        scene_of_seed(201)


def test_measured_scenes_are_others_than_trained_ones():
    trained, measured = training_seeds(5, 3)
    assert trained == [1_000_000, 1_000_001, 1_000_002, 1_000_003, 1_000_004]
    assert measured == [1_999_997, 1_999_998, 1_999_999]


def test_a_part_may_be_named_without_its_object():
    nodes = (
        AnnotatedNode(0, 1, -1, "bear", ("teddy",)),
        AnnotatedNode(1, 2, 0, "bear head", ("head of the bear", "head of the teddy")),
    )
    whole, part = phrases_of(nodes)
    assert whole.phrases == ("bear", "teddy")
    assert part.phrases == ("bear head", "head of the bear", "head of the teddy", "head")


@pytest.mark.slow
def test_the_recipe_writes_both_models_and_goes_on_from_its_cache(tmp_path):
    small = {"sam_steps": 2, "clip_steps": 2, "scenes": 2, "validation_scenes": 1, "views": 2, "threads": 1}
    train_models(tmp_path / "models", tmp_path / "cache", **small)
    first = {name: read_json(tmp_path / "models" / name / RECORD) for name in ("sam-tiny", "clip-tiny")}
    for name, record in first.items():
        assert digests(tmp_path / "models" / name) == record["sha256"]
        assert (tmp_path / "models" / name / "curve.png").is_file()
    assert set(first["sam-tiny"]["metrics"]["grid"]) == {"whole", "part", "subpart"}
    assert np.isfinite(first["clip-tiny"]["curve"][-1]["loss"])
    train_models(tmp_path / "models", tmp_path / "cache", **small)
    again = read_json(tmp_path / "models" / "sam-tiny" / RECORD)
    assert again["sha256"] == first["sam-tiny"]["sha256"]
