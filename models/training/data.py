"""Training data of the small models: rendered views with labels, cut into windows with targets."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, Shaped, UInt8
from scipy import ndimage

from models.training.export import MEAN, STD
from models.training.sam import HEADS, UNIT_PX


@dataclass(frozen=True)
class LabelledNode:
    """A node of a training scene: its level, parent (-1: none) and the phrases that name it."""

    level: int
    parent: int
    phrases: tuple[str, ...]


@dataclass(frozen=True)
class LabelledViews:
    """V rendered views with exact labels."""

    images: UInt8[np.ndarray, "V S S 3"]
    labels: np.ndarray  # (V, 3, S, S) node id per view, level (whole, part, subpart) and pixel, -1 for none
    nodes: tuple[tuple[LabelledNode, ...], ...]  # for each view, the nodes of its scene by id

    def __len__(self) -> int:
        return len(self.images)

    def spread(self, count: int) -> "LabelledViews":
        """Return at most `count` of the views, evenly spaced."""
        rows = np.linspace(0, len(self) - 1, min(count, len(self)))
        return self.chosen(np.unique(rows.round().astype(int)))

    def chosen(self, rows: Sequence[int] | Int[np.ndarray, " v"]) -> "LabelledViews":
        return LabelledViews(self.images[rows], self.labels[rows], tuple(self.nodes[row] for row in rows))


def normalised(images: Shaped[np.ndarray, "B H W 3"]) -> Float32[np.ndarray, "B 3 H W"]:
    """Normalise pixels in [0, 255] for the networks and move channels first."""
    scale = (1 / (255 * np.array(STD))).astype(np.float32)
    shift = (np.array(MEAN) / np.array(STD)).astype(np.float32)
    return np.ascontiguousarray((images * scale - shift).transpose(0, 3, 1, 2))


def recolour(rng: np.random.Generator, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Vary exposure, white balance, contrast, saturation, gamma, vignette, blur and noise at random."""
    size = image.shape[:2]
    if rng.random() < 0.15:
        small = cv2.resize(image, (size[1] // 2, size[0] // 2), interpolation=cv2.INTER_AREA)
        image = cv2.resize(small, (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
    elif rng.random() < 0.25:
        image = cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.3, 1.0)))
    values = image.astype(np.float32)
    gain = rng.normal(1.0, 0.06) * rng.normal(1.0, 0.03, 3)
    middle = float(values.mean())
    contrast = rng.normal(1.0, 0.08)
    values = (values - middle) * contrast + middle
    grey = values.mean(axis=2, keepdims=True)
    values = grey + (values - grey) * np.float32(max(0.0, rng.normal(1.0, 0.15)))
    if rng.random() < 0.3:
        gamma = float(np.exp(rng.normal(0, 0.15)))
        values = 255 * (values.clip(0, 255) / 255) ** np.float32(gamma)
    if rng.random() < 0.2:
        y, x = np.ogrid[-1 : 1 : size[0] * 1j, -1 : 1 : size[1] * 1j]
        values = values * (1 - rng.uniform(0.05, 0.25) * (x * x + y * y) / 2).astype(np.float32)[..., None]
    values = values * gain.astype(np.float32)
    if rng.random() < 0.4:
        values += rng.normal(0, rng.uniform(1, 6), image.shape).astype(np.float32)
    return np.clip(values + 0.5, 0, 255).astype(np.uint8)


def cut_window(
    rng: np.random.Generator,
    image: UInt8[np.ndarray, "H W 3"],  # a square view
    labels: np.ndarray,  # (3, H, W) node ids
    size: int,
) -> tuple[UInt8[np.ndarray, "S S 3"], np.ndarray, tuple[float, float, float]]:
    """Cut a random square from a view, possibly mirrored and scaled by up to a quarter.

    `size` is the side of the window in network pixels; the window is the whole view if `size` is at least the
    view's side.

    Returns:
        Pixels and labels of the window, and its position in the view (x0, y0, side as shares).
    """
    full = image.shape[0]
    factor = float(np.exp(rng.uniform(-0.22, 0.25)))
    side = min(full, max(16, round(size / factor)))
    x0, y0 = int(rng.integers(0, full - side + 1)), int(rng.integers(0, full - side + 1))
    image = image[y0 : y0 + side, x0 : x0 + side]
    labels = labels[:, y0 : y0 + side, x0 : x0 + side]
    if rng.random() < 0.5:
        image, labels, x0 = image[:, ::-1], labels[..., ::-1], full - side - x0
    if side != size:
        image = cv2.resize(np.ascontiguousarray(image), (size, size), interpolation=cv2.INTER_LINEAR)
        nearest = ((np.arange(size) + 0.5) * side / size).astype(np.int64)
        labels = labels[:, nearest][:, :, nearest]
    window = (x0 / full, y0 / full, side / full)
    return np.ascontiguousarray(image), np.ascontiguousarray(labels), window


def nested_targets(labels: np.ndarray) -> np.ndarray:
    """Return the node id per pixel and head (subpart, part, whole).

    If a pixel has no subpart, its subpart is its part; if it has no part, its part is its whole. `labels`:
    (3, H, W) node ids, whole, part, subpart; -1 for none. Ids differ between levels.
    """
    whole, part, subpart = labels
    part = np.where(part >= 0, part, whole)
    return np.stack([np.where(subpart >= 0, subpart, part), part, whole])


def region_centres(
    targets: np.ndarray, spacing_px: int = 1
) -> tuple[Float32[np.ndarray, "6 H W"], Bool[np.ndarray, "3 H W"]]:
    """Return the offset from each pixel to the mean position of its region, and the pixels with a region.

    Offsets are x and y for each head in order, in units of 32 px. `targets` are from `nested_targets`,
    possibly subsampled; `spacing_px` is the distance between the sampled pixels.
    """
    height, width = targets.shape[1:]
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) * spacing_px
    offsets = np.zeros((2 * len(HEADS), height, width), np.float32)
    for head, target in enumerate(targets):
        ids = target.reshape(-1) + 1
        counts = np.bincount(ids).clip(1)
        for axis, coordinates in enumerate((x, y)):
            mean = np.bincount(ids, coordinates.reshape(-1)) / counts
            offsets[2 * head + axis] = (mean[ids].reshape(height, width) - coordinates) / UNIT_PX
    return offsets, targets >= 0


def boxes_of(target: Shaped[np.ndarray, "H W"]) -> dict[int, tuple[int, int, int, int]]:
    """Return the box (x0, y0, x1, y1, end exclusive) of each region of a label image."""
    slices = ndimage.find_objects((target + 1).astype(np.int32))
    return {
        index: (box[1].start, box[0].start, box[1].stop, box[0].stop)
        for index, box in enumerate(slices)
        if box is not None
    }
