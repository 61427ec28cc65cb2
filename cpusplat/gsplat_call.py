"""gsplat's `rasterization` on the CPU: NumPy arrays, or torch tensors with gradients."""

import operator
import os
from importlib import import_module
from typing import Any

import numpy as np

from cpusplat.activated import ActivatedViews, as_array
from cpusplat.project import FAR, LOW_PASS_PX2, NEAR, pack_camera

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")

SUPPORTED: dict[str, Any] = {
    "packed": False,
    "radius_clip": 0.0,
    "sparse_grad": False,
    "absgrad": False,
    "rasterize_mode": "classic",
    "distributed": False,
    "camera_model": "pinhole",
    "covars": None,
    "with_ut": False,
    "with_eval3d": False,
    "radial_coeffs": None,
    "tangential_coeffs": None,
    "thin_prism_coeffs": None,
    "ftheta_coeffs": None,
    "rolling_shutter": None,
    "viewmats_rs": None,
}
"""The only value that each of these arguments of gsplat's may have."""
IGNORED = ("tile_size", "channel_chunk", "segmented")
"""Arguments of gsplat's that affect only its speed and memory."""


def rasterization(
    means: Any,
    quats: Any,
    scales: Any,
    opacities: Any,
    colors: Any,
    viewmats: Any,
    Ks: Any,
    width: int,
    height: int,
    near_plane: float = NEAR,
    far_plane: float = FAR,
    radius_clip: float = 0.0,
    eps2d: float = LOW_PASS_PX2,
    sh_degree: int | None = None,
    packed: bool = False,
    tile_size: int = 16,
    backgrounds: Any = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    *,
    threads: int | None = None,
    **others: Any,
) -> tuple[Any, Any, dict[str, Any]]:
    """Render N Gaussians into C views, as gsplat 1.5's function of this name does on CUDA.

    All arrays are NumPy arrays, or all are torch tensors on the CPU; results are of the same kind, in
    float32. Tensors have first-order gradients with respect to means, quats, scales, opacities and colors,
    and `meta["means2d"].grad` after `meta["means2d"].retain_grad()`.

    Args:
        means: [N, 3], centres, in scene units.
        quats: [N, 4], rotations (wxyz) of any non-zero length.
        scales: [N, 3], standard deviations along the axes, in scene units, not negative.
        opacities: [N], peak alphas in [0, 1].
        colors: [N, D] or [C, N, D], colours or features of any number of channels; with `sh_degree`,
            [N, K, 3], spherical harmonics.
        viewmats: [C, 4, 4], world to camera: x right, y down, z forward.
        Ks: [C, 3, 3], intrinsics, px; the centre of the top-left pixel is (0.5, 0.5).
        width, height: size of the views, px.
        near_plane, far_plane: range of depths (z of the centre) that are drawn, in scene units.
        eps2d: variance added to the projected covariance, px^2.
        sh_degree: degree of the harmonics to use, at most 3; K >= (sh_degree + 1)^2.
        backgrounds: [C, D], colours behind the Gaussians; depth channels have none.
        render_mode: `RGB` (colours), `D` (depth weighted by the blending weights), `ED` (the same divided by
            alpha), `RGB+D` or `RGB+ED` (depth is the last channel).
        threads: CPU threads, by default one per core; results are byte-identical for any number.
        radius_clip, packed, sparse_grad, absgrad, rasterize_mode, others: arguments of gsplat's, which must
            have the values in `SUPPORTED`.
        tile_size, and `channel_chunk` and `segmented` among the others: have no effect.

    Returns:
        colors [C, H, W, X], premultiplied by alpha; alphas [C, H, W, 1]; and a dictionary with `means2d`
        [C, N, 2] (px), `radii` [C, N, 2] (int32, px: half-widths of the box in which a Gaussian is visible;
        0 if it is not drawn), `depths` [C, N], `opacities` [C, N], `width`, `height`, `n_cameras`, and, as
        without `packed` in gsplat, `gaussian_ids` and `camera_ids`, which are None.

    Raises:
        NotImplementedError: an argument has a value that only gsplat supports.
        ValueError: a shape, the degree or the render mode is wrong; Gaussians or cameras are not finite,
            quaternions are zero, or scales, opacities, focal lengths or the size are out of range.
        TypeError: an argument is unknown, a tensor is not on the CPU, tensors are mixed with arrays, or the
            size or degree is not a whole number.
    """
    others |= {"radius_clip": radius_clip, "packed": packed, "sparse_grad": sparse_grad, "absgrad": absgrad}
    _refuse_unsupported(others | {"rasterize_mode": rasterize_mode})
    if render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode is {render_mode!r}; expected one of {', '.join(RENDER_MODES)}")
    viewmats = as_array("viewmats", _constant("viewmats", viewmats), None, 4, 4, dtype=np.float64)
    Ks = as_array("Ks", _constant("Ks", Ks), len(viewmats), 3, 3, dtype=np.float64)
    width, height = operator.index(width), operator.index(height)
    focal_lengths = Ks[:, (0, 1), (0, 1)]
    if not np.isfinite(viewmats).all() or not np.isfinite(Ks).all() or not (focal_lengths > 0).all():
        raise ValueError("viewmats and Ks must be finite, and focal lengths above 0")
    if not (len(viewmats) and min(width, height) > 0 and eps2d >= 0):
        raise ValueError(
            "expected at least one view, width and height of at least 1, and eps2d of at least 0"
        )
    sizes = (height, width), near_plane, far_plane, eps2d
    cameras = [pack_camera(viewmat, K, *sizes) for viewmat, K in zip(viewmats, Ks, strict=True)]
    gaussians = means, quats, scales, opacities, colors if "RGB" in render_mode else None
    are_torch = {hasattr(values, "detach") for values in (*gaussians, backgrounds) if values is not None}
    if len(are_torch) > 1:  # tensors among arrays would get no gradients
        raise TypeError("Gaussians and backgrounds are arrays and tensors; expected only one of them")
    degree = None if sh_degree is None else operator.index(sh_degree)
    views = ActivatedViews(*gaussians, cameras, degree, "D" in render_mode, threads or os.cpu_count() or 1)
    (is_torch,) = are_torch
    library: Any = import_module("torch" if is_torch else "numpy")
    draw = import_module("cpusplat.torch_call").draw if is_torch else _draw_arrays
    images, alphas, means2d, depths = draw(views, *gaussians)
    num_colours = images.shape[-1] - int(views.has_depth)
    images, depth = images[..., :num_colours], images[..., num_colours:]
    if backgrounds is not None and "RGB" in render_mode:
        behind = as_array("backgrounds", backgrounds, len(cameras), num_colours)
        behind = backgrounds.to(images.dtype) if is_torch else behind
        images = images + (1 - alphas) * behind[:, None, None, :]
    if render_mode.endswith("ED"):
        depth = depth / alphas.clip(1e-10)
    images = library.concatenate([images, depth], -1) if views.has_depth else images
    meta = {
        "means2d": means2d,
        "depths": depths,
        "radii": library.asarray(views.radii()),
        "opacities": library.stack([opacities] * len(cameras)),
        "width": width,
        "height": height,
        "n_cameras": len(cameras),
        "gaussian_ids": None,
        "camera_ids": None,
    }
    return images, alphas, meta


def _draw_arrays(views: ActivatedViews, *_: Any) -> tuple[np.ndarray, ...]:
    means2d, depths = views.project()
    return *views.blend(), means2d, depths


def _refuse_unsupported(arguments: dict[str, Any]) -> None:
    for name, value in arguments.items():
        if name not in SUPPORTED and name not in IGNORED:
            raise TypeError(f"rasterization() got an unexpected keyword argument {name!r}")
        only = SUPPORTED.get(name)
        if name in SUPPORTED and value is not only and (only is None or value != only):
            raise NotImplementedError(f"{name} = {value!r} is not supported, only {only!r}")


def _constant(name: str, values: Any) -> Any:
    if getattr(values, "requires_grad", False):
        raise NotImplementedError(f"gradients with respect to {name} are not supported: use {name}.detach()")
    return values
