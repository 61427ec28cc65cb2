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

`hilsplat.field.literal_trainer` (loss `l1`) renders at every step, and averages over all pixels like
LangSplat. It also trains all levels in one run. It treats alpha and unit length like this module.
"""

import numpy as np
from jaxtyping import Float32

from hilsplat.base.compiled import compiled
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.progress import track
from hilsplat.field.adam import Adam
from hilsplat.methods.common.pixels import LabelledView, in_random_order, labelled_views
from hilsplat.methods.common.quads import WIDTH, load, plus, signs_of_difference, store, zeros
from hilsplat.methods.method import Method, MethodInputs
from hilsplat.settings import MethodSettings


def train_level(
    views: list[LabelledView],
    latents: Float32[np.ndarray, "M D"],
    level: Level,
    num_gaussians: int,
    settings: MethodSettings,
    seed: int,
) -> Float32[np.ndarray, "N D"]:
    """Train by Adam from zero, one random view per step, each once before any is repeated.

    Args:
        views: train views with labelled pixels at this level, at least one.
        settings: steps and rate.
        seed: seed of the order of views.
    """
    channels = latents.shape[1]
    wide = channels + -channels % WIDTH
    features, gradient = np.zeros((2, num_gaussians * wide), np.float32)
    adam = Adam(features, settings.rate)
    codes = [np.pad(latents[view.rows], ((0, 0), (0, wide - channels))).reshape(-1) for view in views]
    order = in_random_order(list(zip(views, codes, strict=True)), np.random.default_rng(seed))
    for _ in range(settings.steps):
        view, own = next(order)
        rows = view.weights.indptr, view.weights.indices, view.weights.data
        l1_gradient(*rows, view.labels[:, level.index], own, channels, wide, features, gradient)
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
    views, latents = labelled_views(inputs, settings.pixel_step), inputs.latents
    num = inputs.contributions.num_gaussians
    features = np.zeros((num, len(LEVELS), latents.shape[1]), np.float32)
    for level in track(list(LEVELS), "levels trained"):
        if labelled := [view for view in views if len(view.at(level))]:
            own_seed = seed + level.index
            features[:, level.index] = train_level(labelled, latents, level, num, settings, own_seed)
    return features


METHOD = Method("langsplat", "LangSplat", "minghanqin/LangSplat train.py", fit)
