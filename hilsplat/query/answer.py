"""Query a finished scene: report the ranked answers as text, and draw a picture."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from hilsplat.base.levels import LEVELS, PATH_SEPARATOR, path_of
from hilsplat.base.lineage import sha256_of_bytes
from hilsplat.base.ownership import require_own_picture
from hilsplat.query.hits import Hit, counted, doubts_of
from hilsplat.query.language_scene import LanguageScene
from hilsplat.query.node_search import NodeHits
from hilsplat.scene.finished import FinishedScene
from hilsplat.segment.origin import made_from_truth, masks_label
from hilsplat.semantic_tree.export import write_selection_ply

LISTED = 10
"""Maximum number of answers in a report."""

LONGEST_NAME = 80
"""Maximum length of the query's own text in a folder name, bytes."""


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
    threads: int = 1,
) -> Iterator[str]:
    """Query a scene: yield the report, then write `panel.png` and `selection.ply` and yield their names.

    The query takes milliseconds; the picture takes one to two seconds, including imports and rendering.
    For other arguments and for errors, see `LanguageScene.open` and `LanguageScene.query`.

    Args:
        views: number of views in the panel; `view`, if given, is the first.
        out: output folder for both files; by default `queries/<text>` in the scene's folder.
    """
    found = FinishedScene.locate(Path(folder), variant)
    scene = LanguageScene.of(found, threads=threads)
    nodes = scene.select(text, level=level, answerer=answerer, view=view, threshold=threshold)
    hits = scene.hits_of(nodes, LISTED)
    label = masks_label(found.parts.masks)
    note = f"; diagnostic only, with masks made from true labels: {label}" if made_from_truth(label) else ""
    caution = scene.caution_about(text)
    yield "\n".join([report(scene, text, nodes, view) + note, *([caution] if caution else [])])

    from hilsplat.query.query_panel import query_panel

    folder = Path(out) if out is not None else found.folder / "queries" / file_name(text)
    panel, selection = folder / "panel.png", folder / "selection.ply"
    if out is not None:
        require_own_picture(panel, beside=selection)
    shown = list(dict.fromkeys([*([view] if view else []), *views_of(scene, hits, views)]))[:views]
    restriction = "" if view is None else f", in view {view}"
    query_panel(scene, text, nodes, shown, panel, note=restriction + note, answerer=answerer)
    write_selection_ply(found.parts.gaussians, scene.gaussians_of(nodes.ids), selection)
    yield f"wrote {panel} and {selection.name}"


def views_of(scene: LanguageScene, hits: Sequence[Hit], count: int) -> list[str]:
    """Return the views in which the best answers are largest, then views spaced evenly over the scene."""
    best = [view for hit in hits for view in hit.best_views[:1]] + [v for hit in hits for v in hit.best_views]
    every = scene.scene.views()
    spread = [every[number * len(every) // count] for number in range(count)]
    return list(dict.fromkeys([*best, *spread, *every]))[:count]


def report(scene: LanguageScene, text: str, found: NodeHits, view: str | None = None) -> str:
    """Return answers and doubts as text; `view` is the view that the query was restricted to."""
    place = scene.scene.name if view is None else f"view {view} of {scene.scene.name}"
    hits, doubts = scene.hits_of(found, LISTED), doubts_of(found)
    if not hits:
        levels = ", ".join(f"--level {each.label}" for each in LEVELS if each is not found.level)
        other = "" if view is None else ", or omit --view"
        return f"nothing in {place} matches {text!r} at level {found.level.label}; try {levels}{other}"
    lengths = "metres" if scene.scene.unit == "metre" else "scene units"
    width = max(len(hit.name or "?") for hit in hits)
    lines = [
        f"{counted(len(hits), 'answer')} to {text!r} in {place}; lengths in {lengths}",
        f"{'node':>5}  {'level':<8} {'score':>5}  {'position':<24} {'box size':<20} "
        f"{'name':<{width}}  best views",
    ]
    for hit in hits:
        position = ", ".join(f"{value:.2f}" for value in hit.centroid)
        size = " x ".join(f"{side:.2f}" for side in hit.oriented_box.size)
        views = ", ".join(hit.best_views)
        lines.append(
            f"{hit.node:>5}  {hit.level.label:<8} {hit.score:>5.2f}  {position:<24} {size:<20} "
            f"{hit.name or '?':<{width}}  {views}"
        )
    if more := len(found.ids) - len(hits):
        lines.append(f"and {counted(more, 'weaker answer')}, also shown in the pictures")
    lines.append('a score of 0.5 means that the query fits no better than a generic word such as "object"')
    if hits[0].route == "fallback":
        first = path_of(text)[0]
        lines.append(f"no answer is part of a match for {first!r}: the whole scene was searched instead")
    return "\n".join([*lines, *(f"doubtful: {doubt}" for doubt in doubts)])


def file_name(text: str) -> str:
    """Return a folder name for a query, such as `bear--nose`, that is valid on every system.

    If the text is long or contains other characters, part of its digest makes the name unique.
    """
    parts = [part.split() for part in text.split(PATH_SEPARATOR)]
    if all(parts) and all(re.fullmatch(r"[\w.]*\w", word) for part in parts for word in part):
        name = "--".join("-".join(part) for part in parts)
        if len(name.encode()) <= LONGEST_NAME:
            return name
    words = re.sub(r"[^a-zA-Z0-9]+", "-", text)[:LONGEST_NAME].strip("-")
    return f"{words or 'query'}-{sha256_of_bytes(text.encode())[:8]}"
