"""The stage functions on a whole scene folder; only the opening of model files is replaced."""

from types import SimpleNamespace

import pytest
from PIL import Image

from hilsplat.evaluate import stage
from hilsplat.evaluate.figures import panel
from hilsplat.evaluate.scores import read_scores
from hilsplat.settings import EvaluateSettings, FiguresSettings


@pytest.fixture
def opened(block_world, monkeypatch):
    """Arguments of a stage; the scene that they open is the block world."""
    asked = {}

    def open_scene(*paths, **options):
        asked.update(options, model=paths[-1].as_posix())
        return block_world.answers

    for module in (stage, panel):
        monkeypatch.setattr(module, "LanguageScene", SimpleNamespace(from_parts=open_scene))
    folder = block_world.folder
    arguments = {
        "scene_folder": folder / "scene",
        "truth": folder / "truth",
        "masks_folder": folder / "masks",
        "gaussians": folder / "gaussians.ply",
        "semantic_tree": folder / "semantic_tree",
        "language": folder / "field.safetensors",
        "autoencoder": folder / "autoencoder",
        "clip_folder": folder / "clip",
        "threads": 1,
    }
    return SimpleNamespace(arguments=arguments, asked=asked)


def evaluate(opened, out, **changes):
    names = {"dataset": "synthetic", "scene": "blocks", "variant": "default", "settings": EvaluateSettings()}
    stage.run_evaluate(**{**opened.arguments, **names, "out": out, **changes})


def test_only_test_views_are_scored_and_rows_say_where_they_come_from(opened, tmp_path):
    evaluate(opened, tmp_path / "scores.csv")
    scores = read_scores([tmp_path / "scores.csv"])
    assert set(scores["view"]) == {"001.png"}
    assert set(scores["masks"]) == {"sam-tiny"}
    assert set(scores["method"]) == {"field", "tree", "tree-path", "truth"}
    assert opened.asked["model"] == "models/clip-tiny"
    assert opened.asked["canonical"] == ("object", "things", "stuff", "texture")


def test_evaluating_twice_gives_the_same_bytes(opened, tmp_path):
    evaluate(opened, tmp_path / "one.csv")
    evaluate(opened, tmp_path / "two.csv")
    assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "two.csv").read_bytes()


def test_scene_without_annotations_gives_a_header_only(opened, tmp_path):
    evaluate(opened, tmp_path / "scores.csv", truth=None)
    assert len(read_scores([tmp_path / "scores.csv"])) == 0


def test_panel_is_written(opened, tmp_path):
    panel.run_figures(
        **opened.arguments,
        out=tmp_path / "panel.png",
        settings=FiguresSettings(queries_per_level=1),
        evaluate=EvaluateSettings(),
        queries=None,
    )
    with Image.open(tmp_path / "panel.png") as picture:
        assert picture.width == 1430
