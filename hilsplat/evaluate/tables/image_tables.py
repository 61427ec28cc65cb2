"""Tables of labelled images: LERF, 3D-OVS, queries at three levels, and the scored frames."""

from functools import partial
from typing import TYPE_CHECKING

from hilsplat.evaluate.metrics.hierarchy import READINGS
from hilsplat.evaluate.protocols.cards import LERF_MASK, LEVEL_GIVEN, VIEW_CONSISTENCY
from hilsplat.evaluate.tables import measured
from hilsplat.evaluate.tables.rows import Block, Cell, Row, Sources, Table

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = (
    *("L1", "L2", "L3", "Avg", "Acc@0.25", "HC containment", "HC literal", "HC anchored"),
    *("View consistency", "Avg, best threshold", "Pairs"),
)

OVS_SCENES = ("bed", "bench", "room", "sofa", "lawn")
"""Scenes in the paper's table; its column Overall is their average."""


def hierarchy_table(sources: Sources) -> Table:
    """Build the table of mIoU at three levels, hierarchical consistency and view consistency."""
    blocks = [
        sources.reported(data, rename=partial(column_of_data, data)) for data in ("Hi-LERF", "Hi-3DOVS")
    ]
    scores = measured.with_seeds(sources.scores)

    def cells_of(part: "pd.DataFrame") -> dict[str, Cell]:
        ious = part[part["metric"] == "iou"]
        above = ious.assign(value=(ious["value"] > 0.25).astype(float))
        cells = {
            **measured.level_cells(part),
            "Acc@0.25": Cell.percent(measured.table_value(above, "iou")),
            **{f"HC {name}": Cell.percent(measured.table_value(part, f"hc_{name}")) for name in READINGS},
            "Avg, best threshold": measured.level_cells(part, "best_threshold_iou")["Avg"],
            "Pairs": Cell(str(len(ious)), float(len(ious))) if len(ious) else Cell(),
        }
        if part["protocol"].iloc[0].startswith(LEVEL_GIVEN.full_name):
            same = measured.same_row(scores, part, (VIEW_CONSISTENCY.full_name,))
            cells["View consistency"] = measured.level_cells(same, "view_consistency")["Avg"]
        return cells

    blocks += measured.measured_blocks(
        sources,
        ("hierarchy/",),
        cells_of,
        lambda _: COLUMNS,
        frozenset({"HC literal", "Avg, best threshold", "Pairs"}),
    )
    footnotes = (
        "mIoU in %: mean over (view, text) pairs of a scene, then over scenes; Avg is the mean of L1 to L3.",
        "HC containment: share of the child inside the parent (the paper's wording), mean over the children "
        "of a parent, then over parents: 100 for perfect nesting, 50 in a view without subparts. HC literal: "
        "share of the parent covered by the child (the printed formula; perfect masks "
        "score low). HC anchored: share of the child inside the annotated parent. The annotations' row "
        "shows the score of perfect masks.",
        "A path of texts queries whole > part > subpart, which uses more text than the paper's protocol.",
        "In each view, the field and the tree rank only the Gaussians and nodes visible there. "
        "Scene-wide: all nodes of the scene compete, and all views share one 3D answer.",
        "View consistency: IoU of the answers in two neighbouring views, over the surface points visible in "
        "both, with exact geometry and the level given; mean over the texts of a level, then over levels. "
        "Texts without an answer in either view are omitted. The metric measures consistency, not "
        "correctness.",
        "Avg, best threshold: a diagnostic that chooses each map's threshold with the ground truth.",
    )
    return sources.finished("hierarchy", "Queries at three levels", blocks, footnotes)


def column_of_data(data: str, column: str) -> str | None:
    """Return the name of a reported column in the block of a data set; None in the other block."""
    if not column.startswith(f"{data} "):
        return None
    return column.removeprefix(f"{data} ").replace("HC", "HC (reading not stated)")


def frames_table(sources: Sources, data: str) -> Table:
    """Build a table of the paper's frames and the views queried at levels, with numbers of texts."""
    texts: dict[tuple[str, str, str], set] = {}
    for row in sources.scores.itertuples():
        if row.metric == "iou" and row.protocol.startswith(LEVEL_GIVEN.full_name):
            texts.setdefault((row.dataset, row.scene, row.view), set()).add((row.query, row.level))
    views: dict[str, dict[str, list[str]]] = {}
    for (dataset, scene, view), of_view in sorted(texts.items()):
        name = view.rpartition(".")[0] or view
        views.setdefault(dataset, {}).setdefault(scene, []).append(f"{name} ({len(of_view)} texts)")
    blocks = [sources.reported(data, families=False)]
    for dataset, of_scenes in views.items():
        rows = []
        for number in range(max(map(len, of_scenes.values()))):
            cells = {scene: Cell(names[number]) for scene, names in of_scenes.items() if number < len(names)}
            rows.append(Row({"Frame": str(number + 1)}, cells, None))
        blocks.append(Block(*measured.kind_and_title(dataset), tuple(rows), tuple(sorted(of_scenes))))
    footnotes = ("Measured rows: scored views, with the number of texts queried at levels.",)
    return sources.finished(f"frames-{data.lower()}", f"{data}: frames", blocks, footnotes)


