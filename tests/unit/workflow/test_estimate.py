"""The table after a dry run: jobs, disk, memory and hours of each data set."""

import re

import pytest

from hilsplat.workflow.estimate import GPU_GAIN, RunEstimate
from hilsplat.workflow.resources import START_S, JobResources
from tests.unit.workflow.test_resources import plan

SCENES = ({"dataset": "synthetic", "scene": "0"}, {"dataset": "synthetic", "scene": "1"})


@pytest.fixture
def resources(tmp_path, monkeypatch):
    found = JobResources(plan(tmp_path, scenes=2), cores=2)
    seconds = {"gaussians": 7200.0, "poses": 720.0}
    monkeypatch.setattr(found, "core_seconds", lambda rule, job: seconds.get(rule, START_S))
    monkeypatch.setattr(found, "disk_mb", lambda rule, job: 500.0 if rule == "gaussians" else 0.0)
    return found


def test_jobs_are_summed_by_data_set(resources):
    estimate = RunEstimate(resources)
    assert estimate.lines() == [], "nothing would run"
    for scene in SCENES:
        estimate.add("poses", scene, 1000)
        estimate.add("gaussians", scene, 4000)
    estimate.add("table", {"table": "lerf"}, 500)
    rows = [re.split(r"\s{2,}", line) for line in estimate.lines()[1:5]]
    assert rows[0] == ["", "scenes", "jobs", "disk", "memory", "hours, 2 cores", "hours, GPU"]
    # two scenes of 7920 core seconds on two cores; 7200 of them by the GPU
    gpu = (2 * 7200 / GPU_GAIN["gaussians"] + 720) / 3600
    assert rows[1] == ["synthetic", "2", "4", "1.0 GB", "4.0 GB", "2.20", f"{gpu:.2f}"]
    assert [row[0] for row in rows[2:]] == ["tables", "all"]
    assert rows[3][1:5] == ["2", "5", "1.0 GB", "4.0 GB"]


def test_more_steps_prompts_and_crops_take_longer(tmp_path):
    def seconds(rule: str, **config: object) -> float:
        found = JobResources(plan(tmp_path, **config))
        job = type("Job", (), {"dataset": "synthetic", "scene": "0", "variant": "default"})
        return found.core_seconds(rule, job) - START_S

    steps = {"gaussians": {"iterations": 500}}
    assert seconds("gaussians") > 2 * seconds("gaussians", **steps)
    network = {"autoencoder": {"code": "network", "latent": 3}}
    literal = {**network, "field": {"trainer": "literal", "iterations": 10000}}
    assert seconds("field", **literal) > 10 * seconds("field", **network)
    baseline = {"method": {"name": "langsplat", "steps": 3000}}
    longer = {"method": {"name": "langsplat", "steps": 30000}}
    assert seconds("method", **longer) == pytest.approx(10 * seconds("method", **baseline), rel=0.2)
