"""The evaluate stage: scores a finished scene against its annotations and writes `scores.csv`."""

import logging
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median_high

import numpy as np
from jaxtyping import Float64

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.base.progress import stage_log, track
from hilsplat.datasets.generators import Truth
from hilsplat.datasets.labelled import LabelledScene
from hilsplat.datasets.points.labelled_points import PointScene
from hilsplat.datasets.registry import ANNOTATED
from hilsplat.evaluate.costs import write_times
from hilsplat.evaluate.extra_protocols import ExtraProtocols
from hilsplat.evaluate.metrics.instances import InstanceMatches
from hilsplat.evaluate.metrics.relevancy_rule import SmoothedRelevancy, relevancy_mask
from hilsplat.evaluate.protocols.answers import PackedMasks, Selections
from hilsplat.evaluate.protocols.points import measure_scene_points
from hilsplat.evaluate.protocols.view_truth import truths_of
from hilsplat.evaluate.protocols.views import departures, measure_view, rule_of
from hilsplat.evaluate.scores import Measured, Score, write_instances, write_scores
from hilsplat.query.language_scene import LanguageScene
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.finished import SceneParts
from hilsplat.segment.origin import masks_label
from hilsplat.settings import EvaluateSettings

logger = logging.getLogger(__name__)

MAX_CAMERA_ERROR_M = 0.1
"""Median camera error above which point scores are meaningless and a warning is logged."""

TIMED_TEXTS = 3  # number of timed queries, all in one view

Annotations = LabelledScene | PointScene | Truth
"""Labels of a published data set, or the ground truth of a generated scene."""


def run_evaluate(
    parts: SceneParts,
    out: Path,
    settings: EvaluateSettings,
    *,
    dataset: str,
    scene: str,
    variant: str = "default",
    truth: Path | None = None,
    source: str = "",
    labels: Sequence[str] = (),
    data_root: Path = Path(),
    threads: int = 1,
) -> None:
    """Score every annotated query in every annotated test view, and every labelled point (`protocols`).

    With the labels of a published data set, every labelled view is scored, even if it was used for training,
    because most benchmarks train on all views. `times.csv` (seconds per query) and `instances.npz` are
    written beside `scores.csv`. Without truth and labels, `scores.csv` contains only its header.

    Args:
        dataset: data set recorded in every row, as are `scene` and `variant`. Rows of `labels` record theirs;
            in rows of your own annotations, the scene is `dataset/scene`, as in `run_evaluate_files`.
        truth: ground-truth folder of a generated scene, whose `source` determines its benchmarks.
        labels: labels of published data sets, such as "lerf_ovs/figurines", instead of `truth`.

    Raises:
        MisalignedArtifactError: label images and cameras differ in size.
        SceneError: a data set or source is unknown, a labelled view has no pose, or labels differ from their
            view in aspect ratio.
    """
    scores: list[Score] = []
    matches: dict[tuple[str, ...], InstanceMatches] = {}
    seconds: dict[str, float] = {}
    label = masks_label(parts.masks)

    def keep(data: str, view: str, measured: Measured) -> None:
        name = f"{dataset}/{scene}" if data == ANNOTATED else scene
        scores.append(
            Score(dataset=data, scene=name, variant=variant, masks=label, view=view, **vars(measured))
        )

    with stage_log("evaluate", f"{dataset}/{scene}/{variant}") as counts:
        scored: list[tuple[str, Annotations, ExtraProtocols]] = [
            ExtraProtocols.open(name, data_root) for name in labels
        ]
        if truth is not None:
            scored.append((dataset, *ExtraProtocols.generated(source, truth)))
        if not scored:
            logger.info("%s/%s has no annotations: nothing to score", dataset, scene)
        else:
            answers = LanguageScene.from_parts(parts, settings, threads=threads)
            posed, selections = answers.scene, Selections(answers)
            for data, annotations, protocols in scored:
                truths = {}
                if not isinstance(annotations, PointScene):
                    regions = annotations if isinstance(annotations, LabelledScene) else annotations.folder
                    truths = truths_of(regions, posed, settings.min_region_px)
                    if not truths:
                        logger.warning("no view of %s is annotated: nothing to score", posed.name)
                counts[f"views of {data}"] = len(truths)
                masks: dict[str, PackedMasks] = {}
                for view in track(list(truths), "views scored"):
                    of_view = truths[view]()
                    masks[view] = PackedMasks(posed.cameras[view].size_hw)
                    for row in measure_view(selections, of_view, view, masks[view], settings, protocols):
                        keep(data, view, row)
                    if not seconds and of_view.categories:
                        texts = [query.text for query in of_view.categories[:TIMED_TEXTS]]
                        seconds = time_queries(answers, view, texts, settings)
                    answers.views.cache.forget(view)  # reusing the freed memory avoids clearing new pages
                is_checked = bool(truths) and settings.view_consistency
                if is_checked and not isinstance(annotations, LabelledScene | PointScene):
                    for view, row in annotations.consistency(selections, truths, masks, settings):
                        keep(data, view, row)
                for result in point_rows(answers, annotations, protocols, settings, threads):
                    if isinstance(result, Measured):
                        keep(data, "", result)
                    else:
                        matches[data, scene, variant, label, "tree"] = result
        counts["rows"] = len(scores)
        write_times(out, dataset, scene, variant, seconds)
        write_instances(out, matches)
        write_scores(out, scores)


