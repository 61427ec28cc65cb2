"""The baselines by name. A new one is a file with a constant `METHOD` and a line here.

The workflow reads this module at start-up, so the files are imported when they are asked for.
"""

import importlib
from typing import TYPE_CHECKING

from hilsplat.base.errors import SettingsError
from hilsplat.settings import MethodSettings

if TYPE_CHECKING:
    from hilsplat.methods.method import Method

METHODS: dict[str, str] = {
    "langsplat": "hilsplat.methods.langsplat",
    "lifted": "hilsplat.methods.lifted",
}
"""Name -> module, whose `METHOD` it is."""

OURS: str = MethodSettings().name
"""The method of this repository, whose field the stage `field` solves."""


def require_method(name: str) -> None:
    """Refuse a name that is neither ours nor a baseline's.

    Raises:
        SettingsError: there is no such method.
    """
    if name != OURS and name not in METHODS:
        raise SettingsError(
            f"method.name: there is no method {name!r}",
            expected=f"one of {', '.join((OURS, *METHODS))}",
            fix="correct it, or write the method (docs/extending.md)",
        )


def method_of(name: str) -> "Method":
    """Load a baseline.

    Raises:
        SettingsError: there is none of this name.
    """
    require_method(name)
    if name == OURS:
        raise SettingsError(
            f"method.name: {OURS} is no baseline",
            expected=f"one of {', '.join(METHODS)}",
            fix="run the stage language, which solves its field",
        )
    return importlib.import_module(METHODS[name]).METHOD
