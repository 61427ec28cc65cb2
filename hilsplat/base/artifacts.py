"""Reading and writing of artifacts: text, JSON, arrays, and folders with an index; how to rebuild them."""

import copy
import functools
import json
import math
import shlex
import zipfile
import zlib
from collections import Counter
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from hilsplat.base.atomic import atomic_path
from hilsplat.base.errors import ArtifactError, HilsplatError, foreign
from hilsplat.base.files import regular

ZIP64_BYTES = 2**30  # arrays above this size get an archive entry that may exceed 2 GiB
INDEX = "index.json"  # written last in a folder artifact, so its presence means that the folder is complete

SEALED = (".json", ".npy", ".npz", ".png", ".safetensors")
"""Suffixes of the files whose checksums are in an artifact's index."""

OTHER_VERSION = " was written by a different version of hilsplat"

RECORD = ".provenance.json"
"""Ending of the name of a provenance record, which begins with the artifact's name."""

RUN = ".run.json"
"""Hidden file in a results folder and in each scene's folder, with the options of the last run."""


def provenance_path(artifact: Path) -> Path:
    """Return the path of an artifact's provenance record, which is beside it."""
    artifact = Path(artifact)
    return artifact.parent / f"{artifact.name}{RECORD}"


def run_command(path: Path, *options: str, scene: str = "", settings: Mapping[str, Any] | None = None) -> str:
    """Return the command that makes a results file, or all results, in the project that they belong to.

    Options are those of the last run of the scene that the file belongs to, or else of any scene. Given a
    `scene`, the command makes this scene; `settings` are added to the overrides of the run.
    """
    path = Path(path).resolve()
    folders = [path, *path.parents]
    marked = (folder for folder in folders if (folder / RUN).is_file() and "scene" not in _run_of(folder))
    named = (folder for folder in folders if folder.name == "results")
    results = next(marked, None) or next(named, path.parent)
    parts = path.relative_to(results).parts
    place = results.joinpath(*(parts[1:3] if parts[:1] == ("figures",) else parts[:2]))
    run = _run_of(place) or _run_of(results)
    configs = [word for config in run.get("config", ()) for word in ("--config", config)]
    name = Path(*run.get("results", ["results"]))
    target = [] if path == results else [scene or str(name / path.relative_to(results))]
    values = [*run.get("overrides", ())]
    values += [f"{section}={json.dumps(changed)}" for section, changed in (settings or {}).items()]
    overrides = ["--", "--config", *values] if values else []
    return shlex.join(["hilsplat", "run", *configs, *options, *target, *overrides])


def _run_of(folder: Path) -> dict[str, list[str]]:
    return read_memo(folder / RUN, dict[str, list[str]])


def rebuild_command(path: Path) -> str:
    """Return the command that rebuilds an artifact, given one of its outputs or a file in one."""
    for output in (Path(path), *Path(path).parents):
        if provenance_path(output).is_file():
            return run_command(output, "--verify")
        for record in output.parent.glob(f"*{RECORD}"):  # of another output of the same stage
            outputs = read_memo(record, dict[str, Any]).get("outputs")
            if isinstance(outputs, dict) and output.name in outputs:
                return run_command(record.with_name(record.name.removesuffix(RECORD)), "--verify")
    return "rerun the stage that writes it"


def damaged(path: Path, problem: str, expected: object = None, found: object = None) -> ArtifactError:
    """Return an error about a file or folder that hilsplat writes, with the command that rebuilds it."""
    return ArtifactError(f"{path}{problem}", expected=expected, found=found, fix=rebuild_command(path))


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically, with keys in the given order."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False) + "\n")


def read_json(path: Path) -> Any:
    """Read JSON; raise ArtifactError if the file is missing or invalid."""
    with readable(path, "is not valid JSON"):
        return parse_json(regular(Path(path)).read_text(encoding="utf-8"))


def parse_json(text: str | bytes) -> Any:
    """Parse JSON from outside the package; raise ValueError if it is invalid, too deep or repeats a key."""
    try:
        return json.loads(text, object_pairs_hook=_unique)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) < len(pairs):  # all but the last value would be ignored
        raise ValueError(f"key {Counter(key for key, _ in pairs).most_common(1)[0][0]!r} is duplicated")
    return values


def read_memo(path: Path, kind: Any) -> Any:
    """Return the JSON object in a cache file; {} if the file is missing or damaged, or is not a `kind`."""
    from pydantic import TypeAdapter

    try:
        return TypeAdapter(kind).validate_python(parse_json(regular(path).read_bytes()), strict=True)
    except (OSError, ValueError):
        return {}


