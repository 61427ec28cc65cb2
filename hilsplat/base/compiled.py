"""Loops compiled by numba and cached on disk, with a notice when they must be compiled."""

import inspect
import logging
from collections.abc import Callable
from typing import Any

import numba
from numba.core import event

from hilsplat.base.definitions import PACKAGE
from hilsplat.base.identity import code_digest

logger = logging.getLogger(__name__)


def compiled(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """`numba.njit` without the interpreter lock, cached on disk until code that the loop reaches changes.

    numba itself recompiles a cached loop if and only if its own file changes: it would miss an edit to a
    function of another file that the loop calls, and recompile for a comment.
    """
    if function is None:
        return lambda later: compiled(later, **options)
    function = inspect.unwrap(function)  # the tests' type checker wraps every function
    dispatcher = numba.njit(nogil=True, cache=True, **options)(function)
    if function.__module__.split(".")[0] == PACKAGE and "<locals>" not in function.__qualname__:
        # numba has no public way to declare what else a cached function depends on
        dispatcher._cache._cache_file._source_stamp = _Stamp(function, options)
    return dispatcher


class _Stamp:
    """Digest of what a loop is compiled from, taken when numba first looks into its cache."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.function, self.options = function, options

    def __str__(self) -> str:
        return f"{code_digest(self.function)} {sorted(self.options.items())}"

    def __eq__(self, other: object) -> bool:
        return str(self) == str(other)

    def __reduce__(self) -> tuple[type[str], tuple[str]]:
        return str, (str(self),)  # the cache's index file keeps plain text


class _Notice(event.Listener):
    """Logs once that loops are being compiled; numba does not report loops from the cache."""

    given = False

    def on_start(self, happening: Any) -> None:
        module = happening.data["dispatcher"].py_func.__module__ or ""
        if not self.given and module.split(".")[0] == PACKAGE:
            self.given = True
            logger.info("compiling kernels, once: about 15 s; later runs load them from disk")

    def on_end(self, happening: Any) -> None:
        """Nothing to report."""


event.register("numba:compile", _Notice())
