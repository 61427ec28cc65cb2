"""The diagnostic segmenter reads the truth when it is requested; no other segmenter does."""

from tests.workflow.conftest import Project

ASKED = ("--config", "main_variants=[default]", "ablation_variants=[default,truth-exact]")


def masks_jobs(project: Project, *words: str) -> dict[str, str]:
    """What a dry run prints of each masks job, by variant."""
    text = project.snakemake("-n", "--printshellcmds", *words).stdout
    blocks = [block for block in text.split("\nrule ")[1:] if block.startswith("masks:")]
    return {block.split("variant=")[1].split()[0]: block.split("\n\n")[0] for block in blocks}


def test_truth_is_an_input_only_of_the_diagnostic_segmenter(plain: Project) -> None:
    jobs = masks_jobs(plain, *ASKED)
    assert not [variant for variant, job in jobs.items() if "truth" in job and variant != "truth-exact"]
    assert "--truth results/synthetic/tiny/world/truth" in jobs["truth-exact"]
    assert "--perturb" in jobs["truth-exact"]


def test_the_diagnostic_is_in_no_run_unless_it_is_named(plain: Project) -> None:
    jobs = masks_jobs(plain)
    assert "default" in jobs and not [job for job in jobs.values() if "truth" in job]
