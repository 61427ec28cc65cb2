"""Ranking of the masks that show a node, from different sides; the clip stage embeds the best crops."""

import numpy as np
from jaxtyping import Float, Float32, Int32

from hilsplat.base.levels import NONE

APART_DEG = 30.0
"""Directions at least this far apart do not lower each other's score."""

LEAST_NEW = 0.1
"""Share of its score that a crop keeps if a higher-ranked crop has the same direction."""

RANKED = 32
"""Number of crops ranked per node."""


def crop_ranks(
    node: Int32[np.ndarray, " M"],
    score: Float32[np.ndarray, " M"],
    directions: Float[np.ndarray, "M 3"],
) -> Int32[np.ndarray, " M"]:
    """Rank the masks of each node by score, reduced for directions close to those already ranked.

    At equal scores, crops from different sides describe a thing better (docs/experiments.md).

    Args:
        node: node that each mask shows, -1 for none.
        score: how well its crop shows the node.
        directions: unit vector from the node to the camera.

    Returns:
        rank of each mask among those of its node, 0 for the best; -1 without a node or beyond `RANKED`.
    """
    rank = np.full(len(node), NONE, np.int32)
    order = np.argsort(node, kind="stable")
    starts = np.flatnonzero(np.diff(node[order], prepend=NONE))
    for rows in np.split(order, starts)[1:]:
        left = score[rows].astype(np.float64)
        new = np.ones(len(rows))
        for place in range(min(RANKED, len(rows))):
            best = int((left * new).argmax())
            rank[rows[best]] = place
            cosine = np.clip(directions[rows] @ directions[rows[best]], -1, 1)
            apart = np.rad2deg(np.arccos(cosine)) / APART_DEG
            new = np.minimum(new, np.clip(apart, LEAST_NEW, 1))
            left[best] = -1
    return rank
