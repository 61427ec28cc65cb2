"""The scenes of a results folder: what each can answer, its size, and the quality of its fit and tree."""

import math
import time
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import INDEX, RECORD, read_index, read_json
from hilsplat.base.errors import ArtifactError, nearest
from hilsplat.base.files import files_below, stats_of
from hilsplat.base.levels import LEVELS
from hilsplat.base.ownership import require_beginning
from hilsplat.base.tables import aligned_table, write_csv
from hilsplat.evaluate.scores import read_scores
from hilsplat.scene.finished import KEY_VIEWS, scenes_in
from hilsplat.segment.origin import masks_label

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
"""Default protocol of the scores: the tree's answers in views, against regions annotated with a text."""


@dataclass(frozen=True)
class SceneState:
    """What a run has computed for a scene.

    Attributes:
        poses: the registration report; empty if there are no poses.
        views: number of views by split.
        fit: the report of the Gaussians; empty if there are none.
        nodes: number of nodes by level; empty if there is no tree.
        state: the artifacts that users can see or query, such as "tree, field".
        models: the models, or other origins, of the masks and their vectors.
        num_bytes: size of the scene's folder.
        date: local time at which its newest artifact was written, or an empty string.
    """

    poses: dict[str, Any]
    views: dict[str, int]
    fit: dict[str, Any]
    nodes: dict[str, int]
    state: str
    models: str
    num_bytes: int
    date: str

    @staticmethod
    def read(folder: Path) -> "SceneState":
        """Read the state of the variant `default`, or of the key views until `default` accepts queries.

        Raises:
            ArtifactError: an artifact is damaged.
        """
        own, early = folder / "default", folder / KEY_VIEWS
        used = own if (own / "clip" / INDEX).is_file() or not (early / "clip" / INDEX).is_file() else early
        has_poses, has_tree, has_clip = (
            (path / INDEX).is_file() for path in (folder / "scene", used / "semantic_tree", used / "clip")
        )
        views, registration = {"train": 0, "test": 0}, folder / "scene/registration.json"
        for view in read_index(folder / "scene")["views"].values() if has_poses else ():
            views[view["split"]] += 1
        report = folder / "gaussians/report.json"
        if has_tree and has_clip:
            field = own / "field.safetensors"
            state = "tree of key views" if used == early else "tree, field" if field.is_file() else "tree"
        else:
            state = "Gaussians" if report.is_file() else "poses" if has_poses else "no poses"
        has_masks = (used / "masks" / INDEX).is_file()
        models = [masks_label(used / "masks")] if has_masks else []
        models += [Path(read_index(used / "clip", "model")["model"]).name] if has_clip else []
        stats = stats_of(files_below(folder))
        times = [stat.st_mtime for path, stat in stats.items() if path.name.endswith(RECORD)]
        return SceneState(
            poses=read_json(registration) if has_poses and registration.is_file() else {},
            views=views,
            fit=read_json(report) if report.is_file() else {},
            nodes=read_index(used / "semantic_tree", "nodes")["nodes"] if has_tree else {},
            state=state,
            models=", ".join(models),
            num_bytes=sum(stat.st_size for stat in stats.values()),
            date=time.strftime("%Y-%m-%d %H:%M", time.localtime(max(times))) if times else "",
        )


def run_scenes(results: Path, pattern: str, out: Path | None, protocol: str = PROTOCOL) -> str:
    """Return a table of the scenes that match a pattern, and write all columns to `out` as CSV, if given.

    Cells of what a scene's run has not computed, such as scores without labels, are empty.

    Args:
        protocol: beginning of the name of the protocol whose mean IoU of the tree's answers is shown.

    Raises:
        ArtifactError: no scene matches, an artifact is damaged, or `out` is another file.
    """
    names = scenes_in(results)
    chosen = [name for name in names if any(fnmatchcase(each, pattern) for each in (name, Path(name).name))]
    if not chosen:
        raise ArtifactError(
            f"{results} has no scene that matches {pattern!r}",
            expected=nearest(pattern, names) if names else None,
            fix="correct the name, or specify the results folder" if names else "run a scene: hilsplat run",
        )
    lines, rows = scene_lines(results, chosen, protocol)
    if out is not None:
        require_beginning(out, ",".join(COLUMNS))
        write_csv(out, COLUMNS, rows)
    return "\n".join(lines)


def scene_lines(
    results: Path, names: list[str], protocol: str = PROTOCOL
) -> tuple[list[str], list[list[object]]]:
    """Return the lines of a table of scenes, and the rows of its CSV."""
    rows: list[list[object]] = []
    shown: list[tuple[object, ...]] = [SHOWN]
    for name in names:
        scene = SceneState.read(results / name)
        train, test = (scene.views[split] or "" for split in ("train", "test"))
        psnr, iou = scene.fit.get("psnr_db"), _tree_iou(results / name / "default/scores.csv", protocol)
        psnr_db, megabytes = "" if psnr is None else f"{psnr:.2f}", round(scene.num_bytes / 1e6)
        nodes = [scene.nodes.get(level.label, "") for level in LEVELS]
        known = [name, scene.state, train, test, scene.fit.get("gaussians", ""), psnr_db, *nodes]
        rows.append([*known, iou, megabytes, scene.date, scene.models])
        views = sum(scene.views.values()) or ""
        shown.append((name, scene.state, views, psnr_db, iou, megabytes, scene.date, scene.models))
    return aligned_table(shown, WORDS), rows


def _tree_iou(scores: Path, protocol: str) -> str:
    table = read_scores([scores] if scores.is_file() else [])
    is_shown = (table["method"] == "tree") & (table["metric"] == "iou")
    iou = table["value"][is_shown & table["protocol"].str.startswith(protocol)].mean()
    return "" if math.isnan(iou) else f"{iou:.4f}"
