"""Normalised compositing weights: a pixel's feature is an average over the Gaussians it shows."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32

from hilsplat.base.compiled import compiled

MIN_ALPHA = 0.5
"""Pixels with a smaller alpha are ignored, since their features would be extrapolated."""


def normalised_weights(weights: sp.csr_matrix, min_alpha: float = MIN_ALPHA) -> sp.csr_matrix:
    """Divide the weights of each pixel by their sum, the accumulated alpha.

    The weights then sum to 1, so that a rendered feature is an average of features. Weights that the
    rasteriser dropped as too small are not in the sum.

    Args:
        weights: compositing weights (pixels x Gaussians), whose memory is overwritten by the result.
        min_alpha: pixels with a smaller sum become empty rows.

    Returns:
        the normalised matrix, with sorted columns.
    """
    weights.sort_indices()
    kept = _normalise(weights.indptr, weights.indices, weights.data, min_alpha)
    arrays = (weights.data[:kept], weights.indices[:kept], weights.indptr)
    return sp.csr_matrix(arrays, shape=weights.shape, copy=False)


def visible_mass(weights: sp.csr_matrix) -> Float32[np.ndarray, " N"]:
    """Return the sum of each Gaussian's weights over the pixels, px; summed in float64."""
    out = np.zeros(weights.shape[1], np.float64)
    _add_columns(weights.indices, weights.data, out)
    return out.astype(np.float32)


@compiled
def _add_columns(indices, data, out):
    for k in range(len(indices)):
        out[indices[k]] += data[k]


@compiled
def _normalise(indptr, indices, data, min_alpha):
    done, begin = 0, indptr[0]
    for row in range(len(indptr) - 1):
        end = indptr[row + 1]
        alpha = 0.0
        for k in range(begin, end):
            alpha += data[k]
        if alpha >= min_alpha:
            for k in range(begin, end):
                indices[done] = indices[k]
                data[done] = data[k] / alpha
                done += 1
        begin, indptr[row + 1] = end, done
    return done
