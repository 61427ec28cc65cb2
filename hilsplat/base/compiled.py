"""Loops compiled by numba and kept on disk, with a notice when they must be compiled."""

import inspect
import logging
from collections.abc import Callable
from typing import Any

import numba
from numba.core import event

logger = logging.getLogger(__name__)

PACKAGE = __name__.split(".")[0]


def compiled(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """`numba.njit` without the interpreter lock, cached on disk (unwrapped: tests wrap every function)."""
    if function is None:
        return lambda later: compiled(later, **options)
    return numba.njit(nogil=True, cache=True, **options)(inspect.unwrap(function))


class _Notice(event.Listener):
    """Says once that loops are compiled; numba reports compilations only, not loops from the cache."""

    given = False

    def on_start(self, happening: Any) -> None:
        module = happening.data["dispatcher"].py_func.__module__ or ""
        if not self.given and module.split(".")[0] == PACKAGE:
            self.given = True
            logger.info("compiling kernels, once: a quarter of a minute; later runs load them from disk")

    def on_end(self, happening: Any) -> None:
        """Nothing to say."""


event.register("numba:compile", _Notice())
