"""Pictures of masks, for looking at what a segmenter found."""

import colorsys
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from hilsplat.base.artifacts import read_index
from hilsplat.base.images import write_png
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.scene.scene import Scene
from hilsplat.segment.masks import HierarchicalMasks

GOLDEN = 0.6180339887498949
"""Step of the hue from one row to the next: neighbours in the table never look alike."""

UNCOVERED = 0.35
"""Brightness of pixels without a mask."""


def row_colours(number: int) -> UInt8[np.ndarray, "n 3"]:
    """A colour per row, the same in every picture."""
    colours = [
        colorsys.hsv_to_rgb(
            (row * GOLDEN) % 1.0, 0.55 + 0.4 * ((row // 3) % 2), 0.95 - 0.25 * ((row // 7) % 2)
        )
        for row in range(number)
    ]
    return (np.array(colours).reshape(number, 3) * 255).astype(np.uint8)


def paint_level(
    image: UInt8[np.ndarray, "H W 3"], masks: HierarchicalMasks, level: Level
) -> UInt8[np.ndarray, "H W 3"]:
    """A view with its masks of one level tinted and outlined; pixels without a mask are dark grey."""
    labels = masks.label_map(level)
    grey = np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2)
    palette = np.concatenate([row_colours(len(masks)), np.zeros((1, 3), np.uint8)])  # -1 reads the last
    tinted = 0.35 * grey + 0.65 * palette[labels]
    painted = np.where((labels == NONE)[..., None], UNCOVERED * grey, tinted)
    edge = np.zeros(labels.shape, dtype=bool)
    edge[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    edge[1:] |= labels[1:] != labels[:-1]
    painted[edge] = 255
    return painted.astype(np.uint8)


def masks_picture(
    image: UInt8[np.ndarray, "H W 3"], masks: HierarchicalMasks, min_side_px: int = 384
) -> UInt8[np.ndarray, "h w 3"]:
    """A view and its three levels side by side, with the number of masks of each."""
    factor = max(1, -(-min_side_px // max(image.shape[:2])))
    panels = [("photo", image)]
    panels += [
        (f"{level.label}: {len(masks.rows_of(level))}", paint_level(image, masks, level)) for level in LEVELS
    ]
    drawn = []
    for title, panel in panels:
        large = np.repeat(np.repeat(panel, factor, axis=0), factor, axis=1)
        header = np.full((28, large.shape[1], 3), 255, dtype=np.uint8)
        cv2.putText(header, title, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (0, 0, 0), 1, cv2.LINE_AA)
        drawn.append(np.concatenate([header, large]))
    return np.concatenate(drawn, axis=1)


def masks_overview(scene_folder: Path, masks_folder: Path, out_png: Path, view: str | None = None) -> None:
    """Write a picture of one view: the photograph and its masks at three levels.

    Args:
        scene_folder: the `Scene` artifact.
        masks_folder: what the masks stage wrote.
        out_png: file to write.
        view: view name; None takes the middle one of the views that have masks.
    """
    views = list(read_index(masks_folder)["views"])
    chosen = view or views[len(views) // 2]
    masks = HierarchicalMasks.load(Path(masks_folder) / f"{chosen}.npz")
    write_png(out_png, masks_picture(Scene.load(scene_folder).image(chosen), masks))
