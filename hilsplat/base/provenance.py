"""Provenance records beside artifacts, and checks that a command replaces only its own earlier outputs."""

import functools
import os
import platform
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hilsplat.base.artifacts import (
    provenance_path,
    read_json,
    read_memo,
    remake,
    seal_of,
    sha256_of_path,
    visible_files,
    was_interrupted,
    write_json,
)
from hilsplat.base.errors import ArtifactError, HilsplatError, ImageError
from hilsplat.base.images import opened_image

LIBRARIES = (
    *("hilsplat", "numpy", "scipy", "torch", "numba", "pycolmap", "onnxruntime"),
    *("opencv-contrib-python-headless", "pandas", "snakemake"),
)
"""Libraries that affect results."""

SOFTWARE = {"Software": "hilsplat"}
"""Metadata of the PNGs that commands draw for users; these files have no provenance record."""


class Inputs:
    """Inputs of a stage, with digests computed before the stage ran; a missing input raises HilsplatError."""

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
        for record in self.records.values():
            files = record.get("files", {record["path"]: record.get("sha256")})
            has_record = functools.cache(_has_record)  # a folder may contain thousands of photographs
            for path, digest in files.items():
                if has_record(Path(path).parent):
                    require_as_written(Path(path), digest)

    def require_unchanged(self) -> None:
        """Raise HilsplatError if an input changed; files with the same size, time and inode are skipped."""
        now = self._signatures()
        changed = sorted({file for file, _ in self._files.items() ^ now.items()})
        for name, path in self._paths.items() if changed else ():
            if self._record(path) != self.records[name]:
                raise HilsplatError(
                    f"{self.stage}: input {name} changed while the stage ran: {changed[0]}",
                    expected="inputs that do not change until the stage ends",
                    found="a changed or deleted file" if changed[0] in self._files else "a new file",
                    fix="run the stage again",
                )

    def _signatures(self) -> dict[Path, tuple[int, ...]]:
        stats = {file: file.stat() for path in self._paths.values() for file in files_of(path)}
        return {file: (stat.st_size, stat.st_mtime_ns, stat.st_ino) for file, stat in stats.items()}

    @staticmethod
    def _record(path: Path | Sequence[Path]) -> dict[str, Any]:
        if isinstance(path, Path):
            return {"path": str(path), "sha256": sha256_of_path(path) if files_of(path) else None}
        digests = {str(file): sha256_of_path(file) if file.exists() else None for file in path}
        return {"path": os.path.commonpath(digests) if digests else "", "files": digests}


def files_of(path: Path | Sequence[Path]) -> list[Path]:
    """Return the non-hidden files in a folder, or the given file or files that exist."""
    if not isinstance(path, Path):
        return [file for each in path for file in files_of(each)]
    if not path.is_dir():
        return [path] if path.exists() else []
    return visible_files(path)


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
    """Write an artifact's provenance record: command, settings, inputs, software, and digests of outputs."""
    folder = Path(artifact).parent
    record = {
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
        "libraries": {name: version_of(name) or "not installed" for name in LIBRARIES},
        "git": git_commit(),
    }
    write_json(provenance_path(artifact), {**record, "seal": seal_of(record)})


class Written(BaseModel):
    """An output as it was written: its digest from `sha256_of_path`, and sizes from `sizes_of`."""

    sha256: str
    bytes: dict[str, int]


class Read(BaseModel):
    """An input as a stage read it: its digest, or one digest per listed file; None if empty or missing."""

    path: str
    sha256: str | None = None
    files: dict[str, str | None] | None = None


class Provenance(BaseModel):
    """A record, as `write_provenance` documents it; `seal` is its checksum, which old records lack."""

    model_config = ConfigDict(extra="forbid")

    stage: str
    artifact: str = ""
    command: tuple[str, ...] = ()
    code: str
    plugins: tuple[str, ...]
    settings: dict[str, Any]
    seed: int | None
    device: str | None = None
    inputs: dict[str, Read]
    outputs: dict[str, Written]
    python: str = ""
    libraries: dict[str, str] = Field(default_factory=dict)
    git: str = ""
    seal: int | None = None


def read_provenance(artifact: Path) -> Provenance | None:
    """Return the provenance of an artifact, or None; raise ArtifactError if the record is damaged."""
    path = provenance_path(artifact)
    if not path.is_file():
        return None
    try:
        values = read_json(path)
        record = Provenance.model_validate(values)
        if record.seal is not None and values.pop("seal") != seal_of(values):
            raise ArtifactError(f"{path} was changed after it was written", fix=remake(artifact))
        return record
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise ArtifactError(
            f"{path} is damaged: {'.'.join(map(str, first['loc']))}: {first['msg']}", fix=remake(artifact)
        ) from error


def _has_record(folder: Path) -> bool:
    return provenance_path(folder).is_file() or any(folder.glob(f"*{provenance_path(Path()).name}"))


def require_as_written(path: Path, sha256: str | None) -> None:
    """Raise ArtifactError if an artifact's digest differs from its provenance; other files are ignored."""
    ending = provenance_path(Path()).name
    beside = [path.parent / file.name.removesuffix(ending) for file in path.parent.glob(f"*{ending}")]
    for artifact in [path] if path in beside else [path.parent, *beside]:  # `world` records `world/images`
        record = read_provenance(artifact)
        written = record.outputs.get(os.path.relpath(path, artifact.parent)) if record else None
        if written is not None and written.sha256 != sha256:
            raise ArtifactError(
                f"{path} was changed after it was written",
                expected=f"sha256 {written.sha256[:12]}, as in {provenance_path(artifact).name}",
                found=f"sha256 {(sha256 or 'of nothing')[:12]}",
                fix=remake(artifact),
            )


