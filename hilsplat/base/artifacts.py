"""Atomic writing, reading and hashing of artifacts; view caches; output locks."""

import copy
import errno
import functools
import hashlib
import json
import logging
import math
import os
import shlex
import shutil
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from hilsplat.base.errors import ArtifactError, DiskSpaceError, HilsplatError
from hilsplat.base.files import regular
from hilsplat.base.processes import lock, unfinished_folder
from hilsplat.base.removal import UNFINISHED, delete, is_unfinished, replace_folder, tag

logger = logging.getLogger(__name__)

ZIP64_BYTES = 2**30  # arrays above this size get an archive entry that may exceed 2 GiB

INDEX = "index.json"  # written last in a folder artifact, so its presence means that the folder is complete

DAMAGE = (
    *(EOFError, MemoryError, NotImplementedError, OSError, SyntaxError, TokenError, ValueError),
    *(OverflowError, zipfile.BadZipFile, zlib.error),
    TypeError,  # an .npy file instead of .npz
)
"""Errors that numpy and zipfile raise on damaged files."""


def provenance_path(artifact: Path) -> Path:
    """Return the path of an artifact's provenance record, which is beside it."""
    artifact = Path(artifact)
    return artifact.parent / f"{artifact.name}.provenance.json"


RUN = ".run.json"
"""Hidden file in a results folder that records the options of the run that writes to it."""

CONVERTED = ".made_from.json"
"""Hidden file in a folder of extracted frames or unpacked photographs that records their source."""


def run_command(path: Path, *options: str) -> str:
    """Return the command that makes a results file, or all results, in the project that they belong to."""
    path = Path(path).resolve()
    places = [path, *path.parents]
    results = next((place for place in places if (place / RUN).is_file()), None)
    about = read_memo(results / RUN, dict[str, list[str]]) if results else {}
    results = results or next((place for place in places if place.name == "results"), path.parent)
    files = [word for name in about.get("config", ()) for word in ("--config", name)]
    name = Path(*about.get("results", ["results"]))
    target = [] if path == results else [str(name / path.relative_to(results))]
    overrides = ["--", "--config", *about["overrides"]] if about.get("overrides") else []
    return shlex.join(["hilsplat", "run", *files, *options, *target, *overrides])


def remake(path: Path) -> str:
    """Return the command that rebuilds an artifact, given the artifact or a file in it."""
    places = [place for place in (Path(path), *Path(path).parents) if provenance_path(place).is_file()]
    if not places:
        return "rerun the stage that writes it"
    place = places[0] / "images" if places[0].name == "world" else places[0]  # its rule writes two subfolders
    return run_command(place, "--verify")


