"""LangSplat: one field per level by itself, L1 between rendered and painted codes, no tree.

The published code renders a random view per step and compares every labelled pixel (minghanqin/LangSplat
`train.py`). Geometry is frozen, so what it renders is a product with fixed compositing weights; here these
are computed once per view, and pixels are taken from a grid. `hilsplat.language.reference` is the same
trainer without either short cut.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32, Int64

from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.progress import track
from hilsplat.methods.method import Method, MethodInputs
from hilsplat.settings import MethodSettings

BETAS = (0.9, 0.999)
EPS = 1e-15
"""As the published optimiser is configured."""


@dataclass(frozen=True)
class ViewRows:
    """Labelled pixels of one view at one level.

    Attributes:
        weights: their compositing weights (pixels x Gaussians), rows summing to 1.
        targets: code of the mask painted there.
    """

    weights: sp.csr_matrix
    targets: Float32[np.ndarray, "p D"]


def l1_step(features: Float32[np.ndarray, "N D"], rows: ViewRows) -> tuple[float, Float32[np.ndarray, "N D"]]:
    """Mean absolute difference of rendered and painted codes, and its gradient by the features."""
    apart = rows.weights @ features - rows.targets
    scale = np.float32(1 / max(apart.size, 1))
    gradient = rows.weights.T @ (np.sign(apart) * scale)
    return float(np.abs(apart).sum(dtype=np.float64) * scale), gradient.astype(np.float32)


def train_level(
    views: list[ViewRows], num_gaussians: int, latent: int, settings: MethodSettings, seed: int
) -> Float32[np.ndarray, "N D"]:
    """Adam from zero, one random view per step (each once before any comes again).

    Args:
        views: labelled pixels of the train views; views without any are left out by the caller.
        num_gaussians: N.
        latent: D.
        settings: steps and rate.
        seed: of the order of views.
    """
    features = np.zeros((num_gaussians, latent), np.float32)
    first, second = np.zeros_like(features), np.zeros_like(features)
    order = np.random.default_rng(seed)
    queue: list[int] = []
    for step in range(1, settings.steps + 1):
        if not queue:
            queue = list(order.permutation(len(views)))
        _, gradient = l1_step(features, views[queue.pop()])
        first += (1 - BETAS[0]) * (gradient - first)
        second += (1 - BETAS[1]) * (gradient * gradient - second)
        mean, spread = first / (1 - BETAS[0] ** step), second / (1 - BETAS[1] ** step)
        features -= settings.rate * mean / (np.sqrt(spread) + EPS)
    return features


def fit(inputs: MethodInputs, settings: MethodSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Train the three levels one after the other, each with a seed of its own."""
    contributions, latents = inputs.contributions, inputs.latents
    of_level: dict[Level, list[ViewRows]] = {level: [] for level in LEVELS}
    for number, view in enumerate(track(list(contributions.views), "weights of views")):
        weights, labels = inputs.view_weights(view), inputs.view_labels(view)
        grid = grid_pixels(inputs.view_size_hw(view), settings.pixel_step)
        covered = grid[np.diff(weights.indptr)[grid] > 0]
        own = latents[contributions.view == number]
        for level in LEVELS:
            pixels = covered[labels[covered, level.index] >= 0]
            if len(pixels):
                of_level[level].append(ViewRows(weights[pixels], own[labels[pixels, level.index]]))
    shape = (contributions.num_gaussians, len(LEVELS), latents.shape[1])
    features = np.zeros(shape, np.float32)
    for level in track(list(LEVELS), "levels trained"):
        if of_level[level]:
            features[:, level.index] = train_level(
                of_level[level], shape[0], shape[2], settings, seed + level.index
            )
    return features


def grid_pixels(size_hw: tuple[int, int], step: int) -> Int64[np.ndarray, " p"]:
    """Row-major indices of every so many pixels of rows and columns."""
    rows, columns = np.arange(0, size_hw[0], step), np.arange(0, size_hw[1], step)
    return (rows[:, None] * size_hw[1] + columns[None]).ravel()


METHOD = Method(
    "langsplat",
    "LangSplat",
    "minghanqin/LangSplat train.py; departs: fewer steps, pixels of a grid, rendered codes divided by alpha",
    fit,
)
