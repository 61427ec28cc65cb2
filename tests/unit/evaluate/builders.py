"""Masks, labelled regions and rows of scores for the tests of this folder."""

import numpy as np

from hilsplat.datasets.labelled import LabelledRegion
from hilsplat.evaluate.scores import Score


def box(rows, columns, size_hw=(10, 10)):
    """A mask of half-open row and column ranges."""
    mask = np.zeros(size_hw, dtype=bool)
    mask[slice(*rows), slice(*columns)] = True
    return mask


def region_of(mask, text, level=None, path=(), boxes=None):
    """A labelled region with a given mask."""
    return LabelledRegion(text, mask.shape, lambda: mask, boxes, level, path or (text,))


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
        "protocol": "hierarchy/level-given@5",
        "n": 1,
    }
    return Score(**{**fields, **more}, metric=metric, value=value)
