"""Turn photographs into a 3D Gaussian scene that answers text queries at three semantic levels.

    import hilsplat

    scene = hilsplat.reconstruct("photos/")  # or hilsplat.load_scene, from COLMAP, nerfstudio or results
    gaussians = hilsplat.fit(scene)
    tree = hilsplat.link(scene, gaussians, hilsplat.segment(scene))
    for hit in tree.query("mug > handle"):
        print(hit.score, hit.level.label, hit.gaussians)
    tree = hilsplat.open_scene("results/photos/desk")  # what `hilsplat run` finished

The names in `__all__` are the public interface (docs/python.md); everything else may change. Importing the
package loads no large library.
"""

import os
import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hilsplat.base.errors import HilsplatError
    from hilsplat.base.levels import Level
    from hilsplat.evaluate.score import Scores, score
    from hilsplat.library import SceneMasks, fit, link, load_gaussians, load_scene, reconstruct, segment
    from hilsplat.query.hits import Doubt, Hit, Node
    from hilsplat.query.language_scene import LanguageScene, open_scene
    from hilsplat.query.scenes import SceneHit, Scenes, open_scenes
    from hilsplat.scene.cameras import Camera
    from hilsplat.scene.scene import Scene
    from hilsplat.segment.masks import HierarchicalMasks
    from hilsplat.splat.gaussians import Gaussians
    from hilsplat.splat.rasterise.api import Rendering, render
    from hilsplat.viewer.app import show

# onnxruntime reads it when imported: its telemetry starts a thread and writes a device id to the home folder.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__all__ = [
    "Camera",
    "Doubt",
    "Gaussians",
    "HierarchicalMasks",
    "HilsplatError",
    "Hit",
    "LanguageScene",
    "Level",
    "Node",
    "Rendering",
    "Scene",
    "SceneHit",
    "SceneMasks",
    "Scenes",
    "Scores",
    "fit",
    "link",
    "load_gaussians",
    "load_scene",
    "open_scene",
    "open_scenes",
    "reconstruct",
    "render",
    "score",
    "segment",
    "show",
]

_NAMES = {
    "hilsplat.base.errors": ("HilsplatError",),
    "hilsplat.base.levels": ("Level",),
    "hilsplat.evaluate.score": ("Scores", "score"),
    "hilsplat.library": (
        *("SceneMasks", "fit", "link", "load_gaussians"),
        *("load_scene", "reconstruct", "segment"),
    ),
    "hilsplat.query.hits": ("Doubt", "Hit", "Node"),
    "hilsplat.query.language_scene": ("LanguageScene", "open_scene"),
    "hilsplat.query.scenes": ("SceneHit", "Scenes", "open_scenes"),
    "hilsplat.scene.cameras": ("Camera",),
    "hilsplat.scene.scene": ("Scene",),
    "hilsplat.segment.masks": ("HierarchicalMasks",),
    "hilsplat.splat.gaussians": ("Gaussians",),
    "hilsplat.splat.rasterise.api": ("Rendering", "render"),
    "hilsplat.viewer.app": ("show",),
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    """Load a public name on first use."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


class _CallablePackage(ModuleType):
    """A subpackage that has the name of a public function, and is called as this function."""

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self.__wrapped__(*arguments, **named)

    @property
    def __wrapped__(self) -> Any:
        return __getattr__(self.__name__.rpartition(".")[2])

    def __reduce__(self) -> tuple[Any, ...]:  # as a function, it is sent to other processes by name
        return __getattr__, (self.__name__.rpartition(".")[2],)


class _Root(ModuleType):
    """This package, in which an import of the subpackage `segment` doesn't hide the function `segment`."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _MODULES and isinstance(value, ModuleType):
            value.__class__ = _CallablePackage
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Root
