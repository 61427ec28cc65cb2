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

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int, Int32
from scipy.special import comb, expit, logit

from cpusplat.threads import over_ranges
from hilsplat.base.rotations import rotate, unit_quaternions
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.gaussians import FIELDS
from hilsplat.splat.kernels import noise_rows
from hilsplat.splat.optimise import Adam
from hilsplat.splat.rasterise.drawn import Gradients

MAX_CLONED_SCALE = 0.01
"""Gaussians whose largest axis exceeds this (in units of the extent) are split; others are cloned (3DGS)."""
SPLIT_FACTOR = 1.6
"""The halves of a split Gaussian get its scales divided by this (3DGS: 0.8 x 2)."""
MAX_SCALE = 0.5
"""Gaussians with a larger axis, in units of the extent, are pruned (3DGS: 0.1, after the first
opacity reset; larger here, because walls of rooms consist of flat, wide Gaussians)."""
RESET_OPACITY = 0.01  # 3DGS

MAX_TOGETHER = 51
"""Maximum number of coincident Gaussians, as in the paper's code; a higher limit would change little."""
MAX_OPACITY = 1 - 1e-6  # maximum opacity; opacity 1 has no logit


@dataclass
class ScreenGradients:
    """Summed screen-space gradient lengths of each Gaussian, and the number of steps that drew it."""

    total: Float64[np.ndarray, " N"]
    seen: Int32[np.ndarray, " N"]

    @staticmethod
    def start(n: int) -> "ScreenGradients":
        """Return zero sums for n Gaussians."""
        return ScreenGradients(np.zeros(n), np.zeros(n, np.int32))

    def add(self, means_px: Float32[np.ndarray, "N 2"], drawn: np.ndarray, size_hw: tuple[int, int]) -> None:
        """Add the gradients of one view's step; they are zero for Gaussians that are not drawn."""
        x, y = means_px[:, 0] * np.float64(size_hw[1] / 2), means_px[:, 1] * np.float64(size_hw[0] / 2)
        self.total += np.sqrt(x * x + y * y)
        self.seen += drawn


def control_density(
    adam: Adam,
    gradients: ScreenGradients,
    settings: GaussiansSettings,
    rate_of_means: float,  # in units of the extent
    extent: float,
    generator: np.random.Generator,
    threads: int,
) -> None:
    """Add, move and remove Gaussians after a step, according to the strategy."""
    is_mcmc = settings.strategy == "mcmc"
    densify_until = int(settings.densify_until * settings.iterations)
    if settings.densify_from * settings.iterations <= adam.steps <= densify_until:
        if adam.steps % settings.densify_every == 0:
            if is_mcmc:
                relocate_and_grow(adam, settings, generator)
            else:
                densify(adam, gradients, settings, extent, generator)
                prune(adam, settings, extent)
            gradients.total, gradients.seen = np.zeros(len(adam)), np.zeros(len(adam), np.int32)
        if not is_mcmc and adam.steps % settings.opacity_reset_every == 0 and adam.steps < densify_until:
            reset_opacities(adam)
    if is_mcmc:
        add_noise(adam, settings, rate_of_means, extent, generator, threads)


def densify(
    adam: Adam,
    gradients: ScreenGradients,
    settings: GaussiansSettings,
    extent: float,
    generator: np.random.Generator,
) -> None:
    """Clone small and split large Gaussians with large screen gradients, largest first, up to the cap."""
    mean = gradients.total / np.maximum(gradients.seen, 1)
    selected = np.flatnonzero(mean > settings.densify_gradient)
    room = max(settings.max_gaussians - len(adam), 0)
    if len(selected) > room:
        selected = np.sort(selected[np.argsort(-mean[selected], kind="stable")[:room]])
    p = adam.parameters
    large = np.exp(p["log_scales"][selected].max(axis=1, initial=-np.inf)) > MAX_CLONED_SCALE * extent
    clone, split = selected[~large], selected[large]
    halves = {name: np.repeat(p[name][split], 2, axis=0) for name in FIELDS}
    offsets = generator.normal(size=halves["means"].shape) * np.exp(halves["log_scales"].astype(np.float64))
    halves["means"] += rotate(unit_quaternions(halves["quats"]), offsets).astype(np.float32)
    halves["log_scales"] -= np.float32(np.log(SPLIT_FACTOR))
    more = {name: np.concatenate([p[name][clone], halves[name]]) for name in FIELDS}
    adam.keep(np.delete(np.arange(len(adam)), split))
    adam.append(more)


def prune(adam: Adam, settings: GaussiansSettings, extent: float) -> None:
    """Drop transparent and huge Gaussians."""
    p = adam.parameters
    threshold = np.log(settings.min_opacity / (1 - settings.min_opacity))
    largest = p["log_scales"].max(axis=1, initial=-np.inf)
    keep = (p["opacity_logits"] > threshold) & (largest < np.log(MAX_SCALE * extent))
    if not keep.all():
        adam.keep(keep)


