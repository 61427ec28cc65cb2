"""The stage functions on a whole scene folder; only the opening of model files is replaced."""

from types import SimpleNamespace

import pytest
from PIL import Image

from hilsplat.evaluate import stage
from hilsplat.evaluate.figures import panel
from hilsplat.evaluate.scores import read_scores
from hilsplat.scene.finished import SceneParts
from hilsplat.settings import EvaluateSettings, FiguresSettings

PARTS = ("scene", "gaussians", "semantic_tree", "field", "autoencoder", "clip", "masks")


@pytest.fixture
def opened(block_world, monkeypatch):
    """Parts of a scene, and what a stage asks for when it opens them; what opens is the block world."""
    asked = {}

    def open_scene(parts, settings, **options):
        asked.update(options, parts=parts, settings=settings)
        return block_world.answers

    for module in (stage, panel):
        monkeypatch.setattr(module, "LanguageScene", SimpleNamespace(from_parts=open_scene))
    folder = block_world.folder
    parts = SceneParts(**{name: folder / name for name in PARTS})
    return SimpleNamespace(parts=parts, truth=folder / "truth", asked=asked)


def evaluate(opened, out, settings=None, **changes):
    names = {"dataset": "synthetic", "scene": "blocks", "variant": "default", "truth": opened.truth}
    stage.run_evaluate(opened.parts, out, settings or EvaluateSettings(), **{**names, **changes})


def test_only_test_views_are_scored_and_rows_say_where_they_come_from(opened, tmp_path):
    evaluate(opened, tmp_path / "scores.csv")
    scores = read_scores([tmp_path / "scores.csv"])
    assert set(scores["view"]) == {"001.png"}
    assert set(scores["masks"]) == {"sam-tiny"}
    assert set(scores["method"]) == {"field", "tree", "tree-path", "truth"}


def test_a_scene_is_opened_with_all_that_the_settings_say(opened, tmp_path):
    settings = EvaluateSettings(node_select=0.5, template="a photo of a {}", methods=("tree",))
    evaluate(opened, tmp_path / "scores.csv", settings)
    assert opened.asked["settings"] is settings
    panel.run_figures(opened.parts, tmp_path / "panel.png", FiguresSettings(), settings, queries=["bear"])
    assert opened.asked["settings"] is settings
    assert opened.asked["parts"] is opened.parts


def test_evaluating_twice_gives_the_same_bytes(opened, tmp_path):
    evaluate(opened, tmp_path / "one.csv")
    evaluate(opened, tmp_path / "two.csv")
    assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "two.csv").read_bytes()


def test_scene_without_annotations_gives_a_header_only(opened, tmp_path):
    evaluate(opened, tmp_path / "scores.csv", truth=None)
    assert len(read_scores([tmp_path / "scores.csv"])) == 0


def test_the_panel_is_written_with_the_pictures_of_poses_and_fit_beside_it(opened, tmp_path):
    (opened.parts.scene / "registration.png").write_bytes(b"cameras")
    (tmp_path / "fit").mkdir()
    (tmp_path / "fit/test_views.png").write_bytes(b"renders")
    panel.run_figures(
        opened.parts,
        tmp_path / "panel.png",
        FiguresSettings(queries_per_level=1),
        EvaluateSettings(),
        fit=tmp_path / "fit",
        truth=opened.truth,
    )
    with Image.open(tmp_path / "panel.png") as picture:
        assert picture.width == 1430
    assert (tmp_path / "registration.png").read_bytes() == b"cameras"
    assert (tmp_path / "fit.png").read_bytes() == b"renders"
