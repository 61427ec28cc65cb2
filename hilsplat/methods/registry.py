"""The baselines by name. To add one, write a file with a function `fit` and add its name to `NAMES`."""

from typing import TYPE_CHECKING

from hilsplat.base.errors import SettingsError
from hilsplat.base.plugins import Plugins
from hilsplat.settings import MethodSettings

if TYPE_CHECKING:
    from hilsplat.methods.method import Fit

NAMES = (
    *("dr_splat", "gaussian_grouping", "laga", "langsplat", "langsplat_v2", "legaussians"),
    *("lifted", "occam", "omniseg3d", "opengaussian", "saga", "vch"),
)
METHODS: Plugins["Fit"] = Plugins({name: f"hilsplat.methods.{name}:fit" for name in NAMES})

OURS: str = MethodSettings().name
"""The method of this repository; the `field` stage computes its field."""


def require_method(name: str) -> None:
    """Raise a `SettingsError` unless `name` is our method or a baseline."""
    if name != OURS and name not in METHODS:
        raise SettingsError(
            f"method.name: method {name!r} is unknown",
            expected=f"one of {', '.join((OURS, *METHODS))}",
            fix="correct the name, or implement the method (docs/extending.md)",
        )


def method_of(name: str) -> "Fit":
    """Import a baseline; raise a `SettingsError` if there is no baseline with this name."""
    require_method(name)
    if name == OURS:
        raise SettingsError(
            f"method.name: {OURS} is not a baseline",
            expected=f"one of {', '.join(METHODS)}",
            fix="run the `field` stage, which computes its field",
        )
    return METHODS[name]