def reset_opacities(adam: Adam) -> None:
    """Cap all opacities at RESET_OPACITY, so that only needed Gaussians become opaque again (3DGS)."""
    max_logit = np.float32(np.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    np.minimum(adam.parameters["opacity_logits"], max_logit, out=adam.parameters["opacity_logits"])
    adam.reset_moments(slice(None), ("opacity_logits",))


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


def add_noise(
    adam: Adam,
    settings: GaussiansSettings,
    rate_of_means: float,
    extent: float,  # radius of the cameras, scene units
    generator: np.random.Generator,
    threads: int = 1,
) -> None:
    """Move the means of transparent Gaussians randomly along their own axes (SGLD; paper, Eq. 8).

    The step is noise weight x rate of the means x gate x covariance x normal numbers, limited to the extent.
    The paper assumes scenes of extent 1; here the covariance is in units of the extent, so that the result
    does not depend on the scene's unit. `rate_of_means` is also in units of the extent. The result is
    byte-identical for any number of threads.
    """
    p = adam.parameters
    normal = generator.standard_normal(p["means"].shape, dtype=np.float32)
    arrays = (p["means"], p["log_scales"], p["quats"], p["opacity_logits"], normal)
    weight = settings.mcmc_noise * rate_of_means
    over_ranges(noise_rows, len(adam), threads, *arrays, settings.min_opacity, weight, extent)


def add_regularisers(adam: Adam, gradients: Gradients, settings: GaussiansSettings, extent: float) -> None:
    """Add the gradients of opacity_weight x mean opacity + scale_weight x mean scale (paper, Eq. 10).

    Scales are in units of the extent.
    """
    n = len(adam)
    opacity = expit(adam.parameters["opacity_logits"])
    by_logit, by_log_scale = gradients.opacity_logits, gradients.log_scales
    by_logit += np.float32(settings.mcmc_opacity_weight / n) * opacity * (1 - opacity)
    scales = np.exp(adam.parameters["log_scales"])
    by_log_scale += np.float32(settings.mcmc_scale_weight / (3 * n * extent)) * scales


def relocate_and_grow(adam: Adam, settings: GaussiansSettings, generator: np.random.Generator) -> None:
    """Move dead Gaussians onto live ones, then add copies of live ones up to the cap.

    Live Gaussians are sampled with a probability proportional to their opacity. A sampled Gaussian and its
    copies together cover what the original covered.
    """
    opacity = opacities(adam)
    dead = opacity <= settings.min_opacity
    if dead.any() and not dead.all():
        targets = np.flatnonzero(dead)
        copies = _share(adam, np.where(dead, 0.0, opacity), len(targets), settings, generator)
        for name in FIELDS:
            adam.parameters[name][targets] = copies[name]
        adam.reset_moments(targets)
    n = len(adam)
    target = min(settings.max_gaussians, int(n * (1 + settings.mcmc_growth)))
    if target > n:
        adam.append(_share(adam, opacities(adam), target - n, settings, generator))


def opacities(adam: Adam) -> Float[np.ndarray, " N"]:
    """Return the peak alpha of each Gaussian."""
    return expit(adam.parameters["opacity_logits"].astype(np.float64))


def _share(
    adam: Adam,
    weights: Float[np.ndarray, " N"],
    number: int,
    settings: GaussiansSettings,
    generator: np.random.Generator,
) -> dict[str, Float32[np.ndarray, "M ..."]]:
    """Sample rows with replacement, with probabilities proportional to `weights`, and return copies.

    The sampled rows are changed, so that a row and its copies together cover what the row covered before.
    """
    p, edges = adam.parameters, np.cumsum(weights)
    source = np.searchsorted(edges, generator.uniform(0, edges[-1], number), side="right")
    rows, drawn = np.unique(source, return_counts=True)
    together = np.minimum(drawn + 1, MAX_TOGETHER)
    old = np.minimum(expit(p["opacity_logits"][rows].astype(np.float64)), MAX_OPACITY)
    new = shared_opacity(old, together)
    p["log_scales"][rows] += np.log(scale_factor(old, new, together)).astype(np.float32)[:, None]
    # Rows at or below the threshold would be relocated again in the next round. The float32 value nearest to
    # the threshold's logit may be too low by up to 6e-8 of its size (0.005 becomes opacity 0.0049999995).
    exact = float(logit(settings.min_opacity))
    alive = np.float32(exact + 1e-6 * max(abs(exact), 1.0))
    p["opacity_logits"][rows] = np.maximum(logit(new).astype(np.float32), alive)
    adam.reset_moments(rows)
    return {name: p[name][source] for name in FIELDS}
