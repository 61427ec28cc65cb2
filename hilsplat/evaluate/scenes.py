"""One table over all scenes of a results folder: views, Gaussians, PSNR, nodes, and IoU if labelled."""

import math
from fnmatch import fnmatchcase
from pathlib import Path

from hilsplat.base.artifacts import INDEX, read_index, read_json
from hilsplat.base.errors import ArtifactError
from hilsplat.base.levels import LEVELS
from hilsplat.base.ownership import require_beginning
from hilsplat.base.tables import markdown_table, write_csv
from hilsplat.evaluate.scores import read_scores

COLUMNS = (
    *("scene", "train_views", "test_views", "gaussians", "psnr_db"),
    *(f"{level.label}_nodes" for level in LEVELS),
    "tree_iou",
)


PROTOCOL = "lerf/tree-nodes"
"""Default protocol of the scores: the tree's answers in views, against regions annotated with a text."""


def run_scenes(results: Path, pattern: str, out: Path | None, protocol: str = PROTOCOL) -> str:
    """Return a Markdown table of the scenes that match a pattern, and write it to `out` as CSV, if given.

    Cells of what a scene's run has not computed, such as scores without labels, are empty.

    Args:
        protocol: beginning of the name of the protocol whose mean IoU of the tree's answers is shown.

    Raises:
        ArtifactError: no scene matches, an artifact is damaged, or `out` is another file.
    """
    folders = sorted(path.parents[1] for path in results.glob(f"*/*/scene/{INDEX}"))
    names = {f"{folder.parent.name}/{folder.name}": folder for folder in folders}
    rows = [
        [name, *_values_of(folder, protocol)]
        for name, folder in names.items()
        if fnmatchcase(name, pattern) or fnmatchcase(folder.name, pattern)
    ]
    if not rows:
        raise ArtifactError(
            f"{results} has no scene with poses that matches {pattern!r}",
            found=", ".join(list(names)[:10]) or "no scenes",
            fix="run the workflow, or specify the results folder",
        )
    if out is not None:
        require_beginning(out, ",".join(COLUMNS))
        write_csv(out, COLUMNS, rows)
    return markdown_table(COLUMNS, rows, 1)


def _values_of(folder: Path, protocol: str) -> list[object]:
    """Return a scene's values, without its name."""
    report, tree = folder / "gaussians/report.json", folder / "default/semantic_tree"
    splits = [view["split"] for view in read_index(folder / "scene")["views"].values()]
    fit = read_json(report) if report.is_file() else {}
    nodes = read_index(tree, "nodes")["nodes"] if (tree / INDEX).is_file() else {}
    psnr, scores = fit.get("psnr_db"), folder / "default/scores.csv"
    values = [splits.count("train"), splits.count("test"), fit.get("gaussians", "")]
    values += ["" if psnr is None else f"{psnr:.2f}", *(nodes.get(level.label, "") for level in LEVELS)]
    table = read_scores([scores] if scores.is_file() else [])
    is_shown = (table["method"] == "tree") & (table["metric"] == "iou")
    iou = table["value"][is_shown & table["protocol"].str.startswith(protocol)].mean()
    return [*values, "" if math.isnan(iou) else f"{iou:.4f}"]
