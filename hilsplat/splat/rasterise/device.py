"""Choice of the rendering backend: our own on the CPU, or gsplat on CUDA."""

import ctypes
import logging
from functools import cache
from importlib.util import find_spec
from typing import Literal

from hilsplat.base.errors import DeviceError

logger = logging.getLogger(__name__)

Device = Literal["cpu", "cuda"]


@cache
def cuda_problem() -> str | None:
    """Return why the CUDA backend cannot be used here, or None if it can."""
    # checked before importing torch, which takes 1.3 to 3 s
    if find_spec("gsplat") is None:
        return "gsplat is not installed"
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return "no NVIDIA driver is installed"
    import torch

    if not torch.cuda.is_available():
        return f"torch {torch.__version__} finds no CUDA device"
    try:
        import gsplat  # noqa: F401
    except ImportError as error:
        return f"gsplat cannot be imported: {error}"
    return None


@cache
def choose_device(requested: Literal["auto", "cpu", "cuda"]) -> Device:
    """Return the device that a setting selects on this machine, and log it the first time.

    `auto` uses CUDA if torch finds a device, gsplat can be imported, and a self-test agrees with the CPU.
    For `cpu`, or if gsplat or a driver is missing, torch is not imported, which would take 1.3 to 3 s.

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
        from hilsplat.splat.rasterise.parity import cuda_disagreement

        problem = cuda_disagreement()
    device: Device = "cuda" if requested != "cpu" and not problem else "cpu"
    logger.info("rasterising on %s (device: %s%s)", device, requested, f"; {problem}" if problem else "")
    return device
