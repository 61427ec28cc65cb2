"""What an artifact was made from, and whether that is still true: digests, provenance records, belonging."""

import functools
import hashlib
import json
import os
import platform
import subprocess
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import (
    RECORD,
    RUN,
    provenance_path,
    read_json,
    read_memo,
    rebuild_command,
    seal_of,
    write_json,
)
from hilsplat.base.errors import ArtifactError, HilsplatError, MisalignedArtifactError, foreign
from hilsplat.base.files import INSTALLED, files_below, regular

CONVERTED = ".made_from.json"
"""Hidden file in a folder of extracted frames or unpacked photographs that records their source."""

LIBRARIES = (
    *("hilsplat", "numpy", "scipy", "torch", "numba", "pycolmap", "onnxruntime"),
    *("opencv-contrib-python-headless", "pandas", "snakemake"),
)
"""Libraries that affect results."""


def sha256_of_bytes(*parts: bytes) -> str:
    """Return the SHA-256 of the parts, each preceded by its length so that boundaries matter."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


def sha256_of_json(value: Any) -> str:
    """Return the SHA-256 of a JSON value; the order of keys does not matter."""
    return sha256_of_bytes(json.dumps(value, sort_keys=True).encode())


def sha256_of_file(path: Path) -> str:
    try:
        with regular(Path(path)).open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        error.filename = str(path)  # errors of reading name no file
        raise


def copies_of(paths: Iterable[Path]) -> dict[Path, Path]:
    """Map each copy of another file to that file; of files with the same bytes, the shortest name is kept.

    Only files of equal size are read. Empty and unreadable files have no copies.
    """
    by_size: dict[int, list[Path]] = defaultdict(list)
    for path in paths:
        with suppress(OSError):  # reported where the file is used
            by_size[path.stat().st_size].append(path)
    copies, originals = {}, dict[str, Path]()
    for size, same in by_size.items():
        for path in sorted(same, key=lambda path: (len(path.name), path)) if size and len(same) > 1 else ():
            with suppress(OSError):
                if (original := originals.setdefault(sha256_of_file(path), path)) != path:
                    copies[path] = original
    return copies


def sha256_of_path(path: Path) -> str:
    """Return the SHA-256 of a file, or of the names and bytes of a folder's non-hidden files."""
    path = Path(path)
    if path.is_file():
        return sha256_of_file(path)
    files = visible_files(path)
    if not files:
        raise ArtifactError(f"{path} is missing or empty", fix=rebuild_command(path))
    return sha256_of_json([(file.relative_to(path).as_posix(), sha256_of_file(file)) for file in files])


UNREADABLE = "unreadable"


def digests_of(paths: Collection[str], memo: Path) -> dict[str, str]:
    """Map each path to its file's SHA-256, or `UNREADABLE`; only files that changed since `memo` are read.

    Programs cannot set the status change time, so it reveals a replacement of the same size and time.
    """
    old, entries = read_memo(memo, dict[str, str]), dict[str, str]()
    changed: dict[str, str] = {}
    for path in paths:
        with suppress(OSError):  # the stage reports it
            stat = Path(path).stat()
            stamp = f"{stat.st_size} {stat.st_mtime_ns} {stat.st_ctime_ns} "
            if old.get(path, "").startswith(stamp):
                entries[path] = old[path]
            else:
                changed[path] = stamp

    def read(path: str) -> None:
        with suppress(OSError, HilsplatError):
            entries[path] = changed[path] + sha256_of_file(Path(path))

    if changed:  # a run of thousands of scenes would otherwise start as many pools
        with ThreadPoolExecutor() as threads:
            list(threads.map(read, changed))
        with suppress(OSError, HilsplatError):  # a read-only folder of results, or a full disk
            write_json(memo, old | entries)
    return {path: entries.get(path, UNREADABLE).split()[-1] for path in paths}


def visible_files(folder: Path) -> list[Path]:
    """Return the files in a folder and its subfolders, sorted; follow links, and skip what is hidden.

    Subfolders that hilsplat wrote are skipped too, because a project may be in a folder of photographs.
    """
    files = []
    for parent, folders, names in os.walk(folder, followlinks=True):
        folders[:] = [name for name in folders if name[0] != "." and not _is_apart(Path(parent, name))]
        files += [path for name in names if name[0] != "." and (path := Path(parent, name)).is_file()]
    return sorted(files)


def _is_apart(folder: Path) -> bool:
    """Return whether a folder is results, an artifact, a converted source, or a link to a parent folder.

    Links among folders also count: in all/a/all, the last one leads to the first.
    """
    marks, real = (folder / RUN, folder / CONVERTED, provenance_path(folder)), folder.resolve()
    is_loop = folder.is_symlink() and any(each.resolve().is_relative_to(real) for each in folder.parents)
    return any(map(Path.is_file, marks)) or is_loop


def files_of(path: Path | Sequence[Path]) -> list[Path]:
    """Return the non-hidden files in a folder, or the given file or files that exist."""
    if not isinstance(path, Path):
        return [file for part in path for file in files_of(part)]
    if not path.is_dir():
        return [path] if path.exists() else []
    return visible_files(path)


def sizes_of(path: Path) -> dict[str, int]:
    """Map the relative path of each file of an artifact ("." for a single file) to its size in bytes."""
    path = Path(path)
    return {file.relative_to(path).as_posix(): file.stat().st_size for file in files_of(path)}


