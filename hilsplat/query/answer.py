"""Query a finished scene: report the ranked answers as text, and draw a picture."""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from hilsplat.base.atomic import atomic_folder, atomic_path, existing_folder
from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import LEVELS, PATH_SEPARATOR, path_of
from hilsplat.base.lineage import sha256_of_bytes
from hilsplat.base.ownership import replaced_files
from hilsplat.base.progress import track
from hilsplat.base.tables import aligned_table, counted
from hilsplat.query.hits import Hit, NodeGroup, doubts_of, label_comments
from hilsplat.query.language_scene import LanguageScene
from hilsplat.query.mask_files import mask_files
from hilsplat.query.node_search import NodeHits
from hilsplat.scene.finished import FinishedScene
from hilsplat.segment.origin import made_from_truth, masks_label
from hilsplat.semantic_tree.export import write_selection_ply
from hilsplat.splat.gaussians import morton_order
from hilsplat.splat.spz import fractional_bits, spz_bytes

LISTED = 10  # maximum number of answers in a report
MAX_NAME_BYTES = 80  # maximum length of the query's own text in a folder name, bytes


def answer(
    folder: Path,
    text: str,
    *,
    level: str = "auto",
    variant: str = "default",
    views: int = 3,
    answerer: str = "tree",
    view: str | None = None,
    threshold: float | None = None,
    out: Path | None = None,
    masks: Path | None = None,
    spz: bool = False,
    threads: int = 1,
) -> Iterator[str]:
    """Query a scene: yield the report, then write `panel.png` and `selection.ply` and yield their names.

    The query takes milliseconds; the picture takes one to two seconds, including imports and rendering.
    For other arguments and errors, see `open_scene` and `LanguageScene.query`.

    Args:
        views: number of views in the panel; `view`, if given, is the first.
        out: output folder for both files; by default `queries/<text>` in the scene's folder.
        masks: new folder for the masks of the answer's nodes in all views (`mask_files`).
        spz: whether to write `selection.spz`, too; if there is one, it is replaced in any case.

    Raises:
        SettingsError: `masks`, which is written last, is or contains another output.
    """
    finished = FinishedScene.locate(Path(folder), variant)
    scene = LanguageScene.of(finished, threads=threads)
    nodes = scene.select(text, level=level, answerer=answerer, view=view, threshold=threshold)
    folder = Path(out) if out is not None else finished.folder / "queries" / file_name(text)
    panel, selection, compressed = (folder / name for name in ("panel.png", "selection.ply", "selection.spz"))
    spz = spz or compressed.is_file()  # that of an earlier answer would remain
    written = (panel, selection, compressed) if spz else (panel, selection)
    if masks is not None and any(path.resolve().is_relative_to(Path(masks).resolve()) for path in written):
        raise SettingsError(f"--masks {masks} would replace {panel}", fix="choose a folder of its own")
    label = masks_label(finished.parts.masks)
    note = f"; diagnostic only, with masks made from true labels: {label}" if made_from_truth(label) else ""
    caution = scene.caution_about(text)
    yield report(scene, text, nodes, view, threshold) + note + (f"\n{caution}" if caution else "")
    if out is None and not os.access(existing_folder(folder), os.W_OK):  # results of another user
        raise SettingsError(f"{folder} cannot be written", fix="choose another folder for the files: --out")

    from hilsplat.query.query_panel import query_panel

    best = views_of(scene, scene.hits_of(nodes, LISTED), views)
    drawn = list(dict.fromkeys([*([view] if view else []), *best]))[:views]
    restriction = "" if view is None else f", in view {view}"
    with nullcontext() if out is None else replaced_files(folder, [path.name for path in written]):
        query_panel(scene, text, nodes, drawn, panel, note=restriction + note, answerer=answerer)
        rows = scene.views.gaussians_of(nodes.ids)
        group = NodeGroup.of(text, scene.hits_of(nodes, len(nodes.ids)))
        comments = label_comments([group], scene.name_of)
        write_selection_ply(finished.parts.gaussians, rows, selection, np.ones(len(rows), np.int32), comments)
        yield f"wrote {panel} and {selection.name}"
        if spz:
            ordered = rows[morton_order(scene.gaussians.means[rows])]
            with atomic_path(compressed) as temporary:
                temporary.write_bytes(spz_bytes(scene.gaussians, ordered, fractional_bits(scene.gaussians)))
            yield f"wrote {compressed}"
    if masks is not None:
        of_views = mask_files(scene, [group])
        with atomic_folder(masks) as temporary:
            for files in track(of_views, "masks of views", len(scene.views.names)):
                for name, data in files.items():
                    path = temporary / name
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_bytes(data)
        yield f"wrote masks of {counted(len(nodes.ids), 'node')} to {masks}/<view>/<node>.png and coco.json"


