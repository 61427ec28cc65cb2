"""The summary at the end of a run."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from hilsplat.base.artifacts import write_json
from hilsplat.base.tables import write_csv
from hilsplat.workflow import run as runs
from hilsplat.workflow import summary as summaries
from tests.unit.workflow.plans import BENCHMARK, plan_of

ROWS = ("photos desk photos photos metre", "photos chair photos photos metre")


@pytest.fixture
def project(desk, tmp_path, monkeypatch) -> Path:
    """A project with one finished scene and one that was never run."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(desk, "results/photos/desk")
    Path("photos").mkdir()
    shutil.copy(desk / "scene/images/000.png", "photos")
    return tmp_path


def described(project: Path, *rows: str) -> dict[str, str]:
    """First word of each line of the summary -> the rest."""
    lines = summaries.summary(plan_of(project, rows or ROWS, groups=["photos"]))
    assert lines[0] == "photos/desk:"
    return {line.split()[0]: line.split(maxsplit=1)[1] for line in lines[1:]}


def test_a_scene_is_described_with_its_numbers_files_and_next_commands(project):
    folder = Path("results/photos/desk")
    registered = {"images": 7, "registered": 6, "mean_reprojection_error_px": 0.614}
    write_json(folder / "scene/registration.json", registered)
    write_json(folder / "gaussians/report.json", {"psnr_db": 20.04, "gaussians": 864, "split": "test"})
    Path("results/figures/photos/desk").mkdir(parents=True)
    for name in ("panel", "fit"):
        Path(f"results/figures/photos/desk/{name}.webp").touch()
    write_csv(folder / "scores.csv", ["method", "mIoU", "protocol"], [["hilsplat (tree)", "75.0", "lerf"]])
    found = described(project)
    assert found["poses"] == "6 of 7 views registered; reprojection error 0.61 px"
    assert found["Gaussians"] == "864; PSNR 20.0 dB in 1 held-out view: fair"
    assert found["nodes"] == "2 whole, 2 part, 1 subpart (graph, colours)"
    assert found["pictures"] == "fit.webp, panel.webp in results/figures/photos/desk"
    assert found["scores"] == "in %, also in results/photos/desk/scores.md and scores.csv:"
    assert found["hilsplat"].split() == ["(tree)", "75.0", "lerf"]
    assert found["next"] == 'hilsplat query photos/desk "..."  or  hilsplat view photos/desk'


@pytest.mark.parametrize(
    ("psnr_db", "split", "words"),
    [
        (25.0, "test", "PSNR 25.0 dB in 1 held-out view: good"),
        (19.9, "test", "PSNR 19.9 dB in 1 held-out view: poor"),
        (31.0, "train", "PSNR 31.0 dB in training views; none is held out"),
    ],
)
def test_only_held_out_views_are_judged(project, psnr_db, split, words):
    report = {"psnr_db": psnr_db, "gaussians": 1, "split": split}
    write_json(Path("results/photos/desk/gaussians/report.json"), report)
    assert described(project)["Gaussians"] == f"1; {words}"


def test_a_scene_without_a_tree_continues_with_a_run(project):
    shutil.rmtree("results/photos/desk/default")
    assert described(project)["next"] == "hilsplat run photos/desk"
    runs.record_run(
        plan_of(project, ROWS, groups=["photos"]), [Path("config/mine.yaml")], {"seed": 5, "only": ["desk"]}
    )
    assert (
        described(project)["next"] == "hilsplat run --config config/mine.yaml photos/desk -- --config seed=5"
    )


def test_many_scenes_share_a_table(project):
    for name in ("a", "b", "c"):
        shutil.copytree("results/photos/desk/scene", f"results/photos/{name}/scene")
    rows = tuple(f"photos {name} photos photos metre" for name in ("a", "b", "c", "desk"))
    lines = summaries.summary(plan_of(project, rows, groups=["photos"]))
    assert [line.split()[0] for line in lines] == [
        "scene",
        *(f"photos/{name}" for name in ("a", "b", "c", "desk")),
    ]


def test_very_many_scenes_are_only_counted(project, monkeypatch):
    monkeypatch.setattr(summaries, "TABLED", 0)
    monkeypatch.setattr(summaries, "DETAILED", 0)
    lines = summaries.summary(plan_of(project, ROWS, groups=["photos"]))
    assert lines == ["1 scenes have poses; to list them: hilsplat scenes --results results"]


def test_a_run_of_files_describes_their_scenes_only(project):
    shutil.copytree("results/photos/desk/scene", "results/photos/chair/scene")
    found = plan_of(project, ROWS, groups=["photos"])
    lines = summaries.summary(found, ["results/photos/chair/scene", "results/tables/lerf.csv"])
    assert [line for line in lines if line.endswith(":")] == ["photos/chair:"]


def test_scenes_that_the_tables_of_a_run_leave_out_are_named(project):
    shutil.copytree("results/photos/desk/scene", "results/synthetic/one/scene")
    for file in ("tables/lerf.csv", "synthetic/two/default/scores.csv"):
        Path("results", file).parent.mkdir(parents=True, exist_ok=True)
        Path("results", file).touch()
    _, without = summaries.summary(plan_of(project, BENCHMARK, only=["one"]))[-2:]
    assert "have scores but are not in this run: synthetic/two;" in without
    assert summaries.summary(plan_of(project, BENCHMARK))[-1] == "tables: results/tables/*.md"


@pytest.fixture
def ended(project, monkeypatch, caplog) -> Callable[..., str]:
    """A function that runs a scene without Snakemake, and returns the log."""
    plan_of(project, ROWS, groups=["photos"])
    Path("config/config.yaml").write_text("groups: [photos]\n")
    monkeypatch.setattr(runs, "outdated", lambda *_, **__: {})
    caplog.set_level("INFO")

    def run(status: int, *options: str) -> str:
        caplog.clear()
        monkeypatch.setattr(runs, "_run", lambda command: status)
        assert runs.run(["desk"], [], options) == status
        return caplog.text

    return run


def test_damage_is_reported_after_a_run_that_succeeded(ended):
    Path("results/photos/desk/scene/index.json").write_text("{}")
    assert "results/photos/desk/scene/index.json is not an artifact index" in ended(0)


def test_every_run_that_succeeds_ends_with_the_summary(ended):
    for status, options, is_printed in ((0, [], True), (1, [], False), (0, ["-n"], False)):
        assert ("hilsplat view photos/desk" in ended(status, *options)) == is_printed
