"""Model of a fit on a card: parameters, moments, images and sums stay there; gsplat draws.

A step copies nothing of the size of the model between host and card. It does not wait for the card either,
except once within gsplat, which reads how many pairs of Gaussians and tiles there are.
"""

from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d
from torch.optim.adam import adam

from cpusplat.adam import BETA1, BETA2, EPSILON
from cpusplat.photometric import C1, C2, TAPS
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.gaussians import FIELDS
from hilsplat.splat.initial import TrainingView
from hilsplat.splat.kernels import MIN_GATE, NOISE_SHARPNESS
from hilsplat.splat.model import SH_REST_SHARE, Model, Scores, StepOptions, is_regularised, step_sizes
from hilsplat.splat.rasterise import cuda
from hilsplat.splat.rasterise.api import refuse_broken

try:
    from fused_ssim import fused_ssim  # the same value in one kernel
except ImportError:
    fused_ssim = None

PASSING_BYTES = 600
"""Estimated bytes per Gaussian of a step's intermediates: projection, colours, copy of `sh`, tile lists."""
PIXEL_BYTES = 800
"""Estimated bytes per pixel of the largest view of a step's image, its loss and their gradients."""
SPARE = 1.1  # estimated factor for memory that torch reserves but cannot use


def bytes_needed(number: int, num_harmonics: int, pixels: list[int]) -> int:
    """Return about how much of a card's memory a fit needs.

    Each number of a Gaussian has a value, a gradient and two moments in float32: 944 bytes at degree 3.

    Args:
        number: maximum number of Gaussians.
        num_harmonics: (degree + 1)^2 of the spherical harmonics.
        pixels: number of pixels of each training view, which is stored in uint8.
    """
    of_gaussian = 4 * 4 * (11 + 3 * num_harmonics) + PASSING_BYTES
    return int(SPARE * (number * of_gaussian + 3 * sum(pixels) + PIXEL_BYTES * max(pixels, default=0)))


