"""Scoring of arrays under a protocol, without files and without the pipeline (`hilsplat.score`)."""

import difflib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int64

from hilsplat.base.errors import MisalignedArtifactError, SettingsError
from hilsplat.base.levels import LEVELS, Level, composed, path_of
from hilsplat.datasets.labelled import LabelledRegion
from hilsplat.datasets.points.labelled_points import LabelledPoints
from hilsplat.evaluate.metrics.instances import CLASS_STRIDE
from hilsplat.evaluate.protocols import cards
from hilsplat.evaluate.protocols.flat_views import Answer, answer_rows, argmax_rows, mask_of, rule_of
from hilsplat.evaluate.protocols.points import class_set, instance_scan, measure_instances, measure_points
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from hilsplat.evaluate.protocols.views import consistency_rows
from hilsplat.evaluate.scores import Measured
from hilsplat.evaluate.tables.means import metric_means

METHOD = "files"  # method in the score rows; the variant is the program's name

WORDS = "masks of files"
"""Bracketed suffix of a protocol's name: masks were supplied, so the protocol's map rule was not applied."""

MASK_METRICS = (*cards.MASK, "acc_25", "acc_50")  # metrics of masks; localization needs relevancy maps

OF_EVERY_TEXT = (cards.LERF_LANGSPLAT, cards.LERF_OPENGAUSSIAN)
"""Protocols that score every text of a view, merged over levels."""

OF_THE_PIPELINE = (
    *(cards.TREE_NODES, cards.OVS_NODES, cards.LEVEL_AUTO, cards.PATH, cards.SCENE_WIDE),
    *(cards.ANNOTATIONS, cards.VIEW_CONSISTENCY),
)
"""Protocols that need more than arrays: our tree, a method's choice of levels, or exact geometry."""

SCORED = {card.full_name: card for card in cards.CARDS if card not in OF_THE_PIPELINE}
"""Protocols that score arrays."""

Answers = Mapping[tuple[str, str], Answer]
"""Answers in one view by (level, text); the level is "" for answers without a level."""


@dataclass(frozen=True, eq=False)
class Scores:
    """What `hilsplat.score` measured.

    Attributes:
        protocol: full name, with version and non-default settings.
        means: metric -> mean, averaged as the protocol's card says. IoUs, accuracies and consistencies are
            shares in [0, 1]. Under protocols with levels, `iou/whole` etc. are the means of each level.
        rows: one dict per view, query and metric: view, query, level, metric, value, n (`Measured`).
    """

    protocol: str
    means: dict[str, float]
    rows: tuple[dict[str, Any], ...]

    def __repr__(self) -> str:
        return f"Scores({self.protocol}: {', '.join(f'{name} {v:.4f}' for name, v in self.means.items())})"


def score(predictions: Any, labels: Any, protocol: str = "lerf/langsplat") -> Scores:
    """Score predictions of any program under a protocol, as `hilsplat evaluate-files` does.

    Args:
        predictions: for images, view -> text -> answer. An answer is a mask, (H, W) bool, to which no rule of
            the protocol is applied, or relevancy at the levels whole, part, subpart, (3, H, W) float, from
            which the protocol's rule makes the mask (under `3d-ovs/argmax`: cosines, (L, H, W) float). Under
            `hierarchy/level-given`, keys are "whole/mug", "part/handle" etc. Texts may be missing; views may
            not. For points: class ids, (P,) int, 0 for none; for `scannet200/instances`: masks (M, P) bool,
            class ids (M,) int and confidences (M,) float.
        labels: for images, view -> text -> region, (H, W) bool, of the predictions' size; with levels, texts
            are paths such as "mug > handle". For points: class ids as in the data set's files, (P,) int; for
            instances: class ids (P,) and instance ids (P,) int, 0 for none.
        protocol: name, with or without version, such as "scannet/opengaussian-19@1".

    Raises:
        SettingsError: the protocol is unknown or does not score arrays, or an array has a wrong type.
        MisalignedArtifactError: predictions and labels differ in size, views, texts or number of points.
    """
    names = {name: card for full, card in SCORED.items() for name in (full, card.name)}
    if protocol not in names:
        known = protocol in cards.BY_NAME
        raise SettingsError(
            f"protocol {protocol!r} {'needs more than arrays' if known else 'is unknown'}",
            expected=f"one of {', '.join(SCORED)}",
            fix="score a finished scene: hilsplat evaluate" if known else None,
        )
    card = names[protocol]
    if card.classes:
        rows = [("", row) for row in _rows_of_points(card, predictions, labels)]
    else:
        rows = list(_rows_of_images(card, predictions, labels))
    if not rows:
        raise MisalignedArtifactError(
            f"the labels contain nothing that {card.full_name} scores",
            expected="a non-empty region, or a point of the protocol's classes",
            fix="check the labels' texts, levels and class ids",
        )
    frame = pd.DataFrame([{**vars(row), "scene": "", "view": view} for view, row in rows])
    records = frame[["view", "query", "level", "metric", "value", "n"]].to_dict("records")
    return Scores(rows[0][1].protocol, metric_means(card, frame), tuple(records))


