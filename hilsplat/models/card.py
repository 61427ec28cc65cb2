"""An NVIDIA card for the networks: whether to use it, and how many items fit into a call."""

import logging
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from threading import RLock
from typing import Any, Literal, TypeVar

import numpy as np
from jaxtyping import Int64

from hilsplat.base.cards import cards, has_driver, release_card, take_card
from hilsplat.base.errors import DeviceError, MemoryLimitError, first_line
from hilsplat.base.memory import MIB

logger = logging.getLogger(__name__)

Result = TypeVar("Result")

CPU = "cpu"  # device on which onnxruntime runs a network; on any other, such as `cuda`, torch does
USED_SHARE = 0.8  # share of the free memory of a card that a call may take, because memory is fragmented
TURN = RLock()  # held during a call on a card, so that threads share its memory one after the other


@cache
def card_problem() -> str | None:
    """Return why torch cannot use an NVIDIA card here, or None; without a driver, torch isn't imported."""
    if not has_driver():
        return "no NVIDIA driver is installed"
    try:
        import torch

        with warnings.catch_warnings(record=True, action="always") as caught:
            is_available = torch.cuda.is_available()
        if not is_available and caught:  # such as of an old driver
            return f"CUDA cannot be used: {first_line(caught[-1].message)}"
        if not is_available:
            return f"torch {torch.__version__} finds no CUDA device"
        version, built_for = torch.cuda.get_device_capability(), torch.cuda.get_arch_list()
        problem = "no kernels for compute capability {}.{}, only {}".format(*version, " ".join(built_for))
        return None if has_kernels(version, built_for) else f"torch {torch.__version__} has {problem}"
    except Exception as error:  # a broken installation can raise anything
        return f"torch cannot be used: {first_line(error)}"


def has_kernels(version: tuple[int, int], built_for: Sequence[str]) -> bool:
    """Return whether a card of a compute capability can run a build of torch for architectures (`sm_86`).

    Machine code (`sm_`) runs on cards of the same major version and at least its minor version; the driver
    compiles `compute_` for any later card.
    """
    built = [(name.startswith("compute"), divmod(int(re.sub(r"\D", "", name)), 10)) for name in built_for]
    return not built or any(
        arch <= version and (is_compiled_later or arch[0] == version[0]) for is_compiled_later, arch in built
    )


def free_mib(device: str = "cuda") -> float:
    """Return the memory of a card that is free, or that torch has reserved but doesn't use, MiB."""
    import torch

    reserved = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return (torch.cuda.mem_get_info(device)[0] + reserved) / MIB


def card_shortage(needed_mib: float) -> str | None:
    """Return why a card doesn't have this much free memory, or None; CUDA is started, which takes memory."""
    try:
        free = free_mib()
    except Exception as error:  # torch raises several types if another program uses the card
        return f"CUDA cannot be started: {first_line(error)}"
    if free < needed_mib:
        return f"the GPU has {free / 1024:.1f} GiB free, and about {needed_mib / 1024:.1f} are needed"
    return None


def network_device(requested: Literal["auto", "cpu", "cuda"], section: str, needed_mib: float) -> str:
    """Return the device for the networks of a section of the settings, and log it.

    `auto` uses a card if torch finds one with enough free memory; otherwise, the reason is logged, as a
    warning if there is a card. If another job has the card, this function waits for it (`take_card`).

    Raises:
        DeviceError: `cuda` was requested, but there is no usable card with enough free memory.
    """
    if requested == CPU:
        return CPU
    if has_driver():
        take_card()  # before CUDA starts
    problem = card_problem() or card_shortage(needed_mib)
    if not problem:
        logger.info("%s runs on the GPU", section)
        return "cuda"
    release_card()
    if requested == "cuda":
        require_card(problem, section)
    logger.log(logging.WARNING if cards() else logging.DEBUG, "%s runs on the CPU: %s", section, problem)
    return CPU


def require_card(problem: str | None, section: str) -> None:
    """Raise DeviceError if there is a problem with the card that the networks of a section need."""
    if problem:
        raise DeviceError(
            f"{section}.device: cuda was requested but cannot be used",
            expected="an NVIDIA card with enough memory, its driver, and a CUDA build of torch for this card",
            found=problem,
            fix=f"set {section}.device: auto or cpu; if only memory is short, end other programs on the GPU, "
            f"or use a smaller model ({section}.model)",
        )


