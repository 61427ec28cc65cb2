"""Files that users can save from the page.

Slow files are created in steps on the scene thread, which handles other requests between steps. Films use
only arrays, so they have their own thread. The response contains lines of JSON, then the file:
`{"made": 3, "of": 120}` after each step, `{"bytes": 12345}` before the file, or `{"error": "..."}`.
"""

from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from pydantic import BaseModel
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route

from hilsplat.base.errors import HilsplatError, SettingsError, system_error
from hilsplat.query.hits import NodeGroup, label_comments
from hilsplat.query.language_scene import LanguageScene
from hilsplat.query.scene_views import ViewStore
from hilsplat.semantic_tree.export import write_selection_ply
from hilsplat.splat.gaussians import morton_order
from hilsplat.viewer import exports, payload, wire
from hilsplat.viewer.html_page import html_page
from hilsplat.viewer.viewer_scene import VIEWS_MIB, ViewerScene
from hilsplat.web.scene_thread import SceneThread, Work
from hilsplat.web.server import as_json, read


class SavedFiles:
    """Handlers of file requests; `static` contains the page's own files by name."""

    def __init__(self, thread: SceneThread[Any], static: dict[str, bytes]) -> None:
        self.thread, self.static = thread, static
        self.films = ThreadPoolExecutor(1, thread_name_prefix="film")

    def routes(self) -> list[Route]:
        post = self.thread.post
        return [
            post("/api/export/ply", wire.Selection, _ply),
            post("/api/export/spz", wire.Selection, _spz),
            post("/api/export/boxes", wire.Selection, _boxes),
            post("/api/export/scene-ply", wire.Edited, _ply),
            post("/api/export/scene-spz", wire.Edited, _spz),
            self._slow("/api/export/masks", wire.Selection, _masks),
            self._slow("/api/export/film", wire.Film, _film, self.films),
            self._slow("/api/export/page", wire.Page, partial(html_page, static=self.static)),
        ]

    def _slow(
        self, path: str, kind: type[BaseModel], begin: Work, worker: ThreadPoolExecutor | None = None
    ) -> Route:
        """Return the route of a file; `begin` runs on the scene thread, later steps on a worker."""

        async def make(request: Request) -> Response:
            asked = await read(request, kind)

            def first(shown: ViewerScene) -> tuple[exports.Steps, tuple[int, int]]:
                steps = begin(shown, asked)
                return steps, next(steps)  # raises errors before the response starts

            begun = await self.thread.do(request, first)
            return StreamingResponse(self._stepped(*begun, worker), headers={"cache-control": "no-store"})

        return Route(path, make, methods=["POST"])

    async def _stepped(
        self, steps: exports.Steps, first: tuple[int, int], worker: ThreadPoolExecutor | None
    ) -> AsyncIterator[bytes]:
        result = first
        while isinstance(result, tuple):
            yield _line(made=result[0], of=result[1])
            try:
                result = await self.thread.run(partial(_step, steps), worker)
            except (HilsplatError, OSError, MemoryError) as error:
                yield _line(error=f"the file could not be created: {system_error(error) or error}")
                return
        yield _line(bytes=len(result))
        yield result


def _ply(shown: ViewerScene, asked: wire.Edited) -> bytes:
    """Return the scene, or nodes with labels, without removed Gaussians as a 3DGS PLY."""
    rows, labels, comments = _rows(shown, asked)
    with shown.unchanged(), TemporaryDirectory() as folder:
        out = Path(folder) / "selection.ply"
        write_selection_ply(shown.ply, rows, out, labels, comments)
        return out.read_bytes()


def _spz(shown: ViewerScene, asked: wire.Edited) -> partial[bytes]:
    """Return the scene, or nodes, without removed Gaussians as SPZ."""
    rows, *_ = _rows(shown, asked)
    return partial(shown.spz, rows[morton_order(shown.gaussians.means[rows])])


def _boxes(shown: ViewerScene, asked: wire.Selection) -> dict[str, Any]:
    """Return the boxes of nodes."""
    return payload.boxes(*_selected(shown, asked))


def _masks(shown: ViewerScene, asked: wire.Selection) -> exports.Steps:
    scene, groups = _selected(shown, asked)
    if asked.removed:
        views = replace(scene.views, gaussians=shown.remaining(asked.removed), cache=ViewStore(VIEWS_MIB))
        scene = replace(scene, views=views)
    return exports.masks_zip(scene, groups)


def _film(shown: ViewerScene, asked: wire.Film) -> exports.Steps:
    cameras, paint = exports.flight(asked, shown.scene), shown.paint(asked.variant, asked.style)
    gaussians = shown.remaining(asked.removed)
    return exports.film(gaussians, cameras, paint, kind=asked.format, threads=shown.threads)


def _rows(shown: ViewerScene, asked: wire.Edited) -> tuple[np.ndarray, np.ndarray | None, list[str]]:
    """Return the remaining rows of the scene or of nodes, and the nodes' labels with comments about them."""
    if not isinstance(asked, wire.Selection):
        return np.sort(shown.kept_rows(asked.removed)), None, []
    scene, groups = _selected(shown, asked)
    rows, labels = exports.labelled(scene, groups)
    remains = ~shown.marked(asked.removed)[rows]
    if not remains.any():
        raise SettingsError("no Gaussian remains to be saved", fix="undo the removal, or select other nodes")
    return rows[remains], labels[remains], label_comments(groups, scene.name_of)


def _selected(shown: ViewerScene, asked: wire.Selection) -> tuple[LanguageScene, list[NodeGroup]]:
    """Return the variant and the groups; raise SettingsError if a node does not exist."""
    scene = shown.answering(asked.variant)
    for group in asked.groups:
        scene.views.existing(group.nodes)
    return scene, [group.group() for group in asked.groups]


def _step(steps: exports.Steps) -> Any:
    """Run the next step; return the progress, or the finished file (`SceneThread.run`)."""
    try:
        return next(steps)
    except StopIteration as finished:
        return finished.value


def _line(**values: int | str) -> bytes:
    return as_json(values) + b"\n"
