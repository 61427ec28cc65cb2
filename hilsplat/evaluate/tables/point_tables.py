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
from hilsplat.evaluate.tables.measured import measured_blocks, scene_cells, table_value
from hilsplat.evaluate.tables.rows import Cell, Sources, Table

if TYPE_CHECKING:
    import pandas as pd

SCANNET_COLUMNS: Mapping[str, str] = {
    "scannet/opengaussian-19": "19 classes",
    "scannet/opengaussian-15": "15 classes",
    "scannet/opengaussian-10": "10 classes",
    "scannet200/opengaussian": "ScanNet200",
}
"""Protocol -> column in the paper."""

BENCHMARK = "scannet200/benchmark"
SPLIT_COLUMNS = {f"miou_{split}": f"ScanNet200 {split} mIoU" for split in ("head", "common", "tail")}
AP_COLUMNS = {
    "ap": "ScanNet200 AP",
    "ap25": "ScanNet200 AP@25",
    "ap50": "ScanNet200 AP@50",
    **{f"ap_{split}": f"ScanNet200 {split} AP" for split in ("head", "common", "tail")},
}

DRAWS = 1000

MODE_NOTE = (
    "Classes are transferred from Gaussians to points by the mode named after 'points:' (nearest: the "
    "nearest Gaussian with an opacity of at least 0.1; frozen: the Gaussian initialised at the point). "
    "Classes are queried by their names alone; the highest cosine wins. Names outside the CLIP model's "
    "vocabulary also compete."
)

INTERVAL_NOTE = (
    "95 %: bootstrap interval of the mIoU, resampling scenes and their class names. Names: numbers of "
    "ground-truth names and of scenes. Rows with overlapping intervals cannot be ranked by these scenes."
)


def replica_table(sources: Sources) -> Table:
    """Build the table of mIoU and mAcc per scene (paper: Replica, semantic segmentation)."""

    def columns_of(of_data: "pd.DataFrame") -> list[str]:
        scenes = [*sorted(set(of_data["scene"])), "Mean"]
        return [
            *(f"{scene} {name}" for scene in scenes for name in ("mIoU", "mAcc")),
            "Mean 95 %",
            "Mean names",
        ]

    def cells_of(part: "pd.DataFrame") -> dict[str, Cell]:
        means = scene_cells(part, {"mIoU": "miou_present", "mAcc": "macc_present"}, "Mean")
        return {**means, **interval_cells(part, "Mean", pooled=False)}

    blocks = [sources.reported("Replica")]
    blocks += measured_blocks(sources, ("replica/per-scene",), cells_of, columns_of)
    footnotes = (
        "All values in %. Mean over the classes present in a scene; vertices of other classes are ignored. "
        "The paper mentions 48 classes but has no evaluation code, so this is our reading.",
        MODE_NOTE,
        INTERVAL_NOTE,
        "*: reproduced by the paper's authors.",
    )
    return sources.finished("replica", "Replica: semantic segmentation of points", blocks, footnotes)


def scannet_table(sources: Sources) -> Table:
    """Build the ScanNet table: 19, 15, 10 and 200 classes and ScanNet200 instances, one row per method."""
    blocks = [sources.reported("ScanNet", "ScanNet, ScanNet200")]
    columns = [
        f"{name} {what}" for name in SCANNET_COLUMNS.values() for what in ("mIoU", "95 %", "names", "mAcc")
    ]
    columns += [*SPLIT_COLUMNS.values(), *AP_COLUMNS.values()]

    blocks += measured_blocks(
        sources,
        (*SCANNET_COLUMNS, BENCHMARK),
        partial(scannet_cells, sources),
        lambda _: columns,
        label_of=lambda protocol: protocol.partition("(")[2].rstrip(")"),  # how points were classified
    )
    footnotes = (
        "All values in %. Columns of 19, 15 and 10 classes and of ScanNet200 follow OpenGaussian's code: "
        "mean over the classes present in a scene, then over scenes; vertices of other classes are ignored.",
        MODE_NOTE,
        INTERVAL_NOTE,
        "Head, common, tail: the benchmark's splits; mIoU with the counts of all scenes pooled, over the "
        "classes that occur in the ground truth or the prediction.",
        "AP, AP@25, AP@50: OpenMask3D's copy of ScanNet's script, over all scans together. An instance is a "
        "tree node at level whole; its class has the highest cosine of all 198, and its confidence is "
        "that cosine. A field has no instances.",
        "*: reproduced by the paper's authors.",
    )
    return sources.finished("scannet", "ScanNet and ScanNet200: segmentation of points", blocks, footnotes)


