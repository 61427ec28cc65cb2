"""Choice of the rendering backend: our own on the CPU, or gsplat on CUDA."""

import contextlib
import io
import logging
import os
import socket
import warnings
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from typing import Literal

from hilsplat.base.cache import forget, remembered
from hilsplat.base.cards import has_driver, release_card
from hilsplat.base.errors import DeviceError, first_line
from hilsplat.base.memory import MIB
from hilsplat.models.card import free_mib, is_out_of_memory

logger = logging.getLogger(__name__)

UNBUILT = "the CUDA kernels of gsplat cannot be compiled"
ABSENT = ("gsplat is not installed", "no NVIDIA driver is installed", "torch ")
"""Beginnings of the problems of machines on which CUDA is not expected to work."""

TOO_MUCH = "needs more memory than the card has free"

KIND = "cuda"  # kind of `remembered` results about CUDA

Device = Literal["cpu", "cuda"]
Requested = Literal["auto", "cpu", "cuda"]
CHOSEN: dict[Requested, Device] = {}  # device of each setting in this process


@cache
def cuda_problem() -> str | None:
    """Return why the CUDA backend cannot be used here, or None if it can; never raise an exception."""
    # checked before importing torch, which takes 1.3 to 3 s
    if find_spec("gsplat") is None:
        return "gsplat is not installed"
    if not has_driver():
        return "no NVIDIA driver is installed"
    try:
        import gsplat
        import torch

        with warnings.catch_warnings(record=True, action="always") as caught:
            is_available = torch.cuda.is_available()
        if not is_available and caught:  # such as of an old driver
            return f"CUDA cannot be used: {first_line(caught[-1].message)}"
        if not is_available:
            return f"torch {torch.__version__} finds no CUDA device"
        # a compilation that fails takes minutes, and each stage runs in its own process
        versions = [torch.__version__, str(torch.version.cuda), gsplat.__version__]
        known = [os.environ.get(name, "") for name in ("PATH", "CUDA_HOME", "CUDA_VISIBLE_DEVICES")]
        return remembered(KIND, ["build", *versions, *known, socket.gethostname()], _build_failure) or None
    except Exception as error:  # a broken installation can raise anything
        # a card may only be busy or full (`kernel_problem`)
        return None if _is_of_card(error) else f"gsplat cannot be imported: {first_line(error)}"


def _build_failure() -> str:
    """Run one of gsplat's kernels, which compiles all on first use; return why it fails, or an empty text.

    Errors of the card, such as a full one, are raised.
    """
    logger.info("loading the CUDA kernels of gsplat, which are compiled on first use, in several minutes")
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints what is reported here
            _run_a_kernel()
    except Exception as error:  # compilers, linkers and torch raise several types
        if _is_of_card(error):
            raise
        if isinstance(error, AttributeError):  # without a compiler, gsplat has None instead of its kernels
            return f"{UNBUILT}, because no CUDA toolkit (nvcc) is installed"
        return f"{UNBUILT}: {first_line(error)}"
    return ""


def _is_of_card(error: Exception) -> bool:
    return is_out_of_memory(error) or "CUDA error" in str(error)


def _run_a_kernel() -> None:
    """Evaluate spherical harmonics of one Gaussian."""
    import gsplat
    import torch

    from hilsplat.splat.rasterise import cuda

    direction, harmonics = (torch.ones(shape, device=cuda.DEVICE) for shape in ((1, 3), (1, 1, 3)))
    gsplat.spherical_harmonics(0, direction, harmonics)


def kernel_problem() -> str | None:
    """Return why the card cannot run one of gsplat's kernels, or None; the card may only be busy or full."""
    try:
        _run_a_kernel()
    except Exception as error:  # torch, the driver and gsplat raise several types
        return f"the card cannot run gsplat's kernels: {first_line(error)}"
    return None


def forget_cuda() -> None:
    """Forget earlier results, so that `cuda_problem` and the self-test examine this machine again."""
    forget(KIND)
    cuda_problem.cache_clear()
    CHOSEN.clear()


def choose_device(requested: Requested) -> Device:
    """Return the device that a setting selects in this process, and log it the first time.

    `auto` uses CUDA if torch finds a device, gsplat works, and a self-test agrees with the CPU. If gsplat is
    installed but does not work on a machine with a device, a warning names the reason.
    For `cpu`, or if gsplat or a driver is missing, torch is not imported, which would take 1.3 to 3 s.

    Raises:
        DeviceError: if `cuda` was requested and cannot be used. There is no fallback.
    """
    if requested not in CHOSEN:
        CHOSEN[requested] = _examined(requested)
    return CHOSEN[requested]


def require_cuda(problem: str | None) -> None:
    """Raise DeviceError if there is a problem with the CUDA backend, such as that of `cuda_problem`."""
    if problem:
        raise DeviceError(
            "device: cuda was requested but cannot be used",
            expected="a CUDA build of torch that finds a device, and gsplat",
            found=problem,
            fix="install the extra gpu and a CUDA toolkit on a machine with a card (docs/gpu.md), or set "
            "device: auto or cpu; after a change, run `hilsplat doctor`",
        )


def _examined(requested: Requested) -> Device:
    problem = None if requested == "cpu" else cuda_problem() or kernel_problem()
    if requested == "cuda":
        require_cuda(problem)
    if requested == "auto" and problem is None:
        from hilsplat.splat.rasterise.parity import cuda_disagreement  # lazy: loads the CPU's kernels

        try:
            problem = cuda_disagreement()
        except Exception as error:  # drivers, torch and gsplat raise several types
            problem = f"the self-test on CUDA failed: {first_line(error)}"
    device: Device = "cuda" if requested != "cpu" and not problem else "cpu"
    is_broken = problem is not None and not problem.startswith(ABSENT)
    level = logging.WARNING if is_broken else logging.INFO
    advice = "; after a fix, run `hilsplat doctor`" if is_broken else ""
    suffix = f"; {problem}{advice}" if problem else ""
    logger.log(level, "rasterising on %s (device: %s%s)", device, requested, suffix)
    if device == "cpu":
        release_card()
    return device


def require_card_memory(requested: Requested, needed: int, user: str, fix: str) -> Device:
    """Return the chosen device; if its free memory is less than `needed` bytes, `auto` selects the CPU.

    Args:
        user: noun phrase that names what needs the memory.
        fix: settings that reduce it.

    Raises:
        DeviceError: if `cuda` was requested, and its free memory is less.
    """
    if choose_device(requested) == "cpu" or needed <= (free := int(free_mib() * MIB)):
        return choose_device(requested)
    problem = f"{user} needs about {_gib(needed)} of the card's memory; {_gib(free)} are free"
    if requested == "cuda":
        raise DeviceError(
            f"{user} {TOO_MUCH}", expected=f"about {_gib(needed)} free", found=f"{_gib(free)} free", fix=fix
        )
    logger.warning("rasterising on cpu (device: auto; %s); to use the card, %s", problem, fix)
    CHOSEN[requested] = "cpu"  # also for the provenance record
    release_card()
    return "cpu"


def _gib(size: int) -> str:
    return f"{size / 2**30:.1f} GiB"


@contextlib.contextmanager
def explained_memory(user: str, fix: str) -> Iterator[None]:
    """Turn torch's out-of-memory error into a DeviceError; arguments are those of `require_card_memory`."""
    try:
        yield
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        raise DeviceError(f"{user} {TOO_MUCH}", found=first_line(error), fix=fix) from error
