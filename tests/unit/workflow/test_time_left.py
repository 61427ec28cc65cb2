"""How long a run still takes: guesses, measurements, the order of jobs."""

import ast
import json
from pathlib import Path

import numpy as np
import pytest

from hilsplat.configuration import parse_run
from hilsplat.workflow.job_times import earlier_ratios, planned_job, size_of
from hilsplat.workflow.plan import Plan
from hilsplat.workflow.stages import STAGES
from hilsplat.workflow.time_left import (
    LOOPS,
    Pace,
    PlannedJob,
    Size,
    duration,
    first_guess,
    left_of_running,
    measured_seconds,
    time_left,
)

ROOT = Path(__file__).resolve().parents[3]


def job(number, seconds=10.0, after=(), *, threads=1, rule="clip", priority=0, measured=None) -> PlannedJob:
    return PlannedJob(
        number, rule, "photos/desk", "default", threads, frozenset(after), priority, float(seconds), measured
    )


def left(jobs, running=None, cores=2) -> float:
    return time_left(jobs, running or {}, lambda each: each.guess_s, cores)


def test_jobs_that_wait_for_each_other_take_their_sum_and_others_share_the_cores():
    assert left([job(1, 10), job(2, 5, [1]), job(3, 1, [2])]) == 16
    assert left([job(1, 10), job(2, 5), job(3, 5)]) == 10
    assert left([job(1, 10), job(2, 5), job(3, 5)], cores=1) == 20


def test_a_job_on_all_cores_waits_until_they_are_free():
    assert left([job(1, 10), job(2, 5, threads=2)]) == 15
    assert left([job(2, 5, threads=8)]) == 5  # Snakemake scales it down


def test_what_runs_counts_with_what_is_left_of_it():
    assert left([job(2, 5, [1])], {1: (2, 3.0)}) == 8
    assert left([], {1: (1, 3.0), 2: (1, 4.0)}) == 4
    assert left([]) == 0


def test_of_the_jobs_that_could_start_the_highest_priority_is_first():
    long, short = job(1, 10, priority=0), job(2, 1, priority=5)
    assert left([long, short, job(3, 10, [2])], cores=1) == 21
    # last in line, the long one leaves a core idle
    assert left([long, short, job(3, 4, [2], priority=9), job(4, 4, priority=9)]) == 14


def test_an_earlier_run_of_the_same_job_counts_more_than_any_guess():
    pace = Pace({"clip": [3.0]})
    assert pace.seconds(job(1, 10, measured=42.0)) == 42
    assert pace.seconds(job(1, 10)) == 30  # as much slower than the guess as the same rule was elsewhere
    assert pace.seconds(job(1, 10, rule="masks")) == 10


def test_an_earlier_run_on_a_busier_machine_is_corrected():
    pace = Pace()
    for number in range(2):
        pace.learn(job(number, 10, measured=100.0), 20.0)
    assert pace.seconds(job(3, 10, rule="field", measured=50.0)) == 10


def test_a_machine_that_turns_out_slower_makes_all_guesses_longer():
    pace = Pace()
    for number in range(3):
        pace.learn(job(number, 10, rule="clip"), 40.0)
    assert pace.seconds(job(7, 10, rule="masks")) == 40
    pace.learn(job(4, 10, rule="masks"), 20.0)
    assert pace.seconds(job(8, 10, rule="masks")) == 20


@pytest.mark.parametrize(
    ("elapsed", "share", "expected"), [(30.0, 0.0, 70.0), (30.0, 0.5, 30.0), (30.0, 1.0, 0.0)]
)
def test_a_job_that_tells_its_share_is_believed(elapsed, share, expected):
    assert left_of_running(100.0, elapsed, share) == pytest.approx(expected)


def test_a_first_percent_is_not_yet_believed():
    assert left_of_running(100.0, 10.0, 0.01) == pytest.approx(0.95 * 100 + 0.05 * 1000 - 10)


def test_a_job_that_is_later_than_thought_is_never_nearly_done():
    assert left_of_running(10.0, 200.0, 0.0) == 20


