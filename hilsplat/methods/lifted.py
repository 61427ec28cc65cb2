"""Training-free lifting: the weighted average of mask codes at each Gaussian (the idea of Occam's LGS)."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32

from hilsplat.base.levels import LEVELS
from hilsplat.methods.method import Method, MethodInputs
from hilsplat.settings import MethodSettings


def lift(weights: sp.csr_matrix, latents: Float32[np.ndarray, "M D"]) -> Float32[np.ndarray, "N D"]:
    """Average of the masks' codes at each Gaussian, each weighed by what of the Gaussian falls into it.

    Args:
        weights: mass of each Gaussian in each mask (M x N), px.
        latents: code of each mask.

    Returns:
        the averages; 0 at Gaussians that no mask holds.
    """
    total = np.asarray(weights.sum(axis=0), dtype=np.float64).ravel()
    summed = weights.T.astype(np.float64) @ latents.astype(np.float64)
    return np.divide(summed, total[:, None], out=np.zeros_like(summed), where=total[:, None] > 0).astype(
        np.float32
    )


def fit(inputs: MethodInputs, settings: MethodSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Lift each level by itself; nothing is trained and nothing is random."""
    contributions, latents = inputs.contributions, inputs.latents
    means = contributions.matrix("A")
    features = np.zeros((contributions.num_gaussians, len(LEVELS), latents.shape[1]), np.float32)
    for level in LEVELS:
        rows = contributions.rows_of(level)
        mass = sp.diags(contributions.pixels[rows].astype(np.float64)) @ means[rows]
        features[:, level.index] = lift(sp.csr_matrix(mass), latents[rows])
    return features


METHOD = Method(
    "lifted",
    "lifted CLIP, training-free",
    "the idea of Occam's LGS; departs: exact weights of all pixels of a mask in place of those at projected "
    "centres, and codes of the scene's linear code (pca, 64) in place of 512 numbers",
    fit,
)
