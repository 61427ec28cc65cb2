"""Tables of labelled points, with bootstrap intervals over scenes and class names.

A room has about twenty class names, and most are entirely right or wrong, so one node changes the mean by
several points.
"""

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from hilsplat.evaluate.protocols.cards import card_of
from hilsplat.evaluate.tables.kinds import TableKind
from hilsplat.evaluate.tables.measured import measured_blocks, percent, scene_cells
from hilsplat.evaluate.tables.rows import Block, Cell, Sources

if TYPE_CHECKING:
    import pandas as pd

SCANNET_COLUMNS: Mapping[str, str] = {
    "scannet/opengaussian-19": "19 classes",
    "scannet/opengaussian-15": "15 classes",
    "scannet/opengaussian-10": "10 classes",
    "scannet200/opengaussian": "ScanNet200",
}
"""Protocol -> column in the paper."""

INTERVAL_COLUMNS = {**SCANNET_COLUMNS, "replica/": "Mean", "waymo/": "Present classes"}
"""Beginning of a protocol's name -> the mean whose interval is shown."""

BENCHMARK = "scannet200/benchmark"
SPLIT_COLUMNS = {f"miou_{split}": f"ScanNet200 {split} mIoU" for split in ("head", "common", "tail")}
AP_COLUMNS = {
    "ap": "ScanNet200 AP",
    "ap25": "ScanNet200 AP@25",
    "ap50": "ScanNet200 AP@50",
    **{f"ap_{split}": f"ScanNet200 {split} AP" for split in ("head", "common", "tail")},
}

DRAWS = 1000


def replica_cells(_: "pd.DataFrame", part: "pd.DataFrame") -> dict[str, Cell]:
    return scene_cells(part, {"mIoU": "miou_present", "mAcc": "macc_present"}, "Mean")


def scannet_blocks(kind: TableKind, sources: Sources) -> list[Block]:
    """Return one row per method, with 19, 15, 10 and 200 classes and ScanNet200 instances."""

    def mode_of(protocol: str) -> str:
        return protocol.partition("(")[2].rstrip(")")  # how points were classified

    return measured_blocks(kind, sources, partial(scannet_cells, sources), interval_cells, mode_of)


def scannet_cells(sources: Sources, _: "pd.DataFrame", part: "pd.DataFrame") -> dict[str, Cell]:
    """Return mIoU and mAcc of each class set, mIoU of ScanNet200's splits, and AP over all scans of a row."""
    cells = {}
    for protocol, name in SCANNET_COLUMNS.items():
        of_protocol = part[part["protocol"].str.startswith(protocol)]
        for mean, metric in (("mIoU", "miou_present"), ("mAcc", "macc_present")):
            cells[f"{name} {mean}"] = percent(of_protocol, metric)
    first = part.iloc[0]
    key = tuple(first[["dataset", "seeded_variant", "masks", "method"]])
    scenes = set(part["scene"])  # another row may have those that were scored under other settings
    scans = {
        scene: matches
        for (dataset, scene, *rest), matches in sources.instances.items()
        if (dataset, *rest) == key and scene in scenes
    }
    of_benchmark = part[part["protocol"].str.startswith(BENCHMARK)]
    if of_benchmark.empty and not scans:
        return cells
    from hilsplat.datasets.classes import SCANNET200
    from hilsplat.evaluate.protocols.points import measure_instances, pooled_points

    if not of_benchmark.empty:  # the counts of all scenes are pooled
        means = pooled_points(card_of(BENCHMARK), of_benchmark.itertuples(), SCANNET200)
        cells |= {column: Cell.percent(means[metric]) for metric, column in SPLIT_COLUMNS.items()}
    if scans:
        rows = measure_instances(first["method"], scans, "nearest")
        cells |= {AP_COLUMNS[row.metric]: Cell.percent(row.value) for row in rows}
    return cells


def waymo_cells(_: "pd.DataFrame", part: "pd.DataFrame") -> dict[str, Cell]:
    """Return mIoU over 22 classes, with counts pooled over scenes."""
    from hilsplat.datasets.classes import WAYMO_22
    from hilsplat.evaluate.protocols.points import pooled_points

    means = pooled_points(card_of(part["protocol"].iloc[0]), part.itertuples(), WAYMO_22)
    return {
        "mIoU": Cell.percent(means["miou_absent_as_one"]),
        "mIoU, present classes": Cell.percent(means["miou_present"]),
        "Classes present": Cell.count(part[part["metric"] == "class_accuracy"]["query"].nunique()),
    }


def bootstrap_mean(
    hits: Float[np.ndarray, "R S K"],
    union: Float[np.ndarray, "R S K"],
    present: Bool[np.ndarray, "S K"],
    pooled: bool,
) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of a mean IoU over seeds, resampling scenes and their class names.

    Args:
        hits: correctly predicted points of each class, per seed and scene.
        union: points labelled or predicted as the class; 0 if the class doesn't occur.
        present: classes of each scene that are included in the mean, at least one.
        pooled: whether counts of all scenes are summed first; otherwise scenes are averaged.
    """
    draws = np.random.default_rng(0)

    def mean_over_names(iou: np.ndarray) -> float:
        of_seeds = iou.mean(axis=0)
        return float(of_seeds[draws.integers(len(of_seeds), size=len(of_seeds))].mean())

    def resampled() -> float:
        scenes = draws.integers(len(present), size=len(present))
        if pooled:
            names = present[scenes].any(axis=0)
            of_names = (counts[:, scenes].sum(axis=1)[:, names] for counts in (hits, union))
            return mean_over_names(np.divide(*of_names))
        means = [mean_over_names(hits[:, s, present[s]] / union[:, s, present[s]]) for s in scenes]
        return float(np.mean(means))

    low, high = np.percentile([resampled() for _ in range(DRAWS)], (2.5, 97.5))
    return float(low), float(high)


def interval_cells(_: "pd.DataFrame", part: "pd.DataFrame") -> dict[str, Cell]:
    """Return the interval and the numbers of names and scenes for each protocol that has rows of classes."""
    import pandas as pd

    cells, keys = {}, ["metric", "seed", "scene", "query"]
    of_classes = part[part["metric"].isin(("class_accuracy", "class_iou"))]
    for protocol, name in INTERVAL_COLUMNS.items():
        rows = of_classes[of_classes["protocol"].str.startswith(protocol)]
        if rows["metric"].nunique() < 2:
            continue
        names = [sorted(set(rows[key])) for key in keys]
        grid = rows.set_index(keys)[["value", "n"]].reindex(pd.MultiIndex.from_product(names)).fillna(0)
        (_, ious), (true, union) = grid.to_numpy().T.reshape(2, *map(len, names))  # of accuracies, of IoUs
        present = true[0] > 0  # all seeds have the same ground truth
        is_pooled = card_of(rows["protocol"].iloc[0]).averaging == "pooled"
        low, high = bootstrap_mean(ious * union, union, present, is_pooled)
        cells[f"{name} 95 %"] = Cell(f"{100 * low:.0f} to {100 * high:.0f}")
        cells[f"{name} names"] = Cell(f"{int(present.sum())} in {len(present)}")
    return cells
