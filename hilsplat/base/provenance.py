"""Provenance of artifacts, written beside them."""

import functools
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import provenance_path, sha256_of_path, write_json

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


def write_provenance(
    artifact: Path,
    *,
    stage: str,
    code: str,
    command: Sequence[str],
    settings: Mapping[str, Any],
    seed: int | None,
    inputs: Mapping[str, Path],
    beside: Sequence[Path] = (),
    plugins: Sequence[str] = (),
) -> None:
    """Write stage, code digest, command, settings, seed, digests of inputs and outputs, versions, git commit.

    `beside` are further files and folders that the stage wrote, `plugins` the readers or baselines it used.
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
            "inputs": {
                name: {"path": str(path), "sha256": sha256_of_path(path)}
                for name, path in inputs.items()
                if Path(path).exists()
            },
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
    """Bytes of each file of an artifact by its path inside, without hidden ones; a file has the path ".".

    Reading them takes no time, and tells which file is gone or cut.
    """
    path = Path(path)
    if path.is_file():
        return {".": path.stat().st_size}
    files = sorted(file for file in path.rglob("*") if file.is_file() and not file.name.startswith("."))
    return {file.relative_to(path).as_posix(): file.stat().st_size for file in files}


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