def lerf_table(sources: Sources) -> Table:
    """Build the table of segmentation and localization per scene (paper: LERF), on LERF-OVS and LERF-Mask."""
    metrics = {"mIoU": "iou", "mBIoU": "boundary_iou", "localization": "localization_box"}

    def columns_of(of_data: "pd.DataFrame") -> list[str]:
        scenes = [*sorted(set(of_data["scene"])), "Average"]
        segmentation = [f"{scene} {name}" for scene in scenes for name in ("mIoU", "mBIoU")]
        return segmentation + [f"{scene} localization" for scene in scenes]

    blocks = [sources.reported("LERF")]
    for prefix in ("lerf/", LERF_MASK.name):
        blocks += measured.measured_blocks(
            sources,
            (prefix,),
            lambda part: measured.scene_cells(part, metrics),
            columns_of,
            ranked_by_protocol=False,
        )
    footnotes = (
        "All values in %. mIoU and mBIoU are means over (view, text) pairs of a scene; Average is the mean "
        "over scenes. Localization: the point of highest smoothed relevancy is in one of the text's boxes.",
        "lerf/langsplat: mean filter (30 px at a height of 730, scaled), min-max above 0.7, 7 x 7 majority, "
        "level with the highest relevancy. lerf/tree-nodes: tree nodes visible in the view, level chosen by "
        "the tree.",
        "lerf-mask/gaussian-grouping: one mask per text and view, mean over the views of a text, then over "
        "texts; a missing prediction counts as 0. On the stand-in, the texts are those of whole objects, "
        "and the row's method chooses the level.",
        "*: reproduced by the paper's authors; other reported rows come from the methods' own papers.",
    )
    return sources.finished("lerf", "Segmentation and localization", blocks, footnotes)


def ovs_table(sources: Sources) -> Table:
    """Build the per-scene segmentation table (paper: 3D-OVS), with LangSplat's thresholds and with argmax."""

    def columns_of(of_data: "pd.DataFrame") -> list[str]:
        scenes = sorted(set(of_data["scene"]))
        return [*(f"{scene} mIoU" for scene in scenes), "Overall mIoU", "Overall accuracy"]

    def cells_of(part: "pd.DataFrame") -> dict[str, Cell]:
        cells = measured.scene_cells(part, {"mIoU": "iou"})
        del cells["Average mIoU"]
        if (part["dataset"] == "3d_ovs").all():
            part = part[part["scene"].isin(OVS_SCENES)]
        for name, metric in (("Overall mIoU", "iou"), ("Overall accuracy", "pixel_accuracy")):
            cells[name] = Cell.percent(measured.table_value(part, metric))
        return cells

    blocks = [sources.reported("3D-OVS")]
    blocks += measured.measured_blocks(sources, ("3d-ovs/",), cells_of, columns_of)
    footnotes = (
        "mIoU in %: mean over (view, text) pairs of a scene; Overall is the mean over scenes (3D-OVS: over "
        f"the paper's five, {', '.join(OVS_SCENES)}).",
        "3d-ovs/langsplat: min-max relevancy above 0.7, unfiltered, level of the highest mean in its mask "
        "(LangSplat's supplement; its code is not released). 3d-ovs/langsplat-raw takes the printed 0.4 "
        "literally. 3d-ovs/langsplat-v2: LangSplatV2's code: smoothed relevancy above 0.625, whole or part. "
        "These are rules for maps; 3d-ovs/tree-nodes scores the nodes selected by the tree.",
        "3d-ovs/argmax: every pixel gets the text with the highest cosine, at an eighth of the image's size; "
        "accuracy is the share of pixels with the right text. The level used is in brackets.",
        "On the stand-in, the texts are those of whole objects in view. Their surroundings have no text, so "
        "the argmax protocol scores only pixels with a text.",
        "*: reproduced by the paper's authors.",
    )
    return sources.finished("3dovs", "3D-OVS: segmentation", blocks, footnotes)
