"""Self-test that compares the CUDA backend with the CPU backend; its result is cached per machine."""

import numpy as np

from hilsplat.base.cache import remembered
from hilsplat.base.code import code_digest
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.rasterise import api
from hilsplat.splat.rasterise.drawn import Device

KIND = "cuda"
"""Kind of `remembered` results about CUDA."""

MAX_DIFFERENCES = {"image": 1e-3, "alpha": 1e-3, "weights": 1e-3, "gradients": 1e-2}
"""Maximum differences caused by rounding. The limit for gradients is relative and covers all Gaussians."""


def cuda_disagreement() -> str | None:
    """Return how CUDA differs from the CPU here, or None; cached per device, library and code version."""
    import gsplat
    import torch

    machine = [torch.__version__, gsplat.__version__, torch.cuda.get_device_name(), str(torch.version.cuda)]
    key = [*machine, code_digest("hilsplat.splat.rasterise.cuda", api.draw)]
    return remembered(KIND, ["self-test", *key], lambda: disagreement("cpu", "cuda") or "") or None


def disagreement(one: Device, other: Device) -> str | None:
    """Return how two devices differ in a small scene's image, gradients and pixel weights, or None."""
    rng = np.random.default_rng(0)
    number = 300  # some of them are behind the camera
    arrays = (
        rng.uniform((-2, -1.5, -0.5), (2, 1.5, 4), (number, 3)),
        np.log(rng.uniform(0.02, 0.3, (number, 3))),
        rng.normal(size=(number, 4)),
        rng.normal(size=number),
        rng.normal(size=(number, 4, 3)) * 0.4,
    )
    gaussians = Gaussians(*(values.astype(np.float32) for values in arrays))
    K = np.array([[70.0, 0, 41], [0, 75, 29], [0, 0, 1]])
    camera = Camera("test", np.eye(4), K, (60, 80))
    slope = rng.normal(size=(60, 80, 3)).astype(np.float32)
    flat = rng.normal(size=(60, 80)).astype(np.float32)
    seen = [api.draw(gaussians, camera, 1, device=device) for device in (one, other)]
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
        errors.append(np.linalg.norm(first - second) / np.linalg.norm(first))
    apart["gradients"] = float(np.max(errors))  # NaN if any error is NaN
    wrong = [
        f"{what} by {apart[what]:.2g}" for what, most in MAX_DIFFERENCES.items() if not apart[what] <= most
    ]
    return f"{other} differs from {one}: {', '.join(wrong)}" if wrong else None
