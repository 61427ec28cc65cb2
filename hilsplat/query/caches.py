"""Caches of a scene: artifacts, each opened once, and results per view, in bounded memory."""

from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

VIEW_CACHE_MIB = 1024.0
"""Memory limit of the cache, MiB."""


class Opened:
    """Artifacts by path, each opened and hashed once because the variants of a scene share most of them."""

    def __init__(self) -> None:
        self._kept: dict[tuple[Hashable, ...], Any] = {}

    def get(self, how: Callable[..., Any], path: Path, *more: Hashable) -> Any:
        """Return `how(path, *more)`, computed on the first call."""
        key = (how, Path(path).resolve(), *more)
        if key not in self._kept:
            self._kept[key] = how(path, *more)
        return self._kept[key]


class ViewStore:
    """Cache of results per view; above `most_mib`, the least recently used are dropped."""

    def __init__(self, most_mib: float = VIEW_CACHE_MIB) -> None:
        self._most_bytes = most_mib * 2**20
        self._kept: dict[tuple, tuple[Any, int]] = {}

    def get(self, key: tuple, compute: Callable[[], Any], size: Callable[[Any], int]) -> Any:
        """Return the cached value, or compute and cache it."""
        if key in self._kept:
            self._kept[key] = self._kept.pop(key)
            return self._kept[key][0]
        value = compute()
        self._kept[key] = (value, size(value))
        while len(self._kept) > 1 and sum(bytes_ for _, bytes_ in self._kept.values()) > self._most_bytes:
            self._kept.pop(next(iter(self._kept)))
        return value

    def forget(self, view: str) -> None:
        """Drop the results of a view, which is the second item of their keys."""
        for key in [key for key in self._kept if key[1] == view]:
            del self._kept[key]
