"""Fused Adam over the parameters of the Gaussians, with the step sizes of 3DGS."""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np

from hilsplat.base.compiled import compiled
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.rasterise.cpu import Gradients, over_ranges

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15  # 3DGS

OPACITY_RATE = 0.05  # 3DGS
SH_RATE, SH_REST_RATE = 2.5e-3, 2.5e-3 / 20  # constant term, other terms; 3DGS


def means_rate(settings: GaussiansSettings, progress: float) -> float:
    """Step size of the means in units of the cameras' extent: falls exponentially from first to last.

    Args:
        progress: share of the iterations done, in [0, 1].
    """
    return settings.means_rate ** (1 - progress) * settings.means_rate_last**progress


@compiled(error_model="numpy")
@no_type_check
def _adam_rows(
    begin, end, values, gradients, first, second, rate, rate_rest, columns, head, root, one_minus1
):
    """Adam for rows begin..end, in place.

    The first `head` of the `columns` numbers of a row step by `rate`, the others by `rate_rest`;
    `root` is sqrt(1 - beta2^t), `one_minus1` 1 - beta1^t.
    """
    beta1, rest1 = np.float32(BETA1), np.float32(1.0 - BETA1)
    beta2, rest2 = np.float32(BETA2), np.float32(1.0 - BETA2)
    epsilon, inverse_root = np.float32(EPSILON), np.float32(1.0 / root)
    for row in range(begin, end):
        for part in range(2):
            start = row * columns + (head if part else 0)
            stop = row * columns + (columns if part else head)
            step = np.float32((rate_rest if part else rate) / one_minus1)
            for k in range(start, stop):
                g = gradients[k]
                m = beta1 * first[k] + rest1 * g
                v = beta2 * second[k] + rest2 * g * g
                first[k] = m
                second[k] = v
                values[k] -= step * m / (np.sqrt(v) * inverse_root + epsilon)


@dataclass
class Adam:
    """Parameters with the running moments of their gradients (all changed in place).

    Attributes:
        parameters, first, second: arrays keyed by field, rows are Gaussians.
        steps: steps taken.
    """

    parameters: dict[str, np.ndarray]
    first: dict[str, np.ndarray]
    second: dict[str, np.ndarray]
    steps: int = 0

    @staticmethod
    def start(parameters: dict[str, np.ndarray]) -> "Adam":
        """Moments at zero."""
        first, second = (
            {name: np.zeros_like(values) for name, values in parameters.items()} for _ in range(2)
        )
        return Adam(parameters, first, second)

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def as_gaussians(self) -> Gaussians:
        """The current values (shared memory)."""
        return Gaussians(**self.parameters)

    def step(
        self, gradients: Gradients, settings: GaussiansSettings, rate_of_means: float, threads: int
    ) -> None:
        """One step.

        Args:
            settings: step sizes of scales and quaternions.
            rate_of_means: step size of the means, scene units.
        """
        self.steps += 1
        rates = {
            "means": (rate_of_means, rate_of_means),
            "log_scales": (settings.scales_rate, settings.scales_rate),
            "quats": (settings.quats_rate, settings.quats_rate),
            "opacity_logits": (OPACITY_RATE, OPACITY_RATE),
            "sh": (SH_RATE, SH_REST_RATE),
        }
        root, one_minus1 = float(np.sqrt(1 - BETA2**self.steps)), 1 - BETA1**self.steps
        for name, (rate, rate_rest) in rates.items():
            values = self.parameters[name]
            columns = int(np.prod(values.shape[1:], dtype=int))
            flat = [
                array.reshape(-1)
                for array in (values, getattr(gradients, name), self.first[name], self.second[name])
            ]
            head = 3 if name == "sh" else columns
            sizes = (rate, rate_rest, columns, head, root, one_minus1)
            over_ranges(_adam_rows, len(values), threads, *flat, *sizes)

    def keep(self, rows: np.ndarray) -> None:
        """Keep these rows (mask or indices), with their moments."""
        for table in (self.parameters, self.first, self.second):
            for name in FIELDS:
                table[name] = np.ascontiguousarray(table[name][rows])

    def append(self, more: dict[str, np.ndarray]) -> None:
        """Add Gaussians with moments at zero."""
        for name in FIELDS:
            zeros = np.zeros_like(more[name])
            for table, rows in ((self.parameters, more[name]), (self.first, zeros), (self.second, zeros)):
                table[name] = np.concatenate([table[name], rows])
