"""Solve the field: lifted average, conjugate gradient, then L-BFGS if contrastive losses have a weight.

Both solvers stop early, since more steps would fit the noise of mask borders.
"""

import numpy as np
from jaxtyping import Float, Float32

from hilsplat.field.contrast import Contrast
from hilsplat.field.minimise import dot, lbfgs
from hilsplat.field.one_pass import add_slope
from hilsplat.field.problem import QuadraticProblem, conjugate_gradient
from hilsplat.settings import FieldSettings


def solve_field(
    problem: QuadraticProblem, contrast: Contrast, settings: FieldSettings
) -> tuple[Float32[np.ndarray, "N 3 D"], dict[str, object]]:
    """Solve by lifting, conjugate gradient, and L-BFGS if a contrastive loss has a weight.

    Returns:
        the features, and a report: every loss before and after each phase.
    """
    weights = (settings.weight_instance, settings.weight_part)
    total = problem.total_pixels
    # The steps of L-BFGS take much memory, so its variables are only those that a mask shows. They are scaled
    # by the root of the mass, which makes the quadratic part nearly isotropic.
    shown = np.flatnonzero(problem.mass)
    root = np.sqrt(problem.mass.reshape(-1)[shown])[:, None]
    inverse_root = np.zeros(problem.mass.shape, np.float32)
    inverse_root.reshape(-1)[shown] = (1 / np.maximum(root, 1e-10))[:, 0]
    right = problem.right_side()

    def unscale(scaled: np.ndarray) -> None:
        _rows(features)[shown] = scaled * inverse_root.reshape(-1)[shown][:, None]

    def objective(scaled: np.ndarray) -> tuple[float, np.ndarray]:
        unscale(scaled)
        curved = problem.hessian_product(features)
        value = (dot(features, curved) - 2 * dot(features, right)) / total
        contrastive, gradient = contrast.weighted(features, weights)
        add_slope(np.float32(2 / total), curved, right, inverse_root, gradient)
        del curved
        return value + contrastive, _rows(gradient)[shown]

    lifted = problem.lifted
    at_lift = problem.quadratic.product(lifted)
    report: dict[str, object] = {"lifted": problem.terms(lifted) | contrast.values(lifted)}
    if settings.cg_steps and any(problem.weights):
        features = conjugate_gradient(problem, lifted, settings.cg_steps, at_lift)
        report["after_cg"] = problem.terms(features) | contrast.values(features)
    else:
        features = lifted.copy()
    del at_lift
    if any(weights) and settings.lbfgs_steps:
        first_step = total / (2 * max(sum(problem.weights), 1e-3))
        unscale(lbfgs(objective, _rows(features)[shown] * root, settings.lbfgs_steps, first_step))
        report["after_lbfgs"] = problem.terms(features) | contrast.values(features)
    return features.astype(np.float32), report


def _rows(features: Float32[np.ndarray, "N 3 D"]) -> Float32[np.ndarray, "R D"]:
    """Return one row per Gaussian and level, in the same memory."""
    return features.reshape(-1, features.shape[2])


def keep_labelled(
    features: Float32[np.ndarray, "N 3 D"],
    mass: Float32[np.ndarray, "N 3"],
    total_mass: Float[np.ndarray, " N"],
    min_share: float,
) -> Float32[np.ndarray, "N 3 D"]:
    """Remove the latents of Gaussians with little of their visible weight in a level's labelled pixels.

    Tables and walls have no part masks. But where a mask border extends onto them by a pixel, their Gaussians
    get the mask's full latent and match its queries everywhere: the regression uses only labelled pixels.

    Args:
        features: the solved field.
        mass: visible weight in labelled pixels of each level.
        total_mass: visible weight in all pixels.
        min_share: minimum share of the weight in labelled pixels.
    """
    share = mass / np.maximum(total_mass, 1e-12)[:, None]
    return np.where((share >= min_share)[:, :, None], features, np.float32(0)).astype(np.float32)
