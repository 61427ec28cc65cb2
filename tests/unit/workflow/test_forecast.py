"""Times that `hilsplat run` predicts for photographs."""

from types import SimpleNamespace

import pytest

from hilsplat.workflow import forecast
from tests.unit.workflow.test_plan import plan

KEY_VIEWS = {"masks": {"key_views": 0.5}, "clip": {"crops_per_node": 3}}


@pytest.fixture
def photographs(tmp_path, monkeypatch):
    """Seventeen photographs, a SAM of 20 s a view, a CLIP of 0.1 s a crop, and 75 s for each other stage."""
    (tmp_path / "desk").mkdir()
    for number in range(16):
        (tmp_path / f"desk/photo{number}.jpg").touch()
    for module in ("forecast", "plan", "resources"):
        monkeypatch.setattr(
            f"hilsplat.workflow.{module}.read_model", lambda folder: SimpleNamespace(embedded=False)
        )
    seconds = {"image": 19 - 10.24, "preview": 0.007, "masks": 0.01, "crop": 0.1}
    monkeypatch.setattr("hilsplat.embed.model_check.seconds_of", lambda *inputs: seconds)
    monkeypatch.setattr(forecast.JobResources, "core_seconds", lambda self, rule, job: 75.0)
    return tmp_path


def test_first_answer_and_all_photographs_are_predicted(photographs):
    masks, variants = {"prompts": "guided"}, {"key-views": KEY_VIEWS}
    found = plan(photographs, groups=["photos"], variants=variants, main_variants=["default"], masks=masks)
    (line,) = forecast.forecasts(found, 2)
    # 15 training views: 150 + 7.5 x 20 + 75 + 400 x 3 x 0.1 = 495 core seconds, then 7.5 x 12.3 + 150 + 200
    assert line.startswith("photos/desk: first answer in about 4 min, all photographs in about 8 min.")
    assert "20 s of SAM on one of 2 cores, a crop 0.10 s of CLIP" in line


def test_without_key_views_there_is_one_time(photographs):
    found = plan(photographs, groups=["photos"], variants={}, main_variants=["default"])
    (line,) = forecast.forecasts(found, 1)
    assert line.startswith("photos/desk: all photographs in about 13 min.")


def test_scenes_that_answer_and_synthetic_scenes_have_no_forecast(photographs, monkeypatch):
    monkeypatch.chdir(photographs)
    found = plan(photographs, groups=["photos", "benchmark"], variants={}, main_variants=["default"])
    (photographs / "results/photos/desk/default/clip").mkdir(parents=True)
    assert forecast.forecasts(found, 2) == []
