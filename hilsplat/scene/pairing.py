"""Choice of the pairs of views to match in a large capture: by appearance, by time, and across gaps.

The appearance vector of a view is its VLAD (Jegou et al., "Aggregating local descriptors into a compact image
representation", CVPR 2010): for each visual word, the sum of the differences between its descriptors and the
word, normalised. The words are trained on descriptors of the capture by k-means, so no weights are needed.
Sums and inner products are whole numbers below 2**24, so float32 is exact, and the pairs are the same for any
number of threads.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Int, Int64, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Pair = tuple[int, int]  # rows of two views, the lower one first
WORDS = 64  # number of visual words (docs/experiments.md: 32 to 256 words retrieve equally well)
SAMPLE_PER_WORD = 256  # number of descriptors per word in the k-means
ROUNDS = 10  # iterations of the k-means
LENGTH = 4000.0  # length of an appearance vector before rounding; inner products stay below 2**24
NEAREST = 20  # number of most similar views to match with each view
TIME_STEPS = 5  # each view is matched with this many views taken after it
WEAK_PARTNERS = 5  # views with fewer verified partners are matched with more views


def visual_words(sample: UInt8[np.ndarray, "S D"], seed: int) -> Float32[np.ndarray, "W D"]:
    """Return up to `WORDS` centres of a sample of descriptors (k-means), rounded to whole numbers."""
    start = np.random.default_rng(seed).choice(len(sample), min(WORDS, len(sample)), replace=False)
    words = sample[np.sort(start)].astype(np.float32)
    for _ in range(ROUNDS):
        sums, counts = _sums_per_word(sample, words)
        used = counts > 0
        words[used] = np.round(sums[used] / counts[used, None])
    return words


def _sums_per_word(
    descriptors: UInt8[np.ndarray, "N D"], words: Float32[np.ndarray, "W D"]
) -> tuple[Float32[np.ndarray, "W D"], Int64[np.ndarray, " W"]]:
    """Return the sum and the number of the descriptors that are nearest to each word."""
    rows = descriptors.astype(np.float32)
    nearest = np.argmax(2 * (rows @ words.T) - (words**2).sum(axis=1), axis=1)
    members = np.zeros((len(words), len(rows)), np.float32)
    members[nearest, np.arange(len(rows))] = 1
    return members @ rows, np.bincount(nearest, minlength=len(words))


def appearance_vectors(
    descriptors: Sequence[UInt8[np.ndarray, "_ D"]], seed: int
) -> Float32[np.ndarray, "V WD"]:
    """Return the appearance vector of each view, given its descriptors; 0 for views without features."""
    rng = np.random.default_rng(seed)
    per_photo = max(1, WORDS * SAMPLE_PER_WORD // max(1, len(descriptors)))
    sample = [rows[rng.permutation(len(rows))[:per_photo]] for rows in descriptors if len(rows)]
    if not sample:
        return np.zeros((len(descriptors), 1), np.float32)
    words = visual_words(np.concatenate(sample), seed)
    vectors = np.zeros((len(descriptors), words.size), np.float32)
    for vector, rows in zip(vectors, descriptors, strict=True):
        if not len(rows):
            continue
        sums, counts = _sums_per_word(rows, words)
        residuals = sums.astype(np.float64) - counts[:, None] * words.astype(np.float64)
        lengths = np.sqrt((residuals**2).sum(axis=1, keepdims=True))
        used = max(1, int((lengths > 0).sum()))
        residuals *= LENGTH / np.sqrt(used) / np.maximum(lengths, 1)
        vector[:] = np.round(residuals.ravel())
    return vectors


def likely_pairs(likeness: Float32[np.ndarray, "V V"], in_time: Sequence[int]) -> set[Pair]:
    """Return the pairs to match first: each view's most similar views, and its neighbours in time.

    Args:
        likeness: inner products of the appearance vectors.
        in_time: rows of the views, in the order in which they were taken.
    """
    pairs = {_pair(row, other) for row in range(len(likeness)) for other in _ranked(likeness, row)[:NEAREST]}
    for step in range(1, TIME_STEPS + 1):
        pairs |= {_pair(*neighbours) for neighbours in zip(in_time, in_time[step:], strict=False)}
    return pairs


def joining_pairs(
    likeness: Float32[np.ndarray, "V V"], tried: set[Pair], verified: Sequence[Pair]
) -> set[Pair]:
    """Return more pairs to match, for views outside the largest group and views with few verified partners.

    Each of these views is paired with the partners of its partners, with its next most similar views, and
    with the most similar views of other groups. Groups are the connected components of the verified pairs.
    """
    num_views = len(likeness)
    partners: list[set[int]] = [set() for _ in range(num_views)]
    for one, other in verified:
        partners[one].add(other)
        partners[other].add(one)
    groups = groups_of(num_views, verified)
    pairs = set()
    for row in range(num_views):
        if groups[row] == 0 and len(partners[row]) >= WEAK_PARTNERS:
            continue
        ranked = [other for other in _ranked(likeness, row) if _pair(row, other) not in tried]
        outside = [other for other in ranked if groups[other] != groups[row]]
        second = set().union(*(partners[other] for other in partners[row])) - {row}
        pairs |= {_pair(row, other) for other in (*ranked[:NEAREST], *outside[:NEAREST], *second)}
    return pairs - tried


def groups_of(num_views: int, verified: Sequence[Pair]) -> Int[np.ndarray, " V"]:
    """Return the connected component of each view, 0 for the largest, 1 for the second, and so on.

    Of groups of the same size, the one that contains the first view comes first.
    """
    rows = np.array(verified, np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(rows)), (rows[:, 0], rows[:, 1])), shape=(num_views, num_views))
    count, group = connected_components(graph, directed=False)
    sizes, first = np.bincount(group, minlength=count), np.unique(group, return_index=True)[1]
    rank = np.empty(count, np.int64)
    rank[np.lexsort((first, -sizes))] = np.arange(count)
    return rank[group]


def _ranked(likeness: Float32[np.ndarray, "V V"], row: int) -> list[int]:
    """Return the other views, most similar first, and in row order if equally similar."""
    order = np.argsort(-likeness[row], kind="stable")
    return order[order != row].tolist()


def _pair(one: int, other: int) -> Pair:
    return (min(one, other), max(one, other))
