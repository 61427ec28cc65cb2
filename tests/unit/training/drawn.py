"""Views of flat shapes with labels, for tests that need no renderer."""

import numpy as np

from hilsplat.segment.masks import HierarchicalMasks
from models.training.data import LabelledNode, LabelledViews
from tests.unit.segment.handmade import pack


def drawn_views(count: int, size: int, seed: int = 0) -> LabelledViews:
    """Discs (whole) with a right half (part) and an inner square in it (subpart), in colours of their own.

    Every view has two discs: a red one, whose parts are named, and a green one without parts.
    """
    images = np.full((count, size, size, 3), 90, np.uint8)
    labels = np.full((count, 3, size, size), -1, np.int16)
    y, x = np.mgrid[0:size, 0:size]
    for view in range(count):
        rng = np.random.default_rng((seed, view))
        images[view] += rng.integers(0, 20, (size, size, 1), dtype=np.uint8)
        radius = size / 5
        for node, side in ((0, 0.28), (3, 0.72)):
            cx, cy = size * side + rng.normal(0, size / 60), size * rng.uniform(0.3, 0.7)
            disc = (x - cx) ** 2 + (y - cy) ** 2 < radius**2
            images[view][disc] = (200, 40, 40) if node == 0 else (40, 180, 60)
            labels[view, 0][disc] = node
            if node == 0:
                half = disc & (x > cx)
                spot = half & (x < cx + radius / 2) & (abs(y - cy) < radius / 3)
                images[view][half] = (240, 160, 40)
                images[view][spot] = (20, 20, 20)
                labels[view, 1][half] = 1
                labels[view, 2][spot] = 2
    nodes = (
        LabelledNode(1, -1, ("ball", "red ball")),
        LabelledNode(2, 0, ("ball half", "half of the ball")),
        LabelledNode(3, 1, ("ball spot",)),
        LabelledNode(1, -1, ("coin", "green coin")),
    )
    return LabelledViews(images, labels, (nodes,) * count)


def drawn_masks(*masks_of_level: tuple[int, np.ndarray]) -> HierarchicalMasks:
    """Masks of a view, given with their levels; all scores are 1."""
    level, masks = zip(*masks_of_level, strict=True)
    return pack(np.stack(masks), level)
