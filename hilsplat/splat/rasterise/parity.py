"""Self-test that compares a card with the CPU: one step of a fit, and pixel weights; cached per machine."""

import numpy as np
from scipy.sparse import csr_matrix

from hilsplat.base.cache import remembered
from hilsplat.base.cards import driver_version
from hilsplat.base.code import code_digest
from hilsplat.base.lineage import version_of
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.rasterise import api
from hilsplat.splat.rasterise.device import KIND, Device

MAX_DIFFERENCES = {"loss": 1e-4, "gradients": 1e-2, "step": 2e-2, "weights": 1e-3}
"""Maximum differences caused by rounding; those of gradients and step are relative to their length."""


def cuda_disagreement() -> str | None:
    """Return how CUDA differs from the CPU here, or None; cached per device, versions, driver and code."""
    import torch

    libraries = [version_of(name) for name in ("torch", "gsplat", "fused-ssim")]
    versions = [*libraries, str(torch.version.cuda), driver_version()]
    code = code_digest("hilsplat.splat.torch_model", disagreement)
    key = ["self-test", *versions, torch.cuda.get_device_name(), code]
    return remembered(KIND, key, lambda: disagreement("cpu", "cuda") or "") or None


def disagreement(one: Device, other: Device) -> str | None:
    """Return how two devices differ in a step of a fit and in pixel weights, or None.

    Both are compared for many Gaussians in several tiles, some behind the camera, and for a single one.
    """
    wrong = [
        f"{what} of {number} Gaussians by {apart:.2g}"
        for number in (300, 1)
        for what, apart in _differences(one, other, number).items()
        if not apart <= MAX_DIFFERENCES[what]  # also if it is NaN
    ]
    return f"{other} differs from {one}: {', '.join(wrong)}" if wrong else None


def _differences(one: Device, other: Device, number: int) -> dict[str, float]:
    # slow imports, which most processes don't need
    from hilsplat.settings import GaussiansSettings
    from hilsplat.splat.initial import TrainingView
    from hilsplat.splat.model import Model, StepOptions, model_on

    rng = np.random.default_rng(0)
    low, high = ((-2, -1.5, -0.5), (2, 1.5, 4)) if number > 1 else ((-0.1, -0.1, 2), (0.1, 0.1, 4))
    arrays = (
        rng.uniform(low, high, (number, 3)),
        np.log(rng.uniform(0.02, 0.3, (number, 3))),
        rng.normal(size=(number, 4)),
        rng.normal(size=number),
        rng.normal(size=(number, 16, 3)) * 0.4,
    )
    gaussians = Gaussians(*(values.astype(np.float32) for values in arrays))
    K = np.array([[70.0, 0, 41], [0, 75, 29], [0, 0, 1]])
    camera = Camera("test", np.eye(4), K, (60, 80))
    view = TrainingView(camera, rng.integers(0, 256, (60, 80, 3), np.uint8))
    options = StepOptions(3, rng.uniform(size=3).astype(np.float32), 1e-3, True)
    settings = GaussiansSettings(strategy="mcmc")

    def stepped(device: Device) -> tuple[Model, float]:
        model = model_on(device)({name: getattr(gaussians, name).copy() for name in FIELDS})
        loss, _ = model.step(view, settings, 1.0, options)()
        return model, loss

    (first, loss), (second, other_loss) = (stepped(device) for device in (one, other))
    a, b = first.state(), second.state()
    start = {f"parameters_{name}": getattr(gaussians, name) for name in FIELDS}

    def apart(names: list[str]) -> float:
        errors = [np.linalg.norm(a[n] - b[n]) / np.linalg.norm(a[n] - start.get(n, 0)) for n in names]
        return float(np.max(errors))

    weights = [_pixel_weights(gaussians, camera, device) for device in (one, other)]
    return {
        "loss": abs(loss - other_loss),
        # the moments after one step are the gradients and their squares, up to a factor
        "gradients": apart([f"first_{name}" for name in FIELDS] + ["gradient_total"]),
        "step": apart([*start]),
        "weights": float(abs(weights[0] - weights[1]).max()),
    }


def _pixel_weights(gaussians: Gaussians, camera: Camera, device: Device) -> csr_matrix:
    if device == "cpu":
        return api.pixel_weights(gaussians, camera, min_weight=1 / 255)
    from hilsplat.splat.rasterise import cuda

    entries = cuda.pixel_weights(cuda.on_device(gaussians), cuda.CardCamera.of(camera), 1 / 255)
    return entries.on_host()