def _rows_of_images(
    card: cards.ProtocolCard, predictions: Any, labels: Any
) -> Iterator[tuple[str, Measured]]:
    for what, given in (("predictions", predictions), ("labels", labels)):
        views = list(given.values()) if isinstance(given, Mapping) else [given]
        if not all(
            isinstance(view, Mapping) and all(isinstance(text, str) for text in view) for view in views
        ):
            problem, expected = f"the {what} are not arrays by view and text", "{view: {text: array}}"
            raise SettingsError(problem, expected=expected, found=type(given).__name__)
    if lacking := sorted(set(labels) ^ set(predictions)):
        has_labels = lacking[0] in labels
        raise MisalignedArtifactError(
            f"view {lacking[0]!r} has no {'predictions' if has_labels else 'labels'}",
            expected="the same views in predictions and labels",
            fix="pass an empty dict if nothing was found" if has_labels else "remove its predictions",
        )
    truths = {view: _truth_of(card, view, regions) for view, regions in labels.items()}
    answers = {
        view: {key_of(name): np.asarray(array) for name, array in of_view.items()}
        for view, of_view in predictions.items()
    }
    are_masks = _are_masks(card, answers)
    check_answers(answers, truths)
    for view, truth in truths.items():
        if _has_levels(card):
            rows = level_rows(answers[view], truth, are_masks)
        else:
            rows = flat_rows(card, answers[view], truth, None, are_masks)
        yield from ((view, row) for row in rows)


def _truth_of(card: cards.ProtocolCard, view: str, regions: Mapping[str, Any]) -> ViewTruth:
    """Return a view's ground truth from regions by text, or by path from the whole down."""
    regions_of_view = []
    for name, region in regions.items():
        mask = np.asarray(region)
        if mask.dtype != bool or mask.ndim != 2 or not mask.size:
            raise SettingsError(
                f"{view}: label {name!r} is not a region",
                expected="(H, W) bool",
                found=f"{mask.shape} {mask.dtype}",
            )
        path = path_of(composed(name)) if _has_levels(card) else (composed(name),)
        if len(path) > len(LEVELS):
            raise SettingsError(f"{view}: label {name!r} has more than {len(LEVELS)} levels")
        level = Level(len(path)) if _has_levels(card) else None
        pixels = partial(np.asarray, mask)
        regions_of_view.append(LabelledRegion(path[-1], mask.shape, pixels, level=level, path=path))
    sizes = sorted({region.size_hw for region in regions_of_view})
    if len(sizes) != 1:
        raise MisalignedArtifactError(
            f"{view}: the labels differ in size" if sizes else f"{view}: there are no labels",
            expected="regions of one size, that of the predictions",
            found=", ".join(map(str, sizes)) or None,
        )
    return ViewTruth.of_regions(regions_of_view, sizes[0])


