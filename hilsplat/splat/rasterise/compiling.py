"""Compiled kernels, kept on disk: a notice where they must be compiled, none where they are loaded.

numba keeps a kernel as long as the file that holds it is unchanged, but kernels also compile in
functions and constants of their neighbours. So the stamp of every kernel holds a digest of all files
they are compiled from, and an edit of one compiles all of them again.
"""

import hashlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import event

logger = logging.getLogger(__name__)

PACKAGE = __name__.split(".")[0]


SOURCES = ("binning.py", "blend.py", "compiling.py", "lanes.py", "project.py")
"""Modules here that kernels are compiled from."""

_DIGEST = hashlib.sha256(
    b"\0".join(Path(__file__).with_name(name).read_bytes() for name in SOURCES)
).hexdigest()


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """`numba.njit` without the interpreter lock, cached on disk until a source of the rasteriser changes."""
    if function is None:
        return lambda later: kernel(later, **options)
    dispatcher = numba.njit(nogil=True, cache=True, **options)(function)
    # numba has no public way to say what else a cached function was made from
    cache = dispatcher._cache._cache_file
    cache._source_stamp = (cache._source_stamp, _DIGEST)
    return dispatcher


class _Notice(event.Listener):
    """Says once that kernels are compiled; numba tells of compilations only, not of cached kernels."""

    given = False

    def on_start(self, happening: Any) -> None:
        compiled = happening.data["dispatcher"].py_func.__module__ or ""
        if not self.given and compiled.split(".")[0] == PACKAGE:
            self.given = True
            logger.info("compiling kernels, once: a quarter of a minute; later runs load them from the disk")

    def on_end(self, happening: Any) -> None:
        """Nothing to say."""


event.register("numba:compile", _Notice())
