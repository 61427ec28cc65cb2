"""The diagnostic segmenter reads the truth when it is requested; no other segmenter does."""

from pathlib import Path

import pytest

from tests.workflow.conftest import Project, copy_project

ASKED = ("--config", "main_variants=[default]", "ablation_variants=[default,truth-exact]")


@pytest.fixture
def plain(project: Path, tmp_path: Path) -> Project:
    return copy_project(project, tmp_path / "project", results=False)


def masks_jobs(project: Project, *words: str) -> dict[str, str]:
    """What a dry run prints of each masks job, by variant."""
    text = project.snakemake("-n", "--printshellcmds", *words).stdout
    blocks = [block for block in text.split("\nrule ")[1:] if block.startswith("masks:")]
    return {block.split("variant=")[1].split()[0]: block.split("\n\n")[0] for block in blocks}


def test_truth_is_an_input_of_the_diagnostic_segmenter_alone(plain: Project) -> None:
    jobs = masks_jobs(plain, *ASKED)
    assert not [variant for variant, job in jobs.items() if "truth" in job and variant != "truth-exact"]
    assert "--truth results/synthetic/tiny/world/truth" in jobs["truth-exact"]
    assert "--perturb" in jobs["truth-exact"]


def test_the_diagnostic_is_in_no_run_unless_it_is_named(plain: Project) -> None:
    jobs = masks_jobs(plain)
    assert "default" in jobs and not [job for job in jobs.values() if "truth" in job]


def test_a_scene_without_truth_is_refused(plain: Project) -> None:
    sheet = plain.root / "config/scenes.tsv"
    sheet.write_text(sheet.read_text() + "photos\tdesk\tphotos\tdesk\tarbitrary\n")
    (plain.root / "desk").mkdir()
    for number in range(3):
        (plain.root / "desk" / f"{number}.jpg").write_bytes(b"")
    plain.edit("config/config.yaml", "segmenter: auto", "segmenter: truth-perturbed")
    result = plain.snakemake("-n", "--config", "groups=[photos]", check=False)
    assert result.returncode != 0
    assert "photos/desk, variant default: masks.segmenter truth-perturbed needs the true labels" in (
        result.stdout + result.stderr
    )
