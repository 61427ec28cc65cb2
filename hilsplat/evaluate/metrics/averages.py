"""Averaging orders. A number without its averaging order is not a result.

A pair without a prediction has the value 0 here; protocols that leave such pairs out say so on their card.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

Pairs = Mapping[tuple[str, str], float]
"""(view, query) -> value."""


def mean_over_pairs(values: Pairs) -> float:
    """Plain mean over all (view, query) pairs of a scene: LERF-OVS, LangSplat's code."""
    return _mean(values.values())


def mean_over_classes(values: Pairs) -> float:
    """Mean over views for each query, then over queries: LERF-Mask, Gaussian Grouping's code."""
    of_query: dict[str, list[float]] = {}
    for (_, query), value in values.items():
        of_query.setdefault(query, []).append(value)
    return _mean(_mean(views) for views in of_query.values())


def mean_over_scenes(values: Iterable[float]) -> float:
    """Plain mean of the scenes' values, whatever their numbers of pairs; nan scenes are left out."""
    return _mean(value for value in values if value == value)


def mean_over_levels(values_of_level: Sequence[Iterable[float]]) -> tuple[list[float], float]:
    """Mean of each level's pairs and the mean of the levels: columns L1, L2, L3 and Avg.

    A level without pairs is left out of the mean (its own value is nan).
    """
    means = [_mean(level) for level in values_of_level]
    return means, mean_over_scenes(means)


def accuracy_at(ious: Iterable[float], threshold: float) -> float:
    """Share of pairs whose IoU is greater than the threshold: Acc@0.25, Acc@0.5."""
    return _mean(float(value > threshold) for value in ious)


def _mean(values: Iterable[float]) -> float:
    """Mean that the order of the values cannot change; nan of nothing."""
    listed = sorted(values)
    return float(np.mean(listed)) if listed else float("nan")