def _are_masks(card: cards.ProtocolCard, answers: Mapping[str, Mapping[tuple[str, str], np.ndarray]]) -> bool:
    """Return whether answers are masks, not relevancy; all must be of one kind that the protocol scores."""
    kinds, is_argmax = set[str](), card is cards.OVS_ARGMAX
    for view, of_view in answers.items():
        for (level, text), answer in of_view.items():
            kind = answer.dtype.kind
            is_map = kind == "f" and answer.ndim == 3 and answer.size > 0
            is_map = is_map and bool((answer < np.inf).all())  # False for NaN
            is_map = is_map and (
                is_argmax or (len(answer) == len(LEVELS) and bool(np.isfinite(answer).all()))
            )
            if not (is_map or (kind == "b" and answer.ndim == 2)) or bool(level) != _has_levels(card):
                name = "'part/handle'" if _has_levels(card) else "'handle', without a level"
                raise SettingsError(
                    f"{view}: {level}{'/' * bool(level)}{text} cannot be scored under {card.full_name}",
                    expected=f"mask (H, W) bool, or finite relevancy (3, H, W) float, named like {name}",
                    found=f"{answer.shape} {answer.dtype}",
                )
            kinds.add(kind)
    if len(kinds) > 1 or (kinds == {"f"} and not is_argmax and rule_of(card) is None):
        raise SettingsError(
            f"{card.full_name} cannot score these predictions",
            expected="only masks, or only relevancy under a protocol that has a rule for it: "
            + ", ".join(name for name, other in SCORED.items() if rule_of(other)),
        )
    return kinds != {"f"}


def _has_levels(card: cards.ProtocolCard) -> bool:
    return card is cards.LEVEL_GIVEN


def key_of(name: str) -> tuple[str, str]:
    """Split the name of an answer, such as "part/handle", into level ("" for none) and text."""
    first, _, rest = (name := composed(name)).partition("/")
    return (first, rest) if rest and first in [level.label for level in LEVELS] else ("", name)


def check_answers(answers: Mapping[str, Answers], truths: Mapping[str, ViewTruth]) -> None:
    """Check the texts and sizes of all views' answers; messages name the view.

    Raises:
        MisalignedArtifactError: the labels have no such text, or another size.
    """
    texts: dict[str, set[str]] = {}
    for truth in truths.values():
        for level_of_text, text in truth.texts:
            for name in {level_of_text.label if level_of_text else "", ""}:
                texts.setdefault(name, set()).add(text)
    for view, truth in truths.items():
        for (level, text), answer in answers[view].items():
            where = f"{view}: {level}/{text}" if level else f"{view}: {text}"
            of_level = sorted(texts.get(level, ()))
            if text not in of_level:
                near = difflib.get_close_matches(text, of_level, n=1)
                raise MisalignedArtifactError(
                    f"{where}: the labels have no text {text!r}" + (f" at level {level}" if level else ""),
                    expected=f"one of {', '.join(of_level)}",
                    found=text,
                    fix=f"rename it to {near[0]!r}" if near else "remove it, or correct its name",
                )
            size_hw = answer.shape[-2:]
            shape = next((query.truth.shape for query in (*truth.categories, *truth.absent)), size_hw)
            if size_hw != shape:
                raise MisalignedArtifactError(
                    f"{where}: the {'mask' if answer.ndim == 2 else 'map'} and the labels differ in size",
                    expected=f"{shape[0]} x {shape[1]} (height x width)",
                    found=f"{size_hw[0]} x {size_hw[1]}",
                    fix="resize the prediction to the size of the labels by nearest neighbour",
                )


def flat_rows(
    card: cards.ProtocolCard, answers: Answers, truth: ViewTruth, level: Level | None, are_masks: bool = True
) -> Iterator[Measured]:
    """Yield a view's rows under a protocol without levels.

    Args:
        level: level whose texts are queried, on a stand-in with levels; None if the labels have no levels.
        are_masks: whether all views have masks as answers, not relevancy.
    """
    words = truth.departures
    if card in OF_EVERY_TEXT:
        queries = truth.categories
    elif level is None:
        queries = (*truth.categories, *truth.absent)
    else:
        queries = tuple(query for query in truth.queries if query.level is level)
        words = [*(["wholes"] if level is Level.WHOLE else []), *words]
    words += [WORDS] if are_masks else []
    if card is cards.OVS_ARGMAX:
        yield from argmax_rows(METHOD, queries, partial(_cosine, answers), words, level is not None)
        return
    for query in queries:
        other = answers.get(("", dict(card.united).get(query.text, "")))
        flat, answer = replace(query, level=None), answers.get(("", query.text))
        yield from answer_rows(METHOD, card, flat, answer, words, _metrics(card, are_masks), other)


