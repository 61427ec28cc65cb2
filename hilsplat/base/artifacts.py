"""Files that are either whole or absent: atomic writers, digests, provenance, view caches."""

import errno
import fcntl
import hashlib
import json
import os
import shlex
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from hilsplat.base.errors import ArtifactError, DiskSpaceError, HilsplatError
from hilsplat.base.processes import LITTER, temporary_prefix

Made = TypeVar("Made")

ZIP64_BYTES = 2**30
"""Larger arrays get an archive entry that may exceed 2 GiB."""

INDEX = "index.json"
"""Written last into a folder artifact: its presence means that the folder is complete."""

DAMAGE = (ValueError, zipfile.BadZipFile, zlib.error, NotImplementedError, EOFError, OSError, MemoryError)
"""What numpy and zipfile raise on files whose bytes are not what was written."""


def provenance_path(artifact: Path) -> Path:
    """Path of the provenance of a file or folder artifact: beside it, with its name."""
    artifact = Path(artifact)
    return artifact.parent / f"{artifact.name}.provenance.json"


def remake(path: Path) -> str:
    """How to have an artifact, or the one that a file belongs to, written again."""
    places = [place for place in (Path(path), *Path(path).parents) if provenance_path(place).is_file()]
    if not places:
        return "run the stage that writes it again"
    place = places[0] / "images" if places[0].name == "world" else places[0]  # its rule declares two folders
    parts = place.parts  # Snakemake knows its files by their paths from the project
    start = len(parts) - 1 - parts[::-1].index("results") if "results" in parts else 0
    return f"snakemake --cores 2 --forcerun {shlex.quote(str(Path(*parts[start:])))}"


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside `path` that replaces it when the block ends without error.

    Raises:
        DiskSpaceError: the disk is full.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with full_disk_told(path):
        handle, name = tempfile.mkstemp(prefix=temporary_prefix(), suffix=path.suffix[-16:], dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        with full_disk_told(path):
            yield temporary
            temporary.chmod(0o644)
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `path` that replaces it when the block ends without error.

    Raises:
        DiskSpaceError: the disk is full.
    """
    path = Path(path)
    with work_folder(path) as both:
        temporary = both / "new"
        with full_disk_told(path):
            temporary.mkdir()
            yield temporary
            temporary.chmod(0o755)
            if path.exists():  # moved, not deleted: there is no moment in which neither is whole
                path.replace(both / "old")
            temporary.replace(path)


@contextmanager
def work_folder(path: Path) -> Iterator[Path]:
    """A temporary folder beside `path`, removed at the end.

    Raises:
        DiskSpaceError: the disk is full.
    """
    path = Path(path)
    with full_disk_told(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=temporary_prefix(), dir=path.parent))
    try:
        with full_disk_told(path):
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


FULL_DISK = ("No space left on device", "disk is full", "Disk quota exceeded")
"""What libraries in C++ and Rust say, whose errors are not the system's: safetensors, SQLite."""

FULL_BELOW_MIB = 1.0
"""Other errors of libraries are put down to a full disk if less is free: COLMAP's do not say it."""


@contextmanager
def full_disk_told(path: Path) -> Iterator[None]:
    """Turn the system's "no space left" while `path` is written into an error that says so.

    Raises:
        DiskSpaceError: the disk is full.
    """
    try:
        yield
    except HilsplatError:
        raise
    except Exception as error:
        folder = _lasting(path)
        usage = shutil.disk_usage(folder)
        full = getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)
        full = full or any(words in str(error) for words in FULL_DISK)
        full = full or (isinstance(error, LIBRARY) and usage.free < FULL_BELOW_MIB * 2**20)
        if full:
            raise DiskSpaceError(
                f"no space left while writing {path.name} in {folder}",
                found=f"{usage.free / 2**20:.1f} MiB free of {usage.total / 2**20:.0f} MiB on that disk",
                fix=f"free space on the disk of {folder}, then run again; finished work is kept",
            ) from error
        if isinstance(error, OSError) and LITTER.fullmatch(Path(str(error.filename)).name):
            error.filename = str(path)  # the temporary name would tell nobody anything
        raise


LIBRARY = (RuntimeError, ChildProcessError)
"""What libraries in C++ raise, and what stands for one that ended its process."""


def _lasting(path: Path) -> Path:
    """The folder of a path, or the one that holds its unfinished artifact: what is unfinished goes."""
    path = Path(path)
    hidden = [place for place in path.parents if LITTER.fullmatch(place.name)]
    folder = hidden[-1].parent if hidden else path.parent
    while not folder.exists():
        folder = folder.parent
    return folder


