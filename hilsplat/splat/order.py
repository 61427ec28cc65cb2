"""Order points so that neighbours in space are neighbours in memory."""

import numpy as np
from jaxtyping import Float, Int64, UInt64

BITS = 21
"""Bits per coordinate; three coordinates use 63 of a key's 64 bits."""


def morton_order(means: Float[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """Return the order of points along a Z-shaped curve (Morton 1966) through their box.

    Loops over Gaussians and their neighbours, such as G of the language field, then mostly hit the
    processor's cache. The box excludes the outermost hundredth on each side: otherwise a few Gaussians
    far away would put all others into one cell.

    Returns:
        rows in that order; rows of one cell keep their relative order.
    """
    if not len(means):
        return np.zeros(0, np.int64)
    low, high = np.percentile(means.astype(np.float64), (1, 99), axis=0)
    side = max(float((high - low).max()), 1e-12)
    cell = (np.clip((means - low) / side, 0, 1) * (2**BITS - 1)).astype(np.uint64)
    key = _every_third(cell[:, 0]) | _every_third(cell[:, 1]) << 1 | _every_third(cell[:, 2]) << 2
    return np.argsort(key, kind="stable")


def _every_third(values: UInt64[np.ndarray, " N"]) -> UInt64[np.ndarray, " N"]:
    """Move bit b of each value to 3 b."""
    out = np.zeros_like(values)
    for bit in range(BITS):
        out |= (values >> bit & 1) << 3 * bit
    return out
