"""Score classes and instances of labelled points: ScanNet, ScanNet200, Replica, Waymo and their stand-ins.

Scores depend on the mode by which predictions are transferred from Gaussians to points
(`gaussians_of_points`), so every row names it. Instances (ScanNet200) are the tree's nodes at level whole; a
field has no instances.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Int32, Int64

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.base.levels import Level
from hilsplat.datasets.classes import LABELLINGS, SCANNET200_INSTANCES, ClassSet, splits_of
from hilsplat.datasets.points.labelled_points import LabelledPoints
from hilsplat.evaluate.metrics import instances, point_classes
from hilsplat.evaluate.protocols.cards import INSTANCES, ProtocolCard
from hilsplat.evaluate.scores import Measured
from hilsplat.splat.gaussians import Gaussians

if TYPE_CHECKING:
    from hilsplat.query.language_scene import LanguageScene

Mode = Literal["frozen", "nearest"]

LEVEL = Level.WHOLE
"""Level of all predictions: the classes of these data sets are objects and surfaces, not parts."""

OPACITY_MIN = 0.1
"""Gaussians below this opacity count as transparent; OpenGaussian excludes them from the evaluation."""

CHUNK_POINTS = 65536  # number of points classified at once; bounds memory use


def gaussians_of_points(
    points: Float[np.ndarray, "P 3"], gaussians: Gaussians, mode: Mode, threads: int = 1
) -> tuple[Int64[np.ndarray, " P"], Bool[np.ndarray, " P"]]:
    """Return the Gaussian of each point, and whether the point is scored; positions are in scene units.

    `nearest` uses the nearest Gaussian that is opaque enough. The search tree breaks ties between equidistant
    Gaussians deterministically, for the same input and any number of threads. `frozen` uses the Gaussian with
    the point's index, so the fit must not have moved, split or dropped any. As in OpenGaussian's
    `scripts/eval_scannet.py`, points whose Gaussian is transparent are then not scored.

    Raises:
        MisalignedArtifactError: no Gaussian is opaque enough, or under `frozen`, the numbers of Gaussians and
            points differ.
    """
    opacities = gaussians.opacities
    if mode == "frozen":
        if len(opacities) != len(points):
            raise MisalignedArtifactError(
                "the Gaussians do not correspond to the ground-truth points",
                expected=f"{len(points)} Gaussians, one per point",
                found=len(opacities),
                fix="fit with frozen points, or use mode nearest",
            )
        return np.arange(len(points), dtype=np.int64), opacities >= OPACITY_MIN
    opaque = np.flatnonzero(opacities >= OPACITY_MIN)
    if not opaque.size:
        raise MisalignedArtifactError(
            "no Gaussian is opaque enough to label a point",
            expected=f"an opacity of at least {OPACITY_MIN}",
            found=f"{len(opacities)} Gaussians, all below",
            fix="check gaussians.ply; the fit has probably failed",
        )
    from scipy.spatial import cKDTree  # importing takes 0.2 s and is needed only for points

    tree = cKDTree(gaussians.means[opaque].astype(float))
    _, nearest = tree.query(points.astype(float), workers=threads)
    return opaque[nearest].astype(np.int64), np.ones(len(points), dtype=bool)


def classify(features: Float[np.ndarray, "P D"], texts: Float[np.ndarray, "K D"]) -> Int32[np.ndarray, " P"]:
    """Return labels 1 .. K by the largest cosine with the class texts (unit vectors); the first wins ties.

    Canonical phrases and a class "other" are not used. Departs: OpenGaussian's argmax assigns points without
    a feature (all zero) to its first class, wall; here they get label 0, a miss.
    """
    labels = np.zeros(len(features), dtype=np.int32)
    for start in range(0, len(features), CHUNK_POINTS):
        rows = slice(start, start + CHUNK_POINTS)
        # The norm of a feature does not change which cosine is largest.
        scores = features[rows] @ texts.T
        labels[rows] = np.where(scores.any(axis=1), scores.argmax(axis=1) + 1, 0)
    return labels


def measure_points(
    card: ProtocolCard,
    method: str,
    truth: Int[np.ndarray, " P"],
    prediction: Int[np.ndarray, " P"],
    classes: ClassSet,
    carried: str,
    words: Sequence[str] = (),
) -> Iterator[Measured]:
    """Yield the rows of one scene: IoU and accuracy per class, and the scene's means if the card has them.

    In a class row, `n` is the number of points in the denominator, so that `pooled_points` can pool scenes.
    Classes absent from ground truth and prediction have no row; a scene without ground truth has no rows.
    `carried` names the mode that transferred predictions to the points, and `words` other departures.
    """
    counts = point_classes.ClassCounts.of(truth, prediction, len(classes))
    protocol = card.labelled([f"points: {carried}", *words])
    for metric, values, points in (
        ("class_iou", point_classes.class_iou(counts), counts.union),
        ("class_accuracy", point_classes.class_accuracy(counts), counts.truth),
    ):
        for row in np.flatnonzero(points):
            value, n = float(values[row]), int(points[row])
            yield Measured(method, classes.texts[row], "", metric, protocol, value, n)
    if card.averaging == "scenes" and counts.truth.any():
        for metric in filter(point_classes.MEANS.__contains__, card.metrics):
            value = point_classes.MEANS[metric](counts)
            yield Measured(method, "", "", metric, protocol, value, int(counts.truth.sum()))


def pooled_points(card: ProtocolCard, rows: Iterable[Any], classes: ClassSet) -> dict[str, float]:
    """Return the means of a pooled protocol from the class rows (or similar named tuples) of all scenes.

    The counts are exact up to 10**6 points per class and scene, because files keep six decimals.
    """
    hits, truth, union = np.zeros((3, len(classes)), dtype=np.int64)
    row_of_text = {text: row for row, text in enumerate(classes.texts)}
    for row in rows:
        if row.metric == "class_iou":
            union[row_of_text[row.query]] += row.n
            hits[row_of_text[row.query]] += round(row.value * row.n)
        elif row.metric == "class_accuracy":
            truth[row_of_text[row.query]] += row.n
    counts = point_classes.ClassCounts(hits, truth, union - truth + hits)
    means = point_classes.MEANS
    values = {metric: means[metric](counts) for metric in card.metrics if metric in means}
    if "miou_head" in card.metrics:
        for split, members in splits_of(classes).items():
            values[f"miou_{split}"] = point_classes.miou_over_occurring(counts, np.array(members))
    return values


def measure_instances(
    method: str, scans: Mapping[str, instances.InstanceMatches], carried: str
) -> Iterator[Measured]:
    """Yield AP, AP50 and AP25 over all scans, and AP of each split; `n` is the number of scans.

    Include scans without predictions: their instances are misses. Nothing is yielded if no scan has an
    instance.
    """
    precisions = instances.average_precision(list(scans.values()))
    if np.isnan(precisions).all():
        return
    # columns of `precisions` follow `instances.OVERLAPS`
    parts = {"ap": precisions[:, :-1], "ap50": precisions[:, :1], "ap25": precisions[:, -1:]}
    for split, members in splits_of(SCANNET200_INSTANCES).items():
        parts[f"ap_{split}"] = precisions[np.array(members), :-1]
    protocol = INSTANCES.labelled([f"points: {carried}"])
    for metric, part in parts.items():
        yield Measured(method, "", "", metric, protocol, instances.mean_precision(part), len(scans))


def classes_of_points(
    scene: "LanguageScene", gaussian: Int64[np.ndarray, " P"], method: str, texts: Sequence[str]
) -> Int32[np.ndarray, " P"]:
    """Return point labels 1 .. K, the text with the highest cosine; 0 if the point's Gaussian has none.

    The cosine is that of the Gaussian's node (`method` "tree") or decoded latent ("field") at level whole.
    """
    vectors = scene.clip.embed_texts(list(texts))
    if method == "tree":
        of_node = classify(scene.tree.clip.astype(np.float32), vectors)
        node = scene.tree.node_of_gaussian[:, LEVEL.index]
        return np.append(of_node, 0)[node[gaussian]].astype(np.int32)  # node -1 means none
    language, code = scene.field.language, scene.field.code
    latents = language.features[gaussian, LEVEL.index]
    fitted = np.flatnonzero(latents.any(axis=1))
    labels = np.zeros(len(latents), dtype=np.int32)
    if len(fitted):
        labels[fitted] = classify(code.decode_array(latents[fitted].astype(np.float32)), vectors)
    return labels


def node_instances(
    scene: "LanguageScene", gaussian: Int64[np.ndarray, " P"], truth: LabelledPoints, classes: ClassSet
) -> instances.InstanceMatches:
    """Match the nodes at level whole to the ground truth; a node's best cosine gives class and confidence."""
    tree = scene.tree
    nodes = tree.nodes_of(LEVEL)
    cosines = tree.clip[nodes].astype(np.float32) @ scene.clip.embed_texts(list(classes.texts)).T
    node = tree.node_of_gaussian[gaussian, LEVEL.index]
    class_ids = np.array(classes.ids)[cosines.argmax(axis=1)]
    return instance_scan(truth, classes, node[None] == nodes[:, None], class_ids, cosines.max(axis=1))


