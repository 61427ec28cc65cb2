"""LangSplat: an independent field per level, an L1 loss between rendered and painted codes, no tree.

The published code renders one random view per step (using each view once before repeating any) and compares
every labelled pixel (minghanqin/LangSplat `train.py`). Geometry is frozen, so rendering is a product with
fixed compositing weights, which we compute once per view.

Departs from the published code:
    - fewer steps, and a pixel grid instead of all pixels (`TrainedSettings`);
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

from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.progress import track
from hilsplat.baselines import TrainedSettings
from hilsplat.field.adam import Adam, in_random_order
from hilsplat.methods.kernels import WIDTH, l1_gradient
from hilsplat.methods.method import LabelledView, MethodInputs, labelled_views


def train_level(
    views: list[LabelledView],  # at least one; each has labelled pixels at this level
    latents: Float32[np.ndarray, "M D"],
    level: Level,
    num_gaussians: int,
    settings: TrainedSettings,
    seed: int,
) -> Float32[np.ndarray, "N D"]:
    """Train with Adam from zeros, on one random view per step; each view is used once before a repeat."""
    channels = latents.shape[1]
    wide = channels + -channels % WIDTH
    features, gradient = np.zeros((2, num_gaussians * wide), np.float32)
    adam = Adam(features, settings.rate)
    codes = [np.pad(latents[view.rows], ((0, 0), (0, wide - channels))).reshape(-1) for view in views]
    pairs, random = list(zip(views, codes, strict=True)), np.random.default_rng(seed)
    for view, painted in in_random_order(pairs, random, settings.steps):
        rows = view.weights.indptr, view.weights.indices, view.weights.data
        l1_gradient(*rows, view.labels[:, level.index], painted, channels, wide, features, gradient)
        adam.step(gradient)
    return features.reshape(num_gaussians, wide)[:, :channels].copy()


def fit(inputs: MethodInputs, settings: TrainedSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Train the three levels one after the other, each with its own seed."""
    views, features = labelled_views(inputs, settings.pixel_step), inputs.no_features()
    for level in track(list(LEVELS), "levels trained"):
        if labelled := [view for view in views if len(view.at(level))]:
            features[:, level.index] = train_level(
                labelled, inputs.latents, level, len(features), settings, seed + level.index
            )
    return features
