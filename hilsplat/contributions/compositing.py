"""Normalised compositing weights of a view, and latents rendered at its pixels with these weights."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32, Float64

from cpusplat.lanes import WIDTH
from hilsplat.contributions.kernels import add_columns, normalise, render_rows

MIN_ALPHA = 0.5  # pixels with a smaller alpha are ignored, because their features would be extrapolated

MIN_LATENT_SHARE = 0.5
"""A pixel has a latent at a level if Gaussians with a latent make up more than this share of its weight."""


def normalised_weights(weights: sp.csr_matrix) -> sp.csr_matrix:
    """Divide each pixel's weights in place by their sum, which is the accumulated alpha.

    The weights then sum to 1, so that a rendered feature is an average of features; pixels with an alpha
    below `MIN_ALPHA` become empty rows. The sum excludes weights that the rasteriser dropped as too small.
    """
    weights.sort_indices()
    num_entries = normalise(weights.indptr, weights.indices, weights.data, MIN_ALPHA)
    arrays = (weights.data[:num_entries], weights.indices[:num_entries], weights.indptr)
    return sp.csr_matrix(arrays, shape=weights.shape, copy=False)


def visible_mass(weights: sp.csr_matrix) -> Float32[np.ndarray, " N"]:
    """Return each Gaussian's sum of weights over all pixels (px), computed in float64."""
    return column_sums(weights).astype(np.float32)


def column_sums(matrix: sp.csr_matrix) -> Float64[np.ndarray, " N"]:
    """Return the sum of each column, entry by entry in float64."""
    sums = np.zeros(matrix.shape[1])
    add_columns(matrix.indices, matrix.data, sums)
    return sums


def rendered_latents(
    weights: sp.csr_matrix, features: Float32[np.ndarray, "N 3 D"]
) -> list[tuple[np.ndarray, Float32[np.ndarray, "P D"]]]:
    """Return, per level, the pixels dominated by Gaussians that have a latent, and these pixels' latents.

    Gaussians without a latent are omitted, because a code would decode their zeros like any other latent.
    The remaining normalised weights are divided by their sum. Results are bit-identical to sparse products.
    """
    rows = weights.indptr, weights.indices, weights.data
    shares = weights @ (features != 0).any(axis=2).astype(np.float32)
    levels = []
    for level in range(features.shape[1]):
        pixels = np.flatnonzero(shares[:, level] > MIN_LATENT_SHARE)
        wide = padded(features[:, level])
        latents = np.empty((len(pixels), wide.shape[1]), np.float32)
        share = shares[pixels, level]
        render_rows(*rows, pixels, share, wide.reshape(-1), wide.shape[1], latents.reshape(-1))
        levels.append((pixels, latents[:, : features.shape[2]]))
    return levels


def padded(rows: Float32[np.ndarray, "*rows D"]) -> Float32[np.ndarray, "*rows E"]:
    """Pad channels with zeros to a multiple of sixteen (a vector's lanes), and make rows contiguous."""
    missing = -rows.shape[-1] % WIDTH
    if missing:
        rows = np.concatenate([rows, np.zeros((*rows.shape[:-1], missing), np.float32)], axis=-1)
    return np.ascontiguousarray(rows)
