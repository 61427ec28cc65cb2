"""Files that users can save from the page.

Slow files are created in steps on the scene thread, which handles other requests between steps. Films use
only arrays, so they have their own thread. The response contains lines of JSON, then the file:
`{"made": 3, "of": 120}` after each step, `{"bytes": 12345}` before the file, or `{"error": "..."}`.
"""

from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route

from hilsplat.base.errors import HilsplatError
from hilsplat.query.language_scene import LanguageScene
from hilsplat.splat.gaussians import morton_order
from hilsplat.viewer import exports, payload, wire
from hilsplat.viewer.html_page import html_page
from hilsplat.viewer.viewer_scene import ViewerScene
from hilsplat.web.scene_thread import SceneThread
from hilsplat.web.server import as_json, read


class SavedFiles:
    """Handlers of file requests; `static` contains the page's own files by name."""

    def __init__(self, thread: SceneThread, static: dict[str, bytes]) -> None:
        self.thread, self.static = thread, static
        self.films = ThreadPoolExecutor(1, thread_name_prefix="film")

    def routes(self) -> list[Route]:
        """Return the routes of all files."""
        post = self.thread.post
        return [
            Route("/api/export/ply", post(wire.Selection, _ply), methods=["POST"]),
            Route("/api/export/spz", post(wire.Selection, _spz), methods=["POST"]),
            Route("/api/export/boxes", post(wire.Selection, _boxes), methods=["POST"]),
            Route("/api/export/masks", self._masks, methods=["POST"]),
            Route("/api/export/film", self._film, methods=["POST"]),
            Route("/api/export/page", self._page, methods=["POST"]),
        ]

    async def _masks(self, request: Request) -> Response:
        asked = await read(request, wire.Selection)
        return await self._in_steps(request, lambda shown: exports.masks_zip(*_selected(shown, asked)))

    async def _page(self, request: Request) -> Response:
        asked = await read(request, wire.Page)
        return await self._in_steps(request, lambda shown: html_page(shown, asked, self.static))

    async def _film(self, request: Request) -> Response:
        asked = await read(request, wire.Film)

        def begin(shown: ViewerScene) -> exports.Steps:
            cameras, paint = exports.flight(asked, shown.scene), shown.paint(asked.variant, asked.style)
            return exports.film(shown.gaussians, cameras, paint, kind=asked.format, threads=shown.threads)

        return await self._in_steps(request, begin, self.films)

    async def _in_steps(
        self,
        request: Request,
        begin: Callable[[ViewerScene], exports.Steps],
        worker: ThreadPoolExecutor | None = None,
    ) -> Response:
        """Return the response for a file; `begin` runs on the scene thread, later steps on a worker."""

        def first(shown: ViewerScene) -> tuple[exports.Steps, tuple[int, int]]:
            steps = begin(shown)
            return steps, next(steps)  # raises errors before the response starts

        begun = await self.thread.do(request, first)
        return StreamingResponse(self._stepped(*begun, worker), headers={"cache-control": "no-store"})

    async def _stepped(
        self, steps: exports.Steps, first: tuple[int, int], worker: ThreadPoolExecutor | None
    ) -> AsyncIterator[bytes]:
        found: tuple[int, int] | bytes = first
        while isinstance(found, tuple):
            yield _line(made=found[0], of=found[1])
            try:
                found = await self.thread.run(partial(_step, steps), worker)
            except (HilsplatError, OSError) as error:  # such as a full disk
                yield _line(error=f"the file could not be created: {error}")
                return
        yield _line(bytes=len(found))
        yield found


def _ply(shown: ViewerScene, asked: wire.Selection) -> bytes:
    selected = _selected(shown, asked)
    with shown.unchanged():
        return exports.selection_ply(shown.folder / "gaussians.ply", *selected)


def _spz(shown: ViewerScene, asked: wire.Selection) -> bytes:
    rows, _ = exports.labelled(*_selected(shown, asked))
    return shown.spz(rows[morton_order(shown.gaussians.means[rows])])


def _boxes(shown: ViewerScene, asked: wire.Selection) -> dict[str, Any]:
    return payload.boxes(*_selected(shown, asked))


def _selected(shown: ViewerScene, asked: wire.Selection) -> tuple[LanguageScene, list[wire.Group]]:
    """Return the variant and the groups; raise SettingsError if a node does not exist."""
    scene = shown.answering(asked.variant)
    for group in asked.groups:
        for node in group.nodes:
            scene.existing_node(node)
    return scene, asked.groups


def _step(steps: exports.Steps) -> tuple[int, int] | bytes:
    """Run the next step; return the progress, or the finished file."""
    try:
        return next(steps)
    except StopIteration as made:
        data: bytes = made.value
        return data


def _line(**values: int | str) -> bytes:
    return as_json(values) + b"\n"
