"""Crops of nodes, and a picture of the semantic tree with a crop per node, parents above their children."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from cpusplat.views import blend_forward
from hilsplat.base.artifacts import write_json
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.images import write_png
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.query.language_scene import LanguageScene
from hilsplat.scene.cameras import Camera
from hilsplat.scene.finished import FinishedScene
from hilsplat.semantic_tree.export import readable_nodes, write_tree_ply
from hilsplat.splat.rasterise.api import project_gaussians

CELL_PX = 84
GAP_PX = 6
LABEL_PX = 32  # height of two lines of text: a node's name and number

BLOCK_GAP_PX = 18
MARGIN_PX = 84  # left margin, for the names of the levels

ROW_PX = CELL_PX + LABEL_PX + 2 * GAP_PX
COLUMNS = 18
"""Maximum number of leaves in a row of the picture; wholes are placed side by side until the row is full."""

BACKGROUND = 250.0
CROP_MARGIN = 0.15
MIN_ALPHA = 0.1
"""Minimum alpha assumed in deciding whether a crop's pixel shows the node; enlarged Gaussians leave gaps."""

LINE = (150, 150, 150)
TEXT = (40, 40, 40)
TEXT_PX = 12


def export_tree(folder: Path, variant: str, out: Path, threads: int) -> str:
    """Write `tree.json`, `tree.ply` (a node per Gaussian and level) and `tree.png`; return a summary."""
    finished = FinishedScene.locate(folder, variant)
    scene = LanguageScene.of(finished, threads=threads)
    nodes = [{**node, "name": scene.name_of(row)} for row, node in enumerate(readable_nodes(scene.tree))]
    with atomic_folder(out) as temporary:
        write_json(temporary / "tree.json", {"scene": scene.scene.name, "nodes": nodes})
        write_tree_ply(finished.parts.gaussians, scene.tree, temporary / "tree.ply")
        write_png(temporary / "tree.png", tree_picture(scene))
    counts = ", ".join(f"{len(scene.tree.nodes_of(level))} {level.label}" for level in LEVELS)
    return f"wrote tree.json, tree.ply and tree.png to {out} ({counts})"


