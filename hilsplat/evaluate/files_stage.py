"""The evaluate-files stage: scores any program's predictions without the pipeline; writes `scores.csv`."""

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float64, Int64

from hilsplat.base.artifacts import read_npz
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError, SettingsError, foreign
from hilsplat.base.files import list_masks
from hilsplat.base.images import read_mask
from hilsplat.base.progress import stage_log
from hilsplat.base.tables import aligned_table
from hilsplat.datasets.points.labelled_points import LabelledPoints, PointScene
from hilsplat.evaluate.extra_protocols import ExtraProtocols
from hilsplat.evaluate.metrics.instances import InstanceMatches
from hilsplat.evaluate.protocols import cards
from hilsplat.evaluate.protocols.points import class_set, instance_scan, measure_instances, measure_points
from hilsplat.evaluate.protocols.view_truth import ViewTruth, truths_of
from hilsplat.evaluate.score import METHOD, OF_EVERY_TEXT, check_answers, flat_rows, key_of, level_rows
from hilsplat.evaluate.scores import COLUMNS, OF_FILES, Measured, Score, write_instances, write_scores
from hilsplat.evaluate.tables.means import TEXTS, mean_rows
from hilsplat.scene.scene import Scene
from hilsplat.settings import EvaluateSettings

logger = logging.getLogger(__name__)

FOREGROUND = 128  # pixels with a grey value above this are foreground, as in Gaussian Grouping's script


def run_evaluate_files(
    predictions: Path,
    out: Path,
    *,
    method: str,
    labels: str = "",
    data_root: Path = Path(),
    truth: Path | None = None,
    scene: Path | None = None,
    source: str = "",
    dataset: str = "synthetic",
    name: str = "",
    min_region_px: int | None = None,
) -> str:
    """Score masks or point labels written by any program (see `read_view_masks` for the format).

    Masks without a level are scored under the text protocols, masks with levels under
    `hierarchy/level-given`, and point labels under each point protocol that has a file. A text without a mask
    counts as 0, except under the protocol that omits such texts.

    Args:
        method: name of the program, used as the variant in its rows.
        labels: labels of a published data set, such as "lerf_ovs/figurines".
        truth: a generated scene's ground truth, instead of `labels`; needs the posed `scene` (which defines
            the test views), `source` as in `run_evaluate`, and the data set and name for the rows.
        min_region_px: smaller regions of a generated scene are not scored; None for the default setting.

    Returns:
        A table of the means under each protocol, in %.

    Raises:
        ArtifactError: the labels are empty, a view has no predictions, or a file is missing or malformed.
        MisalignedArtifactError: a prediction and its labels differ in size, or no label has its text.
        SettingsError: neither labels nor truth and scene are given, or both are.
    """
    if bool(labels) == (truth is not None) or (truth is None) != (scene is None):
        raise SettingsError(
            "predictions must be scored against exactly one set of labels",
            expected="--labels for a data set, or --truth, --source and --scene for a generated scene",
        )
    with stage_log("evaluate-files", str(predictions)) as counts:
        views: dict[str, Callable[[], ViewTruth]] = {}
        points: Mapping[str, LabelledPoints] = {}
        if truth is not None and scene is not None:
            exact, extra = ExtraProtocols.generated(source, truth)
            if any((predictions / file).is_file() for card in extra.points for file in _files_of(card)):
                points = exact.points()
            else:
                views = truths_of(truth, Scene.load(scene), min_region_px or EvaluateSettings().min_region_px)
        else:
            dataset, labelled, extra = ExtraProtocols.open(labels, data_root)
            for sentence in labelled.warnings:
                logger.warning("%s: %s", labels, sentence)
            name = labels.partition("/")[2]
            if isinstance(labelled, PointScene):
                points = labelled.truth
            else:
                for view, regions in labelled.views.items():
                    if regions:
                        sizes_hw = regions[0].size_hw, labelled.image_hw(view)
                        views[view] = partial(ViewTruth.of_regions, regions, *sizes_hw)
        if not views and not points:
            raise ArtifactError(
                f"{labels or truth} has neither a labelled region nor a labelled point",
                fix="draw or accept regions in the labels",
            )
        rows = list(_mask_rows(predictions, views, extra)) if views else []
        matches: dict[tuple[str, ...], InstanceMatches] = {}
        for result in _point_rows(predictions, points, extra) if points else ():
            if isinstance(result, Measured):
                rows.append(("", result))
            else:
                matches[dataset, name, method, "-", METHOD] = result
        scans = {scene: of_scene for (_, scene, *_), of_scene in matches.items()}
        precisions = measure_instances(METHOD, scans, "files") if scans else ()
        rows += [("", row) for row in precisions if not math.isnan(row.value)]
        score = partial(Score, dataset=dataset, scene=name, variant=method, masks="-")
        scores = [score(view=view, **vars(row)) for view, row in rows]
        counts["views"], counts["rows"] = len(views), len(scores)
        write_instances(out, matches, out.with_suffix(OF_FILES).name)
        write_scores(out, scores)
        frame = pd.DataFrame(map(vars, scores), columns=list(COLUMNS))
        return "\n".join(aligned_table(mean_rows(frame, {}), TEXTS))


