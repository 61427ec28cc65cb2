"""A small world drawn by hand, written as the world stage writes it."""

import numpy as np
import pytest

from hilsplat.base.images import write_png
from hilsplat.base.levels import Level
from hilsplat.datasets.hierarchy import AnnotatedNode, write_hierarchy
from hilsplat.scene.cameras import Cameras
from tests.unit.datasets.writers.labelled import TrueWorld

SIZE = (24, 40)
NAMES = tuple(f"{row:03d}.png" for row in range(4))
NODES = (
    AnnotatedNode(0, 1, -1, "bear"),
    AnnotatedNode(1, 2, 0, "head"),
    AnnotatedNode(2, 2, 0, "paw"),
    AnnotatedNode(3, 2, 0, "paw"),
    AnnotatedNode(4, 3, 1, "nose"),
    AnnotatedNode(5, 1, -1, "Ring"),
    AnnotatedNode(6, 1, -1, "table"),
)


def draw_labels(view: int) -> dict[Level, np.ndarray]:
    """A bear of 12 x 16 px with a head, two paws and a nose, moved by the number of the view; a ring."""
    labels = np.full((3, *SIZE), -1, np.int32)
    left = 2 + view
    labels[0] = 6
    labels[0, 6:18, left : left + 16] = 0
    labels[1, 6:12, left : left + 16] = 1
    labels[1, 14:18, left : left + 4] = 2
    labels[1, 14:18, left + 10 : left + 16] = 3
    labels[2, 8:10, left + 6 : left + 9] = 4
    if view != 3:  # the last view does not show it
        labels[0, 5:14, 26:35] = 5
        labels[0, 8:11, 29:32] = 6  # the hole shows the table
    return {level: labels[level.index] for level in Level}


@pytest.fixture
def true_world(tmp_path) -> TrueWorld:
    """Write images, annotations and cameras to a folder; the table is not annotated."""
    folder, generator = tmp_path / "world", np.random.default_rng(0)
    labels, annotated = {}, {}
    poses = np.tile(np.eye(4), (len(NAMES), 1, 1))
    for row, name in enumerate(NAMES):
        write_png(folder / "images" / name, generator.integers(0, 256, (*SIZE, 3), dtype=np.uint8))
        labels[name] = draw_labels(row)
        annotated[name] = tuple(range(6)) if row != 3 else tuple(range(5))
        angle = 0.1 * row
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        poses[row, :3, :3] = turn @ np.diag([1.0, -1.0, -1.0])
        poses[row, :3, 3] = [0.5 * row, 1.0, 4.0]
    K = np.array([[50.0, 0, 20], [0, 50.0, 12], [0, 0, 1]])
    cameras = Cameras(NAMES, poses, np.tile(K, (4, 1, 1)), np.tile(np.int32(SIZE), (4, 1)))
    write_hierarchy(folder / "truth", NODES, labels, annotated)
    cameras.save(folder / "truth" / "cameras.npz")
    return TrueWorld.open(folder)
