"""Instance segmentation of points: AP, AP50 and AP25 of the ScanNet benchmark.

Source: OpenMask3D's copy of ScanNet/ScanNet `BenchmarkScripts/3d_evaluation/evaluate_semantic_instance.py`,
including its quirks; the protocol `scannet200/instances` lists our departures.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int64

from hilsplat.base.errors import MisalignedArtifactError

OVERLAPS: tuple[float, ...] = (*np.arange(0.5, 0.95, 0.05).tolist(), 0.25)
"""IoU thresholds: nine from 0.50 to 0.90 (without 0.95), then 0.25."""

CLASS_STRIDE = 1000
"""A vertex of class c and instance i has the value c * 1000 + i; smaller values mean no object."""

MIN_POINTS = 100  # smaller instances and predictions are ignored


@dataclass(frozen=True)
class InstanceMatches:
    """Matches of one scan, from which the precision-recall curves over all scans are computed."""

    class_index: Int64[np.ndarray, " E"]  # class of each curve entry, 0 .. K - 1
    overlap_index: Int64[np.ndarray, " E"]  # threshold of each entry, 0 .. T - 1
    confidence: Float64[np.ndarray, " E"]
    is_match: Bool[np.ndarray, " E"]  # otherwise the entry is a false positive
    misses: Int64[np.ndarray, "K T"]  # number of unmatched ground-truth instances
    has_truth: Bool[np.ndarray, " K"]  # whether the scan has a sufficiently large instance of the class


def match_instances(
    truth: Int[np.ndarray, " P"],
    masks: Bool[np.ndarray, "M Q"],  # Q = P, checked below
    classes: Int[np.ndarray, " M"],
    confidences: Float[np.ndarray, " M"],
    class_ids: Sequence[int],
    min_points: int = MIN_POINTS,
) -> InstanceMatches:
    """Match the predictions of one scan to its ground-truth instances, per class and threshold.

    Instances are visited in order. Each unused prediction of the class whose IoU with an instance exceeds
    the threshold matches that instance. If several match, the most confident remains the match and the others
    are false positives with their own confidences. Only the first match of an instance marks its prediction
    as used. A prediction without sufficient overlap with any ground-truth instance is a false positive,
    unless the share of its points in void or in instances that are too small exceeds the threshold.

    Args:
        truth: class * 1000 + instance for each point; values below 1000 or of other classes are void.
        masks: predicted instances over the same points; they may overlap.

    Raises:
        MisalignedArtifactError: masks and truth have different numbers of points.
    """
    if masks.shape[1] != len(truth):
        raise MisalignedArtifactError(
            "predicted instances do not match the scan's points",
            expected=f"{len(truth)} points",
            found=masks.shape[1],
            fix="predict on the vertices of the evaluated mesh",
        )
    ids, instance_of_point = np.unique(truth, return_inverse=True)
    sizes = np.bincount(instance_of_point, minlength=len(ids))
    points = masks.sum(axis=1)
    usable = np.flatnonzero((points >= min_points) & np.isin(classes, class_ids))
    # [kept prediction, true instance]: points in common
    common = np.array(
        [np.bincount(instance_of_point[masks[row]], minlength=len(ids)) for row in usable], dtype=np.int64
    ).reshape(len(usable), len(ids))
    of_class = ids // CLASS_STRIDE
    void = ~np.isin(of_class, class_ids)

    entries: list[tuple[int, int, float, bool]] = []
    misses = np.zeros((len(class_ids), len(OVERLAPS)), dtype=np.int64)
    has_truth = np.zeros(len(class_ids), dtype=bool)
    for class_index, class_id in enumerate(class_ids):
        members = np.flatnonzero(of_class == class_id)
        large = sizes[members] >= min_points
        predictions = np.flatnonzero(classes[usable] == class_id)
        has_truth[class_index] = large.any()
        shared = common[np.ix_(predictions, members)]
        area = points[usable[predictions]]
        overlap = shared / (area[:, None] + sizes[members][None, :] - shared)
        ignored = (common[predictions][:, void].sum(axis=1) + shared[:, ~large].sum(axis=1)) / area
        confidence = confidences[usable[predictions]].astype(float)
        for overlap_index, threshold in enumerate(OVERLAPS):
            scored, missed = _matches(overlap > threshold, large, ignored > threshold, confidence)
            misses[class_index, overlap_index] = missed
            entries += [(class_index, overlap_index, *entry) for entry in scored]
    table = np.array(entries, dtype="i8, i8, f8, ?")
    return InstanceMatches(table["f0"], table["f1"], table["f2"], table["f3"], misses, has_truth)


def _matches(
    fits: Bool[np.ndarray, "M G"],
    large: Bool[np.ndarray, " G"],
    is_ignored: Bool[np.ndarray, " M"],
    confidence: Float64[np.ndarray, " M"],
) -> tuple[list[tuple[float, bool]], int]:
    """Return the (confidence, is match) entries for one class and threshold, and the number of misses."""
    used = np.zeros(len(fits), dtype=bool)
    entries, missed = [], 0
    for instance in np.flatnonzero(large):
        candidates = np.flatnonzero(fits[:, instance] & ~used)
        if not candidates.size:
            missed += 1
            continue
        used[candidates[0]] = True
        best = confidence[candidates[0]]
        for lower in confidence[candidates[1:]]:
            best, worse = max(best, lower), min(best, lower)
            entries.append((float(worse), False))
        entries.append((float(best), True))
    alone = ~fits.any(axis=1) & ~is_ignored
    return entries + [(float(value), False) for value in confidence[alone]], missed


def curve_area(confidence: Float[np.ndarray, " E"], is_match: Bool[np.ndarray, " E"], misses: int) -> float:
    """Return the area under one precision-recall curve, integrated as in the benchmark.

    For each distinct confidence, precision P and recall R are computed from the entries with at least that
    confidence; less confident matches and unmatched instances reduce recall. The point (1, 0) ends the curve.
    The area is the sum of P_k (R_(k-1) - R_(k+1)) / 2, with R_(-1) = R_0 and R = 0 after the last point, and
    no interpolation envelope. Without entries, the area is 0.
    """
    if not len(confidence):
        return 0.0
    levels, row = np.unique(confidence, return_inverse=True)
    at_level = np.bincount(row, minlength=len(levels))
    matches_at_level = np.bincount(row, weights=is_match, minlength=len(levels))
    taken = at_level[::-1].cumsum()[::-1]
    hits = matches_at_level[::-1].cumsum()[::-1]
    truths = hits[0] + misses
    precision = np.append(hits / taken, 1.0)
    recall = np.append(hits / truths if truths else np.zeros(len(levels)), 0.0)
    padded = np.concatenate([recall[:1], recall, [0.0]])
    return float(precision @ ((padded[:-2] - padded[2:]) / 2))


def average_precision(scans: Sequence[InstanceMatches]) -> Float64[np.ndarray, "K T"]:
    """Return the average precision per class and threshold over all scans.

    It is nan for classes without ground-truth instances, and 0 for classes with instances but no prediction.
    """
    result = np.full_like(scans[0].misses, np.nan, dtype=np.float64)
    misses = np.sum([scan.misses for scan in scans], axis=0)
    has_truth = np.any([scan.has_truth for scan in scans], axis=0)
    classes, overlaps, confidence, is_match = (
        np.concatenate([getattr(scan, name) for scan in scans])
        for name in ("class_index", "overlap_index", "confidence", "is_match")
    )
    for class_index in np.flatnonzero(has_truth):
        for overlap_index in range(result.shape[1]):
            entries = (classes == class_index) & (overlaps == overlap_index)
            result[class_index, overlap_index] = curve_area(
                confidence[entries], is_match[entries], int(misses[class_index, overlap_index])
            )
    return result


def mean_precision(precisions: Float64[np.ndarray, "k t"]) -> float:
    """Return the mean over thresholds and classes with ground-truth instances; nan if there are none."""
    known = precisions[~np.isnan(precisions)]
    return float(known.mean()) if known.size else float("nan")
