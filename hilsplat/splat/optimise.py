"""Fused Adam for the Gaussians' parameters, with the step sizes of 3DGS."""

from dataclasses import dataclass

import numpy as np

from cpusplat.compiled import compiled
from cpusplat.lanes import WIDTH, lanes, load, root, store
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.rasterise.cpu import Gradients, over_ranges

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15  # 3DGS

OPACITY_RATE = 0.05  # 3DGS
SH_REST_SHARE = 1 / 20
"""Step size of view-dependent harmonics relative to that of the constant ones (3DGS)."""


def means_rate(settings: GaussiansSettings, progress: float) -> float:
    """Return the step size of the means in units of the extent; it falls exponentially with progress."""
    return settings.means_rate ** (1 - progress) * settings.means_rate_last**progress


@compiled
def _adam_chunks(begin, end, values, gradients, first, second, rates, root_of_rest2):
    """Take an Adam step, in place, for chunks begin..end, which contain 16 numbers each.

    `rates` (divided by 1 - beta1^t) is cyclic: chunk k uses the rates from index 16 k. `root_of_rest2` is
    sqrt(1 - beta2^t).
    """
    beta1, rest1 = lanes(np.float32(BETA1)), lanes(np.float32(1.0 - BETA1))
    beta2, rest2 = lanes(np.float32(BETA2)), lanes(np.float32(1.0 - BETA2))
    epsilon, scale = lanes(np.float32(EPSILON)), lanes(np.float32(1.0 / root_of_rest2))
    for chunk in range(begin, end):
        at = chunk * WIDTH
        g = load(gradients, at)
        m = beta1 * load(first, at) + rest1 * g
        v = beta2 * load(second, at) + rest2 * g * g
        store(first, at, m)
        store(second, at, v)
        store(values, at, load(values, at) - load(rates, at % len(rates)) * m / (root(v) * scale + epsilon))


def _adam(arrays: list[np.ndarray], rates: list[float], t: int, threads: int) -> None:
    """Take Adam step `t` for flat arrays (values, gradients, moments), in place; `rates` is cyclic."""
    repeated = np.array(WIDTH * rates, np.float32) / np.float32(1 - BETA1**t)
    root_of_rest2 = float(np.sqrt(1 - BETA2**t))
    whole, rest = divmod(len(arrays[0]), WIDTH)
    over_ranges(_adam_chunks, whole, threads, *arrays, repeated, root_of_rest2)
    if rest:
        last = [np.concatenate([array[-rest:], np.zeros(WIDTH - rest, np.float32)]) for array in arrays]
        _adam_chunks(0, 1, *last, np.roll(repeated, -WIDTH * whole), root_of_rest2)
        for array, chunk in zip(arrays, last, strict=True):
            array[-rest:] = chunk[:rest]


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
            _adam([array.reshape(-1) for array in arrays], rate, self.steps, threads)

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
