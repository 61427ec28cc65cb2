"""Latents rendered at a view's pixels, level by level, with the bytes of products with its weights."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32

from hilsplat.base.compiled import compiled
from hilsplat.base.lanes import WIDTH, lanes, load, store
from hilsplat.contributions.channels import padded, plus

MIN_LATENT_SHARE = 0.5
"""A pixel has a latent at a level if more than this share of its weight is of Gaussians with a latent."""


def rendered_latents(
    weights: sp.csr_matrix, features: Float32[np.ndarray, "N 3 D"]
) -> list[tuple[np.ndarray, Float32[np.ndarray, "P D"]]]:
    """Return, per level, the pixels that mostly show Gaussians with a latent, and their rendered latents.

    Gaussians without a latent have zeros, which a code would decode like any latent. They are omitted, and
    the weights of the others are divided by their sum.

    Args:
        weights: weights of the view (pixels x Gaussians), rows summing to 1 or empty.
        features: latents of the Gaussians.
    """
    rows = weights.indptr, weights.indices, weights.data
    shares = np.zeros((weights.shape[0], features.shape[1]), np.float32)
    _add_shares(*rows, (features != 0).any(axis=2), shares)
    shown = []
    for level in range(features.shape[1]):
        pixels = np.flatnonzero(shares[:, level] > MIN_LATENT_SHARE)
        wide = padded(features[:, level])
        found = np.empty((len(pixels), wide.shape[1]), np.float32)
        share = shares[pixels, level]
        _render(*rows, pixels, share, wide.reshape(-1), wide.shape[1], found.reshape(-1))
        shown.append((pixels, found[:, : features.shape[2]]))
    return shown


@compiled
def _add_shares(indptr, indices, data, has, shares):
    for p in range(len(shares)):
        a, b, c = np.float32(0), np.float32(0), np.float32(0)
        for k in range(np.uint64(indptr[p]), np.uint64(indptr[p + 1])):
            g = np.uint64(indices[k])  # unsigned: skips the check for negative indices
            a += data[k] if has[g, 0] else np.float32(0)
            b += data[k] if has[g, 1] else np.float32(0)
            c += data[k] if has[g, 2] else np.float32(0)
        shares[p, 0], shares[p, 1], shares[p, 2] = a, b, c


@compiled
def _render(indptr, indices, data, pixels, share, features, wide, out):
    for row in range(len(pixels)):
        p = pixels[row]
        begin, end = np.uint64(indptr[p]), np.uint64(indptr[p + 1])
        for c in range(0, wide, WIDTH):
            total = lanes(np.float32(0))
            for k in range(begin, end):
                total = plus(total, lanes(data[k]), load(features, np.int64(indices[k]) * wide + c))
            store(out, row * wide + c, total / lanes(share[row]))
