"""Work on ranges of items in threads; numba's loops release the GIL."""

import functools
import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

RANGES_PER_THREAD = 4  # number of work ranges per thread; several ranges balance the load


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="ranges")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a forked process has none of the threads


def over_edges(work: Callable[..., Any], edges: list[int], threads: int, *arguments: Any) -> list[Any]:
    """Call `work(begin, end, *arguments)` for each adjacent pair of `edges` in threads; keep their order."""
    if threads <= 1:
        return [work(begin, end, *arguments) for begin, end in itertools.pairwise(edges)]
    return list(_pool(threads).map(lambda begin, end: work(begin, end, *arguments), edges[:-1], edges[1:]))


def over_ranges(
    work: Callable[..., Any], count: int, threads: int, *arguments: Any, first: int = 0
) -> list[Any]:
    """Call `work(begin, end, *arguments)` in threads for ranges of `count` items, starting at `first`."""
    pieces = min(count, RANGES_PER_THREAD * threads) if threads > 1 and count > 1 else 1
    edges = first + np.linspace(0, count, pieces + 1).astype(int)
    return over_edges(work, edges.tolist(), threads, *arguments)