def readable(path: Path, problem: str = "cannot be read") -> AbstractContextManager[None]:
    """Raise ArtifactError if the file is missing or damaged."""
    return foreign(path, ArtifactError, problem=problem, fix=functools.partial(rebuild_command, path))


def write_npz(path: Path, **arrays: np.ndarray) -> None:
    """Write a compressed .npz file atomically; identical arrays give identical bytes (fixed timestamps)."""
    write_arrays(path, arrays)


def write_arrays(
    path: Path, arrays: Mapping[str, np.ndarray], *, compressed: bool = True, durable: bool = True
) -> None:
    """Write an .npz file like `write_npz`, by choice many times as fast without compression."""
    method = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
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
    with readable(path):
        with np.load(regular(Path(path)), allow_pickle=False) as archive:
            if (gib := sum(entry.file_size for entry in archive.zip.infolist()) / 2**30) > max_gib:
                raise ValueError(f"it unpacks to {gib:.1f} GiB, but the limit is {max_gib} GiB")
            arrays = {name: archive[name] for name in archive.files}
        if any(isinstance(array, bytes) for array in arrays.values()):  # numpy found no header
            raise ValueError("it contains data other than arrays")
    if lacking := [name for name in needed if name not in arrays]:
        found = ", ".join(sorted(arrays)) or "no arrays"
        raise damaged(path, f" lacks {', '.join(lacking)}", found=found)
    return arrays


def write_npy(path: Path, array: np.ndarray) -> None:
    """Write an .npy file atomically."""
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.save(stream, array, allow_pickle=False)


def read_npy(path: Path) -> np.ndarray:
    """Read a numeric array from an .npy file without unpickling; raise ArtifactError for anything else."""
    with readable(path):
        with regular(Path(path)).open("rb") as stream:
            array = np.load(stream, allow_pickle=False)
            if stream.read(1):
                raise ValueError("bytes follow its array")
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
            raise ValueError(f"it contains {getattr(array, 'dtype', 'an archive')}, not numbers")
    return array


def write_index(folder: Path, views: Mapping[str, Any], **more: Any) -> None:
    """Complete a folder artifact by writing its index: one entry per view, and the checksums of all files."""
    folder = Path(folder)
    files = sorted(path for path in folder.rglob("*") if path.suffix in SEALED)
    sums = {path.relative_to(folder).as_posix(): _crc32_of_file(path) for path in files}
    index = {**more, "views": dict(views), "crc32": sums}
    write_json(folder / INDEX, {**index, "seal": seal_of(index)})


def read_index(folder: Path, *entries: str) -> dict[str, Any]:
    """Read a folder's index; raise ArtifactError if it is missing, changed or lacks one of the entries."""
    index = copy.deepcopy(_index(Path(folder)))
    if missing := [entry for entry in entries if entry not in index]:
        raise damaged(folder, OTHER_VERSION, expected=f"{', '.join(missing)} in {INDEX}")
    return index


def is_artifact(folder: Path) -> bool:
    """Return whether a folder has an index that hilsplat wrote."""
    try:
        return bool(_index(folder))
    except HilsplatError:
        return False


def _index(folder: Path) -> dict[str, Any]:
    try:
        stat = (folder / INDEX).stat()
    except OSError as error:
        raise damaged(folder, f" is missing or incomplete: it has no {INDEX}") from error
    return _unsealed(folder / INDEX, stat.st_mtime_ns, stat.st_size, stat.st_ino)


@functools.lru_cache(maxsize=16)
def _unsealed(path: Path, *_: int) -> dict[str, Any]:
    """Read an index and compare it with its seal; the result is cached until the file changes."""
    index = read_json(path)
    if not isinstance(index, dict) or not isinstance(index.get("views"), dict) or "seal" not in index:
        raise damaged(path, " is not an artifact index of this version of hilsplat")
    if index.pop("seal") != seal_of(index):
        raise _changed(path)
    return index


def sealed(folder: Path, name: str) -> Path:
    """Return the path of an artifact's file; raise ArtifactError if its checksum differs from the index."""
    path = Path(folder) / name
    sums = _index(Path(folder))["crc32"]
    if not path.is_file():
        raise damaged(path, " is missing")
    if sums.get(name) != _crc32_of_file(path):
        raise _changed(path)
    return path


def _changed(path: Path) -> ArtifactError:
    return damaged(path, " was changed after it was written", f"a file that matches its checksum in {INDEX}")


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
