"""The stage functions on a whole scene folder; only the opening of model files is replaced."""

from PIL import Image

from hilsplat.evaluate.figures import panel
from hilsplat.settings import EvaluateSettings, FiguresSettings


def test_only_test_views_are_scored_and_evaluating_twice_gives_the_same_bytes(opened, tmp_path):
    scores = opened.evaluate(tmp_path / "scores.csv")
    assert set(scores["view"]) == {"001.png"}
    assert set(scores["masks"]) == {"sam-tiny"}
    assert set(scores["method"]) == {"field", "tree", "tree-path", "truth"}
    opened.evaluate(tmp_path / "two.csv")
    assert (tmp_path / "scores.csv").read_bytes() == (tmp_path / "two.csv").read_bytes()


def test_a_scene_is_opened_with_the_settings_of_the_stage(opened, tmp_path):
    settings = EvaluateSettings(node_select=0.5, template="a photo of a {}", methods=("tree",))
    opened.evaluate(tmp_path / "scores.csv", settings)
    assert opened.asked["settings"] is settings
    other = EvaluateSettings()
    panel.run_figures(opened.parts, tmp_path / "panel.png", FiguresSettings(), other, queries=["bear"])
    assert opened.asked["settings"] is other
    assert opened.asked["parts"] is opened.parts


def test_a_scene_without_annotations_gives_only_a_header(opened, tmp_path):
    assert len(opened.evaluate(tmp_path / "scores.csv", truth=None)) == 0


def test_the_panel_is_written_with_the_pictures_of_poses_and_fit_beside_it(opened, tmp_path):
    (opened.parts.scene / "registration.png").write_bytes(b"cameras")
    (tmp_path / "fit").mkdir()
    (tmp_path / "fit/test_views.png").write_bytes(b"renders")
    out, settings = tmp_path / "panel.png", FiguresSettings(queries_per_level=1)
    given = {"fit": tmp_path / "fit", "truth": opened.truth}
    panel.run_figures(opened.parts, out, settings, EvaluateSettings(), **given)
    with Image.open(out) as picture:
        assert picture.width == 1430
    assert (tmp_path / "registration.png").read_bytes() == b"cameras"
    assert (tmp_path / "fit.png").read_bytes() == b"renders"
