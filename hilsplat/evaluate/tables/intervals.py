"""Bootstrap intervals of point labelling, over scenes and class names.

A room has about twenty names, most entirely right or wrong: one node changes the mean by several points.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from hilsplat.evaluate.tables.rows import Cell

if TYPE_CHECKING:
    import pandas as pd

DRAWS = 1000
PERCENTILES = (2.5, 97.5)


def bootstrap_mean(
    hits: Float[np.ndarray, "S K"],
    union: Float[np.ndarray, "S K"],
    present: Bool[np.ndarray, "S K"],
    pooled: bool,
) -> tuple[float, float]:
    """Return the 95 % interval of a mean IoU when scenes, and names within them, are resampled.

    Args:
        hits: correctly predicted points of each class, per scene.
        union: points of the class or predicted as it; 0 where it doesn't occur.
        present: classes included in the mean.
        pooled: whether counts of all scenes are summed first; otherwise scenes are averaged.
    """
    draws, found = np.random.default_rng(0), []

    def mean_over_names(iou: np.ndarray) -> float:
        return float(iou[draws.integers(len(iou), size=len(iou))].mean())

    for _ in range(DRAWS):
        scenes = draws.integers(len(hits), size=len(hits))
        if pooled:
            counts = present[scenes].any(axis=0)
            found.append(
                mean_over_names(hits[scenes].sum(axis=0)[counts] / union[scenes].sum(axis=0)[counts])
            )
        else:
            each = [
                mean_over_names(hits[s, present[s]] / union[s, present[s]])
                for s in scenes
                if present[s].any()
            ]
            found.append(float(np.mean(each)) if each else 0.0)
    low, high = np.percentile(found, PERCENTILES)
    return float(low), float(high)


def interval_cells(part: "pd.DataFrame", name: str, pooled: bool) -> dict[str, Cell]:
    """Return interval, scenes and names of one protocol, method and seed; nothing without class rows.

    Args:
        part: score rows.
        name: prefix of the columns.
        pooled: as in `bootstrap_mean`.
    """
    ious = part[part["metric"] == "class_iou"]
    true = part[part["metric"] == "class_accuracy"]
    if ious.empty or true.empty:
        return {}
    values, points, present = (
        frame.pivot(index="scene", columns="query", values=column).reindex(
            index=sorted(set(ious["scene"])), columns=sorted(set(ious["query"]))
        )
        for frame, column in ((ious, "value"), (ious, "n"), (true, "n"))
    )
    union = points.fillna(0).to_numpy(float)
    counts = present.fillna(0).to_numpy() > 0
    low, high = bootstrap_mean(values.fillna(0).to_numpy() * union, union, counts, pooled)
    return {
        f"{name} 95 %": Cell(f"{100 * low:.0f} to {100 * high:.0f}"),
        f"{name} names": Cell(f"{int(counts.sum())} in {len(counts)}"),
    }
