"""The Gaussians of a scene that remain after answers or nodes are removed."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int64

from hilsplat.base.errors import SettingsError
from hilsplat.base.tables import counted
from hilsplat.query.language_scene import LanguageScene


def remaining_rows(
    scene: LanguageScene, only: Sequence[str], without: Sequence[str], clean: bool
) -> tuple[Int64[np.ndarray, " g"], list[str]]:
    """Return the rows of the Gaussians that remain, in ascending order, and a line of text for each removal.

    Args:
        only: queries, or numbers of nodes, whose Gaussians are kept; empty to keep all.
        without: queries, or numbers of nodes, whose Gaussians are removed.
        clean: whether Gaussians that belong to no node are removed.

    Raises:
        SettingsError: nothing matches a query, a node doesn't exist, or no Gaussian remains.
    """
    is_kept = np.full(len(scene.gaussians), not only)
    lines = []
    for keeps, whats in ((True, only), (False, without)):
        for what in whats:
            rows, line = _matching(scene, what)
            is_kept[rows] = keeps
            lines.append(f"{'only' if keeps else 'without'} {line}")
    if clean:
        loose = scene.views.loose
        is_kept &= ~loose
        lines.append(f"without {counted(int(loose.sum()), 'Gaussian')} of no node")
    if not is_kept.any():
        raise SettingsError("no Gaussian remains", fix="keep more, or remove less")
    return np.flatnonzero(is_kept), lines


def _matching(scene: LanguageScene, what: str) -> tuple[Int64[np.ndarray, " g"], str]:
    """Return the Gaussians of a node, or of all answers to a query, and a description."""
    if what.isdecimal():
        nodes, doubts = [scene.existing_node(int(what))], ""
        named = f"node {what} ({scene.name_of(nodes[0]) or '?'})"
    else:
        selection = scene.select(what)
        nodes, hits = selection.ids.tolist(), scene.hits_of(selection, len(selection.ids))
        if not hits:
            raise SettingsError(
                f"nothing in {scene.scene.name} matches {what!r}",
                fix="use the number of a node, which hilsplat query and hilsplat view show",
            )
        doubts = "".join(f"; doubtful: {doubt}" for doubt in hits[0].doubts)
        named = f"{what!r}: " + ", ".join(
            f"node {hit.node} ({hit.name or '?'}, {hit.score:.2f})" for hit in hits
        )
    rows = scene.views.gaussians_of(nodes)
    return rows, f"{named}, {counted(len(rows), 'Gaussian')}{doubts}"
