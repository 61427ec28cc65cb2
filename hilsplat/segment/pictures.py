"""Pictures of masks, for inspecting the output of a segmenter."""

import itertools
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Int32, UInt8
from matplotlib.colors import hsv_to_rgb

from hilsplat.base.artifacts import read_index, read_npz, sealed
from hilsplat.base.errors import ArtifactError, nearest
from hilsplat.base.images import write_png
from hilsplat.base.levels import LEVELS, NONE, Level, spelt
from hilsplat.base.ownership import SOFTWARE, require_own_picture
from hilsplat.scene.scene import Scene
from hilsplat.segment.crops import square_crop
from hilsplat.segment.digests import require_same_masks
from hilsplat.segment.masks import HierarchicalMasks

GOLDEN = 0.6180339887498949
"""Hue step between rows; the golden ratio gives consecutive rows clearly different colours."""
UNCOVERED = 0.35  # brightness of pixels without a mask
THUMB_PX = 56  # side of a mask's crop in the tree picture
MAX_LEAVES = 12  # rows of crops in the tree picture
MIN_SIDE_PX = 384  # smaller images are enlarged for the masks picture


def row_colours(number: int) -> UInt8[np.ndarray, "n 3"]:
    """Return one colour per row, the same in every picture."""
    row = np.arange(number)
    hsv = [row * GOLDEN % 1, 0.55 + 0.4 * (row // 3 % 2), 0.95 - 0.25 * (row // 7 % 2)]
    return (hsv_to_rgb(np.stack(hsv, axis=1)) * 255).astype(np.uint8)


def paint_level(
    image: UInt8[np.ndarray, "H W 3"], masks: HierarchicalMasks, level: Level
) -> UInt8[np.ndarray, "H W 3"]:
    """Tint and outline a level's masks in a view; pixels without a mask are dark grey."""
    labels = masks.label_map(level)
    grey = np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2)
    palette = np.concatenate([row_colours(len(masks)), np.zeros((1, 3), np.uint8)])  # -1 selects the last
    tinted = 0.35 * grey + 0.65 * palette[labels]
    painted = np.where((labels == NONE)[..., None], UNCOVERED * grey, tinted)
    edge = np.zeros(labels.shape, dtype=bool)
    edge[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    edge[1:] |= labels[1:] != labels[:-1]
    painted[edge] = 255
    return painted.astype(np.uint8)


def masks_picture(image: UInt8[np.ndarray, "H W 3"], masks: HierarchicalMasks) -> UInt8[np.ndarray, "h w 3"]:
    """Draw a view and its three levels side by side, with the number of masks of each level."""
    factor = max(1, -(-MIN_SIDE_PX // max(image.shape[:2])))
    panels = {"photo": image}
    for level in LEVELS:
        panels[f"{level.label}: {len(masks.rows_of(level))}"] = paint_level(image, masks, level)
    drawn = []
    for title, panel in panels.items():
        large = np.repeat(np.repeat(panel, factor, axis=0), factor, axis=1)
        header = np.full((28, large.shape[1], 3), 255, dtype=np.uint8)
        cv2.putText(header, title, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (0, 0, 0), 1, cv2.LINE_AA)
        drawn.append(np.concatenate([header, large]))
    return np.concatenate(drawn, axis=1)


def tree_picture(
    image: UInt8[np.ndarray, "H W 3"], masks: HierarchicalMasks, parent: Int32[np.ndarray, " M"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the largest coverage trees of a view: roots at the left, children to the right.

    Each mask is shown as a crop, dimmed outside the mask and framed in its `masks_picture` colour. Trees that
    don't fit into `MAX_LEAVES` rows are omitted.
    """
    children: dict[int, list[int]] = {}
    for row, above in enumerate(parent.tolist()):
        children.setdefault(above, []).append(row)

    def leaves(row: int) -> int:
        return sum(map(leaves, children[row])) if row in children else 1

    def nodes(row: int) -> int:
        return 1 + sum(map(nodes, children.get(row, [])))

    def height(row: int) -> int:
        return 1 + max(map(height, children.get(row, [])), default=0)

    roots, left = [], MAX_LEAVES
    for root in sorted(children.get(NONE, []), key=lambda row: (-nodes(row), row)):
        if leaves(root) <= left:
            roots.append(root)
            left -= leaves(root)
    step_x, step_y = 2 * THUMB_PX, THUMB_PX + 6
    columns = max(map(height, roots), default=1)
    canvas = np.full((max(1, MAX_LEAVES - left) * step_y + 6, columns * step_x, 3), 255, np.uint8)
    palette, tops = row_colours(len(masks)), itertools.count(6, step_y)

    def draw(row: int, depth: int) -> int:
        """Draw a subtree, each leaf below the last; return the top of its root's crop, px."""
        below = [draw(child, depth + 1) for child in children.get(row, [])]
        y = round(sum(below) / len(below)) if below else next(tops)
        x = 6 + depth * step_x
        for end in below:
            start = (x + THUMB_PX, y + THUMB_PX // 2)
            cv2.line(canvas, start, (x + step_x, end + THUMB_PX // 2), (120, 120, 120), 1, cv2.LINE_AA)
        mask = masks.dense(np.array([row]))[0]
        canvas[y : y + THUMB_PX, x : x + THUMB_PX] = square_crop(image, mask, "dim", 0.15, THUMB_PX)
        colour = tuple(int(number) for number in palette[row])
        cv2.rectangle(canvas, (x, y), (x + THUMB_PX, y + THUMB_PX), colour, 2)
        return y

    for root in roots:
        draw(root, 0)
    return canvas


def masks_overview(
    scene_folder: Path,
    masks_folder: Path,
    out_png: Path,
    view: str | None = None,
    tree_folder: Path | None = None,
) -> str:
    """Draw one view with its masks at three levels, and optionally its trees; return the view's name.

    Args:
        out_png: file to write; the trees are written beside it as `<name>_tree.png`.
        view: name of the view; None selects the middle view of those that have masks.
        tree_folder: output of the coverage_tree stage; None draws no trees.

    Raises:
        ArtifactError: if the view has no masks.
        MisalignedArtifactError: if the trees were computed from other masks.
    """
    tree_png = out_png.with_name(f"{out_png.stem}_tree.png")
    for path in (out_png, *([tree_png] if tree_folder else [])):
        require_own_picture(path)
    views = list(read_index(masks_folder)["views"])
    if (chosen := spelt(view or views[len(views) // 2], views)) is None:
        raise ArtifactError(f"{masks_folder} has no view {view!r}", expected=nearest(str(view), views))
    masks = HierarchicalMasks.load(masks_folder / f"{chosen}.npz")
    image = Scene.load(scene_folder).image(chosen)
    write_png(out_png, masks_picture(image, masks), text=SOFTWARE)
    if tree_folder is not None:
        require_same_masks(tree_folder, masks_folder)
        parent = read_npz(sealed(tree_folder, f"{chosen}.npz"), "parent")["parent"]
        write_png(tree_png, tree_picture(image, masks, parent), text=SOFTWARE)
    return chosen