def scannet_cells(sources: Sources, part: "pd.DataFrame") -> dict[str, Cell]:
    """Return mIoU and mAcc of each class set, mIoU of ScanNet200's splits, and AP over all scans of a row."""
    cells = {}
    for protocol, name in SCANNET_COLUMNS.items():
        of_protocol = part[part["protocol"].str.startswith(protocol)]
        for mean, metric in (("mIoU", "miou_present"), ("mAcc", "macc_present")):
            cells[f"{name} {mean}"] = Cell.percent(table_value(of_protocol, metric))
        cells |= interval_cells(of_protocol, name, pooled=False)
    first = part.iloc[0]
    variant = first["variant"] if first["seed"] == "0" else f"{first['variant']}.seed{first['seed']}"
    key = (first["dataset"], variant, first["masks"], first["method"])
    scans = {
        scene: matches
        for (dataset, scene, *rest), matches in sources.instances.items()
        if (dataset, *rest) == key
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


def waymo_table(sources: Sources) -> Table:
    """Build the table of mIoU over 22 classes, with counts pooled over scenes (paper: Waymo)."""

    def cells_of(part: "pd.DataFrame") -> dict[str, Cell]:
        from hilsplat.datasets.classes import WAYMO_22
        from hilsplat.evaluate.protocols.points import pooled_points

        means = pooled_points(card_of(part["protocol"].iloc[0]), part.itertuples(), WAYMO_22)
        classes = part[part["metric"] == "class_iou"]["query"].nunique()
        return {
            "mIoU": Cell.percent(means["miou_absent_as_one"]),
            "mIoU, present classes": Cell.percent(means["miou_present"]),
            **interval_cells(part, "Present classes", pooled=True),
            "Classes present": Cell(str(classes), float(classes)),
        }

    blocks = [sources.reported("Waymo")]
    blocks += measured_blocks(
        sources,
        ("waymo/",),
        cells_of,
        lambda _: ("mIoU", "mIoU, present classes", "Present classes 95 %", "Classes present"),
        unranked=frozenset({"Classes present"}),
    )
    footnotes = (
        "All values in %. mIoU: Waymo's official metric over 22 classes, in which a class without points "
        "counts as 100; 'present classes' omits such classes. Counts of all scenes are pooled.",
        MODE_NOTE,
        INTERVAL_NOTE,
        "*: reproduced by the paper's authors.",
    )
    return sources.finished("waymo", "Waymo: segmentation of lidar points", blocks, footnotes)


def bootstrap_mean(
    hits: Float[np.ndarray, "S K"],
    union: Float[np.ndarray, "S K"],
    present: Bool[np.ndarray, "S K"],
    pooled: bool,
) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of a mean IoU, resampling scenes and the class names within them.

    Args:
        hits: correctly predicted points of each class, per scene.
        union: points labelled or predicted as the class, per scene; 0 if the class doesn't occur.
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
    low, high = np.percentile(found, (2.5, 97.5))
    return float(low), float(high)


def interval_cells(part: "pd.DataFrame", name: str, pooled: bool) -> dict[str, Cell]:
    """Return the interval and the numbers of names and scenes; empty if no row describes a class."""
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