def tree_picture(scene: LanguageScene) -> UInt8[np.ndarray, "H W 3"]:
    """Draw the tree with one row of crops per level; each whole and its descendants form a block.

    A part or subpart without a parent has its own block. A crop shows the node in the view in which it is
    largest, with the rest of that view dimmed, above the node's name and number.
    """
    tree = scene.tree
    children = [tree.children_of(np.array([node])).tolist() for node in range(len(tree))]

    def columns(node: int) -> int:
        """Return the number of leaves below a node, at least 1."""
        return sum(map(columns, children[node])) or 1

    rows: list[list[int]] = [[]]
    for root in [int(node) for level in LEVELS for node in tree.nodes_of(level) if tree.parent[node] == NONE]:
        if rows[-1] and sum(map(columns, [*rows[-1], root])) > COLUMNS:
            rows.append([])
        rows[-1].append(root)
    step = CELL_PX + GAP_PX
    height = len(LEVELS) * ROW_PX + BLOCK_GAP_PX
    width = max(sum(columns(root) * step + BLOCK_GAP_PX for root in row) for row in rows)
    canvas = np.full((len(rows) * height, MARGIN_PX + width, 3), BACKGROUND, np.uint8)
    labels: list[tuple[str, int, int]] = []

    def draw(node: int, left: int, top: int) -> int:
        """Draw a node and its descendants, with lines, and return the node's horizontal centre."""
        x = left + (columns(node) - 1) * step // 2
        y = top + Level(int(tree.level[node])).index * ROW_PX
        centre = x + CELL_PX // 2
        bar = y + CELL_PX + LABEL_PX + GAP_PX  # below this line, children do not share columns
        for child in children[node]:
            middle = draw(child, left, top)
            left += columns(child) * step
            canvas[bar : top + Level(int(tree.level[child])).index * ROW_PX, middle] = LINE
            canvas[bar, min(middle, centre) : max(middle, centre) + 1] = LINE
            canvas[bar - GAP_PX : bar, centre] = LINE
        canvas[y : y + CELL_PX, x : x + CELL_PX] = crop(scene, node, CELL_PX, 0.35, BACKGROUND)
        first, line = y + CELL_PX + LABEL_PX // 4, LABEL_PX // 2
        labels.extend([(scene.own_name_of(node) or "?", centre, first), (str(node), centre, first + line)])
        return centre

    for number, row in enumerate(rows):
        left, top = MARGIN_PX, number * height + GAP_PX
        for root in row:
            draw(root, left, top)
            left += columns(root) * step + BLOCK_GAP_PX
        labels += [
            (level.label, MARGIN_PX // 2, top + level.index * ROW_PX + CELL_PX // 2) for level in LEVELS
        ]
    return _labelled(canvas, labels)


def _labelled(
    canvas: UInt8[np.ndarray, "H W 3"], labels: list[tuple[str, int, int]]
) -> UInt8[np.ndarray, "H W 3"]:
    """Write texts centred at (x, y), no wider than a crop."""
    from matplotlib.font_manager import findfont

    font = ImageFont.truetype(findfont("DejaVu Sans"), TEXT_PX)
    picture = Image.fromarray(canvas)
    draw = ImageDraw.Draw(picture)
    for text, x, y in labels:
        while draw.textlength(text, font) > CELL_PX + GAP_PX // 2:
            text = text.rstrip("…")[:-1] + "…"
        draw.text((x, y), text, TEXT, font, anchor="mm")
    return np.asarray(picture)


def crop(
    scene: LanguageScene, node: int, side_px: int = 160, dimmed: float = 0.2, ground: float = 110.0
) -> UInt8[np.ndarray, "S S 3"]:
    """Return a square crop of the photograph in which a node is largest.

    To find the node's pixels, only the square is rendered, with a camera whose image is that square. Other
    pixels are blended with the grey value `ground` and have the weight `dimmed`.
    """
    tree = scene.tree
    view = tree.view_names[int(tree.view_area_px[node].argmax())]
    camera, photograph = scene.scene.cameras[view], scene.views.image(view)
    rows = scene.views.gaussians_of([node])
    x, y, side = _square_around(scene.gaussians.means[rows], camera)
    shift = np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1.0]])
    scale = np.diag([side_px / side, side_px / side, 1.0])
    inside = Camera("crop", camera.cam_from_world, scale @ shift @ camera.K, (side_px, side_px))
    member = np.zeros((len(scene.gaussians), 1), np.float32)
    member[rows] = 1
    drawn = project_gaussians(scene.gaussians, inside, 0, scene.views.threads)
    shares, alpha = blend_forward(drawn, member, scene.views.threads)
    is_node = shares[..., 0] > 0.5 * np.maximum(alpha, MIN_ALPHA)
    pixels = resampled(photograph, x, y, side, side_px, ground)
    around = pixels * dimmed + (1 - dimmed) * ground
    return np.where(is_node[..., None], pixels, around.astype(np.uint8))


def resampled(
    image: UInt8[np.ndarray, "H W 3"], x: float, y: float, side: float, side_px: int, ground: float
) -> np.ndarray:
    """Resample the square (x, y, side) of an image to `side_px` px; pixels outside the image are `ground`."""
    shrink = max(1.0, side / side_px)  # warping does not average areas, so shrink first
    if shrink > 1:
        image = cv2.resize(image, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)
    scale = side_px * shrink / side
    # Pixel centres are at 0.5 here, but at 0 in OpenCV.
    move = np.array([[scale, 0, -scale * x / shrink], [0, scale, -scale * y / shrink]])
    move[:, 2] += 0.5 * scale - 0.5
    return cv2.warpAffine(image, move, (side_px, side_px), flags=cv2.INTER_LINEAR, borderValue=(ground,) * 3)


def _square_around(points: np.ndarray, camera: Camera) -> tuple[float, float, float]:
    """Return the left edge, top edge and side length, px, of a square around most of the points."""
    local = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    local = local[local[:, 2] > 0.01]
    height, width = camera.size_hw
    if not len(local):
        return 0.0, 0.0, float(max(height, width))
    projected = local @ camera.K.T
    xy = projected[:, :2] / projected[:, 2:]
    low, high = np.percentile(xy, (3, 97), axis=0)
    low, high = np.clip(low, 0, (width, height)), np.clip(high, 0, (width, height))
    side = float((high - low).max()) * (1 + 2 * CROP_MARGIN) + 4
    x, y = ((low + high) / 2 - side / 2).tolist()
    return x, y, side
