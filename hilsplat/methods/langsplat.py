"""LangSplat: an independent field per level, L1 between rendered and painted codes, no tree.

The published code renders a random view per step, each view once before any is repeated, and compares every
labelled pixel (minghanqin/LangSplat `train.py`). Geometry is frozen, so rendering is a product with fixed
compositing weights, which we compute once per view.

Departs from the published code:
    - fewer steps, and a grid of pixels instead of all (`MethodSettings`);
    - L1 is averaged over the labelled pixels of the grid; LangSplat averages over all pixels, counting
      unlabelled ones as 0, so a view's step has more weight the larger the area of its masks;
    - rendered codes are divided by alpha, as in queries, and pixels with alpha below `MIN_ALPHA` are ignored;
      LangSplat compares premultiplied codes wherever a mask is painted;
    - Gaussians' codes are blended unscaled; LangSplat first scales each to unit length;
    - weights below `contributions.min_weight` are dropped.

`hilsplat.field.reference_trainer` (loss `l1`) renders at every step, and averages over all pixels like
LangSplat. It also differs in drawing views with replacement and training all levels in one run. It treats
alpha and unit length like this module.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32, Int32

from hilsplat.base.compiled import compiled
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.progress import track
from hilsplat.field.adam import Adam
from hilsplat.methods.common.pixels import labelled_views
from hilsplat.methods.common.quads import WIDTH, load, plus, signs_of_difference, store, zeros
from hilsplat.methods.method import Method, MethodInputs
from hilsplat.settings import MethodSettings


@dataclass(frozen=True)
class LevelPixels:
    """Labelled pixels of one view at one level.

    Attributes:
        weights: compositing weights (pixels x Gaussians), rows summing to 1.
        targets: code of the mask painted at each pixel.
    """

    weights: sp.csr_matrix
    targets: Float32[np.ndarray, "p D"]


@dataclass(frozen=True)
class ViewPixels:
    """Covered pixels of one view that are labelled at any level.

    Most are labelled at all levels, so their weights are stored once.

    Attributes:
        weights: compositing weights (pixels x Gaussians), rows summing to 1.
        labels: row of the mask painted at each pixel and level, -1 for none.
        latents: code of each mask of the view.
    """

    weights: sp.csr_matrix
    labels: Int32[np.ndarray, "p 3"]
    latents: Float32[np.ndarray, "m D"]

    def is_labelled(self, level: Level) -> bool:
        """Return whether any pixel shows a mask of the level."""
        return bool((self.labels[:, level.index] >= 0).any())

    def at(self, level: Level) -> LevelPixels:
        """Copy the pixels labelled at a level, in order."""
        rows = np.flatnonzero(self.labels[:, level.index] >= 0)
        return LevelPixels(self.weights[rows], self.latents[self.labels[rows, level.index]])


class ViewQueue:
    """Views in random order, each once before any is repeated."""

    def __init__(self, views: list[ViewPixels], seed: int) -> None:
        self._views, self._order, self._queue = views, np.random.default_rng(seed), list[int]()

    def next(self) -> ViewPixels:
        """Return the view of the next step."""
        if not self._queue:
            self._queue = list(self._order.permutation(len(self._views)))
        return self._views[self._queue.pop()]


def views_of(inputs: MethodInputs, pixel_step: int) -> list[ViewPixels]:
    """Return the labelled grid pixels of the train views that have any, and the codes of their masks.

    Raises:
        ArtifactError: no view has a labelled pixel.
    """
    rows = inputs.contributions.rows_of_views()
    views = labelled_views(inputs, pixel_step)
    return [ViewPixels(view.weights, view.labels, inputs.latents[rows[view.number]]) for view in views]


def train_level(
    views: list[ViewPixels], level: Level, num_gaussians: int, settings: MethodSettings, seed: int
) -> Float32[np.ndarray, "N D"]:
    """Train by Adam from zero, one random view per step, each once before any is repeated.

    Args:
        views: train views with labelled pixels at this level, at least one.
        level: the level to train.
        num_gaussians: N.
        settings: steps and rate.
        seed: seed of the order of views.
    """
    channels = views[0].latents.shape[1]
    wide = channels + -channels % WIDTH
    features, gradient = np.zeros((2, num_gaussians * wide), np.float32)
    codes = {id(view): np.pad(view.latents, ((0, 0), (0, wide - channels))).reshape(-1) for view in views}
    queue, adam = ViewQueue(views, seed), Adam(features, settings.rate)
    for _ in range(settings.steps):
        view = queue.next()
        weights, labels = view.weights, view.labels[:, level.index]
        rows = weights.indptr, weights.indices, weights.data
        l1_gradient(*rows, labels, codes[id(view)], channels, wide, features, gradient)
        adam.step(gradient)
    return features.reshape(num_gaussians, wide)[:, :channels].copy()


@compiled
def l1_gradient(indptr, indices, data, labels, codes, channels, wide, features, gradient):
    """Write the gradient of the mean absolute difference of rendered and painted codes for the features.

    A row of weights is read once for its sum and, while it is in the fastest cache, once for its gradient.
    Sums are in the order of the products with the matrix and its transpose; there is one thread.

    Args:
        indptr, indices, data: weights (pixels x Gaussians), CSR.
        labels: row of the code painted at each pixel, -1 for none.
        codes: float32, flat, `wide` numbers per row.
        channels: size of a code; padding after it is 0.
        wide: numbers per Gaussian, a multiple of `WIDTH`.
        features: float32, flat, `wide` numbers per Gaussian.
        gradient: same shape as `features`; written.
    """
    gradient[:] = 0
    labelled = 0
    for p in range(len(labels)):
        labelled += labels[p] >= 0
    share = np.float32(1 / max(labelled * channels, 1))
    for p in range(len(labels)):
        if labels[p] < 0:
            continue
        begin, end = np.uint64(indptr[p]), np.uint64(indptr[p + 1])  # unsigned: skips negative-index checks
        for c in range(0, wide, WIDTH):
            total = zeros()
            for k in range(begin, end):
                total = plus(total, data[k], load(features, np.int64(indices[k]) * wide + c))
            pull = signs_of_difference(total, load(codes, np.int64(labels[p]) * wide + c), share)
            for k in range(begin, end):
                there = np.int64(indices[k]) * wide + c
                store(gradient, there, plus(load(gradient, there), data[k], pull))


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


METHOD = Method(
    "langsplat",
    "LangSplat",
    "minghanqin/LangSplat train.py; departs: fewer steps, pixels of a grid, L1 averaged over labelled pixels "
    "in place of all, rendered codes divided by alpha and thinly covered pixels left out, codes of Gaussians "
    "not scaled to unit length, small compositing weights dropped",
    fit,
)
