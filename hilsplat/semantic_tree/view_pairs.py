"""The pairs of views whose masks are compared: all in small scenes, a bounded number in large ones."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Int32, Int64

from hilsplat.semantic_tree.limits import MAX_ALL

NEAREST = 24
"""Number of views that share the most Gaussians with a view, which are its partners in a larger scene."""

SPREAD = 24
"""Number of further partners, at equal steps among the remaining views that share Gaussians with it."""

MIN_IOU = 0.01  # minimum IoU of a pair of masks in a larger scene; most pairs that share Gaussians only touch

MAX_SHARED = 2**29
"""Gaussians are sampled so that at most this many pairs (two views that show a Gaussian) are counted."""

ROWS_AT_A_TIME = 256  # number of views whose shared Gaussians are counted at a time, to bound memory


@dataclass(frozen=True)
class ViewPairs:
    """Partners of each of V views, in ascending order, the view itself included; symmetric.

    Attributes:
        indptr: where each view's partners begin.
        partners: views.
        mirror: for partner v of u, the position of u among the partners of v.
        min_iou: pairs of masks with a smaller IoU are treated as if they shared no Gaussians.
    """

    indptr: Int64[np.ndarray, " V1"]
    partners: Int32[np.ndarray, " E"]
    mirror: Int64[np.ndarray, " E"]
    min_iou: float

    def of_views(self, views: Int64[np.ndarray, " S"]) -> "ViewPairs":
        """Return the pairs that contain one of these views; other views keep only themselves."""
        num = len(self.indptr) - 1
        row, chosen = np.repeat(np.arange(num), np.diff(self.indptr)), np.isin(np.arange(num), views)
        is_chosen = chosen[row] | chosen[self.partners] | (row == self.partners)
        entries = np.ones(is_chosen.sum(), np.int8), (row[is_chosen], self.partners[is_chosen])
        return _symmetric(sp.csr_matrix(entries, shape=(num, num)), self.min_iou)


def view_pairs(visible: sp.csr_matrix) -> ViewPairs:
    """Choose the partners of each view.

    The number of partners doesn't grow with the number of views, so neither does the cost of a view. Masks of
    nearby views overlap most; the others make the sums of a cluster representative of all its views.

    Departs: in scenes of more than `MAX_ALL` views, two masks whose views aren't partners are no evidence.

    Args:
        visible: (V, N) with a stored entry for each Gaussian visible in each view.
    """
    num = visible.shape[0]
    if num <= MAX_ALL:
        pattern = sp.csr_matrix(np.ones((num, num), np.int8))
    else:
        chosen = [_chosen(counts) for counts in _shared(visible)]
        lengths = [len(views) for views in chosen]
        indptr = np.concatenate([[0], np.cumsum(lengths)])
        columns = np.concatenate(chosen)
        upper = sp.csr_matrix((np.ones(len(columns), np.int8), columns, indptr), shape=(num, num))
        pattern = (upper + upper.T + sp.eye(num, dtype=np.int8)).tocsr()
    return _symmetric(pattern, 0.0 if num <= MAX_ALL else MIN_IOU)


def _symmetric(pattern: sp.csr_matrix, min_iou: float) -> ViewPairs:
    """Return the pairs that are stored entries of a symmetric matrix."""
    pattern.sort_indices()
    row = np.repeat(np.arange(pattern.shape[0]), np.diff(pattern.indptr))
    # Sorting the entries by column, then row lists the mirror entries of the rows in order.
    position = np.empty(len(row), np.int64)
    position[np.lexsort((row, pattern.indices))] = np.arange(len(row))
    mirror = position - pattern.indptr[pattern.indices]
    return ViewPairs(pattern.indptr.astype(np.int64), pattern.indices.astype(np.int32), mirror, min_iou)


def _shared(visible: sp.csr_matrix) -> Iterator[Int32[np.ndarray, " V"]]:
    """Yield, for each view, the number of sampled Gaussians that it shares with each view."""
    per_gaussian = np.bincount(visible.indices, minlength=visible.shape[1]).astype(np.float64)
    step = int(np.ceil(np.square(per_gaussian).sum() / MAX_SHARED)) or 1
    in_sample = visible.indices % step == 0
    indptr = np.concatenate([[0], np.cumsum(in_sample)])[visible.indptr]
    columns = visible.indices[in_sample] // step
    shape = (visible.shape[0], -(-visible.shape[1] // step))
    sample = sp.csr_matrix((np.ones(len(columns), np.int32), columns, indptr), shape=shape)
    transposed = sample.T.tocsr()
    for begin in range(0, len(indptr) - 1, ROWS_AT_A_TIME):
        yield from (sample[begin : begin + ROWS_AT_A_TIME] @ transposed).toarray()


def _chosen(shared: Int32[np.ndarray, " V"]) -> Int64[np.ndarray, " K"]:
    """Return the partners of a view with `shared` Gaussians in each view; on a tie, the lowest views."""
    order = np.argsort(-shared, kind="stable")
    order = order[shared[order] > 0]
    nearest, farther = order[: NEAREST + 1], order[NEAREST + 1 :]
    steps = np.linspace(0, len(farther) - 1, min(SPREAD, len(farther))).round().astype(np.int64)
    return np.sort(np.concatenate([nearest, farther[steps]]))