def _mask_rows(
    predictions: Path, views: Mapping[str, Callable[[], ViewTruth]], extra: ExtraProtocols
) -> Iterator[tuple[str, Measured]]:
    """Yield the rows of all views; all files are read first, so that a missing file is reported at once."""
    predicted = {view: read_view_masks(predictions, view) for view in views}
    truths = {view: load() for view, load in views.items()}
    levels = {level for masks in predicted.values() for level, _ in masks}
    if not levels:  # every folder is empty: nothing was found in any view
        levels = {query.level.label for truth in truths.values() for query in truth.queries if query.level}
        levels.add("")
    check_answers(predicted, truths)
    for view, truth in truths.items():
        rows: list[Iterator[Measured]] = []
        if "" in levels:
            # masks from files are not nodes of a tree
            flat = (*OF_EVERY_TEXT, *(card for card in extra.flat if card is not cards.OVS_NODES))
            rows += [flat_rows(card, predicted[view], truth, extra.level) for card in flat]
        if levels - {""}:
            rows.append(level_rows(predicted[view], truth))
        yield from ((view, row) for of_card in rows for row in of_card)


def _files_of(card: cards.ProtocolCard) -> list[str]:
    """Return the names of the files that a point protocol reads; the first that exists is read."""
    if card is cards.INSTANCES:
        return ["instances.txt"]
    return [f"{card.classes}.txt", f"{class_set(card.classes)[0]}.txt"]


def _point_rows(
    predictions: Path, truth: Mapping[str, LabelledPoints], extra: ExtraProtocols
) -> Iterator[Measured | InstanceMatches]:
    """Yield the rows of points under each protocol whose file exists, and the instance matches."""
    is_scored = False
    for card in extra.points:
        labelling, classes = class_set(card.classes)
        if labelling not in truth:
            continue
        paths = [path for file in _files_of(card) if (path := predictions / file).is_file()]
        if not paths:
            logger.info("%s is not scored, because there is no %s", card.name, " or ".join(_files_of(card)))
            continue
        is_scored, points = True, truth[labelling]
        if card is cards.INSTANCES:
            yield instance_scan(points, classes, *read_point_instances(paths[0], len(points)))
        else:
            predicted = classes.labels(read_point_classes(paths[0], len(points)))
            labels = classes.labels(points.class_id)
            yield from measure_points(card, METHOD, labels, predicted, classes, "files")
    if not is_scored:
        files = dict.fromkeys(file for card in extra.points for file in _files_of(card))
        raise ArtifactError(
            f"{predictions} has no point labels",
            expected=" or ".join(files),
            fix="write one class id per line, one line per point",
        )


