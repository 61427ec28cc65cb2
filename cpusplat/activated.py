"""Views of Gaussians given by scales and opacities, as gsplat takes them, and the gradients of these."""

from typing import Any

import numpy as np

from cpusplat import views
from cpusplat.project import LN_2, LOG2_E, LOG2_MIN_ALPHA, MOMENTS

MAX_DEGREE = 3
MIN_OPACITY, MAX_OPACITY = 1e-12, 1 - 2**-24
"""Opacities are clipped to this range, in which they have a logit; smaller ones are not drawn anyway."""
MIN_SCALE = 1e-30
MAX_SIGMAS = 3.33  # radii in units of the standard deviation of opaque Gaussians (gsplat)


def as_array(name: str, values: Any, *shape: int | None, dtype: type = np.float32) -> np.ndarray:
    """Return a contiguous array of this shape, in which None is any length."""
    if hasattr(values, "detach"):
        if values.device.type != "cpu":
            raise TypeError(f"{name} is on {values.device}; expected a tensor on the CPU")
        values = values.detach().numpy()
    array: np.ndarray = np.ascontiguousarray(values, dtype)
    if len(array.shape) != len(shape) or any(
        size not in (None, side) for size, side in zip(shape, array.shape, strict=True)
    ):
        expected = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name} has the shape {list(array.shape)}; expected [{expected}]")
    return array


