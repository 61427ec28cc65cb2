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
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from cpusplat.compiled import compiled
from cpusplat.lanes import QUAD, load_quad, splat, store
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.progress import track
from hilsplat.baselines import TrainedSettings
from hilsplat.field.adam import Adam, in_random_order
from hilsplat.methods.method import LabelledView, MethodInputs, labelled_views

# Loops over the entries of a sparse matrix process four channels of a Gaussian as one vector: with sixteen,
# codes with three channels would waste thirteen. Operations are neither fused nor reordered, so results are
# bit-identical to plain loops over the channels.
WIDTH = 4
ZEROS = ir.Constant(QUAD.vector, None)


@intrinsic
def plus(typingctx, total, scale, row):
    """Return total + scale * row; each product is rounded before the addition."""

    def codegen(context, builder, sig, args):
        return builder.fadd(args[0], builder.fmul(splat(builder, args[1], WIDTH), args[2]))

    return QUAD(QUAD, types.float32, QUAD), codegen


@intrinsic
def zeros(typingctx):
    """Return four zeros."""
    return QUAD(), lambda context, builder, sig, args: ZEROS


@intrinsic
def signs_of_difference(typingctx, a, b, scale):
    """Return scale where a > b, -scale where a < b, and 0 where a == b; NaN is preserved."""

    def codegen(context, builder, sig, args):
        apart, up = builder.fsub(args[0], args[1]), splat(builder, args[2], WIDTH)
        above = builder.fcmp_ordered(">", apart, ZEROS)
        below = builder.fcmp_ordered("<", apart, ZEROS)
        return builder.select(above, up, builder.select(below, builder.fneg(up), apart))

    return QUAD(QUAD, QUAD, types.float32), codegen


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


@compiled
def l1_gradient(indptr, indices, data, labels, codes, channels, wide, features, gradient):
    """Write the features' gradient of the mean absolute difference between rendered and painted codes.

    A row of weights is read once for its sum and, while still in the fastest cache, once for its gradient.
    Sums have the same order as products with the matrix and its transpose; one thread is used.

    Args:
        indptr, indices, data: weights (pixels x Gaussians), CSR.
        labels: row of the code painted at each pixel, -1 for none.
        codes, features, gradient: float32, flat, `wide` numbers per row or Gaussian; `gradient` is written.
        channels: size of a code; the padding after each code is 0.
        wide: multiple of `WIDTH`.
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
                total = plus(total, data[k], load_quad(features, np.int64(indices[k]) * wide + c))
            pull = signs_of_difference(total, load_quad(codes, np.int64(labels[p]) * wide + c), share)
            for k in range(begin, end):
                there = np.int64(indices[k]) * wide + c
                store(gradient, there, plus(load_quad(gradient, there), data[k], pull))


def fit(inputs: MethodInputs, settings: TrainedSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Train the three levels one after the other, each with its own seed."""
    views, features = labelled_views(inputs, settings.pixel_step), inputs.no_features()
    for level in track(list(LEVELS), "levels trained"):
        if labelled := [view for view in views if len(view.at(level))]:
            features[:, level.index] = train_level(
                labelled, inputs.latents, level, len(features), settings, seed + level.index
            )
    return features
