"""State that a fit changes, and one optimiser step: on the CPU here, and on a card in `torch_model`."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.special import expit

from cpusplat.adam import adam_step
from cpusplat.photometric import photometric_loss
from cpusplat.threads import over_ranges
from cpusplat.views import Parameters
from hilsplat.base.images import to_float
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.initial import TrainingView
from hilsplat.splat.kernels import noise_rows
from hilsplat.splat.rasterise.api import draw
from hilsplat.splat.rasterise.device import Device

OPACITY_RATE = 0.05  # 3DGS
SH_REST_SHARE = 1 / 20  # step size of view-dependent harmonics relative to that of the constant ones (3DGS)

TABLES = ("parameters", "first", "second")
"""Arrays by field: the parameters, and the running moments of their gradients."""

Scores = Callable[[], tuple[float, float]]
"""Loss and mean squared error of a step's image, computed on request, because a card must finish first."""


def means_rate(settings: GaussiansSettings, progress: float) -> float:
    """Return the step size of the means in units of the extent; it falls exponentially with progress."""
    return settings.means_rate ** (1 - progress) * settings.means_rate_last**progress


def step_sizes(settings: GaussiansSettings, rate: float) -> dict[str, float]:
    """Return the step size of each field; `rate` is that of the means, in scene units.

    That of `sh` is for the constant harmonics; the others use SH_REST_SHARE of it.
    """
    rates = rate, settings.scales_rate, settings.quats_rate, OPACITY_RATE, settings.sh_rate
    return dict(zip(FIELDS, rates, strict=True))


def is_regularised(settings: GaussiansSettings) -> bool:
    """Return whether the loss includes MCMC's regularisers."""
    return settings.strategy == "mcmc" and settings.initial != "frozen"


class StepOptions(NamedTuple):
    """What varies between the steps of a fit."""

    degree: int  # of the spherical harmonics
    background: Float32[np.ndarray, " 3"]
    rate: float  # step size of the means, in units of the extent
    is_watched: bool  # whether to sum screen-space gradients


