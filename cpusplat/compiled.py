"""Loops compiled by numba, with the GIL released and cached on disk."""

import inspect
from collections.abc import Callable
from typing import Any

import numba


def compiled(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Apply `numba.njit` with the GIL released, and cache the machine code on disk."""
    if function is None:
        return lambda later: compiled(later, **options)
    return numba.njit(nogil=True, cache=True, **options)(inspect.unwrap(function))
