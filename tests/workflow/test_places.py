"""The workflow runs from any folder, as a module, from a read-only clone, in an unactivated environment."""

import re
import shutil
import sys
from pathlib import Path

import pytest

from tests.workflow.conftest import Project, copy_project

PRIVATE = re.compile(
    r"workflow\.(persistence|dag|is_main_process|executor_plugin|rerun_triggers|resource_settings|output_settings"
    r"|local_exec)|logger\.(handlers|addHandler|removeHandler)|forcefiles|\.snakemake/locks|getattr\(workflow"
)
OUTPUTS = ("synthetic/tiny/gaussians.ply", "synthetic/tiny/default/scores.csv")


def test_only_documented_interfaces_of_snakemake_are_used(project: Path) -> None:
    files = [project / "Snakefile"]
    for part in ("rules", "workflow", "hilsplat", "profiles", "snakemake_logger_plugin_hilsplat"):
        files += [file for file in (project / part).rglob("*") if file.suffix in (".py", ".smk", ".yaml")]
    assert len(files) > 200
    assert [str(file) for file in files if PRIVATE.search(file.read_text())] == []


@pytest.fixture
def clone(finished: Project, tmp_path: Path) -> Project:
    """A copy of the project, without results, in a folder with a space and a non-ASCII letter."""
    return copy_project(finished.root, tmp_path / "my scènes", results=False)


def plan_of(project: Project, folder: Path, *words: str) -> str:
    """Return the output of a dry run in another folder."""
    command = [sys.executable, "-m", "snakemake", "-n", "--cores", "2", *words]
    return Project(folder).run(*command, PYTHONPATH=str(project.root)).stdout


def written_files(root: Path) -> dict[Path, int]:
    """Return each file's modification time, except bytecode: root can write to read-only folders."""
    return {
        path: path.stat().st_mtime_ns
        for path in root.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_another_directory_takes_configuration_sheet_and_models_from_a_read_only_clone(
    clone: Project, tmp_path: Path
) -> None:
    (tmp_path / "work").mkdir()
    before, paths = written_files(clone.root), [clone.root, *clone.root.rglob("*")]
    for path in paths:
        path.chmod(path.stat().st_mode & ~0o222)
    try:
        config = str(clone.root / "config/ci.yaml")
        words = ["--directory", "work", "--snakefile", str(clone.root / "Snakefile"), "--configfile", config]
        printed = plan_of(clone, tmp_path, *words)
        assert "rule evaluate:" in printed and "rule figures:" in printed
        printed = clone.hilsplat("run", "--config", config, "--", "-n", folder=tmp_path / "work")
        assert "rule evaluate:" in printed
    finally:
        for path in paths:
            path.chmod(path.stat().st_mode | 0o200)
    assert written_files(clone.root) == before


def test_a_module_with_a_prefix_gives_the_same_bytes_on_one_core_without_an_activated_environment(
    finished: Project, clone: Project, tmp_path: Path
) -> None:
    outer = tmp_path / "outer"
    outer.mkdir()
    (outer / "Snakefile").write_text(
        f"""
configfile: {str(clone.root / "config/ci.yaml")!r}

module hilsplat:
    snakefile: {str(clone.root / "Snakefile")!r}
    config: config
    prefix: "inner"

use rule * from hilsplat as hilsplat_*

rule mine:
    default_target: True
    input: {[f"inner/results/{path}" for path in OUTPUTS]}
"""
    )
    printed = plan_of(clone, outer, "-p")
    commands = [line for line in printed.splitlines() if "python -P -m hilsplat" in line]
    assert len(commands) >= 10 and "rule hilsplat_evaluate:" in printed
    paths = [word for line in commands for word in line.split() if "results" in word]
    assert [path for path in paths if not path.startswith("inner/results/")] == []
    for name in ("gaussians", "masks", "contributions"):  # `test_library` computes these on one core
        shutil.copytree(finished.root / "results/.cache" / name, outer / "inner/results/.cache" / name)
    bare = {"PATH": "/usr/bin:/bin", "PYTHONPATH": str(clone.root)}
    Project(outer).run(sys.executable, "-m", "snakemake", "--cores", "1", **bare)
    # the plan, which no prefix reaches, keeps digests of models there
    beside = [path.name for path in (outer / "results").rglob("*") if path.is_file()]
    assert beside == ["digests.json"]
    for path in OUTPUTS:
        made = (outer / "inner/results" / path).read_bytes()
        assert made == (finished.root / "results" / path).read_bytes(), path


def test_a_script_of_a_workflow_with_our_module_imports_from_its_folder(
    plain: Project, tmp_path: Path
) -> None:
    (tmp_path / "scripts").mkdir()
    (tmp_path / "scripts/mine.py").write_text("import beside")
    (tmp_path / "scripts/beside.py").write_text("print('imported')")
    (tmp_path / "Snakefile").write_text(
        f"""
configfile: {str(plain.root / "config/ci.yaml")!r}

module hilsplat:
    snakefile: {str(plain.root / "Snakefile")!r}
    config: config

use rule * from hilsplat as hilsplat_*

rule mine:
    output: "mine.txt"
    shell: "python scripts/mine.py > {{output}}"
"""
    )
    command = (sys.executable, "-m", "snakemake", "--cores", "1", "mine")
    Project(tmp_path).run(*command, PYTHONPATH=str(plain.root))
    assert (tmp_path / "mine.txt").read_text() == "imported\n"


def test_the_results_folder_is_one_setting(clone: Project) -> None:
    printed = clone.snakemake("-n", "-p", "--verbose", "--config", "results=out put").stdout
    assert "output: out put/" in printed and "output: results/" not in printed
    commands = [line for line in printed.splitlines() if "python -P -m hilsplat" in line]
    assert not [line for line in commands if " results/" in line]
