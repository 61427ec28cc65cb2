"""Wholes for a segmenter that detects only colour regions: regions that touch in 3D are joined.

In a photograph, a coloured part of an object borders both the wall behind it and the next part of the object.
In 3D, it touches only that next part. Small regions join first, so objects are complete before any part is
joined to the table, the walls or the floor, which are large.
"""

import heapq
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32, Float64, Int32, Int64
from scipy.spatial import cKDTree

from hilsplat.base.levels import NONE
from hilsplat.contributions.compositing import column_sums

NEIGHBOURS = 10
"""Number of nearest Gaussians (including itself) that are searched for neighbours in another region."""

MIN_MASS_PX = 2.0
"""Minimum mass of a neighbouring Gaussian, summed over views; Gaussians with less mass may float anywhere."""

MIN_SHARE = 1e-4  # a view shows a region if the region covers more than this share of the view


def joined_regions(
    region_of_gaussian: Int32[np.ndarray, " N"],
    num_regions: int,
    means: Float32[np.ndarray, "N 3"],
    mass: sp.csr_matrix,
    max_cost: float,
) -> Int64[np.ndarray, " T"]:
    """Join regions that touch, cheapest pair first, until every pair costs `max_cost` or more.

    The cost of a pair is `side(both) * sqrt(touch of the smaller / touch of the pair)`. Side is the square
    root of a region's mean area share in the views that show it. Touch is the number of pairs of neighbouring
    Gaussians between a pair of regions, or between a region and all others. Two regions that touch only
    each other are therefore joined up to a side of `max_cost`, and others up to a smaller side.

    Args:
        region_of_gaussian: region of each Gaussian, -1 for none.
        means: centres of the Gaussians, scene units.
        mass: visible mass of each Gaussian in each view (V x N), px.
        max_cost: limit of the cost, as a share of a view's side.

    Returns:
        whole of each region, numbered by first appearance.
    """
    region, num = region_of_gaussian + 1, num_regions + 1
    entries = [slice(*ends) for ends in pairwise(mass.indptr)]
    masses = [np.bincount(region[mass.indices[e]], mass.data[e], num)[1:] for e in entries]
    shares = np.stack(masses, axis=1) / np.maximum(
        [mass.data[e].sum(dtype=np.float64) for e in entries], 1e-12
    )
    firm = np.flatnonzero((region_of_gaussian != NONE) & (column_sums(mass) > MIN_MASS_PX))
    touch = touching(region_of_gaussian[firm], num_regions, means[firm])
    return joined(touch, shares, max_cost)


def touching(
    region: Int32[np.ndarray, " n"], num_regions: int, means: Float32[np.ndarray, "n 3"]
) -> sp.csr_matrix:
    """Count the pairs (Gaussian, one of its `NEIGHBOURS` nearest) between every two regions; symmetric."""
    near = min(NEIGHBOURS, len(means))  # the nearest is the Gaussian itself
    nearest = cKDTree(means).query(means, k=np.arange(1, near + 1))[1] if near else np.zeros((0, 0), np.int64)
    first, second = np.repeat(region, near), region[nearest.ravel()]
    apart = first != second
    pairs = np.ones(apart.sum()), (first[apart], second[apart])
    counts = sp.csr_matrix(pairs, shape=(num_regions, num_regions))
    return counts + counts.T


def joined(
    touch: sp.csr_matrix, shares: Float64[np.ndarray, "T V"], max_cost: float
) -> Int64[np.ndarray, " T"]:
    """Compute `joined_regions` from touches and view shares; on a tie, the lowest regions join first."""
    num = len(shares)
    share = list(shares)
    side = [_side(of_region) for of_region in share]
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
    while queue and queue[0][0] < max_cost:
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
            for neighbour, count in beside[old].items():
                if neighbour not in (a, b):
                    beside[new][neighbour] = beside[new].get(neighbour, 0.0) + count
                    beside[neighbour][new] = beside[new][neighbour]
                    del beside[neighbour][old]
        whole[np.isin(whole, (a, b))] = new
        for neighbour in beside[new]:
            heapq.heappush(queue, (cost(neighbour, new), neighbour, new))
    _, first, inverse = np.unique(whole, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse]


def _side(share: Float64[np.ndarray, " V"]) -> float:
    """Return the square root of a region's mean area share in the views that show it; 0 if unseen."""
    return float(np.sqrt(share.sum() / max((share > MIN_SHARE).sum(), 1)))
