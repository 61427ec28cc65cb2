"""What `snakemake --cores 2` prints: a line per stage, the query commands, errors in full."""

import re
import shutil

from tests.workflow.conftest import SCENE, Project

VECTORS = f"{SCENE}/default/clip"


def test_a_finished_stage_is_one_line_and_query_commands_follow(copy_of_finished: Project) -> None:
    project = copy_of_finished
    shutil.rmtree(project.root / VECTORS)
    printed = project.snakemake(VECTORS).stderr
    assert re.search(r"^synthetic/tiny clip: \d+ s \(1 of 1 done\)$", printed, re.MULTILINE), printed
    assert printed.count("hilsplat view synthetic/tiny") == 1
    assert "rule clip:" not in printed and "Select jobs" not in printed
    record = max((project.root / ".snakemake/log").iterdir(), key=lambda file: file.stat().st_mtime)
    assert "rule clip:" in record.read_text()  # Snakemake's own log has everything
    shutil.rmtree(project.root / VECTORS)
    printed = project.snakemake(VECTORS, "--verbose").stderr
    assert "rule clip:" in printed and "synthetic/tiny clip: " not in printed


def test_a_failed_job_is_shown_in_full_with_the_log_of_its_stage(copy_of_finished: Project) -> None:
    no_masks = 'masks={"predicted_iou_min": 1.0}'
    failed = copy_of_finished.snakemake(f"{SCENE}/default/contributions", "--config", no_masks, check=False)
    assert failed.returncode != 0
    assert "Error in rule contributions:" in failed.stderr
    assert "shell:" in failed.stderr and " contributions --settings" in failed.stderr
    assert "Logfile" in failed.stderr  # profiles/default was found
    assert "has masks" in failed.stderr.partition("Logfile")[2]
