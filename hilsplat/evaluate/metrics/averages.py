"""Averaging orders. A number without its averaging order is not a result."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np


def mean_over_pairs(values: Mapping[tuple[str, str], float]) -> float:
    """Plain mean over all (view, query) pairs of a scene: LERF-OVS, LangSplat's code."""
    return float(np.mean(list(values.values())))


def mean_over_classes(values: Mapping[tuple[str, str], float]) -> float:
    """Mean over views for each query, then over queries: LERF-Mask, Gaussian Grouping's code."""
    of_query: dict[str, list[float]] = {}
    for (_, query), value in values.items():
        of_query.setdefault(query, []).append(value)
    return float(np.mean([np.mean(views) for views in of_query.values()]))


def mean_over_levels(values_of_level: Sequence[Iterable[float]]) -> tuple[list[float], float]:
    """Mean of each level's pairs and the mean of the levels: columns L1, L2, L3 and Avg.

    A level without pairs is left out of the mean (its own value is nan).
    """
    means = [float(np.mean(values)) if (values := list(level)) else np.nan for level in values_of_level]
    return means, float(np.nanmean(means))


def accuracy_at(ious: Iterable[float], threshold: float) -> float:
    """Share of pairs whose IoU is greater than the threshold: Acc@0.25, Acc@0.5."""
    return float(np.mean([value > threshold for value in ious]))
