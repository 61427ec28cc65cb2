"""The quadratic part of the field's objective: language loss, clustering loss and ridge.

With the rendered map M = W F, the mask means A F, the areas n and the mask latents h (see
`contributions`), and all sums divided by the number of labelled pixels:

- language loss (least-squares regression): tr F'GF - 2 sum n h.(AF) + sum n |h|^2
- clustering loss L_h (Eq. 2):              tr F'GF - sum n |AF|^2
- ridge: sum of visible mass x |F - F_lifted|^2

Their sum is a single quadratic form, minimised by a few conjugate-gradient steps from the lifted average.

Departs: the paper's objective has no CLIP term, so a constant field minimises it. The language loss is
LangSplat's regression with squared instead of absolute differences, averaged over labelled pixels only.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float32, Float64

from hilsplat.contributions.mask_operator import MaskOperator, lifted_average
from hilsplat.contributions.quadratic import Blocks, Quadratic, form, level_mass
from hilsplat.field.kernels import add_by_channel, add_scaled, channel_dots, pull, redirect, scaled_squares


@dataclass(frozen=True)
class QuadraticProblem:
    """Language loss, clustering loss and ridge: all terms except the contrastive losses."""

    masks: MaskOperator  # A
    quadratic: Quadratic
    mass: Float32[np.ndarray, "N 3"]  # G times ones: visible mass of each Gaussian at each level, px
    pixels: Float32[np.ndarray, " M"]  # n
    latents: Float32[np.ndarray, "M D"]  # h
    lifted: Float32[np.ndarray, "N 3 D"]  # start of the field, towards which the ridge pulls
    weights: tuple[float, float, float]  # of the language loss, the clustering loss and the ridge
    blocks: Blocks  # Gaussians that are solved together
    # within a block: G times the features of all other Gaussians, and their part of the mask means
    others: tuple[Float32[np.ndarray, "N 3 D"], Float32[np.ndarray, "M D"]] | None = None

    @staticmethod
    def of(
        masks: MaskOperator,
        quadratic: Quadratic,
        pixels: Float32[np.ndarray, " M"],
        latents: Float32[np.ndarray, "M D"],
        weights: tuple[float, float, float],
        start: str | Float32[np.ndarray, "N 3 D"] = "average",  # or "random", or features
        seed: int = 0,
        block_gaussians: int = 2**20,
    ) -> "QuadraticProblem":
        """Compute the mass and the start of the field, towards which the ridge pulls."""
        count = quadratic.num_gaussians
        edges = np.linspace(0, count, -(-count // block_gaussians) + 1).astype(np.int64)
        blocks = tuple(pairwise(edges.tolist()))
        mass = level_mass(quadratic, blocks)
        if isinstance(start, np.ndarray):
            lifted = start
        elif start == "random":
            draws = np.random.default_rng(seed)
            lifted = draws.uniform(-1, 1, (*mass.shape, latents.shape[1])).astype(np.float32)
        else:
            lifted = lifted_average(masks, mass, pixels, latents)
        return QuadraticProblem(masks, quadratic, mass, pixels, latents, lifted, weights, blocks)

    @property
    def total_pixels(self) -> float:
        """Number of labelled pixels at all levels, the divisor that converts sums to means."""
        return max(float(self.pixels.sum(dtype=np.float64)), 1.0)

    def hessian_product(self, features: Float32[np.ndarray, "N 3 D"]) -> Float32[np.ndarray, "N 3 D"]:
        """Return half the Hessian of the summed losses times the features."""
        language, clustering, ridge = self.weights
        out = self.quadratic.product(features)
        out *= np.float32(language + clustering)
        if clustering:
            spread = self.masks.spread(self.pixels[:, None] * self.masks.means(features))
            spread *= np.float32(clustering)
            out -= spread
        add_scaled(np.float32(ridge), self.mass, features, out)
        return out

    def right_side(self) -> Float32[np.ndarray, "N 3 D"]:
        """Return the right side of the optimality condition hessian_product(F) = right_side()."""
        language, clustering, ridge = self.weights
        target = self.masks.spread(self.pixels[:, None] * self.latents)
        target *= np.float32(language)
        add_scaled(np.float32(ridge), self.mass, self.lifted, target)
        if self.others is not None:
            product, means = self.others
            target -= np.float32(language + clustering) * product
            if clustering:
                target += np.float32(clustering) * self.masks.spread(self.pixels[:, None] * means)
        return target

    def terms(self, features: Float32[np.ndarray, "N 3 D"]) -> dict[str, float]:
        """Return the language loss, L_h and the ridge, unweighted, as means over labelled pixels.

        Both losses are small differences of large sums, so all sums are computed in float64.
        """
        total, means = 0.0, np.zeros(self.latents.shape)
        for begin, end in self.blocks:
            of_block = features[begin:end]
            total += form(self.quadratic.block(begin, end), of_block)
            if len(self.blocks) > 1:
                total += float(channel_dots(of_block, self.quadratic.across(begin, end, features)).sum())
            means += self.masks.block(begin, end).means(of_block.astype(np.float64))
        pixels = self.pixels[:, None].astype(np.float64)
        linear = float((pixels * means * self.latents).sum())
        constant = float((pixels * np.square(self.latents, dtype=np.float64)).sum())
        cohesion = float((pixels * means**2).sum())
        return {
            "language": (total - 2 * linear + constant) / self.total_pixels,
            "clustering": (total - cohesion) / self.total_pixels,
            "ridge": pull(self.mass, features, self.lifted) / self.total_pixels,
        }


def conjugate_gradient(problem: QuadraticProblem, steps: int) -> Float32[np.ndarray, "N 3 D"]:
    """Minimise the quadratic part in a few steps from the lifted start, preconditioned by the visible mass.

    Levels and channels do not interact, so each pair of level and channel has its own step size.
    """
    scale = problem.mass * np.float32(max(sum(problem.weights), 1e-12))
    inverse = np.where(scale > 0, 1 / np.maximum(scale, 1e-20), 0).astype(np.float32)
    features = problem.lifted.copy()
    residual = problem.right_side()
    residual -= problem.hessian_product(features)
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
    """Return the quotient, or 0 where a channel is already solved."""
    return np.where(below > 0, above / np.where(below > 0, below, 1), 0).astype(np.float32)
