"""Minimise a smooth function of the field in few steps, with a result independent of the thread count."""

from collections.abc import Callable

import numpy as np

from hilsplat.base.compiled import compiled

LBFGS_MEMORY = 8
SUFFICIENT_DECREASE = 1e-4
MAX_HALVINGS = 12

Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]


def lbfgs(objective: Objective, point: np.ndarray, steps: int, first_step: float) -> np.ndarray:
    """Minimise by limited-memory BFGS with step halving; every sum is taken in a fixed order.

    Args:
        objective: function that returns the value and gradient at a point.
        point: start, which is overwritten.
        steps: iterations; each takes one evaluation, plus one per halving of its step.
        first_step: inverse curvature assumed before the first step.
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
        # reuse the memory of vectors no longer needed: one takes over 100 MiB in a large scene
        moved, turned = (
            np.subtract(candidate, point, out=point),
            np.subtract(new_gradient, gradient, out=gradient),
        )
        curvature = dot(moved, turned)
        if curvature > 0:
            memory = [*memory, (moved, turned, curvature)][-LBFGS_MEMORY:]
        point, value, gradient = candidate, new_value, new_gradient
    return point


def dot(a: np.ndarray, b: np.ndarray) -> float:
    """Return the dot product in float64, without BLAS, whose order of summation depends on the threads."""
    return float(_dot(np.ascontiguousarray(a).reshape(-1), np.ascontiguousarray(b).reshape(-1)))


@compiled
def _dot(a, b):
    s, t, u, v = 0.0, 0.0, 0.0, 0.0
    fours = len(a) // 4 * 4
    for i in range(0, fours, 4):
        s += np.float64(a[i]) * np.float64(b[i])
        t += np.float64(a[i + 1]) * np.float64(b[i + 1])
        u += np.float64(a[i + 2]) * np.float64(b[i + 2])
        v += np.float64(a[i + 3]) * np.float64(b[i + 3])
    for i in range(fours, len(a)):
        s += np.float64(a[i]) * np.float64(b[i])
    return (s + t) + (u + v)


def _add(factor: float, vector: np.ndarray, out: np.ndarray) -> None:
    """Add a multiple of a vector to `out`, in float32, without a temporary."""
    _add_flat(np.float32(factor), vector.reshape(-1), out.reshape(-1))


@compiled
def _add_flat(factor, vector, out):
    for i in range(len(out)):
        out[i] += factor * vector[i]


def _two_loops(
    gradient: np.ndarray, memory: list[tuple[np.ndarray, np.ndarray, float]], first_step: float
) -> np.ndarray:
    """Return the approximate inverse Hessian times the gradient, from the remembered steps."""
    result = gradient.copy()
    factors = []
    for moved, turned, curvature in reversed(memory):
        factor = dot(moved, result) / curvature
        _add(-factor, turned, result)
        factors.append(factor)
    if memory:
        _, turned, curvature = memory[-1]
        result *= np.float32(curvature / dot(turned, turned))
    else:
        result *= np.float32(first_step)
    for (moved, turned, curvature), factor in zip(memory, reversed(factors), strict=True):
        _add(factor - dot(turned, result) / curvature, moved, result)
    return result
