"""Dr. Splat: averaged vectors of the masks at pixels that a Gaussian dominates, stored as a few bytes.

For every pixel the published code selects the 45 Gaussians with the largest compositing weights, adds each
weight to (Gaussian, mask), averages the masks' unit CLIP vectors with these sums, scales the average to unit
length and stores its product-quantised bytes (kaist-ami/Dr-Splat `train.py`). No field is trained.

Departs from the published code:
    - the product quantiser is trained on the scene's own mask vectors, the published index on general images;
    - one byte per four elements of a vector (128 bytes for 512); the published index file sets its own;
    - weights of a pixel are divided by its alpha, those below `contributions.min_weight` are dropped, and
      pixels with alpha below `MIN_ALPHA` are ignored;
    - all three levels instead of one (`--feature_level`);
    - for queries, the bytes are decoded and rendered like any field instead of looked up in the index.
"""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32

from hilsplat.base.compiled import compiled
from hilsplat.base.levels import LEVELS
from hilsplat.base.progress import track
from hilsplat.contributions.view_matrices import painted_indicator
from hilsplat.methods.common.quantise import ProductQuantiser
from hilsplat.methods.method import Method, MethodInputs
from hilsplat.settings import MethodSettings

TOP_GAUSSIANS = 45
"""Heaviest Gaussians of a pixel that take its vector, as in the published code."""

PART = 4
"""Elements of a CLIP vector that share a byte."""

UNSEEN = 1e-9
"""Averages shorter than this have no direction."""


def heaviest(weights: sp.csr_matrix, count: int) -> sp.csr_matrix:
    """Return the `count` largest weights of each row; lower columns win ties."""
    data = weights.data.copy()
    _drop_lighter(weights.indptr, data, count)
    kept = sp.csr_matrix((data, weights.indices.copy(), weights.indptr.copy()), shape=weights.shape)
    kept.eliminate_zeros()
    return kept


def register(
    inputs: MethodInputs, vectors: Float32[np.ndarray, "M C"], count: int
) -> Float32[np.ndarray, "N 3 C"]:
    """Return unit averages of unit mask vectors over the pixels that a Gaussian dominates; zero without any.

    Args:
        count: number of Gaussians that dominate a pixel, those with the largest weights.
    """
    contributions = inputs.contributions
    sums = np.zeros((contributions.num_gaussians, len(LEVELS), vectors.shape[1]), np.float32)
    rows_of_views = contributions.rows_of_views()
    for view, rows in zip(track(list(contributions.views), "views"), rows_of_views, strict=True):
        weights = heaviest(inputs.view_weights(view), count)
        covered = np.diff(weights.indptr) > 0
        shown = painted_indicator(inputs.view_labels(view), len(rows), covered) @ weights  # masks x Gaussians
        for level in LEVELS:
            own = np.flatnonzero(contributions.level[rows] == int(level))
            sums[:, level.index] += (shown[own].T @ vectors[rows[own]]).astype(np.float32)
    length = np.linalg.norm(sums, axis=2, keepdims=True)
    return np.where(length > UNSEEN, sums / np.maximum(length, UNSEEN), np.float32(0))


def fit(inputs: MethodInputs, settings: MethodSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Average, quantise and decode mask vectors; Gaussians that dominate no pixel get zeros."""
    code = inputs.linear_code("dr_splat")
    vectors = code.decode_array(inputs.latents)
    averages = register(inputs, vectors, TOP_GAUSSIANS)
    quantiser = ProductQuantiser.fit(vectors, PART, seed)
    features = np.zeros((*averages.shape[:2], code.latent), np.float32)
    for level in LEVELS:
        seen = averages[:, level.index].any(axis=1)
        stored = quantiser.encode(averages[seen, level.index])
        features[seen, level.index] = code.encode_array(quantiser.decode(stored, code.channels))
    return features


@compiled
def _drop_lighter(indptr, data, count):
    """Set all but the `count` largest values of each row to zero."""
    for row in range(len(indptr) - 1):
        begin, end = indptr[row], indptr[row + 1]
        if end - begin <= count:
            continue
        least = np.sort(data[begin:end])[end - begin - count]
        above = 0
        for k in range(begin, end):
            above += data[k] > least
        equal = count - above
        for k in range(begin, end):
            if data[k] == least and equal > 0:
                equal -= 1
            elif data[k] <= least:
                data[k] = 0


METHOD = Method("dr_splat", "Dr. Splat", "kaist-ami/Dr-Splat train.py", fit)