def artifacts_in(results: Path) -> list[Path]:
    """Return the artifacts in a results folder that have provenance, sorted."""
    records = (path for path in files_below(results) if path.name.endswith(RECORD))
    artifacts = (path.with_name(path.name.removesuffix(RECORD)) for path in records)
    return sorted(path for path in artifacts if ".cache" not in path.relative_to(results).parts)


class Inputs:
    """Inputs of a stage, with digests computed before the stage ran; a missing input raises HilsplatError."""

    def __init__(self, stage: str, paths: Mapping[str, Path | Sequence[Path]]) -> None:
        self.stage = stage
        self._paths = paths
        for name, path in paths.items():
            if isinstance(path, Path) and not path.exists():
                raise HilsplatError(
                    f"{stage}: input {name} is missing: {path}",
                    fix="correct the path, or run the stage that writes it",
                )
        self._files = self._signatures()
        self.records = {name: self._record(path) for name, path in paths.items()}
        for record in self.records.values():
            files = record.get("files", {record["path"]: record.get("sha256")})
            folders = {Path(path).parent for path in files}  # of thousands of photographs
            has_records = {folder: any(folder.glob(f"*{RECORD}")) for folder in folders}
            for path, digest in files.items():
                if has_records[Path(path).parent]:
                    require_as_written(Path(path), digest)

    def require_unchanged(self) -> None:
        """Raise HilsplatError if an input changed; files with the same size, time and inode are skipped."""
        changed = sorted({file for file, _ in self._files.items() ^ self._signatures().items()})
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


RASTERISER: ContextVar[str | None] = ContextVar("RASTERISER", default=None)
"""Device that the running stage has chosen for rasterising, for its provenance record."""


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
        "device": RASTERISER.get(),
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


@dataclass(frozen=True)
class Written:
    """An output as it was written: its digest from `sha256_of_path`, and sizes from `sizes_of`."""

    sha256: str
    bytes: dict[str, int]


@dataclass(frozen=True)
class Read:
    """An input as a stage read it: its digest, or one digest per listed file; None if empty or missing."""

    path: str
    sha256: str | None = None
    files: dict[str, str | None] | None = None


@dataclass(frozen=True)
class Provenance:
    """A record, as `write_provenance` documents it; `seal` is its checksum, which old records lack."""

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012

    stage: str
    code: str
    plugins: tuple[str, ...]
    settings: dict[str, Any]
    seed: int | None
    inputs: dict[str, Read]
    outputs: dict[str, Written]
    artifact: str = ""
    command: tuple[str, ...] = ()
    device: str | None = None
    python: str = ""
    libraries: dict[str, str] = field(default_factory=dict)
    git: str = ""
    seal: int | None = None


@functools.cache
def _checker() -> Any:
    from pydantic import TypeAdapter  # commands start a tenth faster without it

    return TypeAdapter(Provenance)


def read_provenance(artifact: Path) -> Provenance | None:
    """Return the provenance of an artifact, or None; raise ArtifactError if the record is damaged."""
    path = provenance_path(artifact)
    if not path.is_file():
        return None
    values, fix = read_json(path), functools.partial(rebuild_command, artifact)
    with foreign(path, ArtifactError, problem="is damaged", fix=fix):
        record: Provenance = _checker().validate_python(values)
        if record.seal is not None and values.pop("seal") != seal_of(values):
            raise ArtifactError(f"{path} was changed after it was written", fix=fix())
        return record


def require_as_written(path: Path, sha256: str | None) -> None:
    """Raise ArtifactError if an artifact's digest differs from its provenance; other files are ignored."""
    records = path.parent.glob(f"*{RECORD}")
    beside = [record.with_name(record.name.removesuffix(RECORD)) for record in records]
    for artifact in [path] if path in beside else beside:
        record = read_provenance(artifact)
        written = record.outputs.get(os.path.relpath(path, artifact.parent)) if record else None
        if written is not None and written.sha256 != sha256:
            raise ArtifactError(
                f"{path} was changed after it was written",
                expected=f"sha256 {written.sha256[:12]}, as in {provenance_path(artifact).name}",
                found=f"sha256 {(sha256 or 'of nothing')[:12]}",
                fix=rebuild_command(artifact),
            )


def require_made_from(
    artifact: object, source: object, recorded: str | None, digest: str | None, fix: str | None = None
) -> None:
    """Raise MisalignedArtifactError unless an artifact was made from a source.

    Args:
        recorded: digest of the source when the artifact was made; None if it was made without it.
        digest: digest of the source now; None if there is no such source.
    """
    if recorded != digest:
        raise MisalignedArtifactError(
            f"{artifact} was not made from {source}",
            expected=f"digest {recorded[:12]}" if recorded else "nothing",
            found=f"digest {digest[:12]}" if digest else "nothing",
            fix=fix or f"rerun the stage that writes {artifact}",
        )


def require_size(what: str, size_hw: tuple[int, ...], expected_hw: tuple[int, ...], fix: str) -> None:
    """Raise MisalignedArtifactError unless a size (height, width) is as expected; `what` is the problem."""
    expected, found = (f"{height} x {width} (height x width)" for height, width in (expected_hw, size_hw))
    if expected != found:
        raise MisalignedArtifactError(what, expected=expected, found=found, fix=fix)


@functools.cache
def version_of(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


@functools.cache
def git_commit() -> str:
    """Return our checkout's commit, with "+edits" if files were changed, or "unknown" if we are installed."""
    if not (INSTALLED / ".git").exists():  # a folder above may be a repository of the user
        return "unknown"

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=INSTALLED, capture_output=True, text=True, check=True, timeout=20
        ).stdout.strip()

    try:
        commit = git("rev-parse", "HEAD")
        return commit + ("+edits" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return "unknown"
