"""Masks, cameras, labelled regions and rows of scores for the tests of this folder."""

import numpy as np

from hilsplat.datasets.labelled import LabelledRegion
from hilsplat.evaluate.scores import Score
from hilsplat.scene.cameras import Cameras
from hilsplat.segment.masks import HierarchicalMasks


def box(rows, columns, size_hw=(10, 10)):
    """A mask of half-open row and column ranges."""
    mask = np.zeros(size_hw, dtype=bool)
    mask[slice(*rows), slice(*columns)] = True
    return mask


def region_of(mask, text, level=None, path=(), boxes=None):
    """A labelled region with a given mask."""
    return LabelledRegion(text, mask.shape, lambda: mask, boxes, level, path or (text,))


def masks_of(regions, levels):
    """Masks of one view with given regions."""
    ones = np.ones(len(regions), np.float32)
    return HierarchicalMasks.from_dense(np.stack(regions), np.array(levels, np.uint8), ones, ones)


def cameras_of(poses, K, size_hw):
    """Cameras 000.png, 001.png ... with the same intrinsics."""
    n = len(poses)
    names = tuple(f"{row:03d}.png" for row in range(n))
    return Cameras(names, np.stack(poses), np.stack([K] * n), np.tile(np.int32(size_hw), (n, 1)))


def score(metric, value, **more):
    """A row of scores; by default of the tree, for one text in one view of a synthetic scene."""
    fields = {
        "dataset": "synthetic",
        "scene": "one",
        "variant": "default",
        "masks": "sam-tiny",
        "method": "tree",
        "view": "v.png",
        "query": "cup",
        "level": "whole",
        "protocol": "hierarchy/level-given@6",
        "n": 1,
    }
    return Score(**{**fields, **more}, metric=metric, value=value)
