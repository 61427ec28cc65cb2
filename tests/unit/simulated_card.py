"""A card simulated on the CPU: operations refuse what CUDA refuses, such as tensors on two devices."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map

GET_DEVICE, GET_IS_CUDA = torch.Tensor.device.__get__, torch.Tensor.is_cuda.__get__
TO_NUMPY = torch.Tensor.numpy, torch.Tensor.__array__
INDEXED = torch.Tensor.__getitem__, torch.Tensor.__setitem__  # indices may be on the host
JOINED = torch.cat, torch.concatenate, torch.stack  # even numbers must be on the card
MEMORY = {"memory_allocated": 0, "max_memory_allocated": 2**20, "memory_reserved": 0}


class OnCard(torch.Tensor):
    """A tensor on the simulated card; its values are on the CPU."""


class SimulatedCard(TorchFunctionMode):
    """Let `cuda` mean a simulated card in the thread that enters this mode."""

    def __torch_function__(
        self, function: Callable, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        leaves = tree_leaves((args, kwargs))
        tensors = [leaf for leaf in leaves if isinstance(leaf, torch.Tensor)]
        on_card = [leaf for leaf in tensors if isinstance(leaf, OnCard)]
        if function in (GET_DEVICE, GET_IS_CUDA) and on_card:
            return torch.device("cuda", 0) if function == GET_DEVICE else True
        if function in TO_NUMPY and on_card:
            raise TypeError("can't convert cuda:0 device type tensor to numpy")
        on_host = [
            leaf for leaf in tensors if not isinstance(leaf, OnCard) and (leaf.ndim or function in JOINED)
        ]
        if on_card and on_host and function not in INDEXED:
            raise RuntimeError(
                f"{function.__name__}: expected all tensors on one device, found cuda:0 and cpu"
            )
        target = [place for leaf in leaves if (place := place_of(leaf))]
        result = function(*tree_map(simulated, args), **tree_map(simulated, kwargs or {}))
        stays = on_card and function != torch.Tensor.cpu
        return tree_map(placed, result) if (target[0] == "cuda" if target else stays) else result


def place_of(value: Any) -> str:
    """Return the type of a device, or an empty text for other values."""
    if isinstance(value, torch.device):
        return value.type
    place = value.partition(":")[0] if isinstance(value, str) else ""
    return place if place in ("cpu", "cuda") else ""


def simulated(value: Any) -> Any:
    """Return an argument of an operation on the CPU."""
    if isinstance(value, OnCard):
        return value.as_subclass(torch.Tensor)
    return "cpu" if place_of(value) == "cuda" else value


def placed(value: Any) -> Any:
    return value.as_subclass(OnCard) if isinstance(value, torch.Tensor) else value


@contextmanager
def simulated_card(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Simulate a card with 1 TiB of free memory, also in threads that are started."""
    run = threading.Thread.run

    def with_card(self: threading.Thread) -> None:
        with SimulatedCard():
            run(self)

    monkeypatch.setattr(threading.Thread, "run", with_card)
    for name, value in MEMORY.items():
        monkeypatch.setattr(torch.cuda, name, lambda device=None, value=value: value)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device=None: (2**40, 2**40))
    for name in ("reset_peak_memory_stats", "empty_cache"):
        monkeypatch.setattr(torch.cuda, name, lambda *device: None)
    with SimulatedCard():
        yield


def kernel(function: Callable) -> Callable:
    """Return a function of tensors on the simulated card that is computed on the host."""
    return lambda *args, **options: tree_map(placed, function(*tree_map(simulated, args), **options))
