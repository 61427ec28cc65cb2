"""Tables of labelled images without levels: LERF and 3D-OVS."""

from typing import TYPE_CHECKING

from hilsplat.evaluate.protocols.cards import LERF_MASK
from hilsplat.evaluate.protocols.totals import table_value
from hilsplat.evaluate.tables.measured import measured_blocks, scene_cells
from hilsplat.evaluate.tables.rows import Cell, Table
from hilsplat.evaluate.tables.sources import Sources

if TYPE_CHECKING:
    import pandas as pd


def lerf_table(sources: Sources) -> Table:
    """Build the table of segmentation and localization per scene (paper: LERF), on LERF-OVS and LERF-Mask."""
    metrics = {"mIoU": "iou", "mBIoU": "boundary_iou", "localization": "localization_box"}

    def columns_of(of_data: "pd.DataFrame") -> list[str]:
        scenes = [*sorted(set(of_data["scene"])), "Average"]
        segmentation = [f"{scene} {name}" for scene in scenes for name in ("mIoU", "mBIoU")]
        return segmentation + [f"{scene} localization" for scene in scenes]

    blocks = [sources.reported("LERF")]
    for prefix in ("lerf/", LERF_MASK.name):
        blocks += measured_blocks(
            sources,
            (prefix,),
            lambda part: scene_cells(part, metrics),
            columns_of,
            ranked_by_protocol=False,
        )
    footnotes = (
        "All in %. mIoU and mBIoU are means over (view, text) pairs of a scene; Average is the mean of the "
        "scenes. Localization: the point of highest smoothed relevancy lies in a box of the text.",
        "lerf/langsplat: mean filter (30 px at a height of 730, scaled), min-max above 0.7, 7 x 7 majority, "
        "level of the highest relevancy. lerf/tree-nodes: tree nodes that the view shows, level chosen by "
        "the tree.",
        "lerf-mask/gaussian-grouping: one mask per text and view, mean over the views of a text, then over "
        "texts; a missing prediction counts 0. On the stand-in the texts are those of whole objects, and "
        "the answers those of the row's method with the level chosen.",
        "*: reproduced by the paper's authors; other reported rows come from the methods' own papers.",
    )
    return sources.finished("lerf", "Segmentation and localization", blocks, footnotes)


OVS_SCENES = ("bed", "bench", "room", "sofa", "lawn")
"""Scenes of the paper's table, averaged in its column Overall."""


def ovs_table(sources: Sources) -> Table:
    """Build the table of segmentation per scene (paper: 3D-OVS), by LangSplat's thresholds and by argmax."""

    def columns_of(of_data: "pd.DataFrame") -> list[str]:
        scenes = sorted(set(of_data["scene"]))
        return [*(f"{scene} mIoU" for scene in scenes), "Overall mIoU", "Overall accuracy"]

    def cells_of(part: "pd.DataFrame") -> dict[str, Cell]:
        cells = scene_cells(part, {"mIoU": "iou"})
        del cells["Average mIoU"]
        if (part["dataset"] == "3d_ovs").all():
            part = part[part["scene"].isin(OVS_SCENES)]
        overall, accuracy = (Cell.percent(table_value(part, name)) for name in ("iou", "pixel_accuracy"))
        return {**cells, "Overall mIoU": overall, "Overall accuracy": accuracy}

    blocks = [sources.reported("3D-OVS")]
    blocks += measured_blocks(sources, ("3d-ovs/",), cells_of, columns_of)
    footnotes = (
        "mIoU in %: mean over (view, text) pairs of a scene; Overall is the mean of the scenes, on 3D-OVS of "
        f"the five that the paper has ({', '.join(OVS_SCENES)}).",
        "3d-ovs/langsplat: min-max relevancy above 0.7, unfiltered, level of the highest mean in its mask "
        "(LangSplat's supplement; its code is not released). 3d-ovs/langsplat-raw takes the printed 0.4 "
        "literally. 3d-ovs/langsplat-v2: LangSplatV2's code: smoothed relevancy above 0.625, whole or part. "
        "These are rules for maps; 3d-ovs/tree-nodes scores the nodes that a tree answers with.",
        "3d-ovs/argmax: every pixel gets the text of the highest cosine, at an eighth of the image's size; "
        "accuracy is the share of pixels with the right text. Brackets name the level it is read from.",
        "On the stand-in the texts are those of whole objects in view; what surrounds them has no text, and "
        "the argmax protocol is scored on the pixels that have one.",
        "*: reproduced by the paper's authors.",
    )
    return sources.finished("3dovs", "3D-OVS: segmentation", blocks, footnotes)
