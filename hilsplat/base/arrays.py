"""Validation of an artifact's arrays against its dataclass when the artifact is written and opened.

Compiled loops do not check bounds, so an out-of-range offset would crash the process.
"""

import json
import math
import mmap
import os
import tempfile
import threading
import weakref
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np
import safetensors.numpy
from jaxtyping import AbstractArray, jaxtyped
from safetensors import safe_open

from hilsplat.base.artifacts import OTHER_VERSION, damaged, parse_json, readable
from hilsplat.base.atomic import atomic_path
from hilsplat.base.errors import ArtifactError, SettingsError

Built = TypeVar("Built")
Limits = Mapping[str, tuple[int | float, int | float]]  # array name -> minimum and maximum


def require_arrays(built: Any) -> None:
    """Check the arrays of a dataclass instance against their jaxtyping annotations.

    Dimensions with the same name must have the same size.

    Raises:
        SettingsError: an array has the wrong type or shape.
    """
    with jaxtyped("context"):
        for name, declared, array in _declared(type(built), vars(built)):
            if not isinstance(array, declared):
                is_array = isinstance(array, np.ndarray)
                raise SettingsError(
                    f"{type(built).__name__}: array {name} has the wrong type or shape",
                    expected=described(declared),
                    found=f"{array.dtype} of shape {array.shape}" if is_array else type(array).__name__,
                    fix="convert it, such as by np.asarray(array, np.float32), or correct its size",
                )


def _declared(cls: type, arrays: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield the arrays that have a jaxtyping annotation, by field name."""
    hints = get_type_hints(cls)
    for name, array in arrays.items():
        declared = hints.get(name)
        if isinstance(declared, type) and issubclass(declared, AbstractArray):
            yield name, declared, array


def require_types(cls: type, arrays: Mapping[str, Any], path: Path, limits: Limits) -> None:
    """Check arrays, by field name, against the jaxtyping annotations of a dataclass.

    Dimensions with the same name must have the same size.

    Raises:
        ArtifactError: an array has the wrong type or shape, or contains a non-finite or out-of-range value.
    """
    with jaxtyped("context"):
        for name, declared, array in _declared(cls, arrays):
            if not isinstance(array, declared):
                found = f"{array.dtype} of shape {array.shape}"
                raise damaged(path, f": array {name} has the wrong type or shape", described(declared), found)
            low, high = limits.get(name, (-np.inf, np.inf))
            if array.dtype.kind not in "biuf" or not array.size:
                continue
            lowest, highest = array.min(), array.max()  # NaN if any value is NaN
            if not (low <= lowest and highest <= high and np.isfinite([lowest, highest]).all()):
                expected = f"{low:g} to {high:g}" if name in limits else "finite numbers"
                raise impossible(path, name, expected, f"{lowest} to {highest}")


def impossible(path: Path, name: str, expected: str, found: str | None = None) -> ArtifactError:
    """Return an error about a value in an artifact's array."""
    return damaged(path, f": array {name} contains an impossible value", expected, found)


def described(declared: type[AbstractArray]) -> str:
    """Return a jaxtyping annotation in readable form, such as `Float32[N 3]`."""
    return f"{declared.__name__.partition('[')[0]}[{declared.dim_str.strip()}]"


def build_checked(
    cls: type[Built],
    arrays: Mapping[str, np.ndarray],
    others: Mapping[str, Any],
    path: Path,
    limits: Limits | None = None,
) -> Built:
    """Create a dataclass instance from a file's arrays and other fields; raise ArtifactError on mismatch."""
    names = {field.name for field in fields(cls) if field.init}  # type: ignore[arg-type]
    if {*arrays, *others} != names:
        expected = ", ".join(sorted(names - set(others)))
        raise damaged(path, OTHER_VERSION, expected, ", ".join(sorted(arrays)) or "no arrays")
    require_types(cls, arrays, path, limits or {})
    return cls(**arrays, **others)


TENSORS_KEY = "hilsplat"
"""Metadata key in .safetensors files; the value is JSON with a description and a checksum of the arrays."""


def write_tensors(path: Path, arrays: Mapping[str, np.ndarray], **about: Any) -> None:
    """Write a .safetensors file atomically; identical arrays produce identical bytes."""
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    metadata = json.dumps({**about, "crc32": _checksum(arrays, about)}, sort_keys=True)
    with atomic_path(path) as temporary:
        safetensors.numpy.save_file(arrays, temporary, metadata={TENSORS_KEY: metadata})


def read_tensors(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the arrays and metadata of a `write_tensors` file; raise ArtifactError for any other file."""
    with readable(path):
        with safe_open(path, framework="np") as file:
            about = parse_json(file.metadata()[TENSORS_KEY])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if about.pop("crc32") != _checksum(arrays, about):
            raise ValueError("its content was changed after it was written")
    return arrays, about


def _checksum(arrays: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> int:
    total = zlib.crc32(json.dumps(about, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        total = zlib.crc32(f"{name} {array.dtype.str} {array.shape}".encode(), total)
        total = zlib.crc32(array.reshape(-1).view(np.uint8).data, total)
    return total


class Scratch:
    """Arrays in memory, and beyond a limit in files without names in a folder.

    The system writes the pages of such files out when memory is short.
    """

    def __init__(self, folder: Path, memory_bytes: float = 0.0) -> None:
        self._folder, self._free = folder, memory_bytes
        self._lock = threading.RLock()  # an array can be deleted while its own thread holds the lock
        self._maps = weakref.WeakSet[mmap.mmap]()

    def _take(self, size: int) -> bool:
        with self._lock:
            if is_free := size <= self._free:
                self._free -= size
            return is_free

    def empty(self, shape: int | tuple[int, ...], dtype: type) -> np.ndarray:
        """Return an array with any values; its file is deleted with it."""
        sizes = (shape,) if isinstance(shape, int) else shape
        size = math.prod(sizes) * np.dtype(dtype).itemsize
        if self._take(size):
            array: np.ndarray = np.empty(sizes, dtype)
            weakref.finalize(array, self._take, -size)
            return array
        with tempfile.TemporaryFile(dir=self._folder) as stream:
            stream.truncate(size)
            if hasattr(os, "posix_fallocate"):
                # A full disk raises OSError here; otherwise, writing to a page later would kill the process.
                os.posix_fallocate(stream.fileno(), 0, size)
            mapped = mmap.mmap(stream.fileno(), 0)
        self._maps.add(mapped)
        return np.frombuffer(mapped, dtype).reshape(sizes)

    def release(self) -> None:
        """Take all pages out of this process's memory, where the system can do that; the values stay."""
        if hasattr(mmap, "MADV_DONTNEED"):
            for mapped in self._maps:
                mapped.madvise(mmap.MADV_DONTNEED)
