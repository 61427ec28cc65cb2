"""Dr. Splat: averaged mask vectors from the pixels that a Gaussian dominates, stored as a few bytes.

For every pixel, the published code adds the weights of the 45 Gaussians with the largest compositing weights
to sums per Gaussian and mask. It averages the masks' unit CLIP vectors with these sums, scales the average to
unit length and stores its product-quantised bytes (kaist-ami/Dr-Splat `train.py`). No field is trained.

Departs from the published code:
    - the product quantiser is trained on the scene's own mask vectors, not on general images;
    - one byte per four vector elements (128 bytes for 512); the published index file sets its own number;
    - weights of a pixel are divided by its alpha, those below `contributions.min_weight` are dropped, and
      pixels with alpha below `MIN_ALPHA` are ignored;
    - all three levels are used instead of one (`--feature_level`);
    - for queries, the bytes are decoded and rendered like any field instead of looked up in the index.
"""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32
from scipy.cluster.vq import vq

from hilsplat.base.levels import LEVELS
from hilsplat.base.progress import track
from hilsplat.baselines import MethodSettings
from hilsplat.contributions.view_matrices import painted_indicator
from hilsplat.methods.common.groups import kmeans
from hilsplat.methods.method import MethodInputs

TOP_GAUSSIANS = 45  # number of Gaussians, by weight, that get a pixel's vector, as published
PART = 4  # elements of a CLIP vector that share a byte
UNSEEN = 1e-9  # averages shorter than this have no direction


def heaviest(weights: sp.csr_matrix, count: int) -> sp.csr_matrix:
    """Return the `count` largest weights of each row; lower columns win ties."""
    result = weights.copy()
    for row in np.flatnonzero(np.diff(result.indptr) > count):
        row_weights = result.data[result.indptr[row] : result.indptr[row + 1]]
        row_weights[np.argsort(-row_weights, kind="stable")[count:]] = 0
    result.eliminate_zeros()
    return result


def register(
    inputs: MethodInputs, vectors: Float32[np.ndarray, "M C"], count: int
) -> Float32[np.ndarray, "N 3 C"]:
    """Return unit averages of unit mask vectors over the pixels that each Gaussian dominates; zero if none.

    The `count` Gaussians with the largest weights dominate a pixel.
    """
    contributions = inputs.contributions
    sums = np.zeros((contributions.num_gaussians, len(LEVELS), vectors.shape[1]), np.float32)
    rows_of_views = contributions.rows_of_views()
    for view, rows in zip(track(list(contributions.views), "views"), rows_of_views, strict=True):
        weights = heaviest(inputs.view_weights(view), count)
        covered = np.diff(weights.indptr) > 0
        painted = painted_indicator(inputs.view_labels(view), len(rows), covered)
        in_masks = painted @ weights  # masks x Gaussians
        for level in LEVELS:
            of_level = np.flatnonzero(contributions.level[rows] == int(level))
            sums[:, level.index] += (in_masks[of_level].T @ vectors[rows[of_level]]).astype(np.float32)
    length = np.linalg.norm(sums, axis=2, keepdims=True)
    return np.where(length > UNSEEN, sums / np.maximum(length, UNSEEN), np.float32(0))


def codebooks(vectors: Float32[np.ndarray, "B C"], seed: int) -> list[Float32[np.ndarray, "256 S"]]:
    """Return one codebook per vector part (product quantisation; Jegou et al., PAMI 2011)."""
    return [kmeans(part, 256, seed + at)[0] for at, part in enumerate(_parts(vectors))]


def quantised(
    vectors: Float32[np.ndarray, "n C"], books: list[Float32[np.ndarray, "_ S"]]
) -> Float32[np.ndarray, "n C"]:
    """Replace each part of the vectors with its nearest codebook entry (one byte for 256 entries)."""
    nearest = [
        book[vq(part, book, check_finite=False)[0]] for part, book in zip(_parts(vectors), books, strict=True)
    ]
    return np.concatenate(nearest, axis=1)[:, : vectors.shape[1]]


def _parts(vectors: Float32[np.ndarray, "n C"]) -> list[Float32[np.ndarray, "n S"]]:
    """Return parts of `PART` elements; the last part is padded with zeros."""
    filled = np.pad(vectors, ((0, 0), (0, -vectors.shape[1] % PART)))
    return [np.ascontiguousarray(filled[:, at : at + PART]) for at in range(0, filled.shape[1], PART)]


def fit(inputs: MethodInputs, settings: MethodSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Average, quantise and decode mask vectors; Gaussians that dominate no pixel get zeros."""
    code, features = inputs.linear_code("dr_splat"), inputs.no_features()
    vectors = code.decode_array(inputs.latents)
    averages, books = register(inputs, vectors, TOP_GAUSSIANS), codebooks(vectors, seed)
    for level in LEVELS:
        seen = averages[:, level.index].any(axis=1)
        features[seen, level.index] = code.encode_array(quantised(averages[seen, level.index], books))
    return features
