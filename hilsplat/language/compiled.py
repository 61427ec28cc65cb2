"""Compiled loops, kept on disk.

numba keeps a loop as long as the file that holds it is unchanged, so loops that call each other stand in
one file.
"""

import inspect
from collections.abc import Callable

import numba


def compiled(function: Callable, **options: bool) -> Callable:
    """Compile a loop with numba (unwrapped: the tests' type checker wraps every function)."""
    return numba.njit(cache=True, nogil=True, **options)(inspect.unwrap(function))
