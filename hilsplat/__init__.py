"""Turn photographs into a 3D Gaussian scene that answers text queries at three semantic levels.

    import hilsplat

    scene = hilsplat.open_scene("results/photos/desk")
    for hit in scene.query("mug > handle"):
        print(hit.score, hit.level.label, hit.gaussians)
    for hit in hilsplat.open_scenes("results").query("mug"):  # the scenes that match best
        print(hit.score, hit.scene, hit.picture)

The names in `__all__` are the public interface (docs/python.md); everything else may change. Importing the
package loads no large library.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hilsplat.base.errors import HilsplatError
    from hilsplat.base.levels import Level
    from hilsplat.evaluate.score import Scores, score
    from hilsplat.query.hits import Doubt, Hit
    from hilsplat.query.language_scene import LanguageScene, open_scene
    from hilsplat.query.scenes import SceneHit, Scenes, open_scenes
    from hilsplat.viewer.app import show

__all__ = [
    "Doubt",
    "HilsplatError",
    "Hit",
    "LanguageScene",
    "Level",
    "SceneHit",
    "Scenes",
    "Scores",
    "open_scene",
    "open_scenes",
    "score",
    "show",
]

_MODULES = {
    "HilsplatError": "hilsplat.base.errors",
    "Level": "hilsplat.base.levels",
    "Doubt": "hilsplat.query.hits",
    "Hit": "hilsplat.query.hits",
    "LanguageScene": "hilsplat.query.language_scene",
    "SceneHit": "hilsplat.query.scenes",
    "Scenes": "hilsplat.query.scenes",
    "Scores": "hilsplat.evaluate.score",
    "open_scene": "hilsplat.query.language_scene",
    "open_scenes": "hilsplat.query.scenes",
    "score": "hilsplat.evaluate.score",
    "show": "hilsplat.viewer.app",
}


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    """Load a public name on first use."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