class ActivatedViews:
    """Views of the same Gaussians; `project` and `blend` draw them, and the other methods go back.

    Args:
        colours: [N, D], [C, N, D], or harmonics [N, K, 3] if `degree` is set; None draws no colours.
        cameras: rows of `pack_camera`.
        has_depth: whether depth is the last channel.
    """

    def __init__(
        self,
        means: Any,
        quats: Any,
        scales: Any,
        opacities: Any,
        colours: Any,
        cameras: list[np.ndarray],
        degree: int | None,
        has_depth: bool,
        threads: int,
    ) -> None:
        self.means = as_array("means", means, None, 3)
        n = len(self.means)
        self.scales, self.opacities = as_array("scales", scales, n, 3), as_array("opacities", opacities, n)
        if not (self.scales >= 0).all() or not ((self.opacities >= 0) & (self.opacities <= 1)).all():
            raise ValueError("scales must not be negative; opacities must be from 0 to 1; NaN is neither")
        self.quats = as_array("quats", quats, n, 4)
        self.cameras, self.degree, self.has_depth, self.threads = cameras, degree, has_depth, threads
        self.sh, self.colours = np.zeros((n, 1, 3), np.float32), None
        if colours is not None and degree is not None:
            harmonics = as_array("colors", colours, n, None, 3)
            if not 0 <= degree <= MAX_DEGREE or (degree + 1) ** 2 > harmonics.shape[1]:
                raise ValueError(
                    f"sh_degree is {degree} with {harmonics.shape[1]} harmonics; expected 0 to {MAX_DEGREE}, "
                    "and (sh_degree + 1)^2 harmonics or more"
                )
            self.sh = harmonics[:, : (MAX_DEGREE + 1) ** 2]  # the kernels have room for no more
        elif colours is not None:
            axes = (n, None) if np.ndim(colours) == 2 else (len(cameras), n, None)
            array = as_array("colors", colours, *axes)
            self.colours = np.broadcast_to(array, (len(cameras), n, array.shape[-1]))
        self.has_harmonics = colours is not None and degree is not None

    def project(self) -> tuple[np.ndarray, np.ndarray]:
        """Project into all views; return the means [C, N, 2] (px) and depths [C, N], 0 where not drawn."""
        log_scales = np.log(np.maximum(self.scales, MIN_SCALE, dtype=np.float64)).astype(np.float32)
        peaks = self.opacities.astype(np.float64).clip(MIN_OPACITY, MAX_OPACITY)
        logits = (np.log(peaks) - np.log1p(-peaks)).astype(np.float32)
        parameters = views.Parameters(self.means, log_scales, self.quats, logits, self.sh)
        degree = self.degree if self.has_harmonics and self.degree else 0
        self.views = [views.project_gaussians(parameters, row, degree, self.threads) for row in self.cameras]
        if broken := max((view.broken for view in self.views), default=0):
            raise ValueError(
                f"{broken} of {len(self.means)} Gaussians are not finite or have a zero quaternion"
            )
        columns = np.stack([np.where(v.drawn[:, None], v.geometry[: len(v.box), :7], 0) for v in self.views])
        return columns[..., :2].copy(), columns[..., 6].copy()

    def radii(self) -> np.ndarray:
        """Return gsplat's radii, int32 [C, N, 2], px; 0 where not drawn."""
        return np.stack([_radii(view) for view in self.views])

    def blend(self) -> tuple[np.ndarray, np.ndarray]:
        """Blend all views into images [C, H, W, X] and alphas [C, H, W, 1]."""
        self.channels = [self._channels(number, view) for number, view in enumerate(self.views)]
        self.blended = [
            views.blend_forward(view, channels, self.threads)
            for view, channels in zip(self.views, self.channels, strict=True)
        ]
        images, alphas = zip(*self.blended, strict=True)
        return np.stack(images), np.stack(alphas)[..., None]

    def _channels(self, number: int, view: views.Projected) -> np.ndarray:
        parts = [view.colours] if self.has_harmonics else []
        parts += [self.colours[number]] if self.colours is not None else []
        parts += [view.geometry[: len(view.box), 6:7]] if self.has_depth else []
        return np.ascontiguousarray(np.concatenate(parts, axis=1))

    def blend_backward(
        self, grad_images: np.ndarray, grad_alphas: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return gradients of projected means [C, N, 2], depths [C, N], and colours [C, N, D].

        Those of the other parameters are kept for `project_backward`.
        """
        n, means_px, by_depth, by_colour = len(self.means), [], [], []
        self.by_view: list[tuple[views.Parameters, np.ndarray]] = []
        for number, view in enumerate(self.views):
            channels, (image, alpha) = self.channels[number], self.blended[number]
            grads = grad_images[number], grad_alphas[number, ..., 0]
            sums = views.blend_gradients(view, channels, image, alpha, *grads, self.threads)
            by_parameter, by_mean_px = views.project_gradients(view, sums, self.threads)
            self.by_view.append((by_parameter, sums[:n, 0].copy()))
            by_channel = sums[:n, MOMENTS : MOMENTS + channels.shape[1]]
            means_px.append(by_mean_px)
            by_depth.append(by_channel[:, -1] if self.has_depth else np.zeros(n, np.float32))
            by_colour.append(by_channel[:, : channels.shape[1] - self.has_depth])
        self.means_px = np.stack(means_px)
        return self.means_px, np.stack(by_depth), np.stack(by_colour)

    def project_backward(
        self, grad_means2d: np.ndarray, grad_depths: np.ndarray, has_blended: bool
    ) -> tuple[np.ndarray, ...]:
        """Return gradients of means, quats, scales, opacities and harmonics.

        Args:
            grad_means2d, grad_depths: of the outputs of `project`, from all their uses.
            has_blended: whether `blend_backward` was one of these uses, and ran just before.
        """
        means, scales = np.zeros(self.means.shape), np.zeros_like(self.scales)
        quats, opacities, sh = (np.zeros_like(a) for a in (self.quats, self.opacities, self.sh))
        others = grad_means2d - self.means_px if has_blended else grad_means2d
        for number, view in enumerate(self.views):
            if has_blended:
                by_parameter, by_log_alpha = self.by_view[number]
                means += by_parameter.means
                scales += _divided(by_parameter.log_scales, self.scales)
                quats += by_parameter.quats
                opacities += _divided(by_log_alpha, self.opacities)
                sh += by_parameter.sh
            by_camera = self._by_position(view, others[number], grad_depths[number])
            means += by_camera @ view.camera[:9].reshape(3, 3)
        return means.astype(np.float32), quats, scales, opacities, sh

    def _by_position(self, view: views.Projected, by_mean_px: np.ndarray, by_depth: np.ndarray) -> np.ndarray:
        """Return gradients of the means in camera space [N, 3] from those of projected means and depths."""
        rotation, translation = view.camera[:9].reshape(3, 3), view.camera[9:12]
        x, y, z = (self.means @ rotation.T + translation).T
        z = np.where(view.drawn, z, 1)
        gx, gy = (by_mean_px * (view.camera[12:14] / z[:, None])).T
        return np.where(view.drawn, (gx, gy, by_depth - (gx * x + gy * y) / z), 0).T


def _divided(gradients: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return gradients of values from those of their logarithms."""
    return np.divide(gradients, values, out=np.zeros_like(values), where=values > MIN_SCALE)


def _radii(view: views.Projected) -> np.ndarray:
    a, b, c, top = view.geometry[: len(view.box), 2:6].astype(np.float64).T
    with np.errstate(all="ignore"):
        scale = 2 * LOG2_E / (4 * a * c - b * b)  # the covariance is the inverse of the conic
        variances = np.stack([c * scale, a * scale], axis=1)
        sigmas = np.sqrt(2 * LN_2 * (top - LOG2_MIN_ALPHA)).clip(max=MAX_SIGMAS)
        # NaN if the conic is 0
        radii = np.fmin(np.ceil(sigmas[:, None] * np.sqrt(variances)), np.iinfo(np.int32).max)
    return np.where(view.drawn[:, None], radii, 0).astype(np.int32)
