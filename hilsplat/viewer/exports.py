"""Content of exported files (Gaussians, masks of all views, films), and crops of nodes."""

import io
import json
import zipfile
from collections.abc import Generator, Iterable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from jaxtyping import Int32, Int64, UInt8
from PIL import Image

from hilsplat.query.language_scene import LanguageScene
from hilsplat.scene.cameras import Camera
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.export import write_selection_ply
from hilsplat.splat.flyaround import FRAMES_PER_S, closed_path, encoded_film, open_path
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.rasterise.cpu import blend_forward, project_gaussians
from hilsplat.viewer.frames import Paint, painted
from hilsplat.viewer.wire import Film, Group
from hilsplat.web.coco import coco_content, coco_region

STEP = {"mp4": 1, "gif": 2}
"""Frame step of each format. GIFs use every second frame; with all frames, they are far larger than MP4s."""
CROP_PX = 160
CROP_MARGIN = 0.15
LEAST_ALPHA = 0.1
"""Minimum alpha assumed in deciding whether a crop's pixel shows the node; enlarged Gaussians leave gaps."""
DIMMED, GROUND = 0.2, 110.0
"""Weight of a crop's photograph outside the node, and the grey value that it is blended with."""

Steps = Generator[tuple[int, int], None, bytes]
"""Generator that creates a file: it yields (steps done, total), starting at 0, and returns the file."""


def labelled(
    scene: LanguageScene, groups: Sequence[Group]
) -> tuple[Int64[np.ndarray, " g"], Int32[np.ndarray, " g"]]:
    """Return the rows of all groups' Gaussians in ascending order, and each row's group, numbered from 1.

    A Gaussian in several groups is assigned to the one with the fewest Gaussians.
    """
    members = [scene.gaussians_of(group.nodes) for group in groups]
    label = np.zeros(len(scene.gaussians), np.int32)
    for number in sorted(range(len(groups)), key=lambda number: -len(members[number])):
        label[members[number]] = number + 1
    rows = np.flatnonzero(label)
    return rows, label[rows]


def selection_ply(gaussians_ply: Path, scene: LanguageScene, groups: Sequence[Group]) -> bytes:
    """Return the groups' Gaussians as a 3DGS PLY, with group labels."""
    rows, labels = labelled(scene, groups)
    with TemporaryDirectory() as folder:
        out = Path(folder) / "selection.ply"
        write_selection_ply(gaussians_ply, rows, out, labels, [group.name for group in groups])
        return out.read_bytes()


def masks_zip(scene: LanguageScene, groups: Sequence[Group]) -> Steps:
    """Make a ZIP of node masks in all views: one PNG per visible node and view, and one COCO file.

    Groups are the COCO categories; a node in several groups has one annotation per group.
    """
    nodes = sorted({node for group in groups for node in group.nodes})
    yield 0, len(scene.views)
    held = io.BytesIO()
    description = f"{scene.scene.name}: masks of nodes, by hilsplat"
    coco = coco_content(description, scene.views, scene.scene.cameras, [group.name for group in groups])
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        for number, view in enumerate(scene.views):
            for node in nodes:
                mask = scene.node_masks(view, [node])
                if not mask.any():
                    continue
                png = io.BytesIO()
                Image.fromarray(mask).save(png, format="PNG")
                name = f"masks/{Path(view).stem}/{node}.png"
                archive.writestr(name, png.getvalue(), compress_type=zipfile.ZIP_STORED)
                described = {"image_id": number, "node": node, **coco_region(mask)}
                for category, group in enumerate(groups, 1):
                    if node in group.nodes:
                        found = {"id": len(coco["annotations"]) + 1, "category_id": category}
                        coco["annotations"].append({**found, **described})
            yield number + 1, len(scene.views)
        archive.writestr("coco.json", json.dumps(coco, ensure_ascii=False))
    return held.getvalue()