class Model:
    """Gaussians under optimisation: their parameters, Adam's moments, and sums of screen-space gradients.

    Arrays are NumPy arrays, updated in place; results are byte-identical for any number of threads.
    `TorchModel` keeps them on a card. Methods take and return NumPy arrays; `read` without rows and
    `as_gaussians` may share memory with the model.
    """

    def __init__(self, parameters: Mapping[str, np.ndarray], threads: int = 1) -> None:
        self.parameters, self.first, self.second = (dict[str, Any]() for _ in TABLES)
        self.threads, self.steps = threads, 0  # completed steps
        for name, values in parameters.items():
            self.parameters[name] = self.array(values)
            self.first[name], self.second[name] = (self.array(np.zeros_like(values)) for _ in range(2))
        self.restart_sums()

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def array(self, values: np.ndarray) -> Any:
        """Return an array on the model's device."""
        return values

    def host(self, array: Any) -> np.ndarray:
        """Return an array of the model's device in NumPy."""
        return np.asarray(array)

    def read(self, name: str, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return some rows (indices) of a parameter."""
        return self.host(self.parameters[name][self._on_device(rows)])

    def write(self, name: str, rows: np.ndarray | slice, values: np.ndarray) -> None:
        """Replace some rows of a parameter."""
        self.parameters[name][self._on_device(rows)] = self.array(values)

    def select(self, rows: Int64[np.ndarray, " n"]) -> None:
        """Replace all Gaussians and their moments by copies of the given rows; then call `restart_sums`."""
        chosen = self.array(rows)
        for table in TABLES:
            arrays = getattr(self, table)
            for name in FIELDS:
                arrays[name] = arrays[name][chosen]

    def copy(self, source: Int64[np.ndarray, " n"], targets: Int64[np.ndarray, " n"]) -> None:
        """Replace the target rows and their moments by copies of the source rows."""
        for table in TABLES:
            for array in getattr(self, table).values():
                array[self.array(targets)] = array[self.array(source)]

    def reset_moments(self, rows: np.ndarray | slice, names: tuple[str, ...] = FIELDS) -> None:
        """Set the moments of some rows and fields to zero."""
        for table in (self.first, self.second):
            for name in names:
                table[name][self._on_device(rows)] = 0

    def restart_sums(self) -> None:
        """Set the sums of screen-space gradients to zero."""
        self.total, self.seen = (self.array(np.zeros(len(self), kind)) for kind in (np.float64, np.int32))

    def screen_gradients(self) -> Float64[np.ndarray, " N"]:
        """Return the mean length of each Gaussian's screen-space gradient, over the steps that drew it.

        The gradient is in units of half the image: x times half its width, y times half its height.
        """
        return self.host(self.total) / np.maximum(self.host(self.seen), 1)

    def as_gaussians(self) -> Gaussians:
        """Return the current parameters."""
        return Gaussians(**{name: self.read(name) for name in FIELDS})

    def state(self) -> dict[str, np.ndarray]:
        """Return all arrays, from which `restore` rebuilds the model exactly."""
        sums = {"gradient_total": self.host(self.total), "gradient_seen": self.host(self.seen)}
        tables = {
            f"{table}_{name}": self.host(getattr(self, table)[name]) for table in TABLES for name in FIELDS
        }
        return {"steps": np.array(self.steps), **sums, **tables}

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], threads: int) -> "Model":
        """Rebuild a model from `state`."""
        model = cls({name: arrays[f"parameters_{name}"] for name in FIELDS}, threads)
        for table in TABLES[1:]:
            setattr(model, table, {name: model.array(arrays[f"{table}_{name}"]) for name in FIELDS})
        model.total, model.seen = (model.array(arrays[f"gradient_{name}"]) for name in ("total", "seen"))
        model.steps = arrays["steps"].item()
        return model

    def _on_device(self, rows: np.ndarray | slice) -> Any:
        return rows if isinstance(rows, slice) else self.array(rows)

    def step(
        self, view: TrainingView, settings: GaussiansSettings, extent: float, options: StepOptions
    ) -> Scores:
        """Take one step of Adam on one view; `extent` is the radius of the cameras, in scene units.

        Raises:
            HilsplatError: if some Gaussians cannot be drawn; a card may report them when scores are read.
        """
        degree, background, rate, is_watched = options
        drawing = draw(self.as_gaussians(), view.camera, degree, threads=self.threads)
        image, grad_alpha = drawing.image, np.zeros_like(drawing.alpha)
        if background.any():
            image = drawing.image + (1 - drawing.alpha)[..., None] * background
        target = to_float(view.image)
        loss, grad = photometric_loss(image, target, ssim_weight=settings.ssim_weight, threads=self.threads)
        if background.any():
            grad_alpha = -(grad @ background)
        gradients, by_mean_px = drawing.gradients(grad, grad_alpha)
        if is_regularised(settings):
            self.add_regularisers(gradients, settings, extent)
        if is_watched:
            self.add_screen_gradients(by_mean_px, drawing.drawn, view.camera.size_hw)
        self.descend(gradients, step_sizes(settings, extent * rate))
        return lambda: (loss, float(np.square(image - target).mean(dtype=np.float64)))

    def add_regularisers(self, gradients: Parameters, settings: GaussiansSettings, extent: float) -> None:
        """Add the gradients of opacity_weight x mean opacity + scale_weight x mean scale (MCMC, Eq. 10).

        Scales are in units of the extent.
        """
        n = len(self)
        opacity = expit(self.parameters["opacity_logits"])
        by_logit, by_log_scale = gradients.opacity_logits, gradients.log_scales
        by_logit += np.float32(settings.mcmc_opacity_weight / n) * opacity * (1 - opacity)
        scales = np.exp(self.parameters["log_scales"])
        by_log_scale += np.float32(settings.mcmc_scale_weight / (3 * n * extent)) * scales

    def add_screen_gradients(
        self, means_px: Float32[np.ndarray, "N 2"], drawn: np.ndarray, size_hw: tuple[int, int]
    ) -> None:
        """Add the gradients of one view's step; they are zero for Gaussians that are not drawn."""
        x, y = means_px[:, 0] * np.float64(size_hw[1] / 2), means_px[:, 1] * np.float64(size_hw[0] / 2)
        self.total += np.sqrt(x * x + y * y)
        self.seen += drawn

    def descend(self, gradients: Parameters, rates: dict[str, float]) -> None:
        """Take one step of Adam with the given step sizes (see `step_sizes`)."""
        self.steps += 1
        for name, rate in rates.items():
            of_rest = (self.parameters["sh"].shape[1] - 1) * 3 * [SH_REST_SHARE * rate]
            cyclic = 3 * [rate] + of_rest if name == "sh" else [rate]  # one rate per number of a Gaussian
            arrays = (self.parameters[name], getattr(gradients, name), self.first[name], self.second[name])
            values, gradient, first, second = (array.reshape(-1) for array in arrays)
            adam_step(values, gradient, first, second, cyclic, self.steps, self.threads)

    def add_noise(
        self, settings: GaussiansSettings, rate: float, extent: float, generator: np.random.Generator
    ) -> None:
        """Move the means of transparent Gaussians randomly along their own axes (SGLD; MCMC's paper, Eq. 8).

        The step is noise weight x rate of the means x gate x covariance x normal numbers, limited to the
        extent. The paper assumes scenes of extent 1; here the covariance and `rate` are in units of the
        extent, so that the result does not depend on the scene's unit.
        """
        p = self.parameters
        normal = generator.standard_normal(p["means"].shape, dtype=np.float32)
        arrays = (p["means"], p["log_scales"], p["quats"], p["opacity_logits"], normal)
        weight = settings.mcmc_noise * rate
        over_ranges(noise_rows, len(self), self.threads, *arrays, settings.min_opacity, weight, extent)


def model_on(device: Device) -> type[Model]:
    """Return the class of models on a device; only that for `cuda` imports torch."""
    if device == "cpu":
        return Model
    from hilsplat.splat.torch_model import TorchModel

    return TorchModel
