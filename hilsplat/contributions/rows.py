"""The finished contributions of a scene: one row per mask of the train views."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32, Float64, Int32, Int64, UInt8

from hilsplat.base.arrays import read_into
from hilsplat.base.artifacts import read_full_index, read_npy, sealed
from hilsplat.base.levels import Level
from hilsplat.contributions.quadratic import Quadratic, load_quadratic
from hilsplat.contributions.streams import mapped


@dataclass(frozen=True)
class Contributions:
    """The finished stage: its rows in memory, its matrices read on request.

    The M rows are the masks of all train views, view by view, in the order of each view.

    Attributes:
        folder: the artifact.
        views: train views in the order of `view`.
        num_gaussians: N.
        gaussians_sha256: digest of the PLY that the weights belong to.
        cameras_sha256: digest of the scene's cameras.
        min_weight: smaller weights of a Gaussian at a pixel were dropped.
        view: index of each row's view in `views`.
        mask: row of the mask among its view's masks.
        level: `Level` of the mask.
        area_px: pixels of the raw mask.
        pixels: number n of pixels that show the mask and that the Gaussians cover.
        half_pixels: how many of them are in the random half.
    """

    folder: Path
    views: tuple[str, ...]
    num_gaussians: int
    gaussians_sha256: str
    cameras_sha256: str
    min_weight: float
    view: Int32[np.ndarray, " M"]
    mask: Int32[np.ndarray, " M"]
    level: UInt8[np.ndarray, " M"]
    area_px: Int64[np.ndarray, " M"]
    pixels: Int64[np.ndarray, " M"]
    half_pixels: Int64[np.ndarray, " M"]

    def __len__(self) -> int:
        return len(self.view)

    def rows_of(self, level: Level) -> Int64[np.ndarray, " m"]:
        """Rows of a level, in order."""
        return np.flatnonzero(self.level == int(level))

    def rows_of_views(self) -> list[Int64[np.ndarray, " m"]]:
        """Rows of each view, in the order of `views` and of the view's masks."""
        return [np.flatnonzero(self.view == number) for number in range(len(self.views))]

    def matrix(self, name: str) -> sp.csr_matrix:
        """`A`, `A_half` or `S` (M x N), mapped from its file rather than held in memory."""
        parts = (mapped(self.folder, f"{name}/{part}.npy") for part in ("data", "indices", "indptr"))
        return sp.csr_matrix(tuple(parts), shape=(len(self), self.num_gaussians), copy=False)

    def mass(self) -> Float32[np.ndarray, "V N"]:
        """Visible mass of each Gaussian in each train view, px; mapped from its file."""
        return mapped(self.folder, "mass.npy")

    def means(self) -> Float32[np.ndarray, "N 3"]:
        """Centres of the Gaussians, scene units."""
        return read_npy(sealed(self.folder, "means.npy"))

    def centres(self) -> Float64[np.ndarray, "V 3"]:
        """Centres of the cameras, scene units."""
        return read_npy(sealed(self.folder, "centres.npy"))

    def quadratic(self, threads: int = 1) -> Quadratic:
        """Map G, or the stacked weights if those are smaller."""
        return load_quadratic(self.folder, threads)

    @staticmethod
    def load(folder: Path) -> "Contributions":
        """Read the rows of a finished contributions folder.

        Raises:
            ArtifactError: it is missing, damaged or of another version.
        """
        folder = Path(folder)
        index = read_full_index(folder, "num_gaussians", "gaussians_sha256", "cameras_sha256", "min_weight")
        return read_into(
            Contributions,
            sealed(folder, "rows.npz"),
            folder=folder,
            views=tuple(index["views"]),
            num_gaussians=index["num_gaussians"],
            gaussians_sha256=index["gaussians_sha256"],
            cameras_sha256=index["cameras_sha256"],
            min_weight=index["min_weight"],
        )
