"""Device for the sparse algebra after the fit: our kernels on the CPU, or torch on CUDA."""

import importlib.metadata
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Literal

from hilsplat.base.errors import DeviceError

logger = logging.getLogger(__name__)

ComputeDevice = Literal["cpu", "cuda"]
WantedDevice = Literal["auto", "cpu", "cuda"]


@cache
def is_installed(distribution: str) -> bool:
    """Return whether a distribution is installed, such as `onnxruntime-gpu`."""
    try:
        importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


@cache
def cuda_missing() -> str | None:
    """Return why torch cannot use CUDA here, or None if it can."""
    import torch

    return None if torch.cuda.is_available() else f"torch {torch.__version__} finds no CUDA device"


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Make torch sum in a fixed order: results are the same bytes for any number of the stage's threads.

    torch stores its thread count per thread, so each thread of a pool must enter this context itself.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@cache
def compute_device(wanted: WantedDevice) -> ComputeDevice:
    """Return the device of a stage.

    Args:
        wanted: `auto` selects cuda if torch finds a device. The default setting is cpu, because sums computed
            with cuda agree with those of the CPU up to rounding, but not byte for byte.

    Raises:
        DeviceError: `wanted` is `cuda`, and torch finds no device. There is no fallback.
    """
    if wanted == "cpu":
        return "cpu"
    problem = cuda_missing()
    if problem and wanted == "auto":
        return "cpu"
    if problem:
        raise DeviceError(
            "device: cuda cannot be used here",
            expected="a CUDA build of torch that finds a device",
            found=problem,
            fix="set device: cpu",
        )
    logger.info("sparse algebra on cuda")
    return "cuda"
