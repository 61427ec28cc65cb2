"""The scenes of a results folder: what each can answer, its size, and the quality of its fit and tree."""

import logging
from pathlib import Path

from hilsplat.base.errors import ArtifactError, HilsplatError, nearest
from hilsplat.base.levels import LEVELS
from hilsplat.base.ownership import require_beginning
from hilsplat.base.tables import aligned_table, write_csv
from hilsplat.evaluate.protocols.cards import BY_NAME, card_of
from hilsplat.evaluate.scores import read_scores
from hilsplat.evaluate.tables.means import metric_means
from hilsplat.query.scene_state import SceneState
from hilsplat.scene.finished import matching_scenes, scenes_in

logger = logging.getLogger(__name__)

COLUMNS = (
    *("scene", "state", "train_views", "test_views", "gaussians", "psnr_db"),
    *(f"{level.label}_nodes" for level in LEVELS),
    *("tree_iou", "megabytes", "date", "models"),
)
"""Columns of the CSV."""

SHOWN = ("scene", "state", "views", "PSNR", "mIoU", "MB", "date", "models")
"""Columns on a terminal; words begin at the left."""

WORDS = ("scene", "state", "date", "models")

PROTOCOL = "lerf/tree-nodes"
"""Protocol of the scores: the tree's answers in views, against regions annotated with a text."""


def run_scenes(results: Path, pattern: str, out: Path | None) -> str:
    """Return a table of the scenes that match a pattern, and write all columns to `out` as CSV, if given.

    Cells of what a scene's run has not computed, such as scores without labels, are empty, as are those of
    a scene with a damaged artifact, which a warning names.

    Raises:
        ArtifactError: no scene matches, or `out` is another file.
    """
    names = scenes_in(results)
    chosen = matching_scenes(names, pattern)
    if not chosen:
        raise ArtifactError(
            f"{results} has no scene that matches {pattern!r}",
            expected=nearest(pattern, names) if names else None,
            fix="correct the name, or specify the results folder" if names else "run a scene: hilsplat run",
        )
    lines, rows = scene_lines(results, chosen)
    if out is not None:
        require_beginning(out, ",".join(COLUMNS))
        write_csv(out, COLUMNS, rows)
    return "\n".join(lines)


def scene_lines(results: Path, names: list[str]) -> tuple[list[str], list[list[object]]]:
    """Return the lines of a table of scenes, and the rows of its CSV."""
    rows: list[list[object]] = []
    lines: list[tuple[object, ...]] = [SHOWN]
    for name in names:
        try:
            scene = SceneState.read(results / name)
            iou = _tree_iou(results / name / "default/scores.csv")
        except HilsplatError as error:
            logger.warning("%s: %s", name, error)
            rows.append([name, "damaged", *[""] * (len(COLUMNS) - 2)])
            lines.append((name, "damaged", *[""] * (len(SHOWN) - 2)))
            continue
        train, test = (scene.views[split] or "" for split in ("train", "test"))
        psnr = scene.fit.get("psnr_db")
        psnr_db, megabytes = "" if psnr is None else f"{psnr:.2f}", round(scene.num_bytes / 1e6)
        nodes = [scene.nodes.get(level.label, "") for level in LEVELS]
        known = [name, scene.state, train, test, scene.fit.get("gaussians", ""), psnr_db, *nodes]
        rows.append([*known, iou, megabytes, scene.date, scene.models])
        views = sum(scene.views.values()) or ""
        psnr_db += " (training)" if scene.fit.get("split") == "train" else ""  # higher than in held-out views
        lines.append((name, scene.state, views, psnr_db, iou, megabytes, scene.date, scene.models))
    return aligned_table(lines, WORDS), rows


def _tree_iou(scores: Path) -> str:
    """Return the mean IoU of the tree under `PROTOCOL`, for the data set with the most labelled queries.

    It is empty if the scores are of another version of the protocol.
    """
    table = read_scores([scores] if scores.is_file() else [])
    is_shown = (table["method"] == "tree") & (table["metric"] == "iou")
    is_of_protocol = table["protocol"].str.split(" (", regex=False).str[0] == BY_NAME[PROTOCOL].full_name
    groups = table[is_shown & is_of_protocol].groupby(["dataset", "protocol"])
    parts = [(name, part) for (_, name), part in groups]
    name, most = max(parts, key=lambda named: len(named[1]), default=("", table))
    return f"{metric_means(card_of(name), most)['iou']:.4f}" if name else ""
