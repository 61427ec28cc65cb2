"""A tiny world with two boxes, small enough to work out by hand."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.base.artifacts import read_index, write_index, write_npy, write_npz
from hilsplat.contributions import stage
from hilsplat.segment.digests import index_entry
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.settings import ContributionsSettings
from tests.unit.round_gaussians import round_gaussians
from tests.unit.segment.handmade import pack, save_scene

HEIGHT, WIDTH = 8, 12
NUM_GAUSSIANS = HEIGHT * WIDTH
CHANNELS = 16

REGIONS = (
    # name, level, rows, columns, parent; box A is columns 0-6, box B columns 6-12
    ("A", 1, (0, 8), (0, 6), -1),
    ("B", 1, (0, 8), (6, 12), -1),
    ("A top", 2, (0, 4), (0, 6), 0),
    ("A bottom", 2, (4, 8), (0, 6), 0),
    ("B top", 2, (0, 4), (6, 12), 1),
    ("A top left", 3, (0, 4), (0, 2), 2),
    ("B corner", 3, (6, 8), (6, 9), 1),
)


@dataclass(frozen=True)
class TwoBoxes:
    """Folders of the world, the regions of the masks of each train view, and what only a test may know.

    Gaussian g is seen at pixel (row, column) = divmod(g, WIDTH), moved right by one column (and
    around) per view. Weights are 0.9 there and 0.09 at the left neighbour's Gaussian.
    """

    folder: Path
    regions: dict[str, list[int]]
    region_vectors: np.ndarray
    scene: Path
    masks: Path
    coverage_tree: Path
    clip: Path
    ply: Path

    @property
    def views(self) -> tuple[str, ...]:
        return tuple(self.regions)


def region_mask(row: int) -> np.ndarray:
    _, _, (top, bottom), (left, right), _ = REGIONS[row]
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[top:bottom, left:right] = True
    return mask


def two_boxes_weights(shift: int) -> sp.csr_matrix:
    """Each pixel shows its own Gaussian and a little of the left neighbour of the same row."""
    gaussian = np.arange(NUM_GAUSSIANS).reshape(HEIGHT, WIDTH)
    left = np.roll(gaussian, 1, axis=1)
    pixel = np.arange(NUM_GAUSSIANS)
    seen = np.roll(gaussian, shift, axis=1).ravel()
    beside = np.roll(left, shift, axis=1).ravel()
    data = np.tile(np.array([0.9, 0.09], np.float32), NUM_GAUSSIANS)
    columns = np.stack([seen, beside], axis=1).ravel()
    return sp.csr_matrix((data, (np.repeat(pixel, 2), columns)), shape=(NUM_GAUSSIANS, NUM_GAUSSIANS))


@pytest.fixture
def two_boxes(tmp_path, monkeypatch) -> TwoBoxes:
    """The world, for one test."""
    return build_two_boxes(tmp_path, monkeypatch)


@pytest.fixture
def two_boxes_contributions(two_boxes) -> tuple[TwoBoxes, Path]:
    """The world and its contributions, for one test."""
    return two_boxes, build_contributions(two_boxes)


ONE_DROPPED = tuple(tuple(row for row in range(len(REGIONS)) if row != view + 3) for view in range(4))
"""Regions with a mask in each of four views: one is missed in each."""


def build_two_boxes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, regions: tuple[tuple[int, ...], ...] = ONE_DROPPED
) -> TwoBoxes:
    """A train view with masks of the given regions for each item, and a test view."""
    rng = np.random.default_rng(0)
    names = tuple(f"{view:03d}.png" for view in range(len(regions) + 1))
    black = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    K = np.array([[10.0, 0, 6], [0, 10, 4], [0, 0, 1]])
    scene = save_scene(tmp_path / "scene", dict.fromkeys(names, black), names[-1:], K)
    own = {name: list(rows) for name, rows in zip(names, regions, strict=False)}
    vectors = rng.normal(size=(len(REGIONS), CHANNELS))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    stages = (tmp_path / name for name in ("masks", "coverage_tree", "clip", "gaussians.ply"))
    world = TwoBoxes(tmp_path, own, vectors, scene, *stages)
    entries = {}
    for shift, (view, rows) in enumerate(world.regions.items()):
        dense = np.stack([np.roll(region_mask(row), shift, axis=1) for row in rows])
        masks = pack(dense, [REGIONS[row][1] for row in rows])
        masks.save(world.masks / f"{view}.npz")
        entries[view] = index_entry(masks)
        parent = [rows.index(REGIONS[row][4]) if REGIONS[row][4] in rows else -1 for row in rows]
        write_npz(world.coverage_tree / f"{view}.npz", parent=np.array(parent, np.int32))
        noisy = vectors[rows] + 0.02 * rng.normal(size=(len(rows), CHANNELS))
        noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
        write_npy(world.clip / f"{view}.npy", noisy.astype(np.float16))
    for folder in (world.masks, world.coverage_tree, world.clip):
        write_index(folder, entries, segmenter="sam")
    world.ply.write_bytes(b"two boxes")

    gaussian = np.arange(NUM_GAUSSIANS)
    means = np.stack([gaussian % WIDTH, gaussian // WIDTH, np.zeros(NUM_GAUSSIANS)], axis=1)
    gaussians = round_gaussians(means)
    monkeypatch.setattr(stage, "load_ply", lambda path: gaussians)
    monkeypatch.setattr(
        stage,
        "pixel_weights",
        lambda gaussians, camera, *, min_weight, threads: two_boxes_weights(names.index(camera.name)),
    )
    return world


def build_contributions(world: TwoBoxes) -> Path:
    """Run the contributions stage."""
    out, cache = world.folder / "contributions", world.folder / "cache"
    stage.run_contributions(world.scene, world.ply, world.masks, out, cache, ContributionsSettings(), 1)
    return out


def reverse_masks(world: TwoBoxes, view: str) -> None:
    """Reverse the order of a view's masks, and record their digest in the index."""
    path = world.masks / f"{view}.npz"
    masks = HierarchicalMasks.load(path)
    masks = masks.take(np.arange(len(masks))[::-1])
    masks.save(path)
    index = read_index(world.masks)
    write_index(world.masks, {**index.pop("views"), view: index_entry(masks)}, **index)
