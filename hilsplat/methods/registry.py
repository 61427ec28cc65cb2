"""The baselines by name. To add one, write a file with a constant `METHOD` and add a line here."""

from typing import TYPE_CHECKING

from hilsplat.base.errors import SettingsError
from hilsplat.base.plugins import Plugins
from hilsplat.settings import MethodSettings

if TYPE_CHECKING:
    from hilsplat.methods.method import Method

METHODS: Plugins["Method"] = Plugins(
    {
        "dr_splat": "hilsplat.methods.dr_splat:METHOD",
        "gaussian_grouping": "hilsplat.methods.gaussian_grouping:METHOD",
        "laga": "hilsplat.methods.laga:METHOD",
        "langsplat": "hilsplat.methods.langsplat:METHOD",
        "langsplat_v2": "hilsplat.methods.langsplat_v2:METHOD",
        "legaussians": "hilsplat.methods.legaussians:METHOD",
        "lifted": "hilsplat.methods.lifted:METHOD",
        "occam": "hilsplat.methods.occam:METHOD",
        "omniseg3d": "hilsplat.methods.omniseg3d:METHOD",
        "opengaussian": "hilsplat.methods.opengaussian:METHOD",
        "saga": "hilsplat.methods.saga:METHOD",
        "vch": "hilsplat.methods.vch:METHOD",
    }
)

OURS: str = MethodSettings().name
"""The method of this repository; the stage `field` computes its field."""


def require_method(name: str) -> None:
    """Raise if a name is neither ours nor a baseline's.

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
        SettingsError: there is no baseline of this name.
    """
    require_method(name)
    if name == OURS:
        raise SettingsError(
            f"method.name: {OURS} is not a baseline",
            expected=f"one of {', '.join(METHODS)}",
            fix="run the stage `field`, which solves its field",
        )
    return METHODS[name]
