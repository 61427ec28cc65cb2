"""3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024): `strategy: mcmc`.

Gaussians are not cloned, split, pruned or reset. Transparent (dead) Gaussians move onto opaque ones, the
number grows by a fixed share up to the cap, noise lets transparent Gaussians explore, and two
regularisers make unneeded Gaussians transparent and small.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.special import comb, expit, logit

from hilsplat.base.compiled import compiled
from hilsplat.base.rotations import matrix_entries
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.gaussians import FIELDS
from hilsplat.splat.optimise import Adam
from hilsplat.splat.rasterise.cpu import Gradients, over_ranges

MAX_TOGETHER = 51
"""Maximum number of Gaussians that share one place (the paper's code); more would change little."""
MAX_OPACITY = 1 - 1e-6
"""Largest opacity; opacity 1 has no logit."""
NOISE_SHARPNESS = 100.0
"""Rate at which noise decreases with opacity (paper: k = 100): at opacity 0.1 its factor is e^-9.5."""
LEAST_GATE = 1e-6
"""Noise with a smaller factor is skipped."""


def shared_opacity(opacity: Float[np.ndarray, " N"], number: Int[np.ndarray, " N"]) -> np.ndarray:
    """Return the opacity at which `number` coincident Gaussians cover as much as one of `opacity`.

    1 - (1 - new)^number = old (paper, Eq. 9).
    """
    return -np.expm1(np.log1p(-np.minimum(opacity, MAX_OPACITY)) / number)


def scale_factor(
    opacity: Float[np.ndarray, " N"], shared: Float[np.ndarray, " N"], number: Int[np.ndarray, " N"]
) -> Float[np.ndarray, " N"]:
    """Return the factor on the scales of Gaussians that share a place; it preserves their profile's integral.

    n Gaussians of opacity o and deviation s cover 1 - (1 - o exp(-x^2 / 2s^2))^n along a line. Its
    integral is sqrt(2 pi) s times the sum over k = 1..n of C(n, k) (-1)^(k-1) o^k / sqrt(k); one
    Gaussian of opacity `opacity` and deviation 1 has sqrt(2 pi) opacity. (Paper, Eq. 9, whose double
    sum is this one, because C(k-1, k-1) + ... + C(n-1, k-1) = C(n, k).)

    Args:
        opacity: opacity of the original Gaussian.
        shared: `shared_opacity(opacity, number)`.
        number: Gaussians that share the place, 1 to MAX_TOGETHER.
    """
    k = np.arange(1, MAX_TOGETHER + 1)
    signs = np.where(k % 2 == 1, 1.0, -1.0) / np.sqrt(k)
    binomials = comb(np.arange(MAX_TOGETHER + 1)[:, None], k) * signs  # row n: terms of the sum
    total = (binomials[number] * shared[:, None] ** k).sum(axis=1)
    return opacity / total


@compiled(error_model="numpy")
@no_type_check
def noise_gate(opacity, dead_below):
    """Return the noise factor of a Gaussian: 1/2 at the threshold of the dead, 0 for opaque ones (Eq. 8)."""
    return 1.0 / (1.0 + np.exp(NOISE_SHARPNESS * (opacity - dead_below)))


@compiled(error_model="numpy")
@no_type_check
def _noise_rows(begin, end, means, log_scales, quats, logits, normal, dead_below, weight, extent):
    """Add noise to rows begin..end: weight x gate x covariance x normal, in units of the extent."""
    turn, local = np.empty((3, 3)), np.empty(3)
    for row in range(begin, end):
        gate = noise_gate(1.0 / (1.0 + np.exp(-np.float64(logits[row]))), dead_below)
        if gate < LEAST_GATE:
            continue
        w, x = np.float64(quats[row, 0]), np.float64(quats[row, 1])
        y, z = np.float64(quats[row, 2]), np.float64(quats[row, 3])
        norm = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
        entries = matrix_entries(w * norm, x * norm, y * norm, z * norm)
        for axis in range(3):
            for k in range(3):
                turn[axis, k] = entries[3 * axis + k]
        for axis in range(3):
            along = 0.0
            for k in range(3):
                along += turn[k, axis] * normal[row, k]
            local[axis] = along * np.exp(2.0 * np.float64(log_scales[row, axis])) / (extent * extent)
        square = local[0] ** 2 + local[1] ** 2 + local[2] ** 2  # rotation preserves the length
        # without this limit, a Gaussian far wider than the scene would jump out of it
        factor = extent * weight * gate / max(weight * gate * np.sqrt(square), 1.0)
        for axis in range(3):
            step = turn[axis, 0] * local[0] + turn[axis, 1] * local[1] + turn[axis, 2] * local[2]
            means[row, axis] += factor * step


def add_noise(
    adam: Adam,
    settings: GaussiansSettings,
    rate_of_means: float,
    extent: float,
    generator: np.random.Generator,
    threads: int = 1,
) -> None:
    """Move the means of transparent Gaussians randomly along their own axes (SGLD; paper, Eq. 8).

    The step is noise weight x rate of the means x gate x covariance x normal numbers, limited to the extent.
    The paper assumes scenes of extent 1; here the covariance is in units of the extent, so that the result
    does not depend on the scene's unit.

    Args:
        rate_of_means: step size of the means, in units of the extent.
        extent: radius of the cameras, scene units.
        threads: the result has the same bytes for any number.
    """
    p = adam.parameters
    normal = generator.standard_normal(p["means"].shape, dtype=np.float32)
    arrays = (p["means"], p["log_scales"], p["quats"], p["opacity_logits"], normal)
    weight = settings.mcmc_noise * rate_of_means
    over_ranges(_noise_rows, len(adam), threads, *arrays, settings.min_opacity, weight, extent)


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

    Places are drawn with a probability proportional to their opacity. The Gaussians that then share a place
    together cover what the original one covered.
    """
    dead = opacities(adam) <= settings.min_opacity
    if dead.any() and not dead.all():
        targets = np.flatnonzero(dead)
        source = _draw(np.where(dead, 0.0, opacities(adam)), len(targets), generator)
        shared = _share(adam, source, settings)
        for name in FIELDS:
            adam.parameters[name][targets] = shared[name]
            adam.first[name][targets] = 0
            adam.second[name][targets] = 0
    n = len(adam)
    target = min(settings.max_gaussians, int(n * (1 + settings.mcmc_growth)))
    if target > n:
        source = _draw(opacities(adam), target - n, generator)
        adam.append(_share(adam, source, settings))


def opacities(adam: Adam) -> Float[np.ndarray, " N"]:
    """Return the peak alphas."""
    return expit(adam.parameters["opacity_logits"].astype(np.float64))


def least_alive_logit(min_opacity: float) -> np.float32:
    """Return a float32 logit whose opacity is just above the threshold of the dead.

    The nearest float32 to the threshold's logit may be below it: that of 0.005 has opacity 0.0049999995.
    """
    exact = float(logit(min_opacity))
    return np.float32(exact + 1e-6 * max(abs(exact), 1.0))  # float32 rounding is at most 6e-8 of its size


def _draw(weights: Float[np.ndarray, " N"], number: int, generator: np.random.Generator) -> np.ndarray:
    """Draw rows with replacement, with a probability proportional to their weights."""
    edges = np.cumsum(weights)
    return np.searchsorted(edges, generator.uniform(0, edges[-1], number), side="right")


def _share(
    adam: Adam, source: Int[np.ndarray, " M"], settings: GaussiansSettings
) -> dict[str, Float32[np.ndarray, "M ..."]]:
    """Reduce the drawn rows to their share of the place, and return the copies that join them there."""
    p = adam.parameters
    rows, drawn = np.unique(source, return_counts=True)
    number = np.minimum(drawn + 1, MAX_TOGETHER)
    old = np.minimum(expit(p["opacity_logits"][rows].astype(np.float64)), MAX_OPACITY)
    new = shared_opacity(old, number)
    p["log_scales"][rows] += np.log(scale_factor(old, new, number)).astype(np.float32)[:, None]
    # rows at or below the threshold would be relocated again in the next round
    alive = least_alive_logit(settings.min_opacity)
    p["opacity_logits"][rows] = np.maximum(logit(new).astype(np.float32), alive)
    for name in FIELDS:
        adam.first[name][rows] = 0
        adam.second[name][rows] = 0
    return {name: p[name][source] for name in FIELDS}