def crop(scene: LanguageScene, node: int, threads: int = 1) -> UInt8[np.ndarray, "S S 3"]:
    """Return a square crop of the photograph in which a node is largest, with the rest dimmed towards grey.

    To find the node's pixels, only the square is rendered, with a camera whose image is that square.
    """
    tree = scene.tree
    view = tree.view_names[int(tree.view_area_px[node].argmax())]
    camera, photograph = scene.scene.cameras[view], scene.image(view)
    rows = scene.gaussians_of([node])
    x, y, side = _square_around(scene.gaussians.means[rows], camera)
    shift = np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1.0]])
    scale = np.diag([CROP_PX / side, CROP_PX / side, 1.0])
    inside = Camera("crop", camera.cam_from_world, scale @ shift @ camera.K, (CROP_PX, CROP_PX))
    member = np.zeros((len(scene.gaussians), 1), np.float32)
    member[rows] = 1
    drawn = project_gaussians(scene.gaussians, inside, 0, threads)
    shares, alpha = blend_forward(drawn, member, threads)
    is_node = shares[..., 0] > 0.5 * np.maximum(alpha, LEAST_ALPHA)
    pixels = resampled(photograph, x, y, side)
    around = pixels * DIMMED + (1 - DIMMED) * GROUND
    return np.where(is_node[..., None], pixels, around.astype(np.uint8))


def resampled(image: UInt8[np.ndarray, "H W 3"], x: float, y: float, side: float) -> np.ndarray:
    """Resample the square (x, y, side) of an image to `CROP_PX` px; pixels outside the image are black."""
    shrink = max(1.0, side / CROP_PX)  # warping does not average areas, so shrink first
    if shrink > 1:
        image = cv2.resize(image, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)
    scale = CROP_PX * shrink / side
    # Pixel centres are at 0.5 here, but at 0 in OpenCV.
    move = np.array([[scale, 0, -scale * x / shrink], [0, scale, -scale * y / shrink]])
    move[:, 2] += 0.5 * scale - 0.5
    return cv2.warpAffine(image, move, (CROP_PX, CROP_PX), flags=cv2.INTER_LINEAR)


def _square_around(points: np.ndarray, camera: Camera) -> tuple[float, float, float]:
    """Return the left edge, top edge and side length, px, of a square around most of the points."""
    local = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    local = local[local[:, 2] > 0.01]
    height, width = camera.size_hw
    if not len(local):
        return 0.0, 0.0, float(max(height, width))
    places = local @ camera.K.T
    xy = places[:, :2] / places[:, 2:]
    low, high = np.percentile(xy, (3, 97), axis=0)
    low, high = np.clip(low, 0, (width, height)), np.clip(high, 0, (width, height))
    side = float((high - low).max()) * (1 + 2 * CROP_MARGIN) + 4
    x, y = ((low + high) / 2 - side / 2).tolist()
    return x, y, side


def flight(asked: Film, scene: Scene) -> list[Camera]:
    """Return one camera per frame: along the film's path, or along a tour of the training cameras."""
    if len(asked.path) > 1:
        path = open_path([camera.camera() for camera in asked.path], asked.frames)
    else:
        views = scene.views("train") or scene.views()
        path = closed_path([scene.cameras[view] for view in views], asked.frames)
    height, width = path[0].size_hw
    scale = asked.side_px / max(height, width)
    size_hw = (max(2, round(height * scale / 2) * 2), max(2, round(width * scale / 2) * 2))
    return [camera.scaled(size_hw) for camera in path]


def film(
    gaussians: Gaussians, cameras: Sequence[Camera], paint: Paint | None, *, kind: str, threads: int
) -> Steps:
    """Make a film in one step per frame, in the colours of a style (None: the scene's own colours).

    Each frame has one camera, with an even image size; a GIF uses every second camera.
    """
    used = cameras[:: STEP[kind]]
    yield 0, len(used)
    pictures = (painted(gaussians, camera, paint, threads) for camera in used)
    with TemporaryDirectory() as folder:
        out = Path(folder) / f"film.{kind}"
        encoded = encoded_film(out, pictures, FRAMES_PER_S) if kind == "mp4" else encoded_gif(out, pictures)
        for made, _ in enumerate(encoded, 1):
            yield made, len(used)
        return out.read_bytes()


def encoded_gif(path: Path, frames: Iterable[np.ndarray]) -> Iterator[None]:
    """Write a looping GIF with 256 colours chosen from the whole film, yielding after each frame.

    Dithering is off: on a synthetic table (128 colours) it lowered the quality from 41 dB to 35 dB, increased
    the size from 2.5 MB to 3.6 MB, and scattered dots over the answer.
    """
    kept = []
    for frame in frames:
        kept.append(frame)
        yield
    some = min(len(kept), 8)
    sheet = np.concatenate([kept[number * len(kept) // some] for number in range(some)])
    palette = Image.fromarray(sheet).quantize(256)
    first, *others = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in kept
    ]
    duration_ms = round(1000 * STEP["gif"] / FRAMES_PER_S)
    first.save(path, save_all=True, append_images=others, duration=duration_ms, loop=0, optimize=False)