class TorchModel(Model):
    """Model on `cuda.DEVICE`; sums on a card are atomic, so results vary within rounding."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._views: dict[str, tuple[cuda.CardCamera, Tensor]] = {}  # uploaded once, at the current scale

    def array(self, values: np.ndarray) -> Tensor:
        return torch.tensor(values, device=cuda.DEVICE)

    def host(self, array: Tensor) -> np.ndarray:
        return array.cpu().numpy()

    def step(
        self, view: TrainingView, settings: GaussiansSettings, extent: float, options: StepOptions
    ) -> Scores:
        import gsplat

        degree, background, rate, is_watched = options
        camera, pixels = self._uploaded(view)
        target = pixels / 255
        g = {name: values.detach().requires_grad_() for name, values in self.parameters.items()}
        colours = (gsplat.spherical_harmonics(degree, g["means"] - camera.centre, g["sh"]) + 0.5).clamp_min(0)
        image, alpha, notes = cuda.blend(g, camera, colours)
        if background.any():
            # numbers as arguments of kernels: copying an array would wait for the card
            behind = torch.stack([image.new_full((), float(value)) for value in background])
            image = image + (1 - alpha)[..., None] * behind
        # cuDNN might compute the windows of SSIM in TF32, too coarse for differences of squares
        with torch.backends.cudnn.flags(enabled=False):
            loss = photometric_loss(image, target, settings.ssim_weight)
            total = loss
            if is_regularised(settings):
                total = total + settings.mcmc_opacity_weight * g["opacity_logits"].sigmoid().mean()
                total = total + settings.mcmc_scale_weight / extent * g["log_scales"].exp().mean()
            *by_field, by_mean_px = torch.autograd.grad(total, [*g.values(), notes["means2d"]])
        if is_watched:
            height, width = camera.size_hw
            self.total += torch.hypot(by_mean_px[0, :, 0] * (width / 2), by_mean_px[0, :, 1] * (height / 2))
            self.seen += (notes["radii"][0] > 0).all(dim=-1)
        self._descend(dict(zip(g, by_field, strict=True)), step_sizes(settings, extent * rate))

        @torch.no_grad()
        def scores() -> tuple[float, float]:
            refuse_broken(int(cuda.broken(self.parameters).sum()), len(self))
            return float(loss), float((image - target).square().mean())

        return scores

    def _uploaded(self, view: TrainingView) -> tuple[cuda.CardCamera, Tensor]:
        name = view.camera.name
        if name not in self._views or self._views[name][0].size_hw != view.camera.size_hw:
            self._views[name] = cuda.CardCamera.of(view.camera), self.array(view.image)
        return self._views[name]

    @torch.no_grad()
    def _descend(self, gradients: dict[str, Tensor], rates: dict[str, float]) -> None:
        """Take one step of Adam."""
        others = self.parameters["sh"][:, 1:]
        before = others.clone()
        for name in FIELDS:
            adam(
                [self.parameters[name]],
                [gradients[name].contiguous()],  # fused Adam ignores strides on a CPU
                [self.first[name]],
                [self.second[name]],
                [],
                [torch.full((), float(self.steps), device=cuda.DEVICE)],
                fused=True,
                amsgrad=False,
                beta1=BETA1,
                beta2=BETA2,
                lr=rates[name],
                weight_decay=0,
                eps=EPSILON,
                maximize=False,
            )
        others.lerp_(before, 1 - SH_REST_SHARE)  # a call has one step size; the other harmonics get a share
        self.steps += 1

    @torch.no_grad()
    def add_noise(
        self, settings: GaussiansSettings, rate: float, extent: float, generator: np.random.Generator
    ) -> None:
        import gsplat

        p = self.parameters
        gate = (NOISE_SHARPNESS * (settings.min_opacity - p["opacity_logits"].sigmoid())).sigmoid()
        weight = settings.mcmc_noise * rate * gate * (gate >= MIN_GATE)
        # wider Gaussians would overflow; their steps are limited to the extent anyway
        scales = (p["log_scales"] - float(np.log(extent))).clamp_max(20).exp()
        covariance, _ = gsplat.quat_scale_to_covar_preci(p["quats"], scales, compute_preci=False)
        normal = normal_numbers(p["means"], generator)
        step = weight[:, None] * (covariance * normal[:, None]).sum(dim=2)
        p["means"] += extent * step / step.norm(dim=1, keepdim=True).clamp_min(1)


def normal_numbers(like: Tensor, generator: np.random.Generator) -> Tensor:
    """Return normal numbers, generated on the device from a seed that the generator determines."""
    seeded = torch.Generator(like.device).manual_seed(int(generator.integers(2**63)))
    return torch.randn(like.shape, generator=seeded, device=like.device)


def photometric_loss(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], ssim_weight: float
) -> Float[Tensor, ""]:
    """Return (1 - w) mean |image - target| + w (1 - SSIM), as `cpusplat.photometric`."""
    if fused_ssim is None:
        similarity = ssim(image, target)
    else:
        similarity = fused_ssim(*(picture.permute(2, 0, 1)[None].contiguous() for picture in (image, target)))
    return (1 - ssim_weight) * (image - target).abs().mean() + ssim_weight * (1 - similarity)


def ssim(image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
    """Return the mean structural similarity."""
    x, t = image.permute(2, 0, 1), target.permute(2, 0, 1)
    maps = torch.cat([x, t, x * x, t * t, x * t])[None]
    windows = _taps(image.device).expand(maps.shape[1], 1, -1)
    blurred = conv2d(maps, windows[..., None], padding="same", groups=len(windows))
    blurred = conv2d(blurred, windows[:, :, None], padding="same", groups=len(windows))
    x_mean, t_mean, xx, tt, xt = blurred[0].chunk(5)
    product, squares = x_mean * t_mean, x_mean * x_mean + t_mean * t_mean
    upper = (2 * product + float(C1)) * (2 * (xt - product) + float(C2))
    return (upper / ((squares + float(C1)) * (xx + tt - squares + float(C2)))).mean()


@cache
def _taps(device: torch.device) -> Float[Tensor, " 11"]:
    return torch.from_numpy(TAPS).to(device)
