"""Loops compiled by numba and cached on disk; a notice is logged when they must be compiled."""

import functools
import inspect
import logging
from collections.abc import Callable
from typing import Any

import numba
from numba.core import event

from hilsplat.base.definitions import PACKAGE
from hilsplat.base.identity import code_digest, is_as_imported

logger = logging.getLogger(__name__)


def compiled(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Apply `numba.njit` with the GIL released; cache the result on disk until code used by the loop changes.

    By default, numba recompiles a cached loop if and only if the loop's own file changes. It would miss edits
    to functions that the loop calls from other files, and recompile after an edit to a comment.
    """
    if function is None:
        return lambda later: compiled(later, **options)
    function = inspect.unwrap(function)  # the type checker used in tests wraps every function
    dispatcher = numba.njit(nogil=True, cache=True, **options)(function)
    if function.__module__.split(".")[0] == PACKAGE and "<locals>" not in function.__qualname__:
        # numba has no public way to declare the dependencies of a cached function
        cache = dispatcher._cache
        cache._enabled = cache._cache_file._source_stamp = _Stamp(function, options)
    return dispatcher


class _Stamp:
    """Digest of the imported code that a loop is compiled from, computed when numba first opens its cache.

    It is falsy if the package was edited after being imported; numba then neither reads nor writes the cache.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.function, self.options = function, options

    @functools.cached_property
    def _digest(self) -> str:
        # The first check avoids half-edited files, which may not parse; the second covers later edits.
        digest = code_digest(self.function) if is_as_imported() else ""
        return digest if is_as_imported() else ""

    def __bool__(self) -> bool:
        return bool(self._digest)

    def __str__(self) -> str:
        return f"{self._digest} {sorted(self.options.items())}"

    def __eq__(self, other: object) -> bool:
        return str(self) == str(other)

    def __reduce__(self) -> tuple[type[str], tuple[str]]:
        return str, (str(self),)  # the cache's index file stores plain text


class _Notice(event.Listener):
    """Listener that logs one notice when loops are compiled; loading them from the cache raises no event."""

    given = False

    def on_start(self, happening: Any) -> None:
        module = happening.data["dispatcher"].py_func.__module__ or ""
        if not self.given and module.split(".")[0] == PACKAGE:
            self.given = True
            logger.info("compiling kernels, which takes about 15 s; later runs load them from disk")

    def on_end(self, happening: Any) -> None:
        pass


event.register("numba:compile", _Notice())
