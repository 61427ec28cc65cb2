"""Minimise a smooth function of the field in few steps, with the same bytes on any number of threads."""

from collections.abc import Callable

import numpy as np

LBFGS_MEMORY = 8
SUFFICIENT_DECREASE = 1e-4
MAX_HALVINGS = 12

CHUNK = 2**18
"""Numbers to sum at a time: two megabytes in float64, whatever the size of the field."""

Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]


def lbfgs(objective: Objective, start: np.ndarray, steps: int, first_step: float) -> np.ndarray:
    """Limited-memory BFGS with step halving; every sum is taken in a fixed order.

    Args:
        objective: value and gradient at a point.
        start: initial point.
        steps: iterations; each costs one evaluation unless its step must be halved.
        first_step: inverse curvature assumed before the first step.
    """
    point = start
    value, gradient = objective(point)
    memory: list[tuple[np.ndarray, np.ndarray, float]] = []
    for _ in range(steps):
        direction = -_two_loops(gradient, memory, first_step)
        slope = dot(direction, gradient)
        if slope >= 0:
            break
        length = 1.0
        for _halving in range(MAX_HALVINGS):
            candidate = point + np.float32(length) * direction
            new_value, new_gradient = objective(candidate)
            if new_value <= value + SUFFICIENT_DECREASE * length * slope:
                break
            length /= 2
        else:
            break
        moved, turned = candidate - point, new_gradient - gradient
        curvature = dot(moved, turned)
        if curvature > 0:
            memory = [*memory, (moved, turned, curvature)][-LBFGS_MEMORY:]
        point, value, gradient = candidate, new_value, new_gradient
    return point


def dot(a: np.ndarray, b: np.ndarray) -> float:
    """Sum of products in float64 (no BLAS: its order of summation depends on the threads)."""
    a, b = a.reshape(-1), b.reshape(-1)
    return float(
        sum(
            np.multiply(a[begin : begin + CHUNK], b[begin : begin + CHUNK], dtype=np.float64).sum()
            for begin in range(0, len(a), CHUNK)
        )
    )


def _two_loops(
    gradient: np.ndarray, memory: list[tuple[np.ndarray, np.ndarray, float]], first_step: float
) -> np.ndarray:
    """Inverse Hessian times gradient, from the remembered steps."""
    result = gradient.copy()
    factors = []
    for moved, turned, curvature in reversed(memory):
        factor = dot(moved, result) / curvature
        result -= np.float32(factor) * turned
        factors.append(factor)
    if memory:
        _, turned, curvature = memory[-1]
        result *= np.float32(curvature / dot(turned, turned))
    else:
        result *= np.float32(first_step)
    for (moved, turned, curvature), factor in zip(memory, reversed(factors), strict=True):
        result += np.float32(factor - dot(turned, result) / curvature) * moved
    return result
