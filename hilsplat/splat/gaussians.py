"""The Gaussians of a scene, in the unconstrained form we optimise."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """N anisotropic 3D Gaussians of one scene, in the unconstrained form we optimise.

    Attributes:
        means: centres, scene units.
        log_scales: natural log of the standard deviation along each axis, scene units.
        quats: world-from-Gaussian rotation, wxyz; any non-zero length.
        opacity_logits: inverse sigmoid of the peak alpha.
        sh: colour as spherical harmonics, K = (degree + 1)**2; row 0 is the constant term.
    """

    means: Float[Tensor, "N 3"]
    log_scales: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    opacity_logits: Float[Tensor, " N"]
    sh: Float[Tensor, "N K 3"]

    def __len__(self) -> int:
        return len(self.means)

    @property
    def scales(self) -> Float[Tensor, "N 3"]:
        """Standard deviations, scene units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Float[Tensor, " N"]:
        """Peak alphas in (0, 1)."""
        return torch.sigmoid(self.opacity_logits)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics: K = 1, 4, 9, 16 is degree 0, 1, 2, 3."""
        return round(self.sh.shape[1] ** 0.5) - 1
