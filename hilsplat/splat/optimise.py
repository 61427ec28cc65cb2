"""Adam for the Gaussians' parameters, with the step sizes of 3DGS."""

from dataclasses import dataclass

import numpy as np

from cpusplat.adam import adam_step
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.rasterise.drawn import Gradients

OPACITY_RATE = 0.05  # 3DGS
SH_REST_SHARE = 1 / 20
"""Step size of view-dependent harmonics relative to that of the constant ones (3DGS)."""


def means_rate(settings: GaussiansSettings, progress: float) -> float:
    """Return the step size of the means in units of the extent; it falls exponentially with progress."""
    return settings.means_rate ** (1 - progress) * settings.means_rate_last**progress


@dataclass
class Adam:
    """Parameters and running moments of their gradients: arrays by field, all updated in place."""

    parameters: dict[str, np.ndarray]
    first: dict[str, np.ndarray]
    second: dict[str, np.ndarray]
    steps: int = 0

    @staticmethod
    def start(parameters: dict[str, np.ndarray]) -> "Adam":
        """Return the parameters with zero moments."""
        zeros = [{name: np.zeros_like(values) for name, values in parameters.items()} for _ in range(2)]
        return Adam(parameters, zeros[0], zeros[1])

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def as_gaussians(self) -> Gaussians:
        """Return Gaussians that share memory with the current values."""
        return Gaussians(**self.parameters)

    def step(
        self, gradients: Gradients, settings: GaussiansSettings, rate_of_means: float, threads: int
    ) -> None:
        """Take one step; `rate_of_means` is in scene units."""
        self.steps += 1
        of_rest = SH_REST_SHARE * settings.sh_rate
        rates: dict[str, list[float]] = {  # one rate per number of a Gaussian, repeated cyclically
            "means": [rate_of_means],
            "log_scales": [settings.scales_rate],
            "quats": [settings.quats_rate],
            "opacity_logits": [OPACITY_RATE],
            "sh": 3 * [settings.sh_rate] + (self.parameters["sh"].shape[1] - 1) * 3 * [of_rest],
        }
        for name, rate in rates.items():
            arrays = (self.parameters[name], getattr(gradients, name), self.first[name], self.second[name])
            values, gradient, first, second = (array.reshape(-1) for array in arrays)
            adam_step(values, gradient, first, second, rate, self.steps, threads)

    def keep(self, rows: np.ndarray) -> None:
        """Keep the given rows (mask or indices) and their moments."""
        for table in (self.parameters, self.first, self.second):
            for name in FIELDS:
                table[name] = np.ascontiguousarray(table[name][rows])

    def reset_moments(self, rows: np.ndarray | slice, names: tuple[str, ...] = FIELDS) -> None:
        """Set the moments of some rows and fields to zero."""
        for table in (self.first, self.second):
            for name in names:
                table[name][rows] = 0

    def append(self, more: dict[str, np.ndarray]) -> None:
        """Add Gaussians with zero moments."""
        for name, rows in more.items():
            zeros = np.zeros_like(rows)
            for table, added in ((self.parameters, rows), (self.first, zeros), (self.second, zeros)):
                table[name] = np.concatenate([table[name], added])