def require_free_space(folder: Path, needed_mib: float) -> None:
    """Refuse to start if the disk cannot hold what is about to be written.

    Raises:
        DiskSpaceError: less than `needed_mib` MiB is free on the folder's disk.
    """
    folder = Path(folder)
    while not folder.exists():
        folder = folder.parent
    free_mib = shutil.disk_usage(folder).free / 2**20
    if free_mib < needed_mib:
        raise DiskSpaceError(
            f"too little space on the disk of {folder}",
            expected=f"at least {needed_mib:.0f} MiB free",
            found=f"{free_mib:.0f} MiB free",
            fix="free space, or keep this folder on another disk (a symbolic link will do)",
        )


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically (UTF-8)."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically, indented, keys in the given order, with a closing newline."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False) + "\n")


def read_json(path: Path) -> Any:
    """Read JSON.

    Raises:
        ArtifactError: the file is missing or is not valid JSON.
    """
    try:
        return parse_json(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ArtifactError(f"{path} is missing", fix=remake(path)) from error
    except (ValueError, OSError) as error:
        raise ArtifactError(f"{path} is not valid JSON: {error}", fix=remake(path)) from error


def parse_json(text: str | bytes) -> Any:
    """Parse JSON that somebody else wrote.

    Raises:
        ValueError: it is not JSON, or is nested too deeply to be anything that we read.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def write_npz(path: Path, **arrays: np.ndarray) -> None:
    """Write a compressed .npz atomically, with fixed time stamps: same arrays, same bytes."""
    _write_zip(path, arrays, zipfile.ZIP_DEFLATED)


def _write_zip(path: Path, arrays: dict[str, np.ndarray], method: int) -> None:
    with (
        atomic_path(path) as temporary,
        zipfile.ZipFile(temporary, "w", method, compresslevel=1) as archive,
    ):
        for name, array in arrays.items():
            # Entries opened by name get the time 1980-01-01. They are written piece by piece, so that neither
            # a copy of a large array nor its compressed form is held in memory.
            large = array.nbytes > ZIP64_BYTES
            with archive.open(f"{name}.npy", "w", force_zip64=large) as stream:
                np.lib.format.write_array(stream, np.ascontiguousarray(array), allow_pickle=False)


def read_npz(path: Path, *needed: str) -> dict[str, np.ndarray]:
    """Read an .npz into a dict, without unpickling anything.

    Args:
        path: the file.
        needed: names of arrays that it must have.

    Raises:
        ArtifactError: the file is missing or damaged, holds objects, or lacks an array.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except FileNotFoundError as error:
        raise ArtifactError(f"{path} is missing", fix=remake(path)) from error
    except (*DAMAGE, AttributeError) as error:  # AttributeError: it is an .npy
        raise ArtifactError(f"{path} cannot be read: {error}", fix=remake(path)) from error
    if lacking := [name for name in needed if name not in arrays]:
        raise ArtifactError(
            f"{path} lacks {', '.join(lacking)}",
            found=", ".join(sorted(arrays)) or "no array",
            fix=remake(path),
        )
    return arrays


def read_into(maker: type[Made], path: Path, **more: Any) -> Made:
    """Make a dataclass from the arrays of an .npz.

    Args:
        maker: the dataclass; its fields are the names of the arrays and of `more`.
        path: the file.
        more: fields that are not in the file.

    Raises:
        ArtifactError: the file is missing or damaged, or another version of the program wrote it.
    """
    arrays = read_npz(path)
    expected = _arguments(maker) - set(more)
    if set(arrays) != expected:
        raise ArtifactError(
            f"{path} is of another version",
            expected=", ".join(sorted(expected)),
            found=", ".join(sorted(arrays)) or "no array",
            fix=remake(path),
        )
    return maker(**arrays, **more)


def _arguments(maker: type) -> set[str]:
    assert is_dataclass(maker), maker
    return {field.name for field in fields(maker) if field.init}


def write_npy(path: Path, array: np.ndarray) -> None:
    """Write one array as .npy atomically."""
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.save(stream, array, allow_pickle=False)


def read_npy(path: Path) -> np.ndarray:
    """Read one .npy array of numbers, without unpickling anything.

    Raises:
        ArtifactError: the file is missing or damaged, or holds something else.
    """
    try:
        array = np.load(path, allow_pickle=False)
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
            raise ValueError(f"it holds {getattr(array, 'dtype', 'an archive')}, not numbers")
        return array
    except FileNotFoundError as error:
        raise ArtifactError(f"{path} is missing", fix=remake(path)) from error
    except DAMAGE as error:
        raise ArtifactError(f"{path} cannot be read: {error}", fix=remake(path)) from error


def sha256_of_bytes(*parts: bytes) -> str:
    """SHA-256 of the parts, each preceded by its length so that the boundaries count."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


def sha256_of_json(value: Any) -> str:
    """SHA-256 of a JSON value, independent of the order of keys."""
    return sha256_of_bytes(json.dumps(value, sort_keys=True).encode())


def sha256_of_file(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def sha256_of_path(path: Path) -> str:
    """SHA-256 of a file, or of the names and bytes of a folder's files, without hidden ones."""
    path = Path(path)
    if path.is_file():
        return sha256_of_file(path)
    files = sorted(file for file in path.rglob("*") if file.is_file() and not file.name.startswith("."))
    if not files:
        raise ArtifactError(f"{path} is missing or empty", fix=remake(path))
    return sha256_of_json([(file.relative_to(path).as_posix(), sha256_of_file(file)) for file in files])


def write_index(folder: Path, views: Mapping[str, Any], **more: Any) -> None:
    """Close a folder artifact: write `index.json` with one entry per view, keyed by view name."""
    write_json(Path(folder) / INDEX, {**more, "views": dict(views)})


def read_index(folder: Path) -> dict[str, Any]:
    """Read a folder artifact's index.

    Raises:
        ArtifactError: there is no index, so the folder is missing or incomplete.
    """
    path = Path(folder) / INDEX
    if not path.is_file():
        raise ArtifactError(f"{folder} is missing or incomplete: it has no {INDEX}", fix=remake(Path(folder)))
    index = read_json(path)
    if not isinstance(index, dict) or not isinstance(index.get("views", {}), dict):
        raise ArtifactError(f"{path} is not the index of an artifact", fix=remake(path))
    return index


def read_full_index(folder: Path, *entries: str) -> dict[str, Any]:
    """Read a folder artifact's index and check that it has the given entries.

    Raises:
        ArtifactError: there is no index, or another version of the program wrote it.
    """
    index = read_index(folder)
    if missing := [entry for entry in entries if entry not in index]:
        raise ArtifactError(
            f"{folder} is of another version",
            expected=f"{', '.join(missing)} in {INDEX}",
            fix=remake(Path(folder)),
        )
    return index


class ViewCache:
    """Finished views of a long stage, kept outside its declared output and keyed by content.

    A stage that was killed finds them again, and adding one photograph costs one photograph. An entry is an
    .npz file. Its key must cover everything that the result depends on: the digests of image, model and code,
    and the settings.

    Args:
        folder: holds the entries, such as `results/.cache/masks`.
        compressed: whether entries are; floating-point numbers hardly shrink, and it takes time.
    """

    def __init__(self, folder: Path, *, compressed: bool = True) -> None:
        self.folder = Path(folder)
        self._method = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
        self.hits = 0
        self.misses = 0

    def path(self, key: str) -> Path:
        """File of a key, whether it exists or not."""
        return self.folder / key[:2] / f"{key}.npz"

    def get(self, key: str, compute: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """Return the entry, computing and storing it if it is missing or damaged."""
        path = self.path(key)
        if path.is_file():
            try:
                arrays = read_npz(path)
                self.hits += 1
                with suppress(OSError):  # another node may prune it in this moment
                    os.utime(path)  # last use, for pruning
                return arrays
            except ArtifactError:
                path.unlink(missing_ok=True)
        arrays = compute()
        _write_zip(path, arrays, self._method)
        self.misses += 1
        return arrays


@contextmanager
def output_lock(output: Path) -> Iterator[None]:
    """Lock an output for writing; a second writer of the same output is refused.

    A writer that does not reach the end leaves a mark in the lock: the output may then be neither what its
    provenance says nor what the writer was about to write.

    Raises:
        ArtifactError: another process is writing it.
    """
    output = Path(output)
    output.parent.mkdir(parents=True, exist_ok=True)
    with lock_path(output).open("a") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ArtifactError(
                f"another process is writing {output}",
                fix="wait for it, or end it, then run again",
            ) from error
        stream.truncate(0)
        stream.write("unfinished\n")
        stream.flush()
        yield
        stream.truncate(0)


def lock_path(output: Path) -> Path:
    """The lock of an output; not empty if its last writer was killed or failed."""
    return output.parent / f".{output.name}.lock"
