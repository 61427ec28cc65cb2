"""Arrays written row by row, so that a stage never holds all of its output, and memory-mapped when read."""

from pathlib import Path
from types import TracebackType
from typing import Literal

import numpy as np

from hilsplat.base.artifacts import sealed

HEADER_BYTES = 128


class ArrayStream:
    """A .npy file written row by row; closing it completes its header.

    Args:
        path: file to write.
        dtype: type of the numbers.
        columns: numbers per row; None for a one-dimensional array.
    """

    def __init__(self, path: Path, dtype: type, columns: int | None = None) -> None:
        self._dtype, self._columns, self._rows = np.dtype(dtype), columns, 0
        self._stream = Path(path).open("wb")  # noqa: SIM115 (closed by close)
        self._stream.write(bytes(HEADER_BYTES))

    def __enter__(self) -> "ArrayStream":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __len__(self) -> int:
        return self._rows

    def append(self, values: np.ndarray) -> None:
        """Add rows."""
        values = np.ascontiguousarray(values, self._dtype)
        self._rows += len(values)
        self._stream.write(values.data)

    def close(self) -> None:
        """Complete the header."""
        shape = (self._rows,) if self._columns is None else (self._rows, self._columns)
        # NumPy's format 1.0: magic, header length, and the header padded with spaces
        text = f"{{'descr': '{self._dtype.str}', 'fortran_order': False, 'shape': {shape}, }}"
        length = HEADER_BYTES - 10
        self._stream.seek(0)
        self._stream.write(b"\x93NUMPY\x01\x00" + length.to_bytes(2, "little"))
        self._stream.write(text.ljust(length - 1).encode() + b"\n")
        self._stream.close()


class MatrixStream:
    """A CSR matrix that grows by rows, in a folder with `data.npy`, `indices.npy` and `indptr.npy`."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True)
        self._data = ArrayStream(folder / "data.npy", np.float32)
        self._indices = ArrayStream(folder / "indices.npy", np.int32)
        self._indptr = ArrayStream(folder / "indptr.npy", np.int64)
        self._indptr.append(np.zeros(1))

    @property
    def nonzeros(self) -> int:
        """Number of stored values."""
        return len(self._data)

    def append(self, data: np.ndarray, indices: np.ndarray, indptr: np.ndarray) -> None:
        """Append the rows of a matrix in CSR form."""
        self._indptr.append(indptr[1:] + self.nonzeros)
        self._data.append(data)
        self._indices.append(indices)

    def close(self) -> None:
        """Complete the files."""
        for stream in (self._data, self._indices, self._indptr):
            stream.close()


def mapped(folder: Path, name: str) -> np.ndarray:
    """Memory-map an array from a file of an artifact, read-only.

    Raises:
        ArtifactError: if the file is missing or has changed since it was written.
    """
    path = sealed(folder, name)
    # an empty array cannot be mapped
    mode: Literal["r"] | None = "r" if path.stat().st_size > HEADER_BYTES else None
    return np.load(path, mmap_mode=mode, allow_pickle=False).view(np.ndarray)
