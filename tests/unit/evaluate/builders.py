"""Masks, cameras, labelled regions and rows of scores for the tests of this folder."""

from types import SimpleNamespace

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


class HandMade:
    """Given answers: nodes, rows of `masks`, by text or path and level; relevancy maps by text.

    `scene_wide` contains those answers that differ if the whole scene is searched.
    """

    def __init__(self, masks, answers, relevancy=None, size_hw=(10, 10)):
        self.masks, self.answers, self.maps, self.scene_wide = masks, answers, relevancy or {}, {}
        self.size_hw = size_hw
        self.views, self.field = self, self

    def relevancy(self, texts, view):
        return np.stack([self.maps.get(text, np.zeros((3, *self.size_hw), np.float32)) for text in texts])

    def cosine(self, texts, view, pixels):
        return self.relevancy(texts, view).reshape(len(texts), 3, -1)[..., pixels]

    node_relevancy_map, node_cosine = relevancy, cosine

    def select(self, path, *, level=None, view=None):
        answers = self.answers if view == "v.png" else self.answers | self.scene_wide
        found = answers.get(path, answers.get((path[0], level), []) if len(path) == 1 else [])
        return SimpleNamespace(ids=np.array(found, dtype=np.int64), level=level)

    def node_masks(self, view, ids):
        return np.any([self.masks[node] for node in ids], axis=0)
