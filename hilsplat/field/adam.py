"""Adam for hand-written gradients, in one pass over the parameters per step, and a random order of views."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from hilsplat.field.kernels import BETA1, BETA2, adam_step

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
        adam_step(self.values.reshape(-1), flat, *self._moments, rate, scale, np.float32(self.eps))
