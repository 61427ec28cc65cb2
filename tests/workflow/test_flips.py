"""One flipped bit in each file of a finished run: it is found, and no stage or query builds on it."""

import os
import re
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from hilsplat.base.artifacts import provenance_path
from hilsplat.base.lineage import files_of, read_provenance, visible_files
from hilsplat.cli.main import main
from hilsplat.workflow.records import WHOLE, Records
from tests.workflow.conftest import SCENE, Project

NO_ARTIFACTS = {"logs", "benchmarks", "efficiency.csv", "efficiency.md"}
"""Logs, times of jobs, and the table of these times, which each run writes again."""


@contextmanager
def flipped(path: Path) -> Iterator[None]:
    """Flip a bit of a file without changing its size or time."""
    content, stat = path.read_bytes(), path.stat()
    changed = bytearray(content)
    place = zlib.crc32(path.name.encode()) % (8 * len(content))
    changed[place // 8] ^= 1 << place % 8
    try:
        path.write_bytes(changed)
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        yield
    finally:
        path.write_bytes(content)
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


@pytest.fixture
def results(copy_of_finished: Project, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(copy_of_finished.root)
    return Path("results")


def artifacts_in(results: Path) -> list[Path]:
    records = sorted(results.rglob("*.provenance.json"))
    return [path.with_name(path.name.removesuffix(".provenance.json")) for path in records]


def test_verify_finds_a_flipped_bit_in_every_file(results: Path) -> None:
    seen = set()
    for artifact in artifacts_in(results):
        record = read_provenance(artifact)
        assert record is not None and record.seal is not None
        paths = [file for name in record.outputs for file in files_of(artifact.parent / name)]
        for path in [provenance_path(artifact), *paths]:
            if path in seen or not path.stat().st_size:
                continue
            seen.add(path)
            assert Records(results, every_byte=True).state(artifact)[0] == WHOLE, artifact
            with flipped(path):
                assert Records(results, every_byte=True).state(artifact)[0] != WHOLE, path
    rest = {path for path in {*visible_files(results)} - seen if path.stat().st_size}
    assert {path for path in rest if not NO_ARTIFACTS & set(path.parts) and path.suffix != ".log"} == set()


def test_every_stage_refuses_an_input_with_a_flipped_bit(
    copy_of_finished: Project,
    results: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried, targets = [], set()
    for artifact in artifacts_in(results):
        if artifact.parent.parent == SCENE and artifact.parent.name != "default":
            continue  # the other variants have the same stages
        record = read_provenance(artifact)
        assert record is not None
        for name, read in record.inputs.items():
            inputs = [Path(path) for path in read.files or [read.path]]
            inputs = [path for path in inputs if path.exists() and path.is_relative_to(results)]
            if not inputs or "logs" in inputs[0].parts or "benchmarks" in inputs[0].parts:
                continue
            file = files_of(inputs[-1])[-1]
            monkeypatch.setattr(sys, "argv", list(record.command))
            with flipped(file), pytest.raises(SystemExit) as ended:
                main()
            assert ended.value.code == 1
            text = capfd.readouterr().err
            assert "was changed after it was written" in text, (artifact, name)
            (advice,) = re.findall(r"  fix       hilsplat run --config config/ci.yaml --verify (\S+)\n", text)
            targets.add(advice)
            tried.append((record.stage, name))
    assert len(tried) > 30 and ("gaussians", "scene") in tried and ("table", "scores") in tried, tried
    dry = copy_of_finished.hilsplat_run("--verify", *sorted(targets), "--", "-n")
    assert "Nothing to be done" in dry.stdout + dry.stderr, "each target exists, and all are whole again"
