"""Choice of the rendering backend: our own on the CPU, or gsplat on CUDA."""

import contextlib
import io
import logging
import os
import shutil
import socket
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from hilsplat.base.cache import forget, recalled, remembered
from hilsplat.base.cards import cards, has_driver, release_card, take_card
from hilsplat.base.errors import DeviceError, first_line
from hilsplat.base.lineage import RASTERISER, version_of
from hilsplat.base.memory import MIB
from hilsplat.models.card import card_problem, free_mib, is_out_of_memory

logger = logging.getLogger(__name__)

UNBUILT = "the CUDA kernels of gsplat cannot be compiled"
TOO_MUCH = "needs more memory than the card has free"

KIND = "cuda"  # kind of `remembered` results about CUDA

Device = Literal["cpu", "cuda"]
Requested = Literal["auto", "cpu", "cuda"]
CHOSEN: dict[Requested, Device] = {}  # device of each setting in this process


def missing_part() -> str | None:
    """Return what the CUDA backend lacks here as far as files show, or None; torch is not imported."""
    gsplat = find_spec("gsplat")
    if gsplat is None:
        return "gsplat is not installed"
    if not has_driver():
        return "no NVIDIA driver is installed"
    places = gsplat.submodule_search_locations or ()
    has_kernels = any(library for place in places for library in Path(place).glob("*.so"))
    if not has_kernels and not _compiler():
        return f"{UNBUILT}, because no CUDA toolkit (nvcc) is installed"
    return None


def _compiler() -> str | None:
    """Return the path of nvcc where torch and gsplat look for it."""
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH") or "/usr/local/cuda"
    return shutil.which("nvcc", path=f"{home}/bin") or shutil.which("nvcc")


def expected_problem() -> str | None:
    """Return why the CUDA backend is not expected to work here, or None.

    This is for planning: nothing is compiled or run on a card. An earlier result of `cuda_problem` counts.
    """
    return missing_part() or card_problem() or recalled(KIND, _build()) or None


@cache
def cuda_problem() -> str | None:
    """Return why the CUDA backend cannot be used here, or None if it can; never raise an exception."""
    if problem := missing_part() or card_problem():
        return problem
    try:
        # a compilation that fails takes minutes, and each stage runs in its own process
        return remembered(KIND, _build(), _build_failure) or None
    except Exception:  # the card may only be busy or full (`kernel_problem`)
        return None


def _build() -> list[str]:
    """Return what decides whether gsplat's kernels can be compiled; equal in plans, jobs and `doctor`."""
    import torch

    versions = torch.__version__, str(torch.version.cuda), str(version_of("gsplat"))
    capability = "{}.{}".format(*torch.cuda.get_device_capability())
    return ["build", *versions, str(_compiler()), capability, socket.gethostname()]


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
    card_problem.cache_clear()
    cuda_problem.cache_clear()
    CHOSEN.clear()


def choose_device(requested: Requested) -> Device:
    """Return the device that a setting selects in this process, and log it the first time.

    `auto` uses CUDA if torch finds a device, gsplat works, and a self-test agrees with the CPU. If gsplat is
    installed but does not work on a machine with a card, a warning names the reason.
    For `cpu`, or if gsplat, a driver or a compiler is missing, torch is not imported, which would take 1.3 to
    3 s. Otherwise, if another job has the card, this function waits for it (`take_card`).

    Raises:
        DeviceError: if `cuda` was requested and cannot be used. There is no fallback.
    """
    if requested not in CHOSEN:
        CHOSEN[requested] = _examined(requested)
    if CHOSEN[requested] == "cuda":
        take_card()  # `require_card_memory` may have released it
    RASTERISER.set(CHOSEN[requested])
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
    problem = None if requested == "cpu" else missing_part()
    if requested != "cpu" and not problem:
        take_card()  # before CUDA starts
        problem = cuda_problem() or kernel_problem()
        if requested == "auto" and not problem:
            problem = _self_test_problem()
        if problem:
            release_card()
    if requested == "cuda":
        require_cuda(problem)
    device: Device = "cpu" if requested == "cpu" or problem else "cuda"
    is_broken = bool(problem and find_spec("gsplat") and cards())
    level = logging.WARNING if is_broken else logging.INFO
    advice = "; after a fix, run `hilsplat doctor`" if is_broken else ""
    suffix = f"; {problem}{advice}" if problem else ""
    logger.log(level, "rasterising on %s (device: %s%s)", device, requested, suffix)
    return device


def _self_test_problem() -> str | None:
    from hilsplat.splat.rasterise.parity import cuda_disagreement  # lazy: loads the CPU's kernels

    try:
        return cuda_disagreement()
    except Exception as error:  # drivers, torch and gsplat raise several types
        return f"the self-test on CUDA failed: {first_line(error)}"


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
    release_card()
    RASTERISER.set("cpu")
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
