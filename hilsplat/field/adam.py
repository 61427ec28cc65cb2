"""Adam for hand-written gradients, in one pass over the parameters per step, and a random order of views."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar, no_type_check

import numpy as np

from cpusplat.compiled import compiled

BETA1, BETA2 = 0.9, 0.999  # decay rates of the moments, as in torch
LEAST_MOMENT = np.float32(1e-36)  # smaller moments are set to 0

View = TypeVar("View")


def in_random_order(views: Sequence[View], random: np.random.Generator, steps: int) -> Iterator[View]:
    """Yield a view for each step; each view is used once before any is repeated."""
    order: list[int] = []
    for _ in range(steps):
        order = order or random.permutation(len(views)).tolist()
        yield views[order.pop()]


@dataclass
class Adam:
    """Adam for one parameter array, which `step` updates in place."""

    values: np.ndarray  # parameters, float32, contiguous
    rate: float  # step size; it may change between steps
    # added to the square root of the second moment: 1e-8 in torch, 1e-15 in 3DGS's optimiser and in the
    # published code of language fields
    eps: float = 1e-15

    def __post_init__(self) -> None:
        self.steps, self._moments = 0, np.zeros((2, self.values.size), np.float32)

    def step(self, gradient: np.ndarray) -> None:
        """Take one step, on a single thread, so that results are always byte-identical."""
        self.steps += 1
        rate = np.float32(self.rate / (1 - BETA1**self.steps))
        scale = np.float32((1 - BETA2**self.steps) ** -0.5)
        flat = np.ascontiguousarray(gradient, np.float32).reshape(-1)
        _step(self.values.reshape(-1), flat, *self._moments, rate, scale, np.float32(self.eps))


@compiled(error_model="numpy")
@no_type_check  # the shape checks of the test suite cannot be compiled
def _step(values, gradient, first, second, rate, scale, eps):
    """Take one step in place; `rate` is divided by 1 - beta1^t, and `scale` is 1 / sqrt(1 - beta2^t)."""
    for k in range(len(values)):
        g = gradient[k]
        m = np.float32(BETA1) * first[k] + np.float32(1 - BETA1) * g
        v = np.float32(BETA2) * second[k] + np.float32(1 - BETA2) * g * g
        # Processors are many times slower with subnormal numbers, which moments of unused units reach.
        first[k] = m if abs(m) > LEAST_MOMENT else np.float32(0)
        second[k] = v if v > LEAST_MOMENT else np.float32(0)
        values[k] -= rate * first[k] / (np.sqrt(second[k]) * scale + eps)
