"""Points labelled by a benchmark: mesh vertices or lidar returns."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int32

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.datasets.classes import (
    REPLICA_48,
    REPLICA_51,
    SCANNET200,
    SCANNET200_INSTANCES,
    SCANNET_10,
    SCANNET_15,
    SCANNET_19,
    WAYMO_22,
    ClassSet,
)
from hilsplat.datasets.dataset import SceneReport
from hilsplat.scene.posed_images import PosedImage

LABELLINGS: dict[str, tuple[ClassSet, ...]] = {
    "nyu40": (SCANNET_19, SCANNET_15, SCANNET_10),
    "scannet200": (SCANNET200, SCANNET200_INSTANCES),
    "replica": (REPLICA_51, REPLICA_48),
    "waymo": (WAYMO_22,),
}
"""Labelling (meaning of the class ids in a data set's files) -> class sets evaluated on it."""


@dataclass(frozen=True, eq=False)
class LabelledPoints:
    """P points with their ground-truth classes, in the frame of the scene's cameras.

    Attributes:
        xyz: positions, metres.
        class_id: class number in the data set's files; 0 if undefined.
        instance_id: instance number from 1, unrelated between files; 0 for none.
        labelling: meaning of `class_id`, a key of `LABELLINGS`.
        faces: corners of triangles, as rows of `xyz`; None if the points are not a mesh.
        visible: whether the point is visible to a camera; None if unknown.
    """

    xyz: Float[np.ndarray, "P 3"]
    class_id: Int32[np.ndarray, " P"]
    instance_id: Int32[np.ndarray, " P"]
    labelling: str
    faces: Int32[np.ndarray, "F 3"] | None = None
    visible: Bool[np.ndarray, " P"] | None = None

    def __len__(self) -> int:
        return len(self.xyz)

    def labels(self, classes: ClassSet) -> Int32[np.ndarray, " P"]:
        """Return labels 1 .. K in the order of a class set, 0 for classes that the set lacks.

        Raises:
            MisalignedArtifactError: the set is not defined on this labelling.
        """
        fitting = LABELLINGS[self.labelling]
        if classes not in fitting:
            raise MisalignedArtifactError(
                f"classes {classes.name} are not defined on {self.labelling} labels",
                expected=" or ".join(each.name for each in fitting),
                found=classes.name,
                fix="use a protocol of this data set",
            )
        return classes.labels(self.class_id)


@dataclass(frozen=True, eq=False)
class PointScene:
    """A scene of a data set with labelled points.

    Attributes:
        images: posed images, without unusable frames (those without a pose).
        truth: labelled points by labelling. Only `evaluate` may read them.
        warnings: one sentence for each item that was skipped or reinterpreted.
    """

    name: str
    images: tuple[PosedImage, ...]
    truth: Mapping[str, LabelledPoints]
    warnings: tuple[str, ...] = ()

    def report(self) -> SceneReport:
        """Report what was read, and warn about what was skipped."""
        facts: dict[str, object] = {"posed images": len(self.images)}
        for labelling, points in self.truth.items():
            facts[f"{labelling} points"] = len(points)
            facts[f"{labelling} points with a class"] = int((points.class_id > 0).sum())
            facts[f"{labelling} classes"] = len(np.unique(points.class_id[points.class_id > 0]))
            facts[f"{labelling} instances"] = len(np.unique(points.instance_id[points.instance_id > 0]))
            if points.visible is not None:
                facts[f"{labelling} points that a camera sees"] = int(points.visible.sum())
        return SceneReport(facts, self.warnings)
