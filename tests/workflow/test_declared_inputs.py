"""Every rule reads only the results that it declares, and gives the same bytes from those alone."""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.workflow.conftest import Project, copy_project

FOLDERS = ("masks", "coverage_tree", "clip", "contributions", "semantic_tree", "names", "autoencoder")
OUTPUTS = {
    "poses": "results/synthetic/tiny/scene",
    "gaussians": "results/synthetic/tiny/gaussians.ply",
    **{name: f"results/synthetic/tiny/default/{name}" for name in FOLDERS},
    "field": "results/synthetic/tiny/default/field.safetensors",
    "method": "results/synthetic/tiny/lifted/field.safetensors",
    "evaluate": "results/synthetic/tiny/default/scores.csv",
    "figures": "results/figures/synthetic/tiny/panel.webp",
    "mask_truth": "results/figures/synthetic/tiny/masks.webp",
    "comparison": "results/figures/synthetic/tiny/comparison.webp",
    "table": "results/tables/hierarchy.csv",
    "sweep_plot": "results/figures/sweep-theta.png",
}
"""One output of each rule that has inputs."""
TIMED = {"results/synthetic/tiny/default/times.csv"}  # outputs that hold times, which differ from run to run


@dataclass(frozen=True)
class Job:
    """A job of a finished run, as Snakemake reports it: what it may read, what it wrote, and its command."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    command: str


@pytest.fixture(scope="module")
def jobs(finished: Project) -> Mapping[str, Job]:
    """The job that wrote each of `OUTPUTS`, by rule."""
    header, *lines = finished.snakemake("--detailed-summary").stdout.splitlines()
    names = header.split("\t")
    rows = [dict(zip(names, line.split("\t"), strict=True)) for line in lines if line.count("\t") > 5]
    found = {}
    for rule, output in OUTPUTS.items():
        [row] = [row for row in rows if row["output_file"] == output]
        assert row["rule"] == rule, output
        outputs = (other["output_file"] for other in rows if other["shellcmd"] == row["shellcmd"])
        found[rule] = Job(tuple(row["input-file(s)"].split(",")), tuple(outputs), row["shellcmd"])
    return found


@pytest.fixture(scope="module")
def empty(finished: Project, tmp_path_factory: pytest.TempPathFactory) -> Project:
    """A copy of the project, whose results every test clears."""
    return copy_project(finished.root, tmp_path_factory.mktemp("alone") / "project", results=False)


def copy_artifact(source: Path, target: Path) -> None:
    """Copy a file or folder, with the provenance that belongs to it."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copytree(source, target) if source.is_dir() else shutil.copy2(source, target)
    record = source.with_name(f"{source.name}.provenance.json")
    if record.is_file():
        shutil.copy2(record, target.with_name(record.name))


@pytest.mark.parametrize("rule", OUTPUTS)
def test_declared_inputs_are_enough(
    rule: str, jobs: Mapping[str, Job], finished: Project, empty: Project
) -> None:
    job = jobs[rule]
    shutil.rmtree(empty.root / "results", ignore_errors=True)
    for path in job.inputs:
        if path.startswith("results/"):
            copy_artifact(finished.root / path, empty.root / path)
    empty.run("bash", "-c", job.command)
    for path in job.outputs:
        if path not in TIMED:
            assert empty.files(path) == finished.files(path), path


def test_no_stage_before_evaluate_declares_the_truth(jobs: Mapping[str, Job]) -> None:
    after = {"evaluate", "figures", "mask_truth", "comparison", "table", "sweep_plot"}
    readers = {rule for rule, job in jobs.items() if any(path.endswith("world/truth") for path in job.inputs)}
    assert readers == {"evaluate", "figures", "mask_truth", "comparison"} <= after
