"""Adam for the methods whose gradients are written out by hand, in one pass over the numbers."""

from dataclasses import dataclass, field

import numpy as np

from hilsplat.base.compiled import compiled

BETAS = (0.9, 0.999)
EPS = 1e-15
"""As in the optimiser of 3DGS, which the published codes keep."""


@dataclass
class Adam:
    """Running moments of one array of parameters, which `step` changes in place.

    Attributes:
        values: parameters, float32, contiguous.
        rate: step size.
    """

    values: np.ndarray
    rate: float
    steps: int = 0
    _moments: tuple[np.ndarray, np.ndarray] = field(init=False)

    def __post_init__(self) -> None:
        self._moments = np.zeros(self.values.size, np.float32), np.zeros(self.values.size, np.float32)

    def step(self, gradient: np.ndarray) -> None:
        """One step; the same bytes on any number of threads, for there is one."""
        self.steps += 1
        unbiased = (np.float32(1 - beta**self.steps) for beta in BETAS)
        flat = np.ascontiguousarray(gradient, np.float32).reshape(-1)
        _adam(flat, *self._moments, self.values.reshape(-1), np.float32(self.rate), *unbiased)


@compiled(error_model="numpy")
def _adam(gradient, first, second, values, rate, unbiased1, unbiased2):
    rest1, rest2 = np.float32(1 - BETAS[0]), np.float32(1 - BETAS[1])
    for k in range(len(values)):
        g = gradient[k]
        first[k] += rest1 * (g - first[k])
        second[k] += rest2 * (g * g - second[k])
        values[k] -= rate * (first[k] / unbiased1) / (np.sqrt(second[k] / unbiased2) + np.float32(EPS))
