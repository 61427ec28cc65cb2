"""The baselines by name. To add one, write a file with a function `fit` and add a line here."""

from typing import TYPE_CHECKING

from hilsplat.base.errors import SettingsError
from hilsplat.base.plugins import Plugins
from hilsplat.settings import MethodSettings

if TYPE_CHECKING:
    from hilsplat.methods.method import Fit

METHODS: Plugins["Fit"] = Plugins(
    {
        "dr_splat": "hilsplat.methods.dr_splat:fit",
        "gaussian_grouping": "hilsplat.methods.gaussian_grouping:fit",
        "laga": "hilsplat.methods.laga:fit",
        "langsplat": "hilsplat.methods.langsplat:fit",
        "langsplat_v2": "hilsplat.methods.langsplat_v2:fit",
        "legaussians": "hilsplat.methods.legaussians:fit",
        "lifted": "hilsplat.methods.lifted:fit",
        "occam": "hilsplat.methods.occam:fit",
        "omniseg3d": "hilsplat.methods.omniseg3d:fit",
        "opengaussian": "hilsplat.methods.opengaussian:fit",
        "saga": "hilsplat.methods.saga:fit",
        "vch": "hilsplat.methods.vch:fit",
    }
)

OURS: str = MethodSettings().name
"""The method of this repository; the stage `field` computes its field."""


def require_method(name: str) -> None:
    """Raise a `SettingsError` unless a name is that of our method or a baseline."""
    if name != OURS and name not in METHODS:
        raise SettingsError(
            f"method.name: there is no method {name!r}",
            expected=f"one of {', '.join((OURS, *METHODS))}",
            fix="correct it, or write the method (docs/extending.md)",
        )


def method_of(name: str) -> "Fit":
    """Import a baseline, or raise a `SettingsError` if there is none with this name."""
    require_method(name)
    if name == OURS:
        raise SettingsError(
            f"method.name: {OURS} is not a baseline",
            expected=f"one of {', '.join(METHODS)}",
            fix="run the `field` stage, which computes its field",
        )
    return METHODS[name]
