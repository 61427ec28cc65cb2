"""Labelled pixels of the train views, the training data of methods, with weights computed once per view."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import scipy.sparse as sp
from jaxtyping import Int32, Int64

from hilsplat.base.errors import ArtifactError
from hilsplat.base.levels import Level
from hilsplat.base.progress import track
from hilsplat.methods.method import MethodInputs

View = TypeVar("View")


@dataclass(frozen=True)
class LabelledView:
    """Covered pixels of one view that are labelled at any level, on the grid of `method.pixel_step`.

    Attributes:
        number: index of the view in the contributions.
        rows: rows of the view's masks in the contributions.
        weights: compositing weights (pixels x Gaussians), rows summing to 1.
        labels: row, among the view's masks, of the mask painted at each pixel and level, -1 for none.
        xy: column and row of each pixel, px.
    """

    number: int
    rows: Int64[np.ndarray, " m"]
    weights: sp.csr_matrix
    labels: Int32[np.ndarray, "p 3"]
    xy: Int64[np.ndarray, "p 2"]

    def __len__(self) -> int:
        return len(self.labels)

    def chosen(self, pixels: Int64[np.ndarray, " q"]) -> "LabelledView":
        """Return the given pixels, in that order."""
        return LabelledView(
            self.number, self.rows, self.weights[pixels], self.labels[pixels], self.xy[pixels]
        )

    def at(self, level: Level) -> Int64[np.ndarray, " q"]:
        """Return the pixels labelled at a level, in order."""
        return np.flatnonzero(self.labels[:, level.index] >= 0)


def labelled_views(inputs: MethodInputs, pixel_step: int) -> list[LabelledView]:
    """Return the labelled pixels of all train views that have any.

    Raises:
        ArtifactError: no view has a labelled pixel.
    """
    found = []
    rows = inputs.contributions.rows_of_views()
    for number, name in enumerate(track(list(inputs.contributions.views), "weights of views")):
        weights, labels = inputs.view_weights(name), inputs.view_labels(name)
        size_hw = inputs.view_camera(name).size_hw
        grid = grid_pixels(size_hw, pixel_step)
        covered = np.diff(weights.indptr)[grid] > 0
        pixels = grid[covered & (labels[grid] >= 0).any(axis=1)]
        row, column = np.divmod(pixels, size_hw[1])
        if len(pixels):
            xy = np.stack([column, row], axis=1)
            found.append(LabelledView(number, rows[number], weights[pixels], labels[pixels], xy))
    if not found:
        raise ArtifactError(
            f"no train view has a pixel on a grid of {pixel_step} px that a mask labels",
            fix="reduce method.pixel_step, or loosen masks.predicted_iou_min and run the masks stage again",
        )
    return found


def in_random_order(views: Sequence[View], random: np.random.Generator) -> Iterator[View]:
    """Yield views without end, each once before any is repeated."""
    while True:
        for number in random.permutation(len(views))[::-1]:
            yield views[number]


def grid_pixels(size_hw: tuple[int, int], step: int) -> Int64[np.ndarray, " p"]:
    """Return the row-major indices of every `step`-th pixel of every `step`-th row."""
    rows, columns = np.arange(0, size_hw[0], step), np.arange(0, size_hw[1], step)
    return (rows[:, None] * size_hw[1] + columns[None]).ravel()
