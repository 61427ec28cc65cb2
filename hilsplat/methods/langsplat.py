"""LangSplat: an independent field per level, an L1 loss between rendered and painted codes, no tree.

The published code renders one random view per step (using each view once before repeating any) and compares
every labelled pixel (minghanqin/LangSplat `train.py`). Geometry is frozen, so rendering is a product with
fixed compositing weights, which we compute once per view.

Departs from the published code:
    - fewer steps, and a pixel grid instead of all pixels (`MethodSettings`);
    - L1 is averaged over the labelled pixels of the grid; LangSplat averages over all pixels, counting
      unlabelled pixels as 0, so views with larger masks have more weight;
    - rendered codes are divided by alpha, as in queries, and pixels with alpha below `MIN_ALPHA` are ignored;
      LangSplat compares premultiplied codes wherever a mask is painted;
    - Gaussians' codes are blended unscaled; LangSplat first scales each code to unit length;
    - weights below `contributions.min_weight` are dropped.

`hilsplat.field.literal_trainer` (loss `l1`) renders at every step and averages over all pixels.
"""

import numpy as np
from jaxtyping import Float32

from hilsplat.base.compiled import compiled
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.progress import track
from hilsplat.field.adam import Adam, in_random_order
from hilsplat.methods.method import LabelledView, MethodInputs, labelled_views
from hilsplat.settings import MethodSettings


def train_level(
    views: list[LabelledView],  # at least one; each has labelled pixels at this level
    latents: Float32[np.ndarray, "M D"],
    level: Level,
    num_gaussians: int,
    settings: MethodSettings,
    seed: int,
) -> Float32[np.ndarray, "N D"]:
    """Train with Adam from zero, one random view per step; each view is used once before any is repeated."""
    features, gradient = np.zeros((2, num_gaussians, latents.shape[1]), np.float32)
    adam = Adam(features, settings.rate)
    for view in in_random_order(views, np.random.default_rng(seed), settings.steps):
        rows = view.weights.indptr, view.weights.indices, view.weights.data
        l1_gradient(*rows, view.labels[:, level.index], latents[view.rows], features, gradient)
        adam.step(gradient)
    return features


@compiled
def l1_gradient(indptr, indices, data, labels, codes, features, gradient):
    """Write the features' gradient of the mean absolute difference between rendered and painted codes.

    A row of weights is read once for its sum and, while still in the fastest cache, once for its gradient.
    Sums have the same order as products with the matrix and its transpose; one thread is used.

    Args:
        indptr, indices, data: weights (pixels x Gaussians), CSR.
        labels: row of the code painted at each pixel, -1 for none.
        gradient: overwritten.
    """
    gradient[:] = 0
    channels = features.shape[1]
    share = np.float32(1 / max((labels >= 0).sum() * channels, 1))
    for p in range(len(labels)):
        if labels[p] < 0:
            continue
        begin, end = np.uint64(indptr[p]), np.uint64(indptr[p + 1])  # unsigned: skips negative-index checks
        for c in range(channels):
            total = np.float32(0)
            for k in range(begin, end):
                total += data[k] * features[np.uint64(indices[k]), c]
            pull = np.sign(total - codes[labels[p], c]) * share
            for k in range(begin, end):
                gradient[np.uint64(indices[k]), c] += data[k] * pull


def fit(inputs: MethodInputs, settings: MethodSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Train the three levels one after the other, each with its own seed."""
    views, features = labelled_views(inputs, settings.pixel_step), inputs.no_features()
    for level in track(list(LEVELS), "levels trained"):
        if labelled := [view for view in views if len(view.at(level))]:
            features[:, level.index] = train_level(
                labelled, inputs.latents, level, len(features), settings, seed + level.index
            )
    return features
