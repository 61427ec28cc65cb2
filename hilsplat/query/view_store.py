"""What was computed for views, kept in bounded memory."""

from collections.abc import Callable
from typing import Any

VIEW_CACHE_MIB = 1024.0
"""What is kept of the views that were asked for last."""


class ViewStore:
    """What was computed for views, the oldest forgotten once it is more than `VIEW_CACHE_MIB`."""

    def __init__(self) -> None:
        self._kept: dict[tuple, tuple[Any, int]] = {}

    def get(self, key: tuple, compute: Callable[[], Any], size: Callable[[Any], int]) -> Any:
        """The kept value, or a new one."""
        if key in self._kept:
            self._kept[key] = self._kept.pop(key)
            return self._kept[key][0]
        value = compute()
        self._kept[key] = (value, size(value))
        while (
            len(self._kept) > 1 and sum(bytes_ for _, bytes_ in self._kept.values()) > VIEW_CACHE_MIB * 2**20
        ):
            self._kept.pop(next(iter(self._kept)))
        return value