def recorded(device: str) -> dict[str, str]:
    """Return the entry of an artifact's index that names a card; none for the CPU."""
    return {} if device == CPU else {"device": device}


def _fix(section: str) -> str:
    return (
        f"end other programs on the GPU, use a smaller model ({section}.model), or set {section}.device: cpu"
    )


def is_out_of_memory(error: Exception) -> bool:
    """Return whether an exception of torch, or of a library that it calls, means that a card is full."""
    torch = sys.modules.get("torch")
    texts = "out of memory", "ALLOC_FAILED"
    return torch is not None and (
        isinstance(error, torch.OutOfMemoryError)
        or (isinstance(error, RuntimeError) and any(text in str(error) for text in texts))
    )


class Batches:
    """Calls of a network for many items.

    On the CPU, every call has `size` items. On a card, the memory of the first call determines the size of
    later calls, and calls that run out of memory are repeated with half as many items.

    Args:
        size: items per call; on a card, of the first call.
        most: maximum number of items per call on a card; `size` if the network fixes the number.
        is_padded: repeat the last item to fill the last call, for networks with a fixed number of items, and
            for those whose first call with another number is slow. Results then don't depend on how items are
            split into calls.
        section: section of the settings, for messages.
    """

    def __init__(
        self, size: int, device: str = CPU, most: int = 0, *, is_padded: bool = False, section: str = "masks"
    ) -> None:
        self.size, self.device, self.most = size, device, most
        self.is_padded, self.section = is_padded, section
        self._is_measured = self._is_fixed = most <= size

    def __call__(
        self, total: int, work: Callable[[Int64[np.ndarray, " b"], int], Result]
    ) -> Iterator[Result]:
        """Yield `work(rows, number)` for the rows of each call; those after the first `number` are padding.

        Raises:
            MemoryLimitError: a call with a single item, or a network's fixed number, runs out of memory.
        """
        start = 0
        while start < total:
            size = self.size  # read once, because other threads may change it
            number = min(size, total - start)
            rows = np.arange(start, start + (size if self.is_padded else number))
            rows = np.minimum(rows, total - 1)
            problem = ""
            try:
                result = self._call(work, rows, number)
            except RuntimeError as error:
                if not is_out_of_memory(error):
                    raise
                problem = first_line(error)
            if problem:  # outside the handler, whose traceback keeps the call's arrays
                self._shrink(len(rows), problem)
                continue
            yield result
            start += number

    def _call(self, work: Callable[[Int64[np.ndarray, " b"], int], Result], rows: Any, number: int) -> Result:
        if self.device == CPU:
            return work(rows, number)
        with TURN:
            if self._is_measured or not self.device.startswith("cuda"):
                return work(rows, number)
            import torch

            torch.cuda.reset_peak_memory_stats(self.device)
            before = torch.cuda.memory_allocated(self.device)
            result = work(rows, number)
            mib_per_item = (torch.cuda.max_memory_allocated(self.device) - before) / MIB / len(rows)
            fitting = int(USED_SHARE * free_mib(self.device) / max(mib_per_item, 1e-3))
            self.size = max(1, min(self.most, fitting))
            self._is_measured = True
            logger.debug("%s: %.0f MiB per item, %d items per call", self.section, mib_per_item, self.size)
            return result

    def _shrink(self, number: int, problem: str) -> None:
        if number == 1 or self._is_fixed:
            raise MemoryLimitError(
                f"the GPU has too little memory for a {self.section} call of size {number}",
                found=problem,
                fix=_fix(self.section),
            )
        import torch

        torch.cuda.empty_cache()
        self.size, self._is_measured = number // 2, True
        logger.info("%s: %d items per call, because the GPU ran out of memory", self.section, self.size)


def in_turn(device: str, section: str, work: Callable[[], Result]) -> Result:
    """Return the result of a call for a single item; errors as in `Batches`."""
    (result,) = Batches(1, device, section=section)(1, lambda rows, number: work())
    return result
