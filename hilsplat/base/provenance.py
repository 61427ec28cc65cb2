"""Provenance of artifacts, written beside them."""

import functools
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import provenance_path, sha256_of_path, visible_files, write_json
from hilsplat.base.errors import HilsplatError

LIBRARIES = (
    "hilsplat",
    "numpy",
    "scipy",
    "torch",
    "numba",
    "pycolmap",
    "onnxruntime",
    "opencv-contrib-python-headless",
    "pandas",
    "snakemake",
)


class Inputs:
    """Inputs of a stage with the digests that they had before it ran.

    Args:
        stage: name of the stage, for messages.
        paths: files and folders that it reads, or lists of files, by name.

    Raises:
        HilsplatError: an input is missing.
    """

    def __init__(self, stage: str, paths: Mapping[str, Path | Sequence[Path]]) -> None:
        self.stage = stage
        self._paths = paths
        for name, path in paths.items():
            if isinstance(path, Path) and not path.exists():
                raise HilsplatError(
                    f"{stage}: input {name} is missing: {path}", fix="run the stage that writes it"
                )
        self._files = self._signatures()
        self.records = {name: self._record(path) for name, path in paths.items()}

    def require_unchanged(self) -> None:
        """Check that no input changed since the digests were computed.

        Files are compared by size, time and inode; only inputs with a difference are read again.

        Raises:
            HilsplatError: an input changed; the message names the file.
        """
        now = self._signatures()
        for name, path in self._paths.items():
            before, after = self._files[name], now[name]
            changed = sorted(
                file for file in before.keys() | after.keys() if before.get(file) != after.get(file)
            )
            if changed and self._record(path) != self.records[name]:
                raise HilsplatError(
                    f"{self.stage}: input {name} changed while the stage ran: {changed[0]}",
                    expected="inputs that stay as they are until the stage ends",
                    found="a new file" if changed[0] not in before else "another file or none",
                    fix="run the stage again",
                )

    def _signatures(self) -> dict[str, dict[Path, tuple[int, ...]]]:
        return {
            name: {file: _signature(file) for file in files_of(path)} for name, path in self._paths.items()
        }

    @staticmethod
    def _record(path: Path | Sequence[Path]) -> dict[str, Any]:
        if isinstance(path, Path):
            return {"path": str(path), "sha256": sha256_of_path(path) if files_of(path) else None}
        digests = {str(file): sha256_of_path(file) if file.exists() else None for file in path}
        return {"path": os.path.commonpath(digests) if digests else "", "files": digests}


def files_of(path: Path | Sequence[Path]) -> list[Path]:
    """Return the files of a folder without hidden ones, or the file or files themselves."""
    if not isinstance(path, Path):
        return [file for each in path for file in files_of(each)]
    if not path.is_dir():
        return [path] if path.exists() else []
    return visible_files(path)


def _signature(file: Path) -> tuple[int, ...]:
    found = file.stat()
    return found.st_size, found.st_mtime_ns, found.st_ino


def write_provenance(
    artifact: Path,
    *,
    stage: str,
    code: str,
    command: Sequence[str],
    settings: Mapping[str, Any],
    seed: int | None,
    inputs: Inputs,
    beside: Sequence[Path] = (),
    plugins: Sequence[str] = (),
    device: str | None = None,
) -> None:
    """Write the record of an artifact: how it was made, from what, and the digests of what was written.

    Args:
        artifact: the output.
        stage: key of `STAGES`.
        code: digest of the stage's code.
        command: command line.
        settings: sections of the settings.
        seed: seed of everything random, or None.
        inputs: inputs with their digests from before the stage ran.
        beside: further outputs.
        plugins: import paths of the readers or baselines that the stage used.
        device: device that `device: auto` stands for, if the stage has this setting.
    """
    folder = Path(artifact).parent
    write_json(
        provenance_path(artifact),
        {
            "stage": stage,
            "artifact": Path(artifact).name,
            "command": list(command),
            "code": code,
            "plugins": list(plugins),
            "settings": dict(settings),
            "seed": seed,
            "device": device,
            "inputs": inputs.records,
            "outputs": {
                os.path.relpath(path, folder): {"sha256": sha256_of_path(path), "bytes": sizes_of(path)}
                for path in (artifact, *beside)
            },
            "python": platform.python_version(),
            "libraries": library_versions(),
            "git": git_commit(),
        },
    )


def sizes_of(path: Path) -> dict[str, int]:
    """Return the size in bytes of each file of an artifact by its path inside; a file has the path "."."""
    path = Path(path)
    return {file.relative_to(path).as_posix(): file.stat().st_size for file in files_of(path)}


@functools.cache
def library_versions() -> dict[str, str]:
    """Versions of the libraries that shape results."""
    versions = {}
    for name in LIBRARIES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions


@functools.cache
def git_commit() -> str:
    """Commit of the checkout, with "+edits" if the tree has changes; "unknown" outside one."""
    folder = Path(__file__).resolve().parent

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=folder, capture_output=True, text=True, check=True, timeout=20
        ).stdout.strip()

    try:
        commit = git("rev-parse", "HEAD")
        return commit + ("+edits" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return "unknown"
