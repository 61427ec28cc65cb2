"""Adam for the methods that train on mask means, in one pass over the numbers."""

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
        _adam(
            self.values.reshape(-1),
            np.ascontiguousarray(gradient, np.float32).reshape(-1),
            *self._moments,
            np.float32(self.rate / (1 - BETAS[0] ** self.steps)),
            np.float32(1 / np.sqrt(1 - BETAS[1] ** self.steps)),
        )


@compiled
def _adam(values, gradient, first, second, rate, scale):
    keep1, rest1 = np.float32(BETAS[0]), np.float32(1 - BETAS[0])
    keep2, rest2 = np.float32(BETAS[1]), np.float32(1 - BETAS[1])
    for k in range(len(values)):
        g = gradient[k]
        first[k] = keep1 * first[k] + rest1 * g
        second[k] = keep2 * second[k] + rest2 * g * g
        values[k] -= rate * first[k] / (np.sqrt(second[k]) * scale + np.float32(EPS))
