"""Gaussians of a scene, in the unconstrained form that is optimised."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32


@dataclass(frozen=True)
class Gaussians:
    """N anisotropic 3D Gaussians of one scene, as contiguous arrays.

    Attributes:
        means: centres, scene units.
        log_scales: natural log of the standard deviation along each axis, scene units.
        quats: world-from-Gaussian rotation, wxyz; any non-zero length.
        opacity_logits: inverse sigmoid of the peak alpha.
        sh: colour as spherical harmonics, K = (degree + 1)**2; row 0 is the constant term.
    """

    means: Float32[np.ndarray, "N 3"]
    log_scales: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    opacity_logits: Float32[np.ndarray, " N"]
    sh: Float32[np.ndarray, "N K 3"]

    def __len__(self) -> int:
        return len(self.means)

    @property
    def scales(self) -> Float32[np.ndarray, "N 3"]:
        """Standard deviations, scene units."""
        return np.exp(self.log_scales)

    @property
    def opacities(self) -> Float32[np.ndarray, " N"]:
        """Peak alphas in (0, 1)."""
        from scipy.special import expit  # slow import

        return expit(self.opacity_logits)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics: K = 1, 4, 9, 16 is degree 0, 1, 2, 3."""
        return round(self.sh.shape[1] ** 0.5) - 1


FIELDS = tuple(field.name for field in fields(Gaussians))
"""Field names of the parameters."""
