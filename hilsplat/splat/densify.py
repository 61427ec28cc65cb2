"""The two strategies that add, move and remove Gaussians during a fit.

Adaptive density control (3DGS; `strategy: default`) clones, splits and prunes Gaussians and resets opacities.
Its criterion is the gradient of the loss with respect to a Gaussian's projected mean, in the units of 3DGS:
x times half the image width and y times half the height (as in normalised device coordinates). The length of
the gradient is averaged over the steps in which the Gaussian was drawn.

3DGS as Markov Chain Monte Carlo (Kheradmand et al. 2024; `strategy: mcmc`) moves transparent (dead) Gaussians
onto opaque ones, increases the number of Gaussians by a fixed share up to the cap, and moves transparent ones
randomly. Two regularisers make unneeded Gaussians transparent and small.
"Paper" below means Kheradmand et al.
"""

import numpy as np
from jaxtyping import Float, Int, Int64
from scipy.special import comb, expit, logit

from hilsplat.base.rotations import rotate, unit_quaternions
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.model import Model

MAX_CLONED_SCALE = 0.01
"""Gaussians whose largest axis exceeds this (in units of the extent) are split; others are cloned (3DGS)."""
SPLIT_FACTOR = 1.6  # the halves of a split Gaussian get its scales divided by this (3DGS: 0.8 x 2)
MAX_SCALE = 0.5
"""Gaussians with a larger axis, in units of the extent, are pruned (3DGS: 0.1, after the first
opacity reset; larger here, because walls of rooms consist of flat, wide Gaussians)."""
RESET_OPACITY = 0.01  # 3DGS

MAX_TOGETHER = 51
"""Maximum number of coincident Gaussians, as in the paper's code; a higher limit would change little."""
MAX_OPACITY = 1 - 1e-6  # maximum opacity; opacity 1 has no logit


def control_density(
    model: Model,
    settings: GaussiansSettings,
    rate_of_means: float,  # in units of the extent
    extent: float,
    generator: np.random.Generator,
) -> None:
    """Add, move and remove Gaussians after a step, according to the strategy."""
    is_mcmc = settings.strategy == "mcmc"
    densify_until = int(settings.densify_until * settings.iterations)
    if settings.densify_from * settings.iterations <= model.steps <= densify_until:
        if model.steps % settings.densify_every == 0:
            if is_mcmc:
                relocate_and_grow(model, settings, generator)
            else:
                densify(model, settings, extent, generator)
                prune(model, settings, extent)
            model.restart_sums()
        if not is_mcmc and model.steps % settings.opacity_reset_every == 0 and model.steps < densify_until:
            reset_opacities(model)
    if is_mcmc:
        model.add_noise(settings, rate_of_means, extent, generator)


def densify(model: Model, settings: GaussiansSettings, extent: float, generator: np.random.Generator) -> None:
    """Clone small and split large Gaussians with large screen gradients, largest first, up to the cap."""
    mean = model.screen_gradients()
    selected = np.flatnonzero(mean > settings.densify_gradient)
    room = max(settings.max_gaussians - len(model), 0)
    if len(selected) > room:
        selected = np.sort(selected[np.argsort(-mean[selected], kind="stable")[:room]])
    largest = model.read("log_scales", selected).max(axis=1, initial=-np.inf)
    large = np.exp(largest) > MAX_CLONED_SCALE * extent
    clone, split = selected[~large], selected[large]
    halves = np.repeat(split, 2)
    means, log_scales, quats = (model.read(name, halves) for name in ("means", "log_scales", "quats"))
    offsets = generator.normal(size=means.shape) * np.exp(log_scales.astype(np.float64))
    means += rotate(unit_quaternions(quats), offsets).astype(np.float32)
    log_scales -= np.float32(np.log(SPLIT_FACTOR))
    rows = np.concatenate([np.delete(np.arange(len(model)), split), clone, halves])
    model.select(rows)
    model.reset_moments(np.arange(len(rows) - len(clone) - len(halves), len(rows)))
    of_halves = np.arange(len(rows) - len(halves), len(rows))
    model.write("means", of_halves, means)
    model.write("log_scales", of_halves, log_scales)


def prune(model: Model, settings: GaussiansSettings, extent: float) -> None:
    """Drop transparent and huge Gaussians."""
    threshold = np.log(settings.min_opacity / (1 - settings.min_opacity))
    largest = model.read("log_scales").max(axis=1, initial=-np.inf)
    keep = (model.read("opacity_logits") > threshold) & (largest < np.log(MAX_SCALE * extent))
    if not keep.all():
        model.select(np.flatnonzero(keep))