@contextmanager
def atomic_path(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary file that replaces `path` when the block ends without error.

    A `durable` file is flushed to disk, to survive a power failure. A full disk raises DiskSpaceError.
    """
    path = Path(path)
    if is_unfinished(path):  # the file is in a hidden folder that is flushed to the disk later
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with explain_full_disk(path), _keep_mode(path):
                yield path
        except BaseException:
            delete(path)
            raise
        return
    with work_folder(path) as folder:
        temporary = folder / f"new{path.suffix[-16:]}"
        with _keep_mode(temporary):
            yield temporary
        if durable:
            _flush(temporary)
        temporary.replace(path)
        if durable:
            _flush(path.parent)


@contextmanager
def _keep_mode(path: Path) -> Iterator[None]:
    """Create a file with the umask's mode, and restore this mode at the end; safetensors would set 0600."""
    path.touch()
    mode = path.stat().st_mode & 0o777
    yield
    path.chmod(mode)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder that replaces `path` at the end; raise DiskSpaceError if the disk is full."""
    path = Path(path)
    durable = not is_unfinished(path)
    with work_folder(path) as folder:
        temporary = folder / "new"
        temporary.mkdir()
        yield temporary
        if durable:
            for place, _, names in os.walk(temporary, topdown=False):
                for name in names:
                    _flush(Path(place, name))
                _flush(Path(place))
        replace_folder(temporary, path, folder)
        if durable:
            _flush(path.parent)


@contextmanager
def work_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `path`, deleted at the end; raise DiskSpaceError on a full disk."""
    path = Path(path)
    with explain_full_disk(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with unfinished_folder(path.parent) as folder, explain_full_disk(path):
            yield folder


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # file systems such as 9p cannot flush folders
            raise
    finally:
        os.close(descriptor)


FULL_DISK = ("No space left on device", "disk is full", "Disk quota exceeded")
"""Parts of disk-full messages from libraries that raise their own error types: safetensors, SQLite."""

LIBRARY_ERRORS = (RuntimeError, ChildProcessError)
"""Exceptions raised by C++ libraries, or because a library terminated its process."""
FULL_BELOW_MIB = 1.0
"""Free space below which `LIBRARY_ERRORS` are attributed to a full disk, which COLMAP does not report."""


@contextmanager
def explain_full_disk(path: Path) -> Iterator[None]:
    """Raise DiskSpaceError, naming the disk and a fix, if writing `path` fails because the disk is full."""
    try:
        yield
    except HilsplatError:
        raise
    except Exception as error:
        hidden = [place for place in path.parents if UNFINISHED.fullmatch(place.name)]
        folder = existing_folder(hidden[-1].parent if hidden else path.parent)
        usage = shutil.disk_usage(folder)
        full = getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)
        full = full or any(words in str(error) for words in FULL_DISK)
        full = full or (isinstance(error, LIBRARY_ERRORS) and usage.free < FULL_BELOW_MIB * 2**20)
        if full:
            raise DiskSpaceError(
                f"no space left while writing {path.name} in {folder}",
                found=f"{usage.free / 2**20:.1f} MiB free of {usage.total / 2**20:.0f} MiB on that disk"
                + ", which cannot hold more files (inodes)" * _lacks_inodes(folder),
                fix=f"free up space on the disk of {folder}, then run again; finished work is kept",
            ) from error
        if isinstance(error, OSError) and is_unfinished(Path(str(error.filename))):
            error.filename = str(path)  # a temporary name means nothing to a user
        raise


def _lacks_inodes(folder: Path) -> bool:
    found = os.statvfs(folder) if hasattr(os, "statvfs") else None
    return found is not None and found.f_files > 0 and found.f_favail == 0


def existing_folder(folder: Path) -> Path:
    """Return the folder, or its nearest existing parent."""
    return next(place for place in (folder, *folder.absolute().parents) if place.exists())


def require_free_space(folder: Path, needed_mib: float) -> None:
    """Raise DiskSpaceError if less than `needed_mib` MiB is free on the folder's disk."""
    folder = existing_folder(Path(folder))
    free_mib = shutil.disk_usage(folder).free / 2**20
    if free_mib < needed_mib:
        raise DiskSpaceError(
            f"not enough space on the disk of {folder}",
            expected=f"at least {needed_mib:.0f} MiB free",
            found=f"{free_mib:.0f} MiB free",
            fix="free up space, or move the folder to another disk and replace it with a symbolic link",
        )


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically, with keys in the given order."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False) + "\n")


def read_json(path: Path) -> Any:
    """Read JSON; raise ArtifactError if the file is missing or invalid."""
    with _readable(path, "is not valid JSON", (ValueError, OSError)):
        return parse_json(regular(Path(path)).read_text(encoding="utf-8"))


def parse_json(text: str | bytes) -> Any:
    """Parse JSON from outside the package; raise ValueError if it is invalid, too deep or repeats a key."""
    try:
        return json.loads(text, object_pairs_hook=_unique)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(found := dict(pairs)) < len(pairs):  # all but the last value would be ignored
        raise ValueError(f"key {Counter(key for key, _ in pairs).most_common(1)[0][0]!r} is duplicated")
    return found


def read_memo(path: Path, kind: Any) -> Any:
    """Return the JSON object in a cache file; {} if the file is missing or damaged, or is not a `kind`."""
    from pydantic import TypeAdapter

    try:
        return TypeAdapter(kind).validate_python(parse_json(regular(path).read_bytes()), strict=True)
    except (OSError, ValueError):
        return {}


@contextmanager
def _readable(
    path: Path, problem: str = "cannot be read", errors: tuple[type[Exception], ...] = DAMAGE
) -> Iterator[None]:
    """Raise ArtifactError if the file is missing, or if reading it raises one of `errors`."""
    try:
        yield
    except FileNotFoundError as error:
        raise ArtifactError(f"{path} is missing", fix=remake(path)) from error
    except errors as error:
        raise ArtifactError(f"{path} {problem}: {error}", fix=remake(path)) from error


def write_npz(path: Path, **arrays: np.ndarray) -> None:
    """Write a compressed .npz file atomically; identical arrays give identical bytes (fixed timestamps)."""
    _write_zip(path, arrays, zipfile.ZIP_DEFLATED)


def write_stored_npz(path: Path, **arrays: np.ndarray) -> None:
    """Write an .npz file atomically without compression, many times as fast as `write_npz`."""
    _write_zip(path, arrays, zipfile.ZIP_STORED)


def _write_zip(path: Path, arrays: dict[str, np.ndarray], method: int, *, durable: bool = True) -> None:
    with (
        atomic_path(path, durable=durable) as temporary,
        zipfile.ZipFile(temporary, "w", method, compresslevel=1) as archive,
    ):
        for name, array in arrays.items():
            # Entries opened by name get the timestamp 1980-01-01. They are written in pieces, because a
            # copy of a large array or its compressed form may not fit into memory.
            large = array.nbytes > ZIP64_BYTES
            with archive.open(f"{name}.npy", "w", force_zip64=large) as stream:
                np.lib.format.write_array(stream, np.ascontiguousarray(array), allow_pickle=False)


def read_npz(path: Path, *needed: str, max_gib: float = math.inf) -> dict[str, np.ndarray]:
    """Read an .npz file without unpickling.

    An ArtifactError is raised if it is damaged, lacks a needed array or, unpacked, is larger than `max_gib`.
    """
    with _readable(path):
        with np.load(regular(Path(path)), allow_pickle=False) as archive:
            if (gib := sum(entry.file_size for entry in archive.zip.infolist()) / 2**30) > max_gib:
                raise ValueError(f"it unpacks to {gib:.1f} GiB, but the limit is {max_gib} GiB")
            arrays = {name: archive[name] for name in archive.files}
        if any(isinstance(array, bytes) for array in arrays.values()):  # numpy found no header
            raise ValueError("it contains data other than arrays")
    if lacking := [name for name in needed if name not in arrays]:
        raise ArtifactError(
            f"{path} lacks {', '.join(lacking)}",
            found=", ".join(sorted(arrays)) or "no arrays",
            fix=remake(path),
        )
    return arrays


def write_npy(path: Path, array: np.ndarray) -> None:
    """Write an .npy file atomically."""
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.save(stream, array, allow_pickle=False)


def read_npy(path: Path) -> np.ndarray:
    """Read a numeric array from an .npy file without unpickling; raise ArtifactError for anything else."""
    with _readable(path):
        with regular(Path(path)).open("rb") as stream:
            array = np.load(stream, allow_pickle=False)
            if stream.read(1):
                raise ValueError("bytes follow its array")
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
            raise ValueError(f"it contains {getattr(array, 'dtype', 'an archive')}, not numbers")
    return array


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
    with regular(Path(path)).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def sha256_of_path(path: Path) -> str:
    """Return the SHA-256 of a file, or of the names and bytes of a folder's non-hidden files."""
    path = Path(path)
    if path.is_file():
        return sha256_of_file(path)
    files = visible_files(path)
    if not files:
        raise ArtifactError(f"{path} is missing or empty", fix=remake(path))
    return sha256_of_json([(file.relative_to(path).as_posix(), sha256_of_file(file)) for file in files])


def digests_of(paths: Collection[str], memo: Path) -> dict[str, str]:
    """Map each path to its file's SHA-256, or "unreadable"; only files that changed since `memo` are read.

    Programs cannot set the status change time, so it reveals a replacement of the same size and time.
    """
    known = read_memo(memo, dict[str, str])

    def entry(path: str) -> str:
        with suppress(OSError, HilsplatError):  # the stage reports them
            stat = Path(path).stat()
            stamp = f"{stat.st_size} {stat.st_mtime_ns} {stat.st_ctime_ns} "
            found = known.get(path, "")
            return found if found.startswith(stamp) else stamp + sha256_of_file(Path(path))
        return "unreadable"

    with ThreadPoolExecutor() as threads:
        entries = dict(zip(paths, threads.map(entry, paths), strict=True))
    if not entries.items() <= known.items():
        with suppress(OSError):  # a read-only folder of results
            write_json(memo, known | entries)
    return {path: each.split()[-1] for path, each in entries.items()}


def visible_files(folder: Path) -> list[Path]:
    """Return the files in a folder and its subfolders, sorted; follow links, and skip what is hidden.

    Subfolders that hilsplat wrote are skipped too, because a project may be in a folder of photographs.
    """
    found = []
    for place, folders, names in os.walk(folder, followlinks=True):
        folders[:] = [name for name in folders if name[0] != "." and not is_apart(Path(place, name))]
        found += [path for name in names if name[0] != "." and (path := Path(place, name)).is_file()]
    return sorted(found)


def is_apart(folder: Path) -> bool:
    """Return whether a folder is results, an artifact, a converted source, or a link to a parent folder."""
    own = (folder / RUN, folder / CONVERTED, provenance_path(folder))
    return any(map(Path.is_file, own)) or folder.parent.resolve().is_relative_to(folder.resolve())


def write_index(folder: Path, views: Mapping[str, Any], **more: Any) -> None:
    """Complete a folder artifact by writing its index: one entry per view, and the checksums of all files."""
    folder = Path(folder)
    files = sorted(path for path in folder.rglob("*") if path.suffix in SEALED)
    sums = {path.relative_to(folder).as_posix(): _crc32_of_file(path) for path in files}
    index = {**more, "views": dict(views), "crc32": sums}
    write_json(folder / INDEX, {**index, "seal": seal_of(index)})


SEALED = (".json", ".npy", ".npz", ".png", ".safetensors")
"""Suffixes of the files whose checksums are in an artifact's index."""


def read_index(folder: Path, *entries: str) -> dict[str, Any]:
    """Read a folder's index; raise ArtifactError if it is missing, changed or lacks one of the entries."""
    index = copy.deepcopy(_index(Path(folder)))
    if missing := [entry for entry in entries if entry not in index]:
        raise ArtifactError(
            f"{folder} was written by a different version of hilsplat",
            expected=f"{', '.join(missing)} in {INDEX}",
            fix=remake(Path(folder)),
        )
    return index


def _index(folder: Path) -> dict[str, Any]:
    try:
        found = (folder / INDEX).stat()
    except OSError as error:
        raise ArtifactError(
            f"{folder} is missing or incomplete: it has no {INDEX}", fix=remake(folder)
        ) from error
    return _unsealed(folder / INDEX, found.st_mtime_ns, found.st_size, found.st_ino)


@functools.lru_cache(maxsize=16)
def _unsealed(path: Path, *_: int) -> dict[str, Any]:
    """Read an index and compare it with its seal; the result is cached until the file changes."""
    index = read_json(path)
    if not isinstance(index, dict) or not isinstance(index.get("views"), dict) or "seal" not in index:
        raise ArtifactError(f"{path} is not an artifact index of this version of hilsplat", fix=remake(path))
    if index.pop("seal") != seal_of(index):
        raise _changed(path)
    return index


def sealed(folder: Path, name: str) -> Path:
    """Return the path of an artifact's file; raise ArtifactError if its checksum differs from the index."""
    path = Path(folder) / name
    sums = _index(Path(folder))["crc32"]
    if not path.is_file():
        raise ArtifactError(f"{path} is missing", fix=remake(path))
    if sums.get(name) != _crc32_of_file(path):
        raise _changed(path)
    return path


def _changed(path: Path) -> ArtifactError:
    return ArtifactError(
        f"{path} was changed after it was written",
        expected=f"a file that matches its checksum in {INDEX}",
        fix=remake(path),
    )


def seal_of(index: Mapping[str, Any]) -> int:
    """Return the checksum of a JSON object, which its file contains as `seal`."""
    as_read = json.loads(json.dumps(index))  # JSON has no tuples, and its keys are strings
    return zlib.crc32(json.dumps(as_read, sort_keys=True).encode())


def _crc32_of_file(path: Path) -> int:
    total = 0
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            total = zlib.crc32(block, total)
    return total


class ViewCache:
    """Cache of a stage's finished views as .npz files, which a rerun uses if the stage was killed.

    Keys must cover all inputs of the result: the settings, and the digests of the image, model and code.
    Entries are not `compressed` if they are floating-point numbers, which shrink too little to benefit.
    """

    def __init__(self, folder: Path, *, compressed: bool = True) -> None:
        self.folder = Path(folder)
        self._method = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
        self.hits = 0

    def path(self, key: str) -> Path:
        """Return the path of a key's file, which may not exist."""
        return self.folder / key[:2] / f"{key}.npz"

    def get(self, key: str, compute: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """Return the entry, computing and storing it if it is missing or damaged."""
        found = self.find(key)
        if found is not None:
            self.hits += 1
            return found
        arrays = compute()
        self.put(key, arrays)
        return arrays

    def find(self, key: str) -> dict[str, np.ndarray] | None:
        """Return the entry, or None if it is missing or damaged."""
        path = self.path(key)
        if path.is_file():
            with suppress(ArtifactError):
                if arrays := read_npz(path):  # a file that ends in zeros may look like an empty archive
                    with suppress(OSError):  # another process may have pruned it
                        os.utime(path)  # last use, for pruning
                    return arrays
        return None

    def put(self, key: str, arrays: dict[str, np.ndarray]) -> None:
        """Store an entry, replacing any existing one."""
        # A power failure may truncate entries or fill them with zeros. Checksums reveal this on reading, and
        # the entry is recomputed. A flush to disk, which takes milliseconds, is therefore unnecessary.
        tag(self.folder)
        _write_zip(self.path(key), arrays, self._method, durable=False)


@contextmanager
def output_lock(output: Path) -> Iterator[None]:
    """Lock an output for writing; raise ArtifactError if another process is writing it.

    If a writer fails or is killed, its lock file stays non-empty, because the output may then match
    neither the provenance record nor the inputs of that writer.
    """
    output = Path(output)
    output.parent.mkdir(parents=True, exist_ok=True)
    with lock_path(output).open("a") as stream:
        try:
            lock(stream, wait=False)
        except BlockingIOError as error:
            raise ArtifactError(
                f"another process is writing {output}", fix="let it finish or stop it, then run again"
            ) from error
        stream.truncate(0)
        stream.write("unfinished\n")
        stream.flush()
        yield
        stream.truncate(0)


@contextmanager
def changing(path: Path) -> Iterator[Path]:
    """Wait for the lock of a file that is read, changed and written; yield the file, or where it links to."""
    path = Path(os.path.realpath(path))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream = lock_path(path).open("a")
    except OSError as error:
        error.filename = str(path)  # the name of the lock means nothing to a user
        raise
    with stream:
        try:
            lock(stream, wait=False)
        except BlockingIOError:
            logger.info("waiting for another command that changes %s", path)
            lock(stream)
        yield path


def lock_path(output: Path) -> Path:
    return output.parent / f".{output.name}.lock"


def was_interrupted(output: Path) -> bool:
    """Return whether the last writer of an output was killed or failed."""
    try:
        return lock_path(output).stat().st_size > 0
    except OSError:
        return False
