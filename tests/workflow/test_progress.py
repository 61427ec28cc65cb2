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


def test_the_error_of_a_failed_job_is_the_last_lines_of_a_run(copy_of_finished: Project) -> None:
    no_masks = 'masks={"predicted_iou_min": 1.0}'
    target = f"{SCENE}/default/contributions"
    failed = copy_of_finished.snakemake(target, "--config", no_masks, check=False)
    assert failed.returncode != 0
    log = f"{SCENE}/default/logs/contributions.log"
    where = f"synthetic/tiny contributions failed; its log is {log}\n"
    ending = failed.stderr.partition(where)[2].splitlines()  # profiles/default was found
    assert "has masks" in ending[0] and all(line.startswith("  ") for line in ending[1:])
    assert "Error in rule" not in failed.stderr
    record = max((copy_of_finished.root / ".snakemake/log").iterdir(), key=lambda file: file.stat().st_mtime)
    assert "Error in rule contributions:" in record.read_text()
    shown = copy_of_finished.snakemake(target, "--config", no_masks, "--verbose", check=False).stderr
    assert "Error in rule contributions:" in shown and " contributions --settings" in shown