def reset_opacities(model: Model) -> None:
    """Cap all opacities at RESET_OPACITY, so that only needed Gaussians become opaque again (3DGS)."""
    max_logit = np.float32(np.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    model.write("opacity_logits", slice(None), np.minimum(model.read("opacity_logits"), max_logit))
    model.reset_moments(slice(None), ("opacity_logits",))


def shared_opacity(opacity: Float[np.ndarray, " N"], number: Int[np.ndarray, " N"]) -> np.ndarray:
    """Return the opacity at which `number` coincident Gaussians cover as much as one with `opacity`.

    1 - (1 - new)^number = old (paper, Eq. 9).
    """
    return -np.expm1(np.log1p(-np.minimum(opacity, MAX_OPACITY)) / number)


def scale_factor(
    opacity: Float[np.ndarray, " N"], shared: Float[np.ndarray, " N"], number: Int[np.ndarray, " N"]
) -> Float[np.ndarray, " N"]:
    """Return the scale factor for coincident Gaussians that preserves the integral of their profile.

    n Gaussians of opacity o and standard deviation s cover 1 - (1 - o exp(-x^2 / 2s^2))^n along a line. The
    integral of this profile is sqrt(2 pi) s times the sum over k = 1..n of C(n, k) (-1)^(k-1) o^k / sqrt(k).
    For one Gaussian of opacity `opacity` and deviation 1, it is sqrt(2 pi) opacity. (Paper, Eq. 9, whose
    double sum equals this sum, because C(k-1, k-1) + ... + C(n-1, k-1) = C(n, k).)

    `shared` is `shared_opacity(opacity, number)` of the original Gaussian; 1 to MAX_TOGETHER coincide.
    """
    k = np.arange(1, MAX_TOGETHER + 1)
    signs = np.where(k % 2 == 1, 1.0, -1.0) / np.sqrt(k)
    binomials = comb(np.arange(MAX_TOGETHER + 1)[:, None], k) * signs  # row n: terms of the sum
    total = (binomials[number] * shared[:, None] ** k).sum(axis=1)
    return opacity / total


def relocate_and_grow(model: Model, settings: GaussiansSettings, generator: np.random.Generator) -> None:
    """Move dead Gaussians onto live ones, then add copies of live ones up to the cap.

    Live Gaussians are sampled with a probability proportional to their opacity. A sampled Gaussian and its
    copies together cover what the original covered; their moments are zero.
    """
    opacity = opacities(model)
    dead = opacity <= settings.min_opacity
    if dead.any() and not dead.all():
        targets = np.flatnonzero(dead)
        model.copy(_shared(model, np.where(dead, 0.0, opacity), len(targets), settings, generator), targets)
    n = len(model)
    target = min(settings.max_gaussians, int(n * (1 + settings.mcmc_growth)))
    if target > n:
        copied = _shared(model, opacities(model), target - n, settings, generator)
        model.select(np.concatenate([np.arange(n), copied]))


def opacities(model: Model) -> Float[np.ndarray, " N"]:
    """Return the peak alpha of each Gaussian."""
    return expit(model.read("opacity_logits").astype(np.float64))


def _shared(
    model: Model,
    weights: Float[np.ndarray, " N"],
    number: int,
    settings: GaussiansSettings,
    generator: np.random.Generator,
) -> Int64[np.ndarray, " M"]:
    """Sample rows to copy, with replacement and probabilities proportional to `weights`.

    The sampled rows are changed, so that a row and its copies together cover what the row covered before,
    and their moments are set to zero.
    """
    edges = np.cumsum(weights)
    source = np.searchsorted(edges, generator.uniform(0, edges[-1], number), side="right")
    rows, drawn = np.unique(source, return_counts=True)
    together = np.minimum(drawn + 1, MAX_TOGETHER)
    old = np.minimum(expit(model.read("opacity_logits", rows).astype(np.float64)), MAX_OPACITY)
    new = shared_opacity(old, together)
    change = np.log(scale_factor(old, new, together)).astype(np.float32)[:, None]
    model.write("log_scales", rows, model.read("log_scales", rows) + change)
    # Rows at or below the threshold would be relocated again in the next round. The float32 value nearest to
    # the threshold's logit may be too low by up to 6e-8 of its size (0.005 becomes opacity 0.0049999995).
    exact = float(logit(settings.min_opacity))
    alive = np.float32(exact + 1e-6 * max(abs(exact), 1.0))
    model.write("opacity_logits", rows, np.maximum(logit(new).astype(np.float32), alive))
    model.reset_moments(rows)
    return source