def views_of(scene: LanguageScene, hits: Sequence[Hit], count: int) -> list[str]:
    """Return the views in which the best answers are largest, then views spaced evenly over the scene."""
    best = [hit.best_views[0] for hit in hits if hit.best_views]
    others = [view for hit in hits for view in hit.best_views]
    every = scene.views.names
    spread = [every[number * len(every) // count] for number in range(count)]
    return list(dict.fromkeys([*best, *others, *spread, *every]))[:count]


def report(
    scene: LanguageScene, text: str, nodes: NodeHits, view: str | None = None, threshold: float | None = None
) -> str:
    """Return answers and doubts as text; `view` and `threshold` are those of the query."""
    searched = scene.scene.name if view is None else f"view {view} of {scene.scene.name}"
    hits = scene.hits_of(nodes, LISTED)
    if not hits:
        levels = ", ".join(f"--level {level.label}" for level in LEVELS if level is not nodes.level)
        given = {"--view": view, "--threshold": threshold}
        other = "".join(f", or omit {name}" for name, value in given.items() if value is not None)
        return f"nothing in {searched} matches {text!r} at level {nodes.level.label}; try {levels}{other}"
    lengths = "metres" if scene.scene.unit == "metre" else "scene units"
    words = "level", "position", "box size", "name", "best views"
    rows = [("node", "level", "score", *words[1:])]
    for hit in hits:
        position = ", ".join(f"{value:.2f}" for value in hit.centroid)
        size = " x ".join(f"{side:.2f}" for side in hit.oriented_box.size)
        cells = str(hit.node), hit.level.label, f"{hit.score:.2f}", position, size, hit.name or "?"
        rows.append((*cells, ", ".join(hit.best_views)))
    lines = [f"{counted(len(hits), 'answer')} to {text!r} in {searched}; lengths in {lengths}"]
    lines += aligned_table(rows, words)
    if more := len(nodes.ids) - len(hits):
        lines.append(f"and {counted(more, 'weaker answer')}, also shown in the pictures")
    lines.append('a score of 0.5 means that the query fits no better than a generic word such as "object"')
    if hits[0].route == "fallback":
        first = path_of(text)[0]
        lines.append(f"no answer is part of a match for {first!r}: the whole scene was searched instead")
    return "\n".join([*lines, *(f"doubtful: {doubt}" for doubt in doubts_of(nodes))])


def file_name(text: str) -> str:
    """Return a folder name for a query, such as `bear--nose`, that is valid on every system.

    If the text is long or contains other characters, part of its digest makes the name unique.
    """
    parts = [part.split() for part in text.split(PATH_SEPARATOR)]
    if all(parts) and all(re.fullmatch(r"[\w.]*\w", word) for part in parts for word in part):
        name = "--".join("-".join(part) for part in parts)
        if len(name.encode()) <= MAX_NAME_BYTES:
            return name
    words = re.sub(r"[^a-zA-Z0-9]+", "-", text)[:MAX_NAME_BYTES].strip("-")
    return f"{words or 'query'}-{sha256_of_bytes(text.encode())[:8]}"
