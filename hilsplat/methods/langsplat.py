"""LangSplat: an independent field per level, L1 between rendered and painted codes, no tree.

The published code renders a random view per step, each view once before any is repeated, and compares every
labelled pixel (minghanqin/LangSplat `train.py`). Geometry is frozen, so rendering is a product with fixed
compositing weights, which we compute once per view.

Departs from the published code:
    - fewer steps, and a grid of pixels instead of all (`MethodSettings`);
    - L1 is averaged over the labelled pixels of the grid; LangSplat averages over all pixels, unlabelled
      ones counting as 0, so the weight of a view's step grows with the area of its masks;
    - rendered codes are divided by alpha, as a query sees them, and pixels of alpha below `MIN_ALPHA`
      are left out; LangSplat compares premultiplied codes wherever a mask is painted;
    - codes of Gaussians are blended without scaling; LangSplat scales each to unit length first;
    - weights below `contributions.min_weight` are dropped.

`hilsplat.field.reference_trainer` (loss `l1`) renders at every step, and averages over all pixels as
LangSplat does. It is a different trainer, not this one with more steps: it draws views with replacement and
trains the levels in one run. It treats alpha and unit length as this one does.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32, Int32, Int64

from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.progress import track
from hilsplat.methods.method import Method, MethodInputs
from hilsplat.settings import MethodSettings

BETAS = (0.9, 0.999)
EPS = 1e-15
"""As in the published optimiser."""


@dataclass(frozen=True)
class LevelPixels:
    """Labelled pixels of one view at one level.

    Attributes:
        weights: their compositing weights (pixels x Gaussians), rows summing to 1.
        targets: code of the mask painted at each pixel.
    """

    weights: sp.csr_matrix
    targets: Float32[np.ndarray, "p D"]


@dataclass(frozen=True)
class ViewPixels:
    """Covered pixels of one view that are labelled at any level.

    Most are labelled at all levels, so their weights are held once.

    Attributes:
        weights: their compositing weights (pixels x Gaussians), rows summing to 1.
        labels: row of the mask painted there at each level, -1 for none.
        latents: code of each mask of the view.
    """

    weights: sp.csr_matrix
    labels: Int32[np.ndarray, "p 3"]
    latents: Float32[np.ndarray, "m D"]

    @staticmethod
    def of(
        weights: sp.csr_matrix,
        labels: Int32[np.ndarray, "P 3"],
        latents: Float32[np.ndarray, "m D"],
        grid: Int64[np.ndarray, " p"],
    ) -> "ViewPixels":
        """Choose the pixels of a grid from all P of a view."""
        covered = np.diff(weights.indptr)[grid] > 0
        pixels = grid[covered & (labels[grid] >= 0).any(axis=1)]
        return ViewPixels(weights[pixels], labels[pixels], latents)

    def is_labelled(self, level: Level) -> bool:
        """Whether any pixel shows a mask of the level."""
        return bool((self.labels[:, level.index] >= 0).any())

    def at(self, level: Level) -> LevelPixels:
        """Copy the pixels that a level labels, in order."""
        rows = np.flatnonzero(self.labels[:, level.index] >= 0)
        return LevelPixels(self.weights[rows], self.latents[self.labels[rows, level.index]])


class ViewQueue:
    """Views in random order, each once before any is repeated."""

    def __init__(self, views: list[ViewPixels], seed: int) -> None:
        self._views, self._order, self._queue = views, np.random.default_rng(seed), list[int]()

    def next(self) -> ViewPixels:
        """The view of the next step."""
        if not self._queue:
            self._queue = list(self._order.permutation(len(self._views)))
        return self._views[self._queue.pop()]


def views_of(inputs: MethodInputs, pixel_step: int) -> list[ViewPixels]:
    """Labelled pixels of every train view, on a grid."""
    contributions, views = inputs.contributions, []
    for number, view in enumerate(track(list(contributions.views), "weights of views")):
        grid = grid_pixels(inputs.view_size_hw(view), pixel_step)
        own = inputs.latents[contributions.view == number]
        views.append(ViewPixels.of(inputs.view_weights(view), inputs.view_labels(view), own, grid))
    return views


def l1_step(
    features: Float32[np.ndarray, "N D"], pixels: LevelPixels
) -> tuple[float, Float32[np.ndarray, "N D"]]:
    """Mean absolute difference of rendered and painted codes, and its gradient by the features."""
    apart = pixels.weights @ features - pixels.targets
    scale = np.float32(1 / max(apart.size, 1))
    gradient = pixels.weights.T @ (np.sign(apart) * scale)
    return float(np.abs(apart).sum(dtype=np.float64) * scale), gradient.astype(np.float32)


def train_level(
    views: list[ViewPixels], level: Level, num_gaussians: int, settings: MethodSettings, seed: int
) -> Float32[np.ndarray, "N D"]:
    """Train by Adam from zero, one random view per step, each once before any is repeated.

    Args:
        views: train views in which the level labels a pixel, at least one.
        level: the level to train.
        num_gaussians: N.
        settings: steps and rate.
        seed: for the order of views.
    """
    features = np.zeros((num_gaussians, views[0].latents.shape[1]), np.float32)
    first, second = np.zeros_like(features), np.zeros_like(features)
    queue = ViewQueue(views, seed)
    for step in range(1, settings.steps + 1):
        _, gradient = l1_step(features, queue.next().at(level))
        first += (1 - BETAS[0]) * (gradient - first)
        second += (1 - BETAS[1]) * (gradient * gradient - second)
        mean, spread = first / (1 - BETAS[0] ** step), second / (1 - BETAS[1] ** step)
        features -= settings.rate * mean / (np.sqrt(spread) + EPS)
    return features


def fit(inputs: MethodInputs, settings: MethodSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Train the three levels one after the other, each with its own seed."""
    views = views_of(inputs, settings.pixel_step)
    num_gaussians = inputs.contributions.num_gaussians
    features = np.zeros((num_gaussians, len(LEVELS), inputs.latents.shape[1]), np.float32)
    for level in track(list(LEVELS), "levels trained"):
        if labelled := [view for view in views if view.is_labelled(level)]:
            features[:, level.index] = train_level(
                labelled, level, num_gaussians, settings, seed + level.index
            )
    return features


def grid_pixels(size_hw: tuple[int, int], step: int) -> Int64[np.ndarray, " p"]:
    """Row-major indices of every `step`-th pixel of every `step`-th row."""
    rows, columns = np.arange(0, size_hw[0], step), np.arange(0, size_hw[1], step)
    return (rows[:, None] * size_hw[1] + columns[None]).ravel()


METHOD = Method(
    "langsplat",
    "LangSplat",
    "minghanqin/LangSplat train.py; departs: fewer steps, pixels of a grid, L1 averaged over labelled pixels "
    "in place of all, rendered codes divided by alpha and thinly covered pixels left out, codes of Gaussians "
    "not scaled to unit length, small compositing weights dropped",
    fit,
)
