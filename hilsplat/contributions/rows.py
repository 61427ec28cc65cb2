"""Finished contributions of a scene: one row per mask of the training views."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32, Float64, Int32, Int64, UInt8

from hilsplat.base.arrays import build_checked
from hilsplat.base.artifacts import read_index, read_npy, read_npz, sealed
from hilsplat.base.errors import ArtifactError
from hilsplat.base.levels import Level
from hilsplat.contributions.quadratic import Gram, Quadratic, StackedWeights

HEADER_BYTES = 128
"""Header size of our .npy files; files of empty arrays contain nothing else and cannot be mapped."""


@dataclass(frozen=True)
class Contributions:
    """Contributions artifact, with its rows in memory and its matrices read on request.

    The M rows are the masks of all training views, view by view, in the order of each view.
    """

    folder: Path
    views: tuple[str, ...]
    num_gaussians: int
    gaussians_sha256: str  # digest of the Gaussians' PLY
    cameras_sha256: str  # digest of the scene's cameras
    min_weight: float  # smaller weights of a Gaussian at a pixel are dropped
    view: Int32[np.ndarray, " M"]  # index of each row's view in `views`
    mask: Int32[np.ndarray, " M"]  # row among the masks of the view
    level: UInt8[np.ndarray, " M"]
    area_px: Int64[np.ndarray, " M"]  # pixels of the raw mask
    pixels: Int64[np.ndarray, " M"]  # number n of pixels that show the mask and are covered by Gaussians
    half_pixels: Int64[np.ndarray, " M"]  # number of those pixels that are in the random half

    def __len__(self) -> int:
        return len(self.view)

    def rows_of(self, level: Level) -> Int64[np.ndarray, " m"]:
        return np.flatnonzero(self.level == int(level))

    def rows_of_views(self) -> list[Int64[np.ndarray, " m"]]:
        """Return the rows of each view, in the order of `views` and of the view's masks."""
        starts = np.searchsorted(self.view, np.arange(1, len(self.views)))
        return np.split(np.arange(len(self)), starts)

    def matrix(self, name: str) -> sp.csr_matrix:
        """Memory-map `A`, `A_half` or `S` (M x N) from its files, or `mass` (V x N).

        `mass` is the visible mass of each Gaussian in each training view, px.
        """
        parts = tuple(self._mapped(f"{name}/{part}") for part in ("data", "indices", "indptr"))
        return sp.csr_matrix(parts, shape=(len(parts[2]) - 1, self.num_gaussians), copy=False)

    def means(self) -> Float32[np.ndarray, "N 3"]:
        """Read the centres of the Gaussians, in scene units."""
        return read_npy(sealed(self.folder, "means.npy"))

    def centres(self) -> Float64[np.ndarray, "V 3"]:
        """Read the centres of the cameras, in scene units."""
        return read_npy(sealed(self.folder, "centres.npy"))

    def quadratic(self, threads: int = 1) -> Quadratic:
        """Memory-map G or W, depending on which the stage kept.

        Raises:
            ArtifactError: the folder contains neither G nor W.
        """
        if (self.folder / "G").is_dir():
            indptr, indices, values = (self._mapped(f"G/{name}") for name in ("indptr", "indices", "values"))
            return Gram(indptr, indices, values, threads)
        if (self.folder / "W").is_dir():
            names = ("indptr", "indices", "data", "columns", "valid")
            indptr, indices, data, columns, valid = (self._mapped(f"W/{name}") for name in names)
            shape = (len(indptr) - 1, int(columns[0]))
            matrix = sp.csr_matrix((data, indices, indptr), shape=shape, copy=False)
            return StackedWeights(matrix, valid, threads)
        raise ArtifactError(f"{self.folder} contains neither G nor W", fix="rerun the contributions stage")

    def _mapped(self, name: str) -> np.ndarray:
        """Memory-map an array from its file, read-only; a missing or changed file raises ArtifactError."""
        path = sealed(self.folder, f"{name}.npy")
        mode: Literal["r"] | None = "r" if path.stat().st_size > HEADER_BYTES else None
        return np.load(path, mmap_mode=mode, allow_pickle=False).view(np.ndarray)

    @staticmethod
    def load(folder: Path) -> "Contributions":
        """Read the rows of a finished contributions folder.

        Raises:
            ArtifactError: it is missing, damaged or from a different version of hilsplat.
        """
        folder, names = Path(folder), ("num_gaussians", "gaussians_sha256", "cameras_sha256", "min_weight")
        index = read_index(folder, *names)
        values = {name: index[name] for name in names}
        views = tuple(index["views"])
        path = sealed(folder, "rows.npz")
        fields = {"folder": folder, "views": views, **values}
        return build_checked(Contributions, read_npz(path), fields, path)
