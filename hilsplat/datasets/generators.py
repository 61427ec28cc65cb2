"""Generators: plugins whose rules make scenes with exact annotations, such as the synthetic world.

The source of such a scene is `<generator>:<kind>:<seed>`. The rule writes `<generator>/images`, which the
stages read, and `<generator>/truth`, which only evaluation and figures read.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilsplat.base.errors import SceneError
from hilsplat.base.plugins import Plugins, entry_points
from hilsplat.datasets.points.labelled_points import LabelledPoints
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.sheet import Generated, generated_of


@dataclass(frozen=True)
class Truth:
    """Ground truth of a generated scene, in the format of `datasets.hierarchy`, without exact geometry."""

    folder: Path

    def points(self) -> dict[str, LabelledPoints]:
        """Return the labelled points for each labelling, in the frame of `cameras`."""
        return {}

    def cameras(self) -> Cameras:
        """Return the true cameras; raise SceneError if they are unknown."""
        raise SceneError(f"{self.folder} has no true cameras", fix="name the scene's source")

    def consistency(self, selections: Any, truths: Any, masks: Any, settings: Any) -> Iterator[Any]:
        """Yield pairs of a view's name and a row of scores: how well answers agree between views."""
        return iter(())


@dataclass(frozen=True)
class Kind:
    """One kind of generated scene: the protocols that score it, and the tables that show it (`evaluate`)."""

    protocols: tuple[str, ...]
    tables: tuple[str, ...]


@dataclass(frozen=True)
class Generator:
    """A generator.

    Attributes:
        size: returns the number of views and the megapixels of one, given all settings.
        open: reads the ground truth in a folder, given the kind.
        pictures: names of pictures in a scene's folder of figures that the plugin's rules draw.
    """

    name: str
    kinds: Mapping[str, Kind]
    size: Callable[[Any], tuple[int, float]]
    open: Callable[[Path, str], Truth]
    pictures: tuple[str, ...] = ()


GENERATORS: Plugins[Generator] = entry_points("hilsplat.generators", Generator)


def generator_of(source: str) -> tuple[Generator, Generated]:
    """Return the generator named in a source, and the source's parts; raise SceneError if it is unknown."""
    generated = generated_of(source)
    generator = GENERATORS[generated.generator] if generated else None
    if generated is None or generator is None or generated.kind not in generator.kinds:
        kinds = [f"{name}:{kind}:<seed>" for name, other in GENERATORS.items() for kind in other.kinds]
        raise SceneError(
            f"{source!r} does not name a generated scene",
            expected=f"one of {', '.join(kinds)}",
            fix="correct the source in the scene sheet, or install its plugin",
        )
    return generator, generated
