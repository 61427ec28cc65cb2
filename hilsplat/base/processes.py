"""Process many items in separate processes, with results in order."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, TypeVar

Result = TypeVar("Result")


def in_processes(
    work: Callable[..., Result], items: Sequence[tuple[Any, ...]], workers: int, chunk: int = 1
) -> Iterator[Result]:
    """Results of `work(*item)` in the order of `items`.

    For work that holds Python's lock, such as Embree's wrapper. Processes are spawned, since forking a
    process that has threads may hang. With one worker or one item, no process is started.

    Args:
        work: a function at the top level of a module, or a `functools.partial` of one.
        items: arguments of each call.
        workers: number of processes.
        chunk: number of items that a process takes at a time.
    """
    if workers <= 1 or len(items) <= 1:
        for item in items:
            yield work(*item)
        return
    with ProcessPoolExecutor(min(workers, len(items)), mp_context=get_context("spawn")) as pool:
        yield from pool.map(work, *zip(*items, strict=True), chunksize=chunk)
