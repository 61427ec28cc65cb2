"""Choice of the rendering backend (ours on the CPU, or gsplat on CUDA), and a self-test that both agree."""

import ctypes
import logging
import sys
from functools import cache
from importlib.util import find_spec
from typing import Literal

import numpy as np
import platformdirs

from hilsplat.base.artifacts import parse_json, sha256_of_json, write_json
from hilsplat.base.errors import DeviceError
from hilsplat.base.identity import code_digest
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import FIELDS, Gaussians

logger = logging.getLogger(__name__)

Device = Literal["cpu", "cuda"]

LEAST_AGREEMENT = {"image": 1e-3, "alpha": 1e-3, "weights": 1e-3, "gradients": 1e-2}
"""Maximum differences attributed to rounding. That of gradients is relative and covers all Gaussians."""


@cache
def cuda_problem() -> str | None:
    """Return why the CUDA backend cannot be used here, or None if it can."""
    # checked before importing torch, which takes 1.3 to 3 s
    if find_spec("gsplat") is None:
        return "gsplat is not installed"
    if not _has_driver():
        return "no NVIDIA driver is installed"
    import torch

    if not torch.cuda.is_available():
        return f"torch {torch.__version__} finds no CUDA device"
    try:
        import gsplat  # noqa: F401
    except ImportError as error:
        return f"gsplat cannot be imported: {error}"
    return None


def _has_driver() -> bool:
    """Return whether the library of NVIDIA's driver can be loaded."""
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return True


@cache
def choose_device(requested: Literal["auto", "cpu", "cuda"]) -> Device:
    """Return the device that a setting selects on this machine, and log it the first time.

    `auto` uses CUDA if torch finds a device, gsplat can be imported, and a self-test matches the CPU.
    Without gsplat and a driver, or for `cpu`, torch isn't imported (1.3 to 3 s).

    Raises:
        DeviceError: if `cuda` was requested and cannot be used. There is no fallback.
    """
    problem = None if requested == "cpu" else cuda_problem()
    if requested == "cuda" and problem:
        raise DeviceError(
            "device: cuda was requested but cannot be used",
            expected="a CUDA build of torch that finds a device, and gsplat",
            found=problem,
            fix="pip install 'hilsplat[gpu]' on a machine with a CUDA device, or set device: auto or cpu",
        )
    if requested == "auto" and problem is None:
        problem = cuda_disagreement()
    device: Device = "cuda" if requested != "cpu" and not problem else "cpu"
    logger.info("rasterising on %s (device: %s%s)", device, requested, f"; {problem}" if problem else "")
    return device


def cuda_disagreement() -> str | None:
    """Return how CUDA differs from the CPU here, or None; cached per device, library and code version."""
    import gsplat
    import torch

    machine = [torch.__version__, gsplat.__version__, torch.cuda.get_device_name(), torch.version.cuda]
    key = sha256_of_json(
        [*machine, code_digest("hilsplat.splat.rasterise.cuda", "hilsplat.splat.rasterise.api:draw")]
    )
    kept = platformdirs.user_cache_path("hilsplat") / "cuda-self-test.json"
    try:
        known = dict(parse_json(kept.read_bytes()))
    except (OSError, ValueError):
        known = {}
    if key not in known:
        known[key] = disagreement("cpu", "cuda") or ""
        write_json(kept, known)
    return known[key] or None


def disagreement(one: Device, other: Device) -> str | None:
    """Return how two devices differ in a small scene's image, gradients and pixel weights, or None."""
    from hilsplat.splat.rasterise import api  # imports this module

    gaussians, camera = _scene()
    rng = np.random.default_rng(1)
    slope = rng.normal(size=(*camera.size_hw, 3)).astype(np.float32)
    flat = rng.normal(size=camera.size_hw).astype(np.float32)
    seen = [api.draw(gaussians, camera, 1, threads=1, device=device) for device in (one, other)]
    grads = [each.gradients(slope, flat) for each in seen]
    weights = [
        api.pixel_weights(gaussians, camera, min_weight=1 / 255, device=device) for device in (one, other)
    ]
    apart = {
        "image": float(np.abs(seen[0].image - seen[1].image).max()),
        "alpha": float(np.abs(seen[0].alpha - seen[1].alpha).max()),
        "weights": float(abs(weights[0] - weights[1]).max()),
    }
    errors = []
    for name in FIELDS:
        first, second = (getattr(each, name) for each in grads)
        errors.append(np.linalg.norm(first - second) / np.maximum(np.linalg.norm(first), 1e-12))
    apart["gradients"] = float(np.max(errors))  # NaN if any is
    wrong = [
        f"{what} by {apart[what]:.2g}" for what, most in LEAST_AGREEMENT.items() if not apart[what] <= most
    ]
    return f"{other} differs from {one}: {', '.join(wrong)}" if wrong else None


def _scene() -> tuple[Gaussians, Camera]:
    """Return 300 Gaussians and a camera of 80 x 60 px, with some of the Gaussians behind it."""
    rng = np.random.default_rng(0)
    number = 300
    arrays = (
        np.stack(
            [rng.uniform(-2, 2, number), rng.uniform(-1.5, 1.5, number), rng.uniform(-0.5, 4, number)], axis=1
        ),
        np.log(rng.uniform(0.02, 0.3, (number, 3))),
        rng.normal(size=(number, 4)),
        rng.normal(size=number),
        rng.normal(size=(number, 4, 3)) * 0.4,
    )
    K = np.array([[70.0, 0, 41], [0, 75, 29], [0, 0, 1]])
    camera = Camera("test", np.eye(4), K, (60, 80))
    return Gaussians(*(values.astype(np.float32) for values in arrays)), camera