def level_rows(answers: Answers, truth: ViewTruth, are_masks: bool = True) -> Iterator[Measured]:
    """Yield the rows of a view's answers with levels, and their hierarchical consistency."""
    card, words = cards.LEVEL_GIVEN, [*truth.departures, *([WORDS] if are_masks else [])]
    for query in truth.queries:
        assert query.level is not None
        answer = answers.get((query.level.label, query.text))
        yield from answer_rows(METHOD, card, query, answer, words, _metrics(card, are_masks))

    def mask_of_path(path: tuple[str, ...]) -> Bool[np.ndarray, "H W"]:
        answer = answers.get((Level(len(path)).label, path[-1]))
        if answer is None:
            return np.zeros_like(truth.regions[path])
        return truth.own_part(path, mask_of(card, Level(len(path)), answer)[0])

    yield from consistency_rows(METHOD, card.labelled(words), truth, mask_of_path)


def _metrics(card: cards.ProtocolCard, are_masks: bool) -> list[str]:
    measured = MASK_METRICS if are_masks else (*MASK_METRICS, *cards.LOCALIZATION)
    return [metric for metric in card.metrics if metric in measured]


def _cosine(
    answers: Answers, texts: Sequence[str], pixels: Int64[np.ndarray, " P"]
) -> Float[np.ndarray, "K L P"]:
    """Return cosines at pixels: those of a mask are 1 and -inf; those at levels that a text lacks, -inf."""
    of_texts = [answers[key] for text in texts if (key := ("", text)) in answers]
    count = max((answer.shape[0] for answer in of_texts if answer.ndim == 3), default=1)
    cosines = np.full((len(texts), count, len(pixels)), -np.inf)
    for row, text in enumerate(texts):
        if (answer := answers.get(("", text))) is not None:
            values = answer if answer.ndim == 3 else np.where(answer, 1.0, -np.inf)[None]
            cosines[row, : len(values)] = values.reshape(len(values), -1)[:, pixels]
    return cosines


def _rows_of_points(card: cards.ProtocolCard, predictions: Any, labels: Any) -> Iterator[Measured]:
    _, classes = class_set(card.classes)
    is_scan = card is cards.INSTANCES
    parts = [
        list(part) if is_scan and isinstance(part, tuple | list) else [part] for part in (predictions, labels)
    ]
    given = [np.asarray(values) for part in parts for values in part]
    given = [array if array.size else array.astype(np.int64) for array in given]  # NumPy reads [] as floats
    sizes = dict(zip("MP", given[0].shape, strict=False)) if is_scan else {"P": given[1].size}
    axes, ids = (("MP", "M", "M", "P", "P"), (1, 3, 4)) if is_scan else (("P", "P"), (0, 1))
    shapes = [tuple(sizes.get(axis) for axis in names) for names in axes]
    fits = [array.shape for array in given] == shapes and all(given[row].dtype.kind in "iu" for row in ids)
    if is_scan and fits:  # masks of ids, such as -1 for none, would be read as masks of all points
        fits = given[0].dtype == bool or not given[0].size
        fits = fits and given[2].dtype.kind in "fiu" and bool(np.isfinite(given[2]).all())
        fits = fits and not (given[4] < 0).any() and len(np.unique(given[4])) < CLASS_STRIDE
    if not fits:
        scan = (
            "masks (M, P) bool, class ids (M,), finite confidences (M,); class ids (P,), instance ids (P,), "
            f"0 for none, of fewer than {CLASS_STRIDE} instances"
        )
        raise MisalignedArtifactError(
            f"predictions and labels do not match under {card.full_name}",
            expected=scan if is_scan else "integer class ids of the same points, (P,) and (P,)",
            found=", ".join(f"{array.shape} {array.dtype}" for array in given),
        )
    if not is_scan:
        predicted, truth = map(classes.labels, given)
        yield from measure_points(card, METHOD, truth, predicted, classes, METHOD)
        return
    masks, class_ids, confidences, class_id, instance_id = given
    class_id = np.where(classes.labels(class_id) > 0, class_id, 0).astype(np.int32)
    # Renumbered: any integer identifies an instance, but a scan's ids are below CLASS_STRIDE. 0 stays 0.
    number = np.unique(np.append(instance_id.dtype.type(0), instance_id), return_inverse=True)[1][1:]
    points = LabelledPoints(np.zeros((sizes["P"], 3)), class_id, number.astype(np.int32))
    matches = instance_scan(points, classes, masks, class_ids, confidences.astype(np.float64))
    yield from measure_instances(METHOD, {"": matches}, METHOD)
