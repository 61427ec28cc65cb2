"""Solve the field: lifted average, conjugate gradient, then L-BFGS if a contrastive loss is used.

Both solvers stop early, because more steps would fit the noise of mask borders.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32

from hilsplat.base.progress import track
from hilsplat.field.contrast import Contrast
from hilsplat.field.kernels import add_multiple, add_slope, flat_dot
from hilsplat.field.problem import QuadraticProblem, conjugate_gradient

LBFGS_MEMORY = 8
SUFFICIENT_DECREASE = 1e-4
MAX_HALVINGS = 12

Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]


def solve_field(
    problem: QuadraticProblem, contrast: Contrast
) -> tuple[Float32[np.ndarray, "N 3 D"], dict[str, object]]:
    """Return the features, and a report with every loss before and after each phase.

    Several blocks are solved one after the other, with the features of all other blocks fixed at their latest
    values; the report then has the losses before and after all blocks.
    """
    report: dict[str, object] = {}
    if len(problem.blocks) == 1:
        for phase, features in _phases(problem, contrast):
            report[phase] = problem.terms(features) | contrast.values(features)
        return features, report
    features = problem.lifted.copy()
    report["lifted"] = problem.terms(features) | contrast.values(features)
    operators = contrast.masks, contrast.half_masks
    means = [operator.means(features) for operator in operators]
    for begin, end in track(problem.blocks, "blocks of the field"):
        parts = [operator.block(begin, end) for operator in operators]
        outer = [total - part.means(features[begin:end]) for total, part in zip(means, parts, strict=True)]
        block = replace(
            problem,
            masks=parts[0],
            quadratic=problem.quadratic.block(begin, end),
            mass=problem.mass[begin:end],
            lifted=problem.lifted[begin:end],
            blocks=((0, end - begin),),
            others=(problem.quadratic.across(begin, end, features), outer[0]),
        )
        of_block = replace(contrast, masks=parts[0], half_masks=parts[1], others=(outer[0], outer[1]))
        for phase, solved in _phases(block, of_block):
            last = phase, solved
        features[begin:end] = last[1]
        means = [fixed + part.means(last[1]) for fixed, part in zip(outer, parts, strict=True)]
    report[last[0]] = problem.terms(features) | contrast.values(features)
    return features, report | {"blocks": len(problem.blocks)}


def _phases(
    problem: QuadraticProblem, contrast: Contrast
) -> Iterator[tuple[str, Float32[np.ndarray, "N 3 D"]]]:
    """Yield the name and the features of each phase: "lifted", "after_cg" and "after_lbfgs"."""
    settings, total = contrast.settings, problem.total_pixels
    flat = -1, problem.latents.shape[1]  # a shape with one row per Gaussian and level
    # L-BFGS needs much memory, so its variables are only the features visible in masks, scaled by the square
    # root of the mass, which makes the quadratic part nearly isotropic.
    seen = np.flatnonzero(problem.mass)
    root = np.sqrt(problem.mass.reshape(-1)[seen])[:, None]
    inverse_root = np.zeros(problem.mass.shape, np.float32)
    inverse_root.reshape(-1)[seen] = (1 / np.maximum(root, 1e-10))[:, 0]
    right = problem.right_side()

    def unscale(scaled: np.ndarray) -> None:
        features.reshape(flat)[seen] = scaled * inverse_root.reshape(-1)[seen][:, None]

    def objective(scaled: np.ndarray) -> tuple[float, np.ndarray]:
        unscale(scaled)
        curved = problem.hessian_product(features)
        value = (dot(features, curved) - 2 * dot(features, right)) / total
        contrastive, gradient = contrast.weighted(features)
        add_slope(np.float32(2 / total), curved, right, inverse_root, gradient)
        del curved
        return value + contrastive, gradient.reshape(flat)[seen]

    yield "lifted", problem.lifted
    if settings.cg_steps and any(problem.weights):
        features = conjugate_gradient(problem, settings.cg_steps)
        yield "after_cg", features
    else:
        features = problem.lifted.copy()
    if (settings.weight_instance or settings.weight_part) and settings.lbfgs_steps:
        first_step = total / (2 * max(sum(problem.weights), 1e-3))
        unscale(lbfgs(objective, features.reshape(flat)[seen] * root, settings.lbfgs_steps, first_step))
        yield "after_lbfgs", features


def keep_labelled(
    features: Float32[np.ndarray, "N 3 D"],
    mass: Float32[np.ndarray, "N 3"],  # visible weight in labelled pixels of each level
    total_mass: Float[np.ndarray, " N"],  # visible weight in all pixels
    min_share: float,
) -> Float32[np.ndarray, "N 3 D"]:
    """Remove latents of Gaussians that have little of their visible weight in a level's labelled pixels.

    Tables and walls have no part masks. But if a mask extends onto a wall by a pixel, the wall's Gaussians
    get the mask's latent and match its queries everywhere, because the regression uses only labelled pixels.
    """
    share = mass / np.maximum(total_mass, 1e-12)[:, None]
    return np.where((share >= min_share)[:, :, None], features, np.float32(0)).astype(np.float32, copy=False)


def lbfgs(objective: Objective, point: np.ndarray, steps: int, first_step: float) -> np.ndarray:
    """Minimise by limited-memory BFGS with step halving; every sum is computed in a fixed order.

    The start `point` is overwritten. Each step evaluates the value and gradient once, plus once per halving.
    `first_step` is the inverse curvature assumed for the first step.
    """
    value, gradient = objective(point)
    memory: list[tuple[np.ndarray, np.ndarray, float]] = []
    for _ in range(steps):
        direction = _two_loops(gradient, memory, first_step)
        np.negative(direction, out=direction)
        slope = dot(direction, gradient)
        if slope >= 0:
            break
        length = 1.0
        for _halving in range(MAX_HALVINGS):
            candidate = np.float32(length) * direction
            candidate += point
            new_value, new_gradient = objective(candidate)
            if new_value <= value + SUFFICIENT_DECREASE * length * slope:
                break
            length /= 2
        else:
            break
        del direction
        # reuse the memory of vectors that are no longer needed: each takes over 100 MiB in a large scene
        moved = np.subtract(candidate, point, out=point)
        turned = np.subtract(new_gradient, gradient, out=gradient)
        curvature = dot(moved, turned)
        if curvature > 0:
            memory = [*memory, (moved, turned, curvature)][-LBFGS_MEMORY:]
        point, value, gradient = candidate, new_value, new_gradient
    return point


def dot(a: np.ndarray, b: np.ndarray) -> float:
    """Return the dot product in float64, without BLAS, whose summation order varies with the thread count."""
    return float(flat_dot(np.ascontiguousarray(a).reshape(-1), np.ascontiguousarray(b).reshape(-1)))


def _two_loops(
    gradient: np.ndarray, memory: list[tuple[np.ndarray, np.ndarray, float]], first_step: float
) -> np.ndarray:
    """Return the approximate inverse Hessian times the gradient, computed from the steps in `memory`."""
    result = gradient.copy()
    flat, factors = result.reshape(-1), []
    for moved, turned, curvature in reversed(memory):
        factor = dot(moved, result) / curvature
        add_multiple(np.float32(-factor), turned.reshape(-1), flat)
        factors.append(factor)
    if memory:
        _, turned, curvature = memory[-1]
        first_step = curvature / dot(turned, turned)
    result *= np.float32(first_step)
    for (moved, turned, curvature), factor in zip(memory, reversed(factors), strict=True):
        add_multiple(np.float32(factor - dot(turned, result) / curvature), moved.reshape(-1), flat)
    return result
