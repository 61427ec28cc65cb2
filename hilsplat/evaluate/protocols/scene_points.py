"""Query a scene for the classes of labelled points: ScanNet, Replica, Waymo and synthetic stand-ins.

| method | class of a point |
|---|---|
| `tree` | the class text with the highest cosine to the node of its Gaussian at level whole |
| `field` | the class text with the highest cosine to the latent transferred to the point at level whole |

Instances (ScanNet200) are the tree's nodes at level whole; a field has none.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, Int32

from hilsplat.base.levels import Level
from hilsplat.datasets.classes.class_set import ClassSet
from hilsplat.datasets.points.labelled_points import LABELLINGS, LabelledPoints
from hilsplat.evaluate.metrics.instances import CLASS_STRIDE, InstanceMatches, match_instances
from hilsplat.evaluate.protocols.cards import INSTANCES, ProtocolCard
from hilsplat.evaluate.protocols.carry import CarriedPoints, Mode, carried_to, classify
from hilsplat.evaluate.protocols.points import measure_points
from hilsplat.evaluate.scores import Measured
from hilsplat.query.language_scene import LanguageScene

VOTE_RADIUS_M = 0.1
"""Radius of votes; 10 cm."""

LEVEL = Level.WHOLE
"""The classes of these data sets are things and surfaces, not parts."""


def point_classes(
    scene: LanguageScene, carried: CarriedPoints, method: str, texts: Sequence[str]
) -> Int32[np.ndarray, " P"]:
    """Return labels 1 .. K of points by "tree" or "field"; 0 if no Gaussian is assigned to a point."""
    vectors = scene.text_vectors(texts)
    if method == "tree":
        of_node = classify(scene.tree.clip.astype(np.float32), vectors)
        node = scene.tree.node_of_gaussian[:, LEVEL.index]
        return carried.labels(np.append(of_node, 0)[node])  # -1 is none
    language, code = scene.trained()
    latents = carried.features(np.ascontiguousarray(language.features[:, LEVEL.index]))
    spoken = np.flatnonzero(latents.any(axis=1))
    labels = np.zeros(len(latents), dtype=np.int32)
    if len(spoken):
        decoded = code.decode_array(latents[spoken].astype(np.float32))
        labels[spoken] = classify(decoded, vectors)
    return labels


def node_instances(
    scene: LanguageScene, carried: CarriedPoints, truth: LabelledPoints, classes: ClassSet
) -> InstanceMatches:
    """Match the nodes at level whole to the truth; a node's best cosine gives class and confidence."""
    tree = scene.tree
    nodes = tree.nodes_of(LEVEL)
    cosines = tree.clip[nodes].astype(np.float32) @ scene.text_vectors(classes.texts).T
    own = carried.labels(tree.node_of_gaussian[:, LEVEL.index] + 1) - 1
    return instance_scan(
        truth,
        classes,
        own[None] == nodes[:, None],
        np.array(classes.ids)[cosines.argmax(axis=1)],
        cosines.max(axis=1),
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
    return match_instances(of_points, masks, class_ids, confidences, classes.ids)


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
    mode: Mode,
    threads: int = 1,
) -> Iterator[Measured | tuple[str, InstanceMatches]]:
    """Yield the rows of one scene under point protocols, and the instance matches of each method.

    Args:
        truth: labelled points by labelling, metres.
        scene_from_points: similarity transform from their frame to the scene's.
        cards: point protocols; those whose labelling is absent are skipped.
        methods: "tree" and "field"; other methods don't label points.
    """
    radius = VOTE_RADIUS_M * float(np.cbrt(np.linalg.det(scene_from_points[:3, :3])))
    carried_of: dict[int, CarriedPoints] = {}  # labellings of a mesh share its vertices
    labels_of: dict[tuple[int, str, str], np.ndarray] = {}  # protocols share classes
    for card in cards:
        labelling, classes = class_set(card.classes)
        if labelling not in truth:
            continue
        points = truth[labelling]
        if id(points.xyz) not in carried_of:
            places = points.xyz @ scene_from_points[:3, :3].T + scene_from_points[:3, 3]
            carried_of[id(points.xyz)] = carried_to(places, scene.gaussians, mode, radius, threads)
        carried = carried_of[id(points.xyz)]
        if card is INSTANCES:
            if "tree" in methods:
                yield "tree", node_instances(scene, carried, points, classes)
            continue
        labels = carried.truth(points.labels(classes))
        for method in ("tree", "field"):
            if method in methods:
                key = (id(points.xyz), method, classes.name)
                if key not in labels_of:
                    labels_of[key] = point_classes(scene, carried, method, classes.texts)
                yield from measure_points(card, method, labels, labels_of[key], classes, carried.mode)