def sizes_of(path: Path) -> dict[str, int]:
    """Map the relative path of each file of an artifact ("." for a single file) to its size in bytes."""
    path = Path(path)
    return {file.relative_to(path).as_posix(): file.stat().st_size for file in files_of(path)}


@functools.cache
def version_of(distribution: str) -> str | None:
    """Return the version of an installed distribution, or None."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


@functools.cache
def git_commit() -> str:
    """Return the checkout's commit, with "+edits" if files were changed, or "unknown" outside a checkout."""
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


def require_replaceable(outputs: Sequence[Path], stage: str, inputs: Iterable[Path]) -> None:
    """Check that a stage can write its outputs without overwriting unrelated data.

    An existing file or folder may be replaced if it is empty, if the same stage wrote it according to the
    provenance of the first output, or if a process was killed while writing it.

    Raises:
        ArtifactError: an output is or contains an input or the working, home or root folder, or exists and is
            not an earlier output of the stage.
    """
    own = _recorded_outputs(outputs[0], stage)
    read = [Path(each).resolve() for each in inputs]
    for out in outputs:
        place = out.resolve()
        for each in read:
            if place == each or place in each.parents:
                what = "is an input" if place == each else f"contains the input {each}"
                raise ArtifactError(f"output {out} {what} of {stage}", fix="choose another output")
        for name, folder in (("working", Path.cwd()), ("home", Path.home())):
            if place == folder.resolve() or place in folder.resolve().parents:
                raise ArtifactError(
                    f"output {out} is or contains the {name} folder", fix="choose a new file or folder"
                )
        if not _is_something(out) or place in own or was_interrupted(out):
            continue
        raise _foreign(out, stage, f"a new path, or an earlier output of {stage} with its provenance")


def require_own_picture(path: Path, beside: Path | None = None) -> None:
    """Raise ArtifactError if a path is not a .png, or if it or `beside` is a file of other programs."""
    if path.suffix.lower() != ".png":
        raise ArtifactError(f"output {path} is not a PNG file", expected="a name that ends in .png")
    if _is_something(path) and not _is_own_picture(path):
        raise _foreign(path)
    if beside is not None and _is_something(beside) and not _is_something(path):
        raise _foreign(beside)


def _is_own_picture(path: Path) -> bool:
    try:
        with opened_image(path) as image:
            return bool(image.info.get("Software") == SOFTWARE["Software"])
    except ImageError:
        return False


@contextmanager
def replaced_folder(folder: Path) -> Iterator[None]:
    """Replace a folder in the block; raise ArtifactError if a file in it is not from the last such block."""
    record = folder.with_name(f".{folder.name}.written.json")  # size and time of each file
    known = read_memo(record, dict[str, list[int]])
    if others := sorted(name for name, stat in _stats(folder).items() if known.get(name) != stat):
        raise ArtifactError(
            f"{folder} contains files that hilsplat did not write, or that were changed later",
            found=", ".join(others[:3]),
            fix="move them elsewhere, or choose another folder (--out)",
        )
    yield
    write_json(record, _stats(folder))


def _stats(folder: Path) -> dict[str, list[int]]:
    stats = {file.relative_to(folder).as_posix(): file.stat() for file in files_of(folder)}
    return {name: [stat.st_size, stat.st_mtime_ns] for name, stat in stats.items()}


def require_beginning(path: Path, line: str) -> None:
    """Raise ArtifactError if a table would replace a file whose first line is not `line`."""
    if not _is_something(path):
        return
    try:
        with path.open(encoding="utf-8") as stream:
            is_own = stream.readline().strip() == line.strip()
    except (OSError, ValueError):
        is_own = False
    if not is_own:
        raise _foreign(path)


def _foreign(path: Path, writer: str = "hilsplat", expected: str | None = None) -> ArtifactError:
    return ArtifactError(
        f"output {path} exists, but {writer} did not write it",
        expected=expected,
        found=_described(path),
        fix="choose another output, or remove this one first",
    )


def _recorded_outputs(artifact: Path, stage: str) -> set[Path]:
    try:
        record = read_provenance(artifact)
    except ArtifactError:
        return set()
    if record is None or record.stage != stage:
        return set()
    return {(artifact.parent / name).resolve() for name in record.outputs}


def _is_something(path: Path) -> bool:
    """Return whether a path exists and is not empty, ignoring hidden files such as Snakemake's markers."""
    if not os.path.lexists(path):
        return False
    if path.is_dir():
        return bool(_visible(path))
    return not path.is_file() or path.stat().st_size > 0


def _visible(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if not path.name.startswith(".")]


def _described(path: Path) -> str:
    if path.is_dir():
        names = sorted(_visible(path))
        return f"a folder of {len(names)} entries: {', '.join(names[:3])}{', ...' if len(names) > 3 else ''}"
    return f"a file of {path.stat().st_size} bytes" if path.is_file() else "neither a file nor a folder"
