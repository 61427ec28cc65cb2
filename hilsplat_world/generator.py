"""The synthetic world as a generator of scenes: kinds, protocols and ground truth."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from hilsplat.datasets.dataset import ABLATIONS
from hilsplat.datasets.generators import Generator, Kind, Truth
from hilsplat.datasets.points.labelled_points import LabelledPoints
from hilsplat.scene.cameras import Cameras


@dataclass(frozen=True)
class WorldTruth(Truth):
    """Ground truth that the stage `world` wrote."""

    kind: str

    def points(self) -> dict[str, LabelledPoints]:
        from hilsplat_world.labels import labelled_points

        return labelled_points(self.folder.parent, self.kind)

    def cameras(self) -> Cameras:
        return Cameras.load(self.folder / "cameras.npz")

    def consistency(
        self, selections: Any, truths: Any, masks: Any, settings: Any
    ) -> Iterator[tuple[str, Any]]:
        from hilsplat_world.diagnostics.world_consistency import measure_world_consistency

        return measure_world_consistency(selections, truths, masks, self.folder, settings)


def size_of(settings: Any) -> tuple[int, float]:
    return settings.world.views, settings.world.image_px**2 / 1e6


# Protocols of the benchmarks that each kind substitutes for, besides LERF-OVS and the level protocols.
TABLETOP = (
    *("3d-ovs/langsplat", "3d-ovs/langsplat-raw", "3d-ovs/langsplat-v2", "3d-ovs/tree-nodes"),
    *("3d-ovs/argmax", "lerf-mask/gaussian-grouping"),
)
ROOM = (
    *("scannet/opengaussian-19", "scannet/opengaussian-15", "scannet/opengaussian-10"),
    *("scannet200/opengaussian", "scannet200/benchmark", "scannet200/instances", "replica/per-scene"),
)
STREET = ("waymo/segmentation",)
FRAMES = ("frames-hi-lerf", "frames-hi-3dovs")

GENERATOR = Generator(
    name="world",
    kinds={
        "tabletop": Kind(TABLETOP, ("lerf", "3dovs", "hierarchy", *FRAMES, *ABLATIONS)),
        "room": Kind(ROOM, ("replica", "scannet", "hierarchy")),
        "street": Kind(STREET, ("waymo", "hierarchy")),
    },
    size=size_of,
    open=WorldTruth,
    pictures=("masks",),
)
