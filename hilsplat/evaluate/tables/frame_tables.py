"""Lists of scored frames: Hi-LERF and Hi-3DOVS."""

from hilsplat.evaluate.protocols.cards import LEVEL_GIVEN
from hilsplat.evaluate.tables.measured import kind_and_title
from hilsplat.evaluate.tables.reported import reported_block
from hilsplat.evaluate.tables.rows import Block, Cell, Row, Table
from hilsplat.evaluate.tables.sources import Sources


def hi_lerf_frames(sources: Sources) -> Table:
    """Build the table of published and scored frames of Hi-LERF."""
    return frames_table(sources, "frames-hi-lerf", "Hi-LERF")


def hi_3dovs_frames(sources: Sources) -> Table:
    """Build the table of published and scored frames of Hi-3DOVS."""
    return frames_table(sources, "frames-hi-3dovs", "Hi-3DOVS")


def frames_table(sources: Sources, name: str, data: str) -> Table:
    """Build a table of the paper's frames, and of the views queried at levels with their number of texts."""
    blocks = [reported_block(sources.published, data, f"Reported in the paper: {data}", families=False)]
    for dataset, views in asked_views(sources).items():
        rows = [
            Row(
                {"Frame": str(number + 1)},
                {scene: Cell(listed[number]) for scene, listed in views.items() if number < len(listed)},
                None,
            )
            for number in range(max(map(len, views.values())))
        ]
        blocks.append(Block(*kind_and_title(dataset), tuple(rows), tuple(sorted(views))))
    footnotes = ("Measured rows: views that were scored, with the number of texts asked at levels.",)
    return sources.finished(name, f"{data}: frames", blocks, footnotes)


def asked_views(sources: Sources) -> dict[str, dict[str, list[str]]]:
    """Return the views queried at levels by data set and scene, each with its number of texts."""
    asked: dict[tuple[str, str, str], set] = {}
    for row in sources.scores.itertuples():
        if row.metric == "iou" and row.protocol.startswith(LEVEL_GIVEN.full_name):
            asked.setdefault((row.dataset, row.scene, row.view), set()).add((row.query, row.level))
    found: dict[str, dict[str, list[str]]] = {}
    for (dataset, scene, view), texts in sorted(asked.items()):
        name = view.rpartition(".")[0] or view
        found.setdefault(dataset, {}).setdefault(scene, []).append(f"{name} ({len(texts)} texts)")
    return found
