"""Shared by the instance and part losses: softened distances, ancestors, cosines."""

import numpy as np
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from hilsplat.base.levels import NONE

SOFTENING = 1e-3
"""Added in quadrature to every distance, so that its logarithm has a finite slope at zero."""

SHORTEST = 1e-6
"""Added in quadrature to every length in a denominator, so that the cosine of a zero vector is zero."""


def soft_distances(means: Float[Tensor, "M D"]) -> Float[Tensor, "M M"]:
    """Pairwise sqrt(|m_i - m_j|^2 + SOFTENING^2).

    Squares are computed from products: M x M numbers instead of M x M x D. In float64 the cancellation error
    is far below the softening.
    """
    centred = means - means.detach().mean(0)
    squares = centred.square().sum(-1)
    apart = squares[:, None] + squares[None] - 2 * centred @ centred.T
    return (apart.clamp(min=0) + SOFTENING**2).sqrt()


def off_diagonal_mean(values: Float[Tensor, "M M"]) -> Float[Tensor, ""]:
    """Mean over ordered pairs i != j; 0 for fewer than two rows."""
    rows = len(values)
    if rows < 2:
        return values.sum() * 0
    return (values.sum() - values.diagonal().sum()) / (rows * (rows - 1))


def common_ancestor_depth(parent: Int32[np.ndarray, " M"]) -> Int64[np.ndarray, "M M"]:
    """Depth of the deepest common ancestor of every two masks of one view's coverage tree.

    A mask counts as its own ancestor and roots have depth 1; 0 means that two masks are unrelated. The value
    for a mask and its child is the depth of the mask; for two children of a root it is 1.

    Example:
        >>> common_ancestor_depth(np.array([-1, 0, 0, 1], dtype=np.int32))[3]
        array([1, 2, 1, 3])
    """
    rows = len(parent)
    is_ancestor = np.eye(rows, dtype=np.int64)  # [mask, ancestor]
    current = np.arange(rows)
    for _ in range(rows):
        current = np.where(current == NONE, NONE, parent[current])
        has = np.flatnonzero(current != NONE)
        if not len(has):
            break
        is_ancestor[has, current[has]] = 1
    # Common ancestors of two masks form a chain from the root down, so their number is the depth.
    # float32 counts exactly and multiplies fast.
    chains = is_ancestor.astype(np.float32)
    return (chains @ chains.T).astype(np.int64)


def similarity_without_parent(
    anchors: Float[Tensor, "A D"], others: Float[Tensor, "B D"], parent: Float[Tensor, "A D"]
) -> Float[Tensor, "A B"]:
    """s_p of Eq. 4: cosine of two mask means after the anchor's parent mean is subtracted from both.

    Departs: Eq. 4 prints index j twice in the denominator; we take i and j, so that s_p is a cosine. We
    read its parent mean, which has no index, as the anchor's, for positives and negatives alike. The
    parent is detached: parts move relative to their whole, not the whole relative to its parts.
    """
    parent = parent.detach()
    own = anchors - parent
    length = (own.square().sum(-1, keepdim=True) + SHORTEST**2).sqrt()
    along = own @ others.T - (own * parent).sum(-1, keepdim=True)
    # |other - parent|^2 from products: A x B numbers instead of A x B x D.
    squares = others.square().sum(-1) - 2 * parent @ others.T + parent.square().sum(-1, keepdim=True)
    return along / length / (squares.clamp(min=0) + SHORTEST**2).sqrt()
