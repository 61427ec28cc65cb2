"""The table after a dry run, and the times that `hilsplat run` predicts for photographs."""

import logging
import re
from types import SimpleNamespace

import pytest

from hilsplat.workflow import estimate
from hilsplat.workflow.resources import NODES, PICTURE_S, START_S, JobResources, Size
from snakemake_logger_plugin_hilsplat import LogHandler
from tests.unit.workflow.plans import BENCHMARK, plan_of
from tests.unit.workflow.test_resources import plan

SCENES = ({"dataset": "synthetic", "scene": "0"}, {"dataset": "synthetic", "scene": "1"})


@pytest.fixture
def resources(tmp_path, monkeypatch):
    found = JobResources(plan(tmp_path, scenes=2), cores=2)
    seconds = {"gaussians": 7200.0, "poses": 720.0}
    monkeypatch.setattr(found, "core_seconds", lambda rule, job: seconds.get(rule, START_S))
    monkeypatch.setattr(found, "card_seconds", lambda rule, job: 900.0 if rule == "gaussians" else None)
    monkeypatch.setattr(found, "disk_mb", lambda rule, job: 500.0 if rule == "gaussians" else 0.0)
    return found


def test_jobs_are_summed_by_data_set(resources, monkeypatch):
    assert 0.05 < estimate.machine_scale(estimate.start_probe()) < 20
    monkeypatch.setattr(estimate, "machine_scale", lambda probe: 0.5)
    run = estimate.RunEstimate(resources)
    assert run.lines() == []
    for scene in SCENES:
        run.add("poses", scene, 1000)
        run.add("gaussians", scene, 4000)
    run.add("table", {"table": "lerf"}, 500)
    rows = [re.split(r"\s{2,}", line) for line in run.lines()[1:5]]
    assert rows[0] == ["", "scenes", "jobs", "disk", "memory", "hours, 2 cores", "hours, GPU"]
    # two scenes of 7920 core seconds on two cores, at twice the speed; 7200 of them are 900 s of the card
    gpu = (2 * 900 + 0.5 * 720) / 3600
    assert rows[1] == ["synthetic", "2", "4", "1.0 GB", "4.0 GB", "1.10", f"{gpu:.2f}"]
    assert [row[0] for row in rows[2:]] == ["tables", "all"]
    assert rows[3][1:5] == ["2", "5", "1.0 GB", "4.0 GB"]


def test_a_dry_run_lists_each_job_with_its_reason_on_one_line(capsys):
    settings = SimpleNamespace(stdout=True, dryrun=True, verbose=False, quiet=None)
    handler = LogHandler(settings, None)
    facts = {"rule_name": "masks", "wildcards": {**SCENES[0], "variant": "default"}, "resources": {}}
    for event, message, more in (
        (None, "Building DAG of jobs...", {}),
        ("run_info", "Job stats:", {}),
        ("job_info", "rule masks:\n    input: many", facts | {"reason": "Missing output files: results/a"}),
    ):
        common = {"msg": message, "levelno": logging.INFO, "pathname": "a.py", "event": event}
        handler.handle(logging.makeLogRecord(common | more))
    handler.close()
    assert capsys.readouterr().out.splitlines() == [
        "Job stats:",
        "rule masks: synthetic/0/default: Missing output files",
    ]


DESK = "photos desk photos desk arbitrary"
KEY_VIEWS = {"masks": {"key_views": 0.5}, "clip": {"crops_per_node": 3}}


@pytest.fixture
def photographs(tmp_path, monkeypatch):
    """Seventeen photographs, a SAM of 20 s a view, a CLIP of 0.1 s a crop, and 75 s for each other stage."""
    (tmp_path / "desk").mkdir()
    for number in range(17):
        (tmp_path / f"desk/photo{number}.jpg").touch()
    for name in ("estimate.read_model", "plan.planned_model", "resources.planned_model"):
        monkeypatch.setattr(f"hilsplat.workflow.{name}", lambda folder: SimpleNamespace(embedded=False))
    seconds = {"image": 19 - 10.24, "preview": 0.007, "masks": 0.01, "crop": 0.1}
    monkeypatch.setattr("hilsplat.embed.model_check.seconds_of", lambda *inputs: seconds)
    monkeypatch.setattr(estimate.JobResources, "core_seconds", lambda self, rule, job: 75.0)
    return tmp_path