def read_view_masks(folder: Path, view: str) -> dict[tuple[str, str], Bool[np.ndarray, "h w"]]:
    """Return the masks of one view by (level, text); the level is "" for masks without a level.

    Files are `<view>/<text>.png`, `<view>/<level>/<text>.png` (level whole, part or subpart), or `<view>.npz`
    with one array per text, named "<text>" or "<level>/<text>". `<view>` is the view's name without suffix.
    A view without predictions has an empty folder. Masks may have another image format.

    Raises:
        ArtifactError: the view has neither a folder nor a file, or has both, or a file cannot be used.
        ImageError: an image is damaged, or has the colours of several classes.
    """
    stem = Path(view).stem
    images, packed = folder / stem, folder / f"{stem}.npz"
    if packed.is_file() and images.is_dir():
        raise ArtifactError(
            f"view {stem} has two sets of predictions",
            expected=f"{packed.name} or {images.name}/",
            found="both",
            fix="remove one of them",
        )
    if packed.is_file():
        arrays = read_npz(packed, max_gib=2.0)  # 500 masks of 4 megapixels
        return {key_of(name): _as_mask(array, f"{packed}: {name}") for name, array in arrays.items()}
    if not images.is_dir():
        raise ArtifactError(
            f"view {stem} has no predictions",
            expected=f"{images}/<text>.png, or {packed.name}",
            fix="write them, or create an empty folder if nothing was found",
        )
    files = list_masks(images, "**/*")
    names = {path: key_of(path.relative_to(images).with_suffix("").as_posix()) for path in files}
    return {name: _as_mask(read_mask(path), str(path)) for path, name in names.items()}


def read_point_classes(path: Path, num_points: int) -> Int64[np.ndarray, " P"]:
    """Read class ids of points from ScanNet's text format, one integer per line; 0 means no class.

    Raises:
        ArtifactError: the file is missing or malformed.
        MisalignedArtifactError: the number of points differs.
    """
    fix = "write one class id per line, 0 for none"
    with foreign(path, ArtifactError, expected="one integer per line", fix=fix):
        values = np.array(_text(path).split(), dtype=np.int64)
    if len(values) != num_points:
        raise MisalignedArtifactError(
            f"{path} does not match the labelled points",
            expected=f"{num_points} lines, one per point in the order of the labels",
            found=len(values),
            fix="predict a class for each ground-truth point",
        )
    return values


def read_point_instances(
    path: Path, num_points: int
) -> tuple[Bool[np.ndarray, "M P"], Int64[np.ndarray, " M"], Float64[np.ndarray, " M"]]:
    """Read instances in ScanNet's format: one line per instance, with mask file, class id and confidence.

    A mask file, relative to the folder of `path`, has one integer per point, non-zero inside the instance.

    Raises:
        ArtifactError: a file is missing or malformed.
        MisalignedArtifactError: the number of points in a mask differs.
    """
    masks, classes, confidences = [], [], []
    for number, line in enumerate(_text(path).splitlines(), 1):
        if not line.strip():
            continue
        try:
            name, class_id, confidence = line.rsplit(maxsplit=2)
            classes.append(np.int64(int(class_id)))
            confidences.append(float(confidence))
            if not math.isfinite(confidences[-1]):
                raise ValueError(confidence)
        except (ValueError, OverflowError) as error:
            raise ArtifactError(
                f"line {number} of {path} does not describe an instance",
                expected="<mask file> <class id> <finite confidence>",
                found=line,
                fix="write one line per predicted instance, in ScanNet's format",
            ) from error
        masks.append(read_point_classes(path.parent / name, num_points) != 0)
    stacked = np.array(masks, dtype=bool).reshape(len(masks), num_points)
    return stacked, np.array(classes, dtype=np.int64), np.array(confidences, dtype=np.float64)


def _as_mask(array: np.ndarray, where: str) -> Bool[np.ndarray, "h w"]:
    if array.ndim != 2 or array.dtype.kind not in "biuf":
        raise ArtifactError(
            f"mask {where} is not two-dimensional, or not numeric",
            expected="height x width",
            found=f"{' x '.join(map(str, array.shape))} {array.dtype}",
        )
    if array.dtype == bool:
        return array
    mask = array > FOREGROUND
    if not mask.any() and array.any():
        raise ArtifactError(
            f"mask {where} has non-zero values, but none is foreground",
            expected=f"0 and 255: values above {FOREGROUND} are foreground",
            found=f"values up to {array.max()}",
            fix="multiply the mask by 255, or store it as bool in a .npz file",
        )
    return mask


def _text(path: Path) -> str:
    with foreign(path, ArtifactError, fix="write it, as UTF-8 text"):
        return path.read_text(encoding="utf-8-sig")
