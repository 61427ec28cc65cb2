"""Share of each node in each pixel of a view: the basis of its masks and relevancy maps.

A pixel blends about ten Gaussians, but rarely more than two nodes of a level. Summing its weights by node
once per view makes each later query in that view several times cheaper than a product with all weights,
and needs only a fraction of the memory.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float32, Int32, Int64

from hilsplat.base.compiled import compiled
from hilsplat.base.levels import NONE


@dataclass(frozen=True)
class ViewNodes:
    """Nodes of one level in each pixel of a view (CSR over P pixels).

    Attributes:
        nodes: rows of the semantic tree.
        shares: each node's share of the pixel; the rest has no node.
        covered: whether the Gaussians cover each pixel.
    """

    indptr: Int64[np.ndarray, " P1"]
    nodes: Int32[np.ndarray, " E"]
    shares: Float32[np.ndarray, " E"]
    covered: Bool[np.ndarray, " P"]

    @staticmethod
    def of(weights: sp.csr_matrix, node_of_gaussian: Int32[np.ndarray, " N"]) -> "ViewNodes":
        """Sum normalised weights (rows sum to 1 or are empty) by node."""
        indptr, nodes, shares = _summed_by_node(
            weights.indptr, weights.indices, weights.data, np.ascontiguousarray(node_of_gaussian)
        )
        return ViewNodes(indptr, nodes, shares, np.diff(weights.indptr) > 0)

    def area_px(self, num_nodes: int) -> Int64[np.ndarray, " n"]:
        """Return the number of pixels in which each node has a share above 0.5."""
        return np.bincount(self.nodes[self.shares > 0.5], minlength=num_nodes)

    def blend(
        self, values: Float32[np.ndarray, " n"], without: float, out: Float32[np.ndarray, " P"] | None = None
    ) -> Float32[np.ndarray, " P"]:
        """Blend one value per node; Gaussians without a node have the value `without`.

        Uncovered pixels get the lowest value of the covered ones. The result is written to `out` if given.
        """
        out = np.empty(len(self.covered), np.float32) if out is None else out
        _blend(self.indptr, self.nodes, self.shares, self.covered, values, np.float32(without), out)
        return out

    def mask(self, chosen: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " P"]:
        """Return the pixels in which the chosen nodes have a total share above 0.5."""
        out = np.zeros(len(self.covered), np.bool_)
        _mask(self.indptr, self.nodes, self.shares, chosen, out)
        return out

    def labels(self, size_hw: tuple[int, int]) -> Int32[np.ndarray, "H W"]:
        """Return the node with a share above 0.5 in each pixel, -1 for none."""
        out = np.full(len(self.covered), NONE, np.int32)
        most = np.flatnonzero(self.shares > 0.5)
        out[np.searchsorted(self.indptr, most, side="right") - 1] = self.nodes[most]
        return out.reshape(size_hw)


@compiled
def _summed_by_node(indptr, indices, data, node_of_gaussian):
    num_pixels = len(indptr) - 1
    out_indptr = np.zeros(num_pixels + 1, np.int64)
    room = max(1024, 2 * num_pixels)
    nodes, shares = np.empty(room, np.int32), np.empty(room, np.float32)
    done = 0
    for p in range(num_pixels):
        longest = indptr[p + 1] - indptr[p]
        if done + longest > room:
            room = 2 * (done + longest)
            more_nodes, more_shares = np.empty(room, np.int32), np.empty(room, np.float32)
            more_nodes[:done], more_shares[:done] = nodes[:done], shares[:done]
            nodes, shares = more_nodes, more_shares
        first = done
        for k in range(indptr[p], indptr[p + 1]):
            node = node_of_gaussian[indices[k]]
            if node < 0:
                continue
            place = first
            while place < done and nodes[place] != node:
                place += 1
            if place == done:
                nodes[place], shares[place] = node, np.float32(0)
                done += 1
            shares[place] += data[k]
        out_indptr[p + 1] = done
    return out_indptr, nodes[:done].copy(), shares[:done].copy()


@compiled
def _blend(indptr, nodes, shares, covered, values, without, out):
    least = np.float32(np.inf)
    for p in range(len(covered)):
        if not covered[p]:
            continue
        total, left = np.float32(0), np.float32(1)
        for k in range(indptr[p], indptr[p + 1]):
            total += shares[k] * values[nodes[k]]
            left -= shares[k]
        total += max(left, np.float32(0)) * without
        out[p] = total
        least = min(least, total)
    if not least < np.inf:
        least = np.float32(0)
    for p in range(len(covered)):
        if not covered[p]:
            out[p] = least


@compiled
def _mask(indptr, nodes, shares, chosen, out):
    for p in range(len(out)):
        total = np.float32(0)
        for k in range(indptr[p], indptr[p + 1]):
            if chosen[nodes[k]]:
                total += shares[k]
        out[p] = total > 0.5