def test_time_on_a_card_grows_with_the_work(photographs, monkeypatch):
    """20 views of 0.5 megapixels, fit in 1,200 steps to 80,000 Gaussians."""
    constants = {"fit_step_s": 0.001, "fit_step_s_per_mp": 0.01, "fit_step_s_per_gaussian": 1e-7}
    constants |= {"sam_picture_s": {"huge": 0.5, "": 0.1}, "clip_crop_s": 0.002}
    monkeypatch.setattr("hilsplat.workflow.resources.GPU", constants)
    fit = {"iterations": 1200, "max_gaussians": 80_000, "quarter_until": 0.0, "half_until": 0.0}
    masks = {"model": "models/sam-vit-huge", "crop_layers": 1}
    found = plan_of(photographs, (DESK,), groups=["photos"], gaussians=fit, masks=masks)
    resources = JobResources(found, cores=2)
    monkeypatch.setattr(resources, "size", lambda row: Size(20, 0.5))
    (row,) = found.scenes
    assert resources.card_seconds("gaussians", row) == pytest.approx(START_S + 1200 * (0.001 + 0.005 + 0.006))
    assert resources.card_seconds("masks", row) == pytest.approx(START_S + 20 * 5 * 0.5)
    nodes = found.stages(row).clip.crops_per_node * NODES
    assert resources.card_seconds("clip", row) == pytest.approx(START_S + 0.002 * nodes)
    assert resources.card_seconds("field", row) is None
    # variants that only filter the same candidates use cached ones
    run = estimate.RunEstimate(resources)
    job = {"dataset": "photos", "scene": "desk"}
    for variant in ("default", "default"):
        run.add("masks", {**job, "variant": variant}, 1000)
    first, second = run._jobs["photos"]
    assert (first.card_s, second.card_s) == (pytest.approx(52.0), None)
    assert second.core_s == START_S + 20 * PICTURE_S


def test_first_answer_and_all_photographs_are_predicted(photographs):
    config = {"masks": {"prompts": "guided"}, "variants": {"key-views": KEY_VIEWS}}
    found = plan_of(photographs, (DESK,), groups=["photos"], main_variants=["default"], **config)
    (line,) = estimate.forecasts(found, 2)
    # 15 training views: 150 + 7.5 x 20 + 75 + 400 x 3 x 0.1 = 495 core seconds, then 7.5 x 12.3 + 150 + 200
    assert line.startswith("photos/desk: first answer in about 4 min, all photographs in about 8 min.")
    assert (
        "SAM takes 20.0 s per photograph on one of 2 cores, and CLIP 0.1 s per crop on one of 2 cores" in line
    )
    assert "GPU" not in line


@pytest.mark.parametrize(
    ("key_views", "words"),
    [
        # 150 + 15 x 60 + 150 + 400 x 5 x 0.3 = 1800 s
        (False, "desk: all photographs in about 30 min."),
        # half of the 15 views, and 400 x 3 crops: 150 + 450 + 75 + 360 = 1035 s, then 450 + 150 + 600
        (True, "desk: first answer in about 17 min, all photographs in about 37 min."),
    ],
)
def test_jobs_on_a_card_are_predicted_without_measuring_the_cpu(photographs, monkeypatch, key_views, words):
    monkeypatch.setattr("hilsplat.embed.model_check.seconds_of", lambda *given: pytest.fail("it measured"))
    monkeypatch.setattr("hilsplat.workflow.resources.cards", lambda: ["0"])
    for name in ("card_problem", "expected_problem"):
        monkeypatch.setattr(f"hilsplat.workflow.resources.{name}", lambda: None)
    monkeypatch.setitem(estimate.GPU, "clip_crop_s", 0.3)
    seconds = {"gaussians": lambda masks: 75.0, "masks": lambda masks: 17 * masks.key_views * 60.0}
    monkeypatch.setattr(
        estimate.JobResources,
        "card_seconds",
        lambda self, rule, job: seconds[rule](self.plan.stages(job).masks),
    )
    config = {"variants": {"key-views": KEY_VIEWS}} if key_views else {}
    found = plan_of(photographs, (DESK,), groups=["photos"], main_variants=["default"], **config)
    monkeypatch.setattr(
        estimate.JobResources, "core_seconds", lambda self, rule, job: 75.0 if rule != "gaussians" else 1e6
    )
    line, note = estimate.forecasts(found, 1)
    assert words in line and "SAM takes 60.0 s per photograph on the GPU, and CLIP 0.3 s per crop" in line
    assert "estimated, not measured" in note


def test_without_key_views_there_is_one_time(photographs):
    found = plan_of(photographs, (DESK,), groups=["photos"])
    (line,) = estimate.forecasts(found, 1)
    assert line.startswith("photos/desk: all photographs in about 13 min.")


def test_scenes_that_are_ready_and_synthetic_scenes_have_no_forecast(photographs, monkeypatch):
    monkeypatch.chdir(photographs)
    found = plan_of(photographs, (*BENCHMARK, DESK), groups=["photos", "benchmark"])
    (photographs / "results/photos/desk/default/clip").mkdir(parents=True)
    assert estimate.forecasts(found, 2) == []