def point_rows(
    answers: LanguageScene,
    known: Annotations,
    extra: ExtraProtocols,
    settings: EvaluateSettings,
    threads: int,
) -> Iterator[Measured | InstanceMatches]:
    """Yield rows of labelled points and the tree's instance matches; nothing if no protocol scores points."""
    if not extra.points or isinstance(known, LabelledScene):
        return
    if isinstance(known, PointScene):
        for sentence in known.warnings:
            logger.warning("%s: %s", known.name, sentence)
        points, transform = known.truth, answers.scene.scene_from_source
    else:
        points = known.points()
        transform, error = scene_from_true(known.cameras(), answers.scene.cameras)
        if error > MAX_CAMERA_ERROR_M:
            sentence = "%s: the median camera error is %.2f m, so point scores are meaningless"
            logger.warning(sentence, answers.scene.name, error)
    # the prompt template changes every cosine
    how = settings.methods, settings.points, departures(settings, ("template",))
    yield from measure_scene_points(answers, points, transform, extra.points, *how, threads)


def scene_from_true(true: Cameras, found: Cameras) -> tuple[Float64[np.ndarray, "4 4"], float]:
    """Return the similarity that maps ground-truth to scene coordinates, and the median camera error.

    Cameras are matched by name. The rotation is the mean of the rotations between paired orientations
    (orthogonal Procrustes), so that it is determined even for cameras on a straight line; scale and offset
    are least-squares fits to the centres. The error is the distance between estimated and true centres, in
    ground-truth units.

    Raises:
        MisalignedArtifactError: fewer than 3 cameras are shared, or all have the same position.
    """
    shared = [name for name in found.names if name in true.names]
    if len(shared) < 3:
        raise MisalignedArtifactError(
            "the ground-truth cameras and the scene's cameras belong to different images",
            expected="at least 3 shared view names",
            found=len(shared),
            fix="evaluate the scene with its own ground-truth folder",
        )
    turns = sum(found[name].cam_from_world[:3, :3].T @ true[name].cam_from_world[:3, :3] for name in shared)
    left, _, right = np.linalg.svd(turns)
    rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    here = np.stack([true[name].centre for name in shared])
    there = np.stack([found[name].centre for name in shared])
    here_mean, there_mean = here.mean(axis=0), there.mean(axis=0)
    turned = (here - here_mean) @ rotation.T
    # rounding separates equal centres
    at_a_point = any(np.ptp(centres, axis=0).max() <= 1e-9 * abs(centres).max() for centres in (here, there))
    scale = 0.0 if at_a_point else (turned * (there - there_mean)).sum() / np.square(turned).sum()
    if scale <= 0:
        raise MisalignedArtifactError(
            "no similarity transform maps the ground-truth cameras to the scene's cameras",
            expected="camera centres in the same arrangement",
            found="coincident or mirrored centres",
            fix="check registration.png; the poses have probably failed",
        )
    transform = np.eye(4)
    transform[:3, :3] = scale * rotation
    transform[:3, 3] = there_mean - scale * rotation @ here_mean
    apart = np.linalg.norm(here @ transform[:3, :3].T + transform[:3, 3] - there, axis=1)
    return transform, float(np.median(apart) / scale)


def time_queries(
    answers: LanguageScene, view: str, texts: Sequence[str], settings: EvaluateSettings
) -> dict[str, float]:
    """Return the seconds per query by field and by tree: text encoding, view weights, relevancy and mask.

    The view's weights and the text's vector are timed once and added, because later queries reuse them. The
    rest is timed with weights and vectors cached, as the median over the texts.
    """
    rule = rule_of(settings)

    def by_field(text: str) -> object:
        relevancy = answers.field.relevancy([text], view, exact=False)[0]
        return relevancy_mask(SmoothedRelevancy.of(relevancy, rule), None, rule)

    def by_tree(text: str) -> object:
        return answers.views.node_masks(view, answers.select((text,), view=view).ids)

    start = time.perf_counter()
    answers.clip.embed_texts([texts[0]])
    answers.views.pixel_weights(view)
    shared_s = time.perf_counter() - start
    seconds: dict[str, float] = {}
    for method, query in (("field", by_field), ("tree", by_tree)):
        if method not in settings.methods:
            continue
        query(texts[0])  # compiles and fills caches
        taken = []
        for text in texts:
            start = time.perf_counter()
            query(text)
            taken.append(time.perf_counter() - start)
        seconds[method] = shared_s + median_high(taken)
    return seconds
