"""Type checks that are compiled when a function is first called; a test run calls few functions."""

import functools
from collections.abc import Callable
from typing import Any

from beartype import beartype


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check the types of arguments and results at every call."""
    if isinstance(function, type):
        return beartype(function)
    made: list[Callable[..., Any]] = []

    @functools.wraps(function)
    def check(*arguments: Any, **named: Any) -> Any:
        if not made:
            made.append(beartype(function))
        return made[0](*arguments, **named)

    return check
