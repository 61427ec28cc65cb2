"""Parts of figures: answer overlays, relevancy colours, and a top-down map of the scene."""

from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hilsplat.base.atomic import atomic_path
from hilsplat.base.images import WEBP
from hilsplat.base.levels import Level
from hilsplat.base.ownership import SOFTWARE
from hilsplat.query.scene_views import upright
from hilsplat.scene.cameras import Cameras
from hilsplat.splat.gaussians import Gaussians, base_rgb

ANSWER_RGB = (255, 122, 0)
TRUTH_RGB = (0, 230, 255)
RELEVANCY_COLOURS = "inferno"

DPI = 110
TITLE_LETTERS = 110  # maximum number of characters per line of a panel's title
MAX_POINTS = 30_000  # maximum number of Gaussians drawn in a top-down map


def grey(image: UInt8[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """Return a photograph's luminance, 0 to 255, as an unobtrusive background."""
    luminance = image @ np.array([0.299, 0.587, 0.114])
    return np.repeat(luminance[..., None], 3, axis=2)


def outline(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Return a line along the inner border of a mask that is visible at any image size."""
    import cv2

    width_px = max(1, round(max(mask.shape) / 256))
    kernel = np.ones((2 * width_px + 1, 2 * width_px + 1), np.uint8)
    inner = cv2.erode(mask.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=(1.0,))
    return mask & (inner == 0)


def paint_answer(
    image: UInt8[np.ndarray, "H W 3"],
    answer: Bool[np.ndarray, "H W"] | None,
    truth: Bool[np.ndarray, "H W"] | None = None,
) -> UInt8[np.ndarray, "H W 3"]:
    """Paint an answer in orange over the dimmed photograph, and outline the ground-truth region in cyan."""
    if answer is None:
        painted = image.astype(float)
    else:
        painted = np.where(
            answer[..., None], 0.4 * image + 0.6 * np.array(ANSWER_RGB), 0.25 * image + 0.4 * grey(image)
        )
        painted[outline(answer)] = ANSWER_RGB
    if truth is not None:
        painted[outline(truth)] = TRUTH_RGB
    return painted.clip(0, 255).astype(np.uint8)


def paint_relevancy(
    image: UInt8[np.ndarray, "H W 3"], relevancy: Float[np.ndarray, "H W"], low: float, high: float
) -> UInt8[np.ndarray, "H W 3"]:
    """Paint relevancy over the grey photograph; the colours span `low` to `high`."""
    stretched = np.clip((relevancy - low) / max(high - low, 1e-6), 0, 1)
    colours = colormaps[RELEVANCY_COLOURS](stretched)[..., :3] * 255
    return (0.78 * colours + 0.22 * grey(image)).clip(0, 255).astype(np.uint8)


def show(axes: Axes, picture: UInt8[np.ndarray, "H W 3"], title: str = "", bold: bool = False) -> None:
    """Show a picture without ticks."""
    axes.imshow(picture, interpolation="nearest" if max(picture.shape[:2]) < 300 else "antialiased")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set(linewidth=2.0 if bold else 0.5, color="#ff7a00" if bold else "#888888")
    # Titles contain queries and user-given names, in which a dollar sign must not start a formula.
    axes.set_title(title, fontsize=8, pad=3, fontweight="bold" if bold else "normal", parse_math=False)


def label_left(axes: Axes, text: str, level: Level | None = None, letters: int = 40) -> None:
    """Write the name of a row of pictures along the left side of its first picture, `letters` to a line."""
    lines = [*wrap(text, letters), *([level.label] if level else [])]
    axes.set_ylabel("\n".join(lines), fontsize=8, parse_math=False)


def show_from_above(
    axes: Axes, gaussians: Gaussians, cameras: Cameras, selected: Bool[np.ndarray, " N"], title: str
) -> None:
    """Draw the scene from above, with selected Gaussians in orange and cameras as triangles."""
    means = gaussians.means.astype(np.float64)
    centres = np.stack([cameras[name].centre for name in cameras.names])
    rotation = _from_above(cameras)
    flat, flat_cameras = means @ rotation.T, centres @ rotation.T
    low, high = np.percentile(flat[:, :2], (1, 99), axis=0)
    low, high = np.minimum(low, flat_cameras[:, :2].min(0)), np.maximum(high, flat_cameras[:, :2].max(0))
    colours = 0.5 * base_rgb(gaussians.sh) + 0.45
    visible = np.flatnonzero((gaussians.opacities > 0.3) & ~selected)
    drawn = visible[:: max(1, len(visible) // MAX_POINTS)]
    drawn = drawn[np.argsort(flat[drawn, 2], kind="stable")]
    axes.scatter(flat[drawn, 0], flat[drawn, 1], s=1.5, c=colours[drawn].clip(0, 1), linewidths=0)
    axes.scatter(flat[selected, 0], flat[selected, 1], s=4, color="#ff7a00", linewidths=0)
    axes.scatter(flat_cameras[:, 0], flat_cameras[:, 1], s=10, color="#333333", marker="^", linewidths=0)
    margin = 0.05 * (high - low).max()
    (left, bottom), (right, top) = low - margin, high + margin
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[])
    axes.set_title(title, fontsize=8, pad=3, parse_math=False)


def _from_above(cameras: Cameras) -> Float[np.ndarray, "3 3"]:
    """Return the rotation whose third axis is the cameras' mean up direction."""
    up = upright(cameras)
    right = cameras.cam_from_world[0, 0, :3]
    right = right - (right @ up) * up
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


PNG = {"compress_level": 4}
"""Options of Pillow, which take half the time of the default (6), for 4 % more bytes."""


def save_figure(figure: Figure, out: Path) -> None:
    """Write a PNG or WebP atomically; a PNG's metadata names this package instead of Matplotlib's version."""
    is_png = out.suffix == ".png"
    options: dict[str, Any] = {"format": out.suffix[1:], "pil_kwargs": PNG if is_png else WEBP}
    with atomic_path(out) as temporary:
        metadata = SOFTWARE if is_png else None
        figure.savefig(temporary, dpi=DPI, facecolor="white", metadata=metadata, **options)


def save_with_pdf(figure: Figure, out: Path) -> None:
    """Write a PNG or WebP and, beside it, a PDF; identical figures produce identical bytes."""
    for part in figure.subfigs:  # by chance, the layout puts a corner of its background at 0 or at -0
        part.patch.set_visible(False)
    save_figure(figure, out)
    with atomic_path(Path(out).with_suffix(".pdf")) as temporary:
        about = {"Creator": None, "Producer": None, "CreationDate": None}
        figure.savefig(temporary, format="pdf", dpi=DPI, facecolor="white", metadata=about)
