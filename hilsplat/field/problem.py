"""The quadratic part of the field's objective: language loss, clustering loss and ridge.

With the rendered map M = W F, the mask means A F, the areas n and the mask latents h (see
`contributions`), and all sums divided by the number of labelled pixels:

- language loss (squared regression): tr F'GF - 2 sum n h.(AF) + sum n |h|^2
- clustering loss L_h (Eq. 2):        tr F'GF - sum n |AF|^2
- ridge: sum of visible mass x |F - F_lifted|^2

Their sum is one quadratic form, minimised by a few conjugate-gradient steps from the lifted average.

Departs: the paper's objective has no term with CLIP, so a constant field minimises it. The language loss is
LangSplat's regression with squared instead of absolute differences, averaged over labelled pixels only.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64

from hilsplat.contributions.mask_operator import MaskOperator, lifted_average, lifted_median
from hilsplat.contributions.quadratic import Quadratic, level_mass
from hilsplat.field.one_pass import (
    add_by_channel,
    add_scaled,
    channel_dots,
    pull,
    redirect,
    scaled_squares,
)


@dataclass(frozen=True)
class QuadraticProblem:
    """Language loss, clustering loss and ridge: all terms except the contrastive losses.

    Attributes:
        masks: A.
        mass: G 1, the visible mass of each Gaussian at each level, px.
        pixels: n.
        latents: h.
        lifted: start of the field, to which the ridge pulls.
        weights: weights of the language loss, the clustering loss and the ridge.
    """

    masks: MaskOperator
    quadratic: Quadratic
    mass: Float32[np.ndarray, "N 3"]
    pixels: Float32[np.ndarray, " M"]
    latents: Float32[np.ndarray, "M D"]
    lifted: Float32[np.ndarray, "N 3 D"]
    weights: tuple[float, float, float]

    @staticmethod
    def of(
        masks: MaskOperator,
        quadratic: Quadratic,
        pixels: Float32[np.ndarray, " M"],
        latents: Float32[np.ndarray, "M D"],
        weights: tuple[float, float, float],
        start: Literal["average", "median", "random", "langsplat"] | np.ndarray = "average",
        seed: int = 0,
    ) -> "QuadraticProblem":
        """Compute the mass and the start of the field, to which the ridge pulls.

        `start` names the start or is its features (N, 3, D), as for "langsplat"; `seed` is for "random".
        """
        mass = level_mass(quadratic)
        if isinstance(start, np.ndarray):
            lifted = start
        elif start == "random":
            draws = np.random.default_rng(seed)
            lifted = draws.uniform(-1, 1, (*mass.shape, latents.shape[1])).astype(np.float32)
        else:
            lifted = lifted_average(masks, mass, pixels, latents)
            if start == "median":
                lifted = lifted_median(masks, pixels, latents, lifted)
        return QuadraticProblem(masks, quadratic, mass, pixels, latents, lifted, weights)

    @property
    def total_pixels(self) -> float:
        """Number of labelled pixels of all levels, the divisor that turns sums into means."""
        return max(float(self.pixels.sum(dtype=np.float64)), 1.0)

    def hessian_product(
        self, features: Float32[np.ndarray, "N 3 D"], curved: Float32[np.ndarray, "N 3 D"] | None = None
    ) -> Float32[np.ndarray, "N 3 D"]:
        """Return half the Hessian of the summed losses times the features; `curved` is G F, if known."""
        language, clustering, ridge = self.weights
        out = self.quadratic.product(features) if curved is None else curved.copy()
        out *= np.float32(language + clustering)
        if clustering:
            spread = self.masks.spread(self.pixels[:, None] * self.masks.means(features))
            spread *= np.float32(clustering)
            out -= spread
        add_scaled(np.float32(ridge), self.mass, features, out)
        return out

    def right_side(self) -> Float32[np.ndarray, "N 3 D"]:
        """Return the right side of the optimality condition hessian_product(F) = right_side()."""
        language, _, ridge = self.weights
        target = self.masks.spread(self.pixels[:, None] * self.latents)
        target *= np.float32(language)
        add_scaled(np.float32(ridge), self.mass, self.lifted, target)
        return target

    def terms(self, features: Float32[np.ndarray, "N 3 D"]) -> dict[str, float]:
        """Return the language loss, L_h and the ridge, unweighted, as means over labelled pixels.

        Both losses are small differences of large sums, so all sums are in float64.
        """
        form = self.quadratic.form(features)
        means = self.masks.means(features.astype(np.float64))
        pixels = self.pixels[:, None].astype(np.float64)
        linear = float((pixels * means * self.latents).sum())
        constant = float((pixels * np.square(self.latents, dtype=np.float64)).sum())
        cohesion = float((pixels * means**2).sum())
        return {
            "language": (form - 2 * linear + constant) / self.total_pixels,
            "clustering": (form - cohesion) / self.total_pixels,
            "ridge": pull(self.mass, features, self.lifted) / self.total_pixels,
        }


def conjugate_gradient(
    problem: QuadraticProblem,
    start: Float32[np.ndarray, "N 3 D"],
    steps: int,
    curved: Float32[np.ndarray, "N 3 D"] | None = None,
) -> np.ndarray:
    """Minimise the quadratic part in a few steps, preconditioned by the visible mass.

    `curved` is G times the start, if known. Levels and channels do not interact, so each has its own step
    size. Dot products are summed in float64 in a fixed order.
    """
    scale = problem.mass * np.float32(max(sum(problem.weights), 1e-12))
    inverse = np.where(scale > 0, 1 / np.maximum(scale, 1e-20), 0).astype(np.float32)
    features = start.copy()
    residual = problem.right_side()
    residual -= problem.hessian_product(features, curved)
    direction, ratio = np.zeros_like(residual), np.zeros(residual.shape[1:], np.float32)
    power = scaled_squares(inverse, residual)
    for _ in range(steps):
        redirect(inverse, residual, ratio, direction)
        turned = problem.hessian_product(direction)
        length = _ratio(power, channel_dots(direction, turned))
        add_by_channel(length, direction, features)
        add_by_channel(-length, turned, residual)
        before, power = power, scaled_squares(inverse, residual)
        ratio = _ratio(power, before)
    return features


def _ratio(
    above: Float64[np.ndarray, "3 D"], below: Float64[np.ndarray, "3 D"]
) -> Float32[np.ndarray, "3 D"]:
    """Return the quotient, or 0 if a channel is already solved."""
    return np.where(below > 0, above / np.where(below > 0, below, 1), 0).astype(np.float32)
