"""Adaptive density control of 3DGS: clone, split, prune, reset opacities.

The criterion is the gradient of the loss with respect to a Gaussian's projected mean, in the units of 3DGS:
its x component times half the image width and its y component times half the height (as in normalised
device coordinates), with its length averaged over the steps in which the Gaussian was drawn.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64, Int32

from hilsplat.base.compiled import compiled
from hilsplat.base.rotations import rotate, unit_quaternions
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.gaussians import FIELDS
from hilsplat.splat.optimise import Adam

SMALL = 0.01
"""Gaussians whose largest axis exceeds this, in units of the extent, are split; others are cloned (3DGS)."""
SPLIT_FACTOR = 1.6
"""Factor by which the halves of a split Gaussian are smaller (3DGS: 0.8 x 2)."""
HUGE = 0.5
"""Gaussians with a larger axis, in units of the extent, are pruned (3DGS: 0.1, after the first
opacity reset; here walls of rooms are flat, wide Gaussians)."""
RESET_OPACITY = 0.01  # 3DGS


@compiled
@no_type_check
def _add_lengths(means_px, drawn, half_width, half_height, total, seen):
    """Add the lengths of the rows of `means_px`, in half images, to `total`, and count the rows in `seen`."""
    for i in range(len(total)):
        if drawn[i]:
            x, y = half_width * means_px[i, 0], half_height * means_px[i, 1]
            total[i] += np.sqrt(x * x + y * y)
            seen[i] += 1


@dataclass
class ScreenGradients:
    """Sum of the lengths of each Gaussian's screen-space gradients, and the steps in which it was drawn."""

    total: Float64[np.ndarray, " N"]
    seen: Int32[np.ndarray, " N"]

    @staticmethod
    def start(n: int) -> "ScreenGradients":
        """Return the averages before the first step."""
        return ScreenGradients(np.zeros(n), np.zeros(n, np.int32))

    def add(self, means_px: Float32[np.ndarray, "N 2"], drawn: np.ndarray, size_hw: tuple[int, int]) -> None:
        """Add the gradients of one view's step."""
        _add_lengths(means_px, drawn, size_hw[1] / 2, size_hw[0] / 2, self.total, self.seen)

    def mean(self) -> Float64[np.ndarray, " N"]:
        """Return the average lengths; 0 for Gaussians never drawn."""
        return self.total / np.maximum(self.seen, 1)


def densify(
    adam: Adam,
    gradients: ScreenGradients,
    settings: GaussiansSettings,
    extent: float,
    generator: np.random.Generator,
) -> None:
    """Clone small and split large Gaussians with large screen gradients, the largest first, up to the cap."""
    mean = gradients.mean()
    selected = np.flatnonzero(mean > settings.densify_gradient)
    room = max(settings.max_gaussians - len(adam), 0)
    if len(selected) > room:
        selected = np.sort(selected[np.argsort(-mean[selected], kind="stable")[:room]])
    p = adam.parameters
    large = np.exp(p["log_scales"][selected].max(axis=1, initial=-np.inf)) > SMALL * extent
    clone, split = selected[~large], selected[large]
    copies = {name: p[name][clone].copy() for name in FIELDS}
    halves = {name: np.repeat(p[name][split], 2, axis=0) for name in FIELDS}
    offsets = generator.normal(size=halves["means"].shape) * np.exp(halves["log_scales"].astype(np.float64))
    halves["means"] += rotate(unit_quaternions(halves["quats"]), offsets).astype(np.float32)
    halves["log_scales"] -= np.float32(np.log(SPLIT_FACTOR))
    keep = np.ones(len(adam), dtype=bool)
    keep[split] = False
    adam.keep(keep)
    adam.append({name: np.concatenate([copies[name], halves[name]]) for name in FIELDS})


def prune(adam: Adam, settings: GaussiansSettings, extent: float) -> None:
    """Drop transparent and huge Gaussians."""
    p = adam.parameters
    threshold = np.log(settings.min_opacity / (1 - settings.min_opacity))
    keep = (p["opacity_logits"] > threshold) & (
        p["log_scales"].max(axis=1, initial=-np.inf) < np.log(HUGE * extent)
    )
    if not keep.all():
        adam.keep(keep)


def reset_opacities(adam: Adam) -> None:
    """Cap all opacities at RESET_OPACITY, so that only needed Gaussians become opaque again (3DGS)."""
    logit = np.float32(np.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    np.minimum(adam.parameters["opacity_logits"], logit, out=adam.parameters["opacity_logits"])
    adam.first["opacity_logits"][:] = 0
    adam.second["opacity_logits"][:] = 0
