"""Gaussians of a scene, with unconstrained parameters for optimisation, and their order in memory."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, Float32, Int64, UInt64

from hilsplat.base.arrays import require_arrays
from hilsplat.base.errors import SettingsError

SH_0 = 0.28209479177387814  # value of the constant harmonic


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N anisotropic 3D Gaussians of one scene, as contiguous arrays.

    Raises:
        SettingsError: arrays have the wrong type or shape, or differ in size.
    """

    means: Float32[np.ndarray, "N 3"]  # centres, scene units
    log_scales: Float32[np.ndarray, "N 3"]  # natural log of the standard deviations, scene units
    quats: Float32[np.ndarray, "N 4"]  # world-from-Gaussian rotations (wxyz), of any non-zero length
    opacity_logits: Float32[np.ndarray, " N"]  # inverse sigmoid of the peak alpha
    sh: Float32[np.ndarray, "N K 3"]  # colour; K = (degree + 1)**2, and row 0 is the constant term

    def __post_init__(self) -> None:
        require_arrays(self)  # compiled loops would read beyond the end of an array that is too short
        if self.sh.shape[1] not in (1, 4, 9, 16):
            raise SettingsError(
                "Gaussians: sh does not have the size of a degree",
                expected="(N, K, 3) with K = 1, 4, 9 or 16",
                found=self.sh.shape,
            )

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return f"Gaussians({len(self)}, colours of degree {self.sh_degree})"

    @property
    def opacities(self) -> Float32[np.ndarray, " N"]:
        """Peak alphas in (0, 1)."""
        from scipy.special import expit  # slow import

        return expit(self.opacity_logits)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics: 0, 1, 2 or 3 for K = 1, 4, 9 or 16."""
        return round(self.sh.shape[1] ** 0.5) - 1


def base_rgb(sh: Float32[np.ndarray, "N K 3"]) -> Float32[np.ndarray, "N 3"]:
    """Return colours without their dependence on the direction, in [0, 1]."""
    return np.clip(0.5 + SH_0 * sh[:, 0], 0, 1)


FIELDS = tuple(field.name for field in fields(Gaussians))  # names of the parameter fields
BITS = 21  # bits per coordinate; three coordinates use 63 of a key's 64 bits


def morton_order(means: Float[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """Return the row order that sorts points along a Z-order curve (Morton 1966) through their bounding box.

    Loops over Gaussians and their neighbours, such as products with the language field's G, then mostly hit
    the processor's cache. The box excludes the outermost 1 % of points on each side: otherwise, a few distant
    Gaussians could force all others into one cell. Rows in the same cell keep their relative order.
    """
    if not len(means):
        return np.zeros(0, np.int64)
    low, high = np.percentile(means.astype(np.float64), (1, 99), axis=0)
    side = max(float((high - low).max()), 1e-12)
    cell = (np.clip((means - low) / side, 0, 1) * (2**BITS - 1)).astype(np.uint64)
    key = _every_third(cell[:, 0]) | _every_third(cell[:, 1]) << 1 | _every_third(cell[:, 2]) << 2
    return np.argsort(key, kind="stable")


def _every_third(values: UInt64[np.ndarray, " N"]) -> UInt64[np.ndarray, " N"]:
    """Move bit b of each value to position 3 b."""
    out = np.zeros_like(values)
    for bit in range(BITS):
        out |= (values >> bit & 1) << 3 * bit
    return out