def test_guesses_grow_with_the_work():
    stages = parse_run({}).stages()
    small, large = Size(10, 0.3), Size(40, 0.3)
    for rule in ("poses", "masks", "clip", "contributions", "field"):
        assert first_guess(rule, stages, large, 1) > 2 * first_guess(rule, stages, small, 1), rule
        assert first_guess(rule, stages, large, 2) < first_guess(rule, stages, large, 1), rule
    longer = parse_run({"gaussians": {"steps_per_view": 120}}).stages()
    once, twice = (first_guess("gaussians", each, small, 1) for each in (stages, longer))
    assert twice - 2 == pytest.approx(2 * (once - 2))
    halved = parse_run({"gaussians": {"image_scale": 0.5}}).stages()
    assert first_guess("gaussians", halved, small, 1) - 2 == pytest.approx((once - 2) / 4)


@pytest.mark.parametrize("rule", LOOPS)
def test_the_loop_of_a_rule_is_one_that_its_stage_runs(rule):
    module = STAGES[rule].partition(":")[0]
    tree = ast.parse((ROOT / f"{module.replace('.', '/')}.py").read_text())
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    told = [each.args[1] for each in calls if getattr(each.func, "id", "") == "track"]
    assert LOOPS[rule] in {text.value for text in told if isinstance(text, ast.Constant)}


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (3, "less than 10 s"),
        (44, "about 40 s"),
        (58, "about 1 min"),
        (500, "about 8 min"),
        (3600, "about 60 min"),
        (7700, "about 2 h 10 min"),
        (10700, "about 3 h"),
    ],
)
def test_time_left_is_said_no_more_exactly_than_it_is_known(seconds, text):
    assert duration(float(seconds)) == text


@pytest.fixture
def plan(tmp_path, monkeypatch) -> Plan:
    """A run of two folders of photographs, one of them finished once."""
    from PIL import Image

    monkeypatch.chdir(tmp_path)
    lines = ["dataset\tscene\tgroup\tsource\tunit\tgaussians"]
    for name in ("desk", "shelf"):
        (tmp_path / name).mkdir()
        for number in range(4):
            Image.new("RGB", (2000, 1000)).save(tmp_path / name / f"{number}.jpg")
        lines.append(f"photos\t{name}\tphotos\t{tmp_path / name}\tarbitrary\t")
    (tmp_path / "scenes.tsv").write_text("\n".join(lines) + "\n")
    finished = tmp_path / "results/photos/desk"
    for folder in ("scene", "benchmarks", "default/benchmarks", "forgotten/benchmarks"):
        (finished / folder).mkdir(parents=True)
    np.savez(finished / "scene/cameras.npz", size_hw=np.array([(500, 1000)] * 2, np.int32))
    for file, seconds in {"": 82.0, "default/": 50.0, "forgotten/": 9.0}.items():
        rule = "clip" if file else "poses"
        (finished / f"{file}benchmarks/{rule}.jsonl").write_text(json.dumps({"s": seconds}) + "\n")
    return Plan({"scenes": "scenes.tsv", "groups": ["photos"]})


def test_a_scene_is_as_large_as_its_poses_say_or_its_photographs(plan):
    desk, shelf = plan.rows
    assert size_of(plan, desk) == Size(2, 0.5)
    found = size_of(plan, shelf)
    assert (found.views, found.view_mp) == (4, pytest.approx(1.28))  # as poses.max_side_px shrinks it


def test_earlier_runs_of_other_scenes_correct_the_guess(plan):
    ratios = earlier_ratios(plan, threads=1)
    guess = first_guess("poses", plan.run.stages(), Size(2, 0.5), 1)
    assert ratios["poses"] == [pytest.approx(82 / guess)]
    assert len(ratios["clip"]) == 1  # not that of a variant that is no longer configured


def test_a_job_knows_its_scene_and_what_it_took_before(plan):
    clip = {"dataset": "photos", "scene": "desk", "variant": "default"}
    benchmark = "results/photos/desk/default/benchmarks/clip.jsonl"
    planned = planned_job(plan, 3, "clip", clip, threads=2, benchmark=benchmark, after=[1])
    assert (planned.name, planned.measured_s, planned.after) == ("photos/desk clip", 50.0, {1})
    table = planned_job(plan, 4, "table", {"table": "lerf"}, threads=1, benchmark="results/none.jsonl")
    assert (table.name, table.measured_s) == ("table", None)


def test_a_benchmark_cut_short_counts_as_none(tmp_path):
    (tmp_path / "a.jsonl").write_text('{"s": 1')
    assert measured_seconds(tmp_path / "a.jsonl") is None
