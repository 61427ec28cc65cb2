"""Turn photographs into a 3D Gaussian scene that answers text queries at three semantic levels.

    import hilsplat

    scene = hilsplat.open("results/photos/desk")
    for hit in scene.query("mug > handle"):
        print(hit.score, hit.level.label, hit.gaussians)

The names in `__all__` are the public interface (docs/python.md); everything else may change. Importing the
package loads no large library.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hilsplat.base.errors import HilsplatError
    from hilsplat.base.levels import Level
    from hilsplat.query.hits import Doubt, Hit
    from hilsplat.query.language_scene import LanguageScene

__all__ = ["Doubt", "HilsplatError", "Hit", "LanguageScene", "Level", "open"]


def open(folder: Path | str, variant: str = "default", *, threads: int = 1) -> "LanguageScene":
    """Open a finished scene, `results/<dataset>/<scene>` or a copy of it: see `LanguageScene.open`."""
    from hilsplat.query.language_scene import LanguageScene

    return LanguageScene.open(folder, variant, threads=threads)


def __getattr__(name: str) -> Any:
    """Load a public type on first use."""
    if name in ("HilsplatError", "Level"):
        from hilsplat.base import errors, levels

        return errors.HilsplatError if name == "HilsplatError" else levels.Level
    if name in ("Doubt", "Hit", "LanguageScene"):
        from hilsplat.query import hits, language_scene

        return getattr(language_scene if name == "LanguageScene" else hits, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
