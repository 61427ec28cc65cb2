"""Linking masks of different views."""

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.semantic_tree.linkage import Evidence, MaskPairs, mask_evidence, pooled_linkage
from hilsplat.semantic_tree.view_pairs import view_pairs


def dense_evidence(intersection, union):
    """Any intersections and unions of pairs: one view per mask, half a union seen from either side."""
    num = len(union)
    a, b = np.nonzero(np.triu(intersection))
    sizes = union / 2
    np.fill_diagonal(sizes, 1.0)
    row, view = np.nonzero(sizes)
    iou = intersection[a, b] / union[a, b]
    return Evidence(
        pairs=(
            MaskPairs(
                a.astype(np.int32),
                b.astype(np.int32),
                np.stack([intersection[a, b], np.zeros(len(a)), iou], axis=1),
            ),
        ),
        size_indptr=np.searchsorted(row, np.arange(num + 1)),
        size_views=view.astype(np.int32),
        sizes=sizes[row, view],
        view=np.arange(num, dtype=np.int32),
    )


def pair(evidence: Evidence, a: int, b: int) -> tuple[float, float]:
    """Intersection and union of two masks."""
    a, b = min(a, b), max(a, b)

    def size(mask: int, view: int) -> float:
        row = slice(*evidence.size_indptr[mask : mask + 2])
        return evidence.sizes[row][evidence.size_views[row] == view].sum()

    sizes = size(a, evidence.view[b]) + size(b, evidence.view[a])
    stored = np.concatenate(
        [block.sums[(block.firsts == a) & (block.seconds == b)] for block in evidence.pairs]
    )
    intersection, extra, _ = stored.sum(axis=0)
    return float(intersection), float(sizes + extra)


def evidence_of(shares, importance, visible, view, min_covisible, threads=1) -> Evidence:
    """`mask_evidence` of dense arrays, in which all pairs of views are compared."""
    visible = sp.csr_matrix(visible.astype(np.float32))
    pairs = view_pairs(visible)
    return mask_evidence(sp.csr_matrix(shares), importance, visible, view, pairs, min_covisible, threads)


@pytest.mark.parametrize(
    ("intersection", "union", "threshold", "cluster", "quality"),
    [
        # 0 and 1 agree by 0.8; together they agree with 2 by (3 + 0) / (10 + 5) = 0.2
        ([[0, 8, 3], [8, 0, 0], [3, 0, 0]], [[0, 10, 10], [10, 0, 5], [10, 5, 0]], 0.21, [0, 0, 1], [0.8, 0]),
        ([[0, 8, 3], [8, 0, 0], [3, 0, 0]], [[0, 10, 10], [10, 0, 5], [10, 5, 0]], 0.19, [0] * 3, [11 / 25]),
        # 0-1 and 1-2 are equally good: the lowest rows join, and leave 2 at 1 / 4 with the pair
        ([[0, 1, 0], [1, 0, 1], [0, 1, 0]], [[0, 2, 2], [2, 0, 2], [2, 2, 0]], 0.3, [0, 0, 1], [0.5, 0]),
    ],
)
def test_linkage_pools_intersections_over_unions(intersection, union, threshold, cluster, quality):
    evidence = dense_evidence(np.array(intersection, float), np.array(union, float))
    found, qualities = pooled_linkage(evidence, threshold)()
    assert found.tolist() == cluster
    assert qualities.tolist() == pytest.approx(quality)


def brute_linkage(intersection, union, threshold):
    clusters = [[row] for row in range(len(intersection))]
    while True:
        best, pair = -1.0, None
        for a in range(len(clusters)):
            for b in range(a + 1, len(clusters)):
                grid = np.ix_(clusters[a], clusters[b])
                if union[grid].sum() > 0:
                    value = intersection[grid].sum() / union[grid].sum()
                    if value > best + 1e-12:
                        best, pair = value, (a, b)
        if pair is None or best < threshold:
            return sorted(sorted(cluster) for cluster in clusters)
        clusters[pair[0]] += clusters.pop(pair[1])


@pytest.mark.parametrize("seed", range(5))
def test_linkage_equals_a_search_over_all_pairs(seed):
    rng = np.random.default_rng(seed)
    union = rng.uniform(1, 2, (14, 14)) * (rng.random((14, 14)) < 0.7)
    union = np.triu(union, 1) + np.triu(union, 1).T
    intersection = np.triu(union * rng.random((14, 14)) ** 2, 1)
    intersection = intersection + intersection.T
    cluster, _ = pooled_linkage(dense_evidence(intersection, union), 0.3)()
    found = sorted(sorted(np.flatnonzero(cluster == c).tolist()) for c in range(cluster.max() + 1))
    assert found == brute_linkage(intersection, union, 0.3)


def dense_rule(shares, importance, visible, view, min_covisible):
    """The rule of `mask_evidence` for every pair, written out."""
    num = len(shares)
    intersection, union = np.zeros((num, num)), np.zeros((num, num))
    for a in range(num):
        for b in range(num):
            if a == b:
                continue
            sizes = [
                [(importance * shares[m] ** 2)[visible[v]].sum() for v in (view[a], view[b])] for m in (a, b)
            ]
            seen_of_a, seen_of_b = sizes[0][1], sizes[1][0]
            enough_of_a = seen_of_a >= min_covisible * sizes[0][0]
            enough_of_b = seen_of_b >= min_covisible * sizes[1][1]
            both = (importance * shares[a] * shares[b]).sum() if view[a] != view[b] else 0.0
            if both > 0 and (enough_of_a or enough_of_b):
                intersection[a, b] = both
                union[a, b] = seen_of_a + seen_of_b - both
            elif both == 0:
                union[a, b] = seen_of_a * enough_of_a + seen_of_b * enough_of_b
    return intersection, union


@pytest.mark.parametrize("threads", [1, 2])
def test_evidence_equals_the_rule_pair_by_pair(threads):
    rng = np.random.default_rng(3)
    view = np.repeat(np.arange(4), 3).astype(np.int32)
    visible = rng.random((4, 30)) < 0.6
    shares = rng.random((12, 30)) * (rng.random((12, 30)) < 0.25) * visible[view]
    importance = rng.uniform(0.5, 2.0, 30)
    found = evidence_of(shares, importance, visible, view, 0.6, threads)
    intersection, union = dense_rule(shares, importance, visible, view, 0.6)
    assert (intersection > 0).sum() > 20
    for a in range(12):
        for b in range(12):
            if a != b:
                assert pair(found, a, b) == pytest.approx((intersection[a, b], union[a, b]))


@pytest.mark.parametrize("num", [160, 550])
def test_linkage_of_many_masks_equals_that_of_dense_sums(num):
    rng = np.random.default_rng(0)
    thing = rng.integers(0, 12, num)
    same = thing[:, None] == thing[None]
    union = np.triu(rng.uniform(1, 2, (num, num)), 1)
    intersection = union * np.where(same, rng.uniform(0.5, 0.9, (num, num)), 0.05)
    union, intersection = union + union.T, np.triu(intersection, 1) + np.triu(intersection, 1).T
    cluster, quality = pooled_linkage(dense_evidence(intersection, union), 0.4)()
    assert len(quality) == 12
    assert all(len(np.unique(cluster[thing == each])) == 1 for each in range(12))
    members = np.flatnonzero(cluster == 0)
    grid = np.ix_(members, members)
    assert quality[0] == pytest.approx(intersection[grid].sum() / union[grid].sum())
