"""Installed packages and torch's threads."""

import importlib.metadata
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache


@cache
def is_installed(distribution: str) -> bool:
    try:
        importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Make torch sum in a fixed order, so that results do not depend on the stage's number of threads.

    torch stores its thread count per thread, so each thread of a pool must enter this context itself.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
