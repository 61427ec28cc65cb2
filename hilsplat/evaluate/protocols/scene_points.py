"""Query a scene for the classes of labelled points: ScanNet, Replica, Waymo and synthetic stand-ins.

| method | class of a point |
|---|---|
| `tree` | the class text with the highest cosine to the node of its Gaussian at level whole |
| `field` | the class text with the highest cosine to the latent transferred to the point at level whole |

Instances (ScanNet200) are the tree's nodes at level whole; a field has none.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Int32

from hilsplat.base.levels import Level
from hilsplat.datasets.classes.class_set import ClassSet
from hilsplat.datasets.points.labelled_points import LABELLINGS, LabelledPoints
from hilsplat.evaluate.metrics.instances import CLASS_STRIDE, InstanceMatches, InstanceScan, match_instances
from hilsplat.evaluate.protocols import carry
from hilsplat.evaluate.protocols.cards import INSTANCES, ProtocolCard
from hilsplat.evaluate.protocols.measured import Measured
from hilsplat.evaluate.protocols.points import measure_points
from hilsplat.query.language_scene import LanguageScene

VOTE_RADIUS_M = 0.1
"""Radius of votes; 10 cm."""

LEVEL = Level.WHOLE
"""The classes of these data sets are things and surfaces, not parts."""


@dataclass(frozen=True)
class PointAnswers:
    """A scene's answers at given points.

    Attributes:
        scene: the queried scene.
        carried: Gaussians assigned to the points.
    """

    scene: LanguageScene
    carried: carry.CarriedPoints

    @staticmethod
    def at(
        scene: LanguageScene,
        points: Float[np.ndarray, "P 3"],
        mode: carry.Mode,
        scene_units_per_metre: float,
        threads: int = 1,
    ) -> "PointAnswers":
        """Assign the scene's Gaussians to points (`carry`).

        Args:
            scene: the queried scene.
            points: positions, scene units.
            mode: how Gaussians are assigned to points.
            scene_units_per_metre: scales the radius of a vote.
            threads: search threads.
        """
        gaussians = scene.gaussians
        means, opacities = (gaussians.means, gaussians.opacities)
        if mode == "frozen":
            carried = carry.frozen(opacities, len(points))
        elif mode == "nearest":
            carried = carry.nearest(points, means, opacities, threads)
        elif mode == "vote":
            radius = VOTE_RADIUS_M * scene_units_per_metre
            carried = carry.vote(points, means, opacities, radius, threads=threads)
        else:
            scales, quats = (gaussians.scales, gaussians.quats)
            carried = carry.density(points, means, opacities, scales, quats, threads=threads)
        return PointAnswers(scene, carried)

    def classes(self, method: str, texts: Sequence[str]) -> Int32[np.ndarray, " P"]:
        """Return labels 1 .. K of the points; 0 if no Gaussian is assigned to a point."""
        vectors = self.scene.text_vectors(texts)
        if method == "tree":
            node = self.scene.tree.node_of_gaussian[:, LEVEL.index]
            of_node = carry.classify(self.scene.tree.clip.astype(np.float32), vectors)
            of_gaussian = np.append(of_node, 0)[node]  # -1 is none
            return self.carried.labels(of_gaussian)
        language, code = self.scene.trained()
        latents = self.carried.features(np.ascontiguousarray(language.features[:, LEVEL.index]))
        spoken = np.flatnonzero(latents.any(axis=1))
        labels = np.zeros(len(latents), dtype=np.int32)
        if len(spoken):
            decoded = code.decode_array(latents[spoken].astype(np.float32))
            labels[spoken] = carry.classify(decoded, vectors)
        return labels

    def instances(self, truth: LabelledPoints, classes: ClassSet) -> InstanceMatches:
        """Match the nodes at level whole to the truth; a node's best cosine gives class and confidence."""
        tree = self.scene.tree
        nodes = tree.nodes_of(LEVEL)
        cosines = tree.clip[nodes].astype(np.float32) @ self.scene.text_vectors(classes.texts).T
        node = np.append(tree.node_of_gaussian[:, LEVEL.index], -1)
        own = self.carried.labels(node[:-1] + 1) - 1
        return instance_scan(
            truth,
            classes,
            own[None] == nodes[:, None],
            np.array(classes.ids)[cosines.argmax(axis=1)] if len(nodes) else np.zeros(0, np.int64),
            cosines.max(axis=1) if len(nodes) else np.zeros(0, np.float32),
        )


def instance_scan(
    truth: LabelledPoints,
    classes: ClassSet,
    masks: Bool[np.ndarray, "M P"],
    class_ids: Int[np.ndarray, " M"],
    confidences: Float[np.ndarray, " M"],
) -> InstanceMatches:
    """Match predicted instances, with class ids as in the data set's files, to the labelled instances."""
    labels = classes.labels(truth.class_id)
    ids = np.array([0, *classes.ids])[labels]
    of_points = np.where(labels > 0, ids * CLASS_STRIDE + truth.instance_id, 0).astype(np.int64)
    return match_instances(InstanceScan(of_points, masks, class_ids, confidences), classes.ids)


def class_set(name: str) -> tuple[str, ClassSet]:
    """Return the labelling and the class set with the given name."""
    for labelling, sets in LABELLINGS.items():
        for classes in sets:
            if classes.name == name:
                return labelling, classes
    raise KeyError(name)


def measure_scene_points(
    scene: LanguageScene,
    truth: Mapping[str, LabelledPoints],
    scene_from_points: Float[np.ndarray, "4 4"],
    cards: Sequence[ProtocolCard],
    methods: Sequence[str],
    mode: carry.Mode,
    threads: int = 1,
) -> Iterator[Measured | tuple[str, InstanceMatches]]:
    """Yield the rows of one scene under point protocols, and the instance matches of each method.

    Args:
        scene: the queried scene.
        truth: labelled points by labelling, metres.
        scene_from_points: similarity transform from their frame to the scene's.
        cards: point protocols; those whose labelling is absent are skipped.
        methods: "tree" and "field"; other methods don't label points.
        mode: see `carry`.
        threads: search threads.
    """
    scale = float(np.cbrt(np.linalg.det(scene_from_points[:3, :3])))
    answers: dict[int, PointAnswers] = {}  # labellings of a mesh share its vertices
    labels_of: dict[tuple[int, str, str], np.ndarray] = {}  # protocols share classes
    for card in cards:
        labelling, classes = class_set(card.classes)
        if labelling not in truth:
            continue
        points = truth[labelling]
        if id(points.xyz) not in answers:
            places = points.xyz @ scene_from_points[:3, :3].T + scene_from_points[:3, 3]
            answers[id(points.xyz)] = PointAnswers.at(scene, places, mode, scale, threads)
        asked = answers[id(points.xyz)]
        if card is INSTANCES:
            if "tree" in methods:
                yield "tree", asked.instances(points, classes)
            continue
        labels = asked.carried.truth(points.labels(classes))
        for method in ("tree", "field"):
            if method in methods:
                key = (id(points.xyz), method, classes.name)
                if key not in labels_of:
                    labels_of[key] = asked.classes(method, classes.texts)
                yield from measure_points(card, method, labels, labels_of[key], classes, asked.carried.mode)
