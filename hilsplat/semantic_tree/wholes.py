"""Wholes of a segmenter that knows colours but no things: regions that touch in 3D are joined.

In a photograph a coloured part of a thing has as much in common with the wall behind it as with the part
beside it. In the scene it touches only the latter. Joining what touches, small before large, builds things
up from their parts before any of them reaches the table, the walls or the floor, which are large.
"""

import heapq

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32, Float64, Int32, Int64

from hilsplat.base.levels import NONE

NEIGHBOURS = 10
"""Nearest Gaussians, itself included, among which one looks for those of another region."""

MIN_MASS_PX = 2.0
"""A Gaussian whose mass in all views together is less is no neighbour: it may float anywhere."""

MIN_SHARE = 1e-4
"""A view shows a region if the region makes up more than this share of it."""


def joined_regions(
    region_of_gaussian: Int32[np.ndarray, " N"],
    num_regions: int,
    means: Float32[np.ndarray, "N 3"],
    mass: Float32[np.ndarray, "V N"],
    most: float,
) -> Int64[np.ndarray, " T"]:
    """Join regions that touch, the cheapest pair first, until every pair costs `most` or more.

    The cost of a pair is `side(both) * sqrt(touch of the smaller / touch of the pair)`. Side is the root of
    the share of a view that a region makes up, averaged over the views that show it. Touch counts the pairs
    of neighbouring Gaussians in two regions: of a pair of regions, or of a region with all others. So two
    regions that only touch each other are joined up to a side of `most`, and others up to a smaller one.

    Args:
        region_of_gaussian: region of each Gaussian, -1 for none.
        num_regions: T; ids are smaller.
        means: centres of the Gaussians, scene units.
        mass: visible mass of each Gaussian in each view, px.
        most: largest cost, as a share of the side of a view.

    Returns:
        whole of each region, numbered by first appearance.
    """
    seen = np.stack([np.bincount(region_of_gaussian + 1, each, num_regions + 1)[1:] for each in mass], axis=1)
    shares = seen / np.maximum(mass.sum(axis=1, dtype=np.float64), 1e-12)
    firm = np.flatnonzero((region_of_gaussian != NONE) & (mass.sum(axis=0) > MIN_MASS_PX))
    touch = touching(region_of_gaussian[firm], num_regions, means[firm])
    return joined(touch, shares, most)


def touching(
    region: Int32[np.ndarray, " n"], num_regions: int, means: Float32[np.ndarray, "n 3"]
) -> sp.csr_matrix:
    """Number of pairs (Gaussian, one of its `NEIGHBOURS` nearest) in every two regions; symmetric."""
    from scipy.spatial import cKDTree  # takes a fifth of a second, and all who open a tree import this module

    near = min(NEIGHBOURS, len(means))  # the nearest of all is the Gaussian itself
    nearest = cKDTree(means).query(means, k=np.arange(1, near + 1))[1] if near else np.zeros((0, 0), np.int64)
    first, second = np.repeat(region, near), region[nearest.ravel()]
    apart = first != second
    rows = np.concatenate([first[apart], second[apart]])
    columns = np.concatenate([second[apart], first[apart]])
    return sp.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(num_regions, num_regions))


def joined(touch: sp.csr_matrix, shares: Float64[np.ndarray, "T V"], most: float) -> Int64[np.ndarray, " T"]:
    """`joined_regions` of known touches and shares of views. Of equal costs, the lowest regions go first."""
    num = len(shares)
    share = list(shares)
    side = [_side(each) for each in share]
    beside = [
        dict(zip(touch.indices[slice(*ends)].tolist(), touch.data[slice(*ends)].tolist(), strict=True))
        for ends in zip(touch.indptr[:-1], touch.indptr[1:], strict=True)
    ]
    whole = np.arange(num)

    def cost(a: int, b: int) -> float:
        smaller = a if side[a] < side[b] else b
        return _side(share[a] + share[b]) * (sum(beside[smaller].values()) / beside[a][b]) ** 0.5

    queue = [(cost(a, b), a, b) for a in range(num) for b in beside[a] if a < b]
    heapq.heapify(queue)
    alive = [True] * num
    while queue and queue[0][0] < most:
        _, a, b = heapq.heappop(queue)
        if not (alive[a] and alive[b]):
            continue
        new = len(alive)
        alive[a] = alive[b] = False
        alive.append(True)
        share.append(share[a] + share[b])
        side.append(_side(share[new]))
        beside.append({})
        for old in (a, b):
            for other, count in beside[old].items():
                if other not in (a, b):
                    beside[new][other] = beside[new].get(other, 0.0) + count
                    beside[other][new] = beside[new][other]
                    del beside[other][old]
        whole[np.isin(whole, (a, b))] = new
        for other in beside[new]:
            heapq.heappush(queue, (cost(other, new), other, new))
    _, first, inverse = np.unique(whole, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse]


def _side(share: Float64[np.ndarray, " V"]) -> float:
    """Root of the mean share of the views that show a region; 0 if none does."""
    shown = share > MIN_SHARE
    return float(np.sqrt(share.sum() / max(shown.sum(), 1)))