def instance_scan(
    truth: LabelledPoints,
    classes: ClassSet,
    masks: Bool[np.ndarray, "M P"],
    class_ids: Int[np.ndarray, " M"],
    confidences: Float[np.ndarray, " M"],
) -> instances.InstanceMatches:
    """Match predicted instances, with class ids as in the data set's files, to the labelled instances."""
    values = truth.class_id * instances.CLASS_STRIDE + truth.instance_id
    of_points = np.where(classes.labels(truth.class_id) > 0, values, 0).astype(np.int64)
    return instances.match_instances(of_points, masks, class_ids, confidences, classes.ids)


def class_set(name: str) -> tuple[str, ClassSet]:
    sets = {classes.name: (labelling, classes) for labelling, sets in LABELLINGS.items() for classes in sets}
    return sets[name]


def measure_scene_points(
    scene: "LanguageScene",
    truth: Mapping[str, LabelledPoints],
    scene_from_points: Float[np.ndarray, "4 4"],
    cards: Sequence[ProtocolCard],
    methods: Sequence[str],
    mode: Mode,
    words: Sequence[str] = (),
    threads: int = 1,
) -> Iterator[Measured | instances.InstanceMatches]:
    """Yield the rows of one scene under point protocols, and the instance matches of the tree.

    Labelled points are keyed by labelling, in metres; `scene_from_points` is a similarity transform.
    Protocols whose labelling is absent are skipped. Protocol names contain `words`, besides the mode.
    """
    carried: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # labellings of the same mesh share its vertices
    labels_of: dict[tuple[str, str], np.ndarray] = {}  # several protocols have the same classes
    for card in cards:
        labelling, classes = class_set(card.classes)
        if labelling not in truth:
            continue
        points = truth[labelling]
        if id(points.xyz) not in carried:
            places = points.xyz @ scene_from_points[:3, :3].T + scene_from_points[:3, 3]
            carried[id(points.xyz)] = gaussians_of_points(places, scene.gaussians, mode, threads)
        gaussian, is_scored = carried[id(points.xyz)]
        if card is INSTANCES:
            if "tree" in methods:
                yield node_instances(scene, gaussian, points, classes)
            continue
        labels = np.where(is_scored, classes.labels(points.class_id), 0)
        for method in ("tree", "field"):
            if method in methods:
                key = method, classes.name
                if key not in labels_of:
                    labels_of[key] = classes_of_points(scene, gaussian, method, classes.texts)
                yield from measure_points(card, method, labels, labels_of[key], classes, mode, words)
