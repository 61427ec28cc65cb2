"""Normalised compositing weights: a pixel shows an average of the Gaussians it sees."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32

from hilsplat.base.compiled import compiled

MIN_ALPHA = 0.5
"""Pixels with a smaller alpha are ignored: their features would be extrapolated."""


def normalised_weights(weights: sp.csr_matrix, min_alpha: float = MIN_ALPHA) -> sp.csr_matrix:
    """Divide the weights of each pixel by their sum, the accumulated alpha.

    The weights then sum to 1, so that a rendered feature is an average of features. Weights that the
    rasteriser dropped as too small do not count in the sum.

    Args:
        weights: compositing weights (pixels x Gaussians).
        min_alpha: pixels with a smaller sum become empty rows.

    Returns:
        the normalised matrix, columns sorted.
    """
    if not weights.has_sorted_indices:
        weights = weights.sorted_indices()
    indptr = np.zeros(weights.shape[0] + 1, np.int64)
    indices, data = np.empty(weights.nnz, np.int32), np.empty(weights.nnz, np.float32)
    kept = _normalise(weights.indptr, weights.indices, weights.data, min_alpha, indptr, indices, data)
    return sp.csr_matrix((data[:kept], indices[:kept], indptr.astype(np.int32)), shape=weights.shape)


def visible_mass(weights: sp.csr_matrix) -> Float32[np.ndarray, " N"]:
    """Sum of each Gaussian's weights over the pixels, px; summed in float64."""
    out = np.zeros(weights.shape[1], np.float64)
    _add_columns(weights.indices, weights.data, out)
    return out.astype(np.float32)


@compiled
def _add_columns(indices, data, out):
    for k in range(len(indices)):
        out[indices[k]] += data[k]


@compiled
def _normalise(indptr, indices, data, min_alpha, out_indptr, out_indices, out_data):
    done = 0
    for row in range(len(indptr) - 1):
        alpha = 0.0
        for k in range(indptr[row], indptr[row + 1]):
            alpha += data[k]
        if alpha >= min_alpha:
            for k in range(indptr[row], indptr[row + 1]):
                out_indices[done] = indices[k]
                out_data[done] = data[k] / alpha
                done += 1
        out_indptr[row + 1] = done
    return done
