"""The evaluate stage: scores a finished scene against its annotations and writes `scores.csv`."""

import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from hilsplat.base.progress import stage_log, track
from hilsplat.datasets.labelled import LabelledScene
from hilsplat.datasets.points.labelled_points import PointScene
from hilsplat.datasets.synthetic.world_labels import labelled_points
from hilsplat.evaluate.diagnostics.alignment import scene_from_true
from hilsplat.evaluate.diagnostics.world_answers import measure_world_consistency
from hilsplat.evaluate.extra_protocols import ExtraProtocols
from hilsplat.evaluate.metrics.instances import InstanceMatches
from hilsplat.evaluate.metrics.relevancy_rule import SmoothedRelevancy, relevancy_mask
from hilsplat.evaluate.protocols.answers import PackedMasks, Selections
from hilsplat.evaluate.protocols.flat_views import FlatProtocols
from hilsplat.evaluate.protocols.points import measure_scene_points
from hilsplat.evaluate.protocols.view_truth import truths_of
from hilsplat.evaluate.protocols.views import measure_view, relevancy_departures, rule_of
from hilsplat.evaluate.scores import Measured, Score, write_instances, write_scores
from hilsplat.evaluate.tables.costs import time_queries, write_times
from hilsplat.query.language_scene import LanguageScene
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.finished import SceneParts
from hilsplat.segment.origin import masks_label
from hilsplat.settings import EvaluateSettings

logger = logging.getLogger(__name__)

MAX_CAMERA_ERROR_M = 0.1
"""Median camera error above which point scores are meaningless; a warning is logged."""

TIMED_TEXTS = 3
"""Number of queries timed, all in one view."""


Annotations = LabelledScene | PointScene | Path
"""Labels of a published data set, or the ground-truth folder of a synthetic scene."""


def run_evaluate(
    parts: SceneParts,
    out: Path,
    settings: EvaluateSettings,
    *,
    dataset: str,
    scene: str,
    variant: str = "default",
    truth: Path | None = None,
    kind: str = "",
    labels: Sequence[str] = (),
    data_root: Path = Path(),
    threads: int = 1,
) -> None:
    """Score every annotated query in every annotated test view, and every labelled point (`protocols`).

    With the labels of a published data set, every labelled view is scored, even if it was used for training,
    because most benchmarks train on all views. `times.csv` (seconds per query) and `instances.npz` are
    written beside `scores.csv`, which contains only the header if there are neither truth nor labels.

    Args:
        parts: the finished scene; its test views were held out from all earlier stages.
        dataset: data set in every row, like `scene` and `variant`.
        truth: ground-truth folder of a synthetic scene.
        kind: kind of synthetic scene, which determines its benchmarks (`ExtraProtocols.of_world`).
        labels: labels of published data sets, such as "lerf_ovs/figurines", instead of `truth`.

    Raises:
        MisalignedArtifactError: label images and cameras differ in size.
        SceneError: a data set or a kind is unknown, a labelled view has no pose, or labels differ in shape
            from their view.
    """
    scores: list[Score] = []
    matches: dict[tuple[str, ...], InstanceMatches] = {}
    seconds: dict[str, float] = {}
    label = masks_label(parts.masks)

    def keep(data: str, view: str, measured: Measured) -> None:
        scores.append(Score(data, scene, variant, label, view=view, **vars(measured)))

    with stage_log("evaluate", f"{dataset}/{scene}/{variant}") as counts:
        scored: list[tuple[str, Annotations, ExtraProtocols]] = [
            ExtraProtocols.open(name, data_root) for name in labels
        ]
        if truth is not None:
            scored.append((dataset, truth, ExtraProtocols.of_world(kind)))
        if not scored:
            logger.info("%s/%s has no annotations: nothing to score", dataset, scene)
        else:
            answers = LanguageScene.from_parts(parts, settings, threads=threads)
            posed, selections = answers.scene, Selections(answers)
            for data, known, protocols in scored:
                min_px = settings.min_region_px
                truths = {} if isinstance(known, PointScene) else truths_of(known, posed, min_px)
                if not truths and not isinstance(known, PointScene):
                    logger.warning("no view of %s is annotated: nothing to score", posed.name)
                counts[f"views of {data}"] = len(truths)
                kept: dict[str, PackedMasks] = {}
                for view in track(list(truths), "views scored"):
                    of_view, size_hw = truths[view](), posed.cameras[view].size_hw
                    words = relevancy_departures(settings)
                    also = FlatProtocols(protocols.flat, protocols.level, words) if protocols.flat else None
                    kept[view] = PackedMasks(size_hw)
                    for row in measure_view(
                        answers, selections, of_view, view, size_hw, settings, also, kept[view]
                    ):
                        keep(data, view, row)
                    if not seconds and of_view.categories:
                        texts = [query.text for query in of_view.categories[:TIMED_TEXTS]]
                        seconds = query_seconds(answers, view, texts, settings)
                    answers.forget(view)  # reused memory need not be cleared again
                if isinstance(known, Path) and truths and settings.view_consistency:
                    for view, row in measure_world_consistency(
                        answers, selections, truths, kept, known, settings
                    ):
                        keep(data, view, row)
                for each in point_rows(answers, known, protocols, settings, threads):
                    if isinstance(each, Measured):
                        keep(data, "", each)
                    else:
                        matches[data, scene, variant, label, each[0]] = each[1]
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
) -> Iterator[Measured | tuple[str, InstanceMatches]]:
    """Yield rows of labelled points and matches of instances; nothing if no protocol scores points."""
    if not extra.points or isinstance(known, LabelledScene):
        return
    if isinstance(known, PointScene):
        for sentence in known.warnings:
            logger.warning("%s: %s", known.name, sentence)
        points, transform = known.truth, answers.scene.scene_from_source
    else:
        kind = "street" if any(card.classes.startswith("waymo") for card in extra.points) else "room"
        points = labelled_points(known.parent, kind)
        transform, error = scene_from_true(Cameras.load(known / "cameras.npz"), answers.scene.cameras)
        if error > MAX_CAMERA_ERROR_M:
            logger.warning(
                "%s: cameras are %.2f m from the ground truth (median); point scores are meaningless",
                answers.scene.name,
                error,
            )
    yield from measure_scene_points(
        answers, points, transform, extra.points, settings.methods, settings.points, threads
    )


def query_seconds(
    answers: LanguageScene, view: str, texts: Sequence[str], settings: EvaluateSettings
) -> dict[str, float]:
    """Return the seconds that field and tree take for one query in a view (see `costs.time_queries`)."""
    rule = rule_of(settings)

    def by_field(text: str) -> object:
        relevancy = answers.field_relevancy([text], view, exact=False)[0]
        return relevancy_mask(SmoothedRelevancy.of(relevancy, rule), None, rule)

    def by_tree(text: str) -> object:
        return answers.node_masks(view, answers.select((text,), view=view).ids)

    timed: dict[str, Callable[[str], object]] = {}
    if "field" in settings.methods:
        timed["field"] = by_field
    if "tree" in settings.methods:
        timed["tree"] = by_tree
    return time_queries(answers, timed, view, texts)
