"""Provenance of artifacts, written beside them."""

import functools
import platform
import subprocess
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import sha256_of_path, write_json

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


def provenance_path(artifact: Path) -> Path:
    """Path of the provenance of a file or folder artifact: beside it, with its name."""
    artifact = Path(artifact)
    return artifact.with_name(f"{artifact.name}.provenance.json")


def write_provenance(
    artifact: Path,
    *,
    stage: str,
    code: str,
    command: Sequence[str],
    settings: Mapping[str, Any],
    seed: int | None,
    inputs: Mapping[str, Path],
) -> None:
    """Write stage, code digest, command, settings, seed, digests of inputs, versions, git commit."""
    write_json(
        provenance_path(artifact),
        {
            "stage": stage,
            "artifact": Path(artifact).name,
            "command": list(command),
            "code": code,
            "settings": dict(settings),
            "seed": seed,
            "inputs": {
                name: {"path": str(path), "sha256": sha256_of_path(path)}
                for name, path in inputs.items()
                if Path(path).exists()
            },
            "python": platform.python_version(),
            "libraries": library_versions(),
            "git": git_commit(),
        },
    )


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
