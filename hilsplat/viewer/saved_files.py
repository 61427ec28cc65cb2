"""Files that users can save from the page.

Films take long and read only arrays, so they have their own thread. Other slow files are made in steps on the
scene thread, which runs other requests between the steps. All of these are sent as lines of JSON, then the
file: `{"made": 3, "of": 120}` after each step, `{"bytes": 12345}` before the file, or `{"error": "..."}`.
"""

import asyncio
from collections.abc import AsyncIterator, Callable
from concurrent.futures import CancelledError, ThreadPoolExecutor
from functools import partial
from threading import Event
from typing import Any

from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route

from hilsplat.base.errors import HilsplatError, SettingsError
from hilsplat.query.language_scene import LanguageScene
from hilsplat.splat.gaussians import morton_order
from hilsplat.viewer import exports, payload, wire
from hilsplat.viewer.html_page import html_page
from hilsplat.viewer.viewer_scene import ViewerScene
from hilsplat.web.scene_thread import SceneThread
from hilsplat.web.server import as_json, read

NOT_STORED = {"cache-control": "no-store"}


class SavedFiles:
    """Handlers of requests for files; `static` holds the page's own files by name."""

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

        def prepared(shown: ViewerScene) -> Callable[..., bytes]:
            return partial(
                exports.film,
                shown.gaussians,
                exports.flight(asked, shown.scene),
                shown.paint(asked.variant, asked.style),
                kind=asked.format,
                threads=shown.threads,
            )

        of = -(-asked.frames // exports.STEP[asked.format])
        return StreamingResponse(
            self._filmed(await self.thread.do(request, prepared), of), headers=NOT_STORED
        )

    async def _filmed(self, film: Callable[..., bytes], of: int) -> AsyncIterator[bytes]:
        loop, made, left = asyncio.get_running_loop(), asyncio.Queue[int | None](), Event()

        def on_frame(number: int) -> None:
            if left.is_set():
                raise CancelledError("the page that requested this film is closed")
            loop.call_soon_threadsafe(made.put_nowait, number)

        making = loop.run_in_executor(self.films, partial(film, on_frame=on_frame))
        making.add_done_callback(lambda _: made.put_nowait(None))
        try:
            yield _line(made=0, of=of)
            while (number := await made.get()) is not None:
                yield _line(made=number, of=of)
            try:
                data = await making
            except (HilsplatError, OSError) as error:  # such as a full disk
                yield _line(error=f"the film could not be made: {error}")
                return
            yield _line(bytes=len(data))
            yield data
        finally:  # also if the user closed the page or cancelled the film
            left.set()
            making.cancel()

    async def _in_steps(self, request: Request, begin: Callable[[ViewerScene], exports.Steps]) -> Response:
        def first(shown: ViewerScene) -> tuple[exports.Steps, tuple[int, int]]:
            steps = begin(shown)
            return steps, next(steps)  # raises errors before the response starts

        begun = await self.thread.do(request, first)
        return StreamingResponse(self._stepped(*begun), headers=NOT_STORED)

    async def _stepped(self, steps: exports.Steps, first: tuple[int, int]) -> AsyncIterator[bytes]:
        found: tuple[int, int] | bytes = first
        while isinstance(found, tuple):
            yield _line(made=found[0], of=found[1])
            try:
                found = await self.thread.run(partial(_step, steps))
            except (HilsplatError, OSError) as error:
                yield _line(error=str(error))
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
            node_of(scene, node)
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


def node_of(scene: LanguageScene, node: int) -> int:
    """Return a requested node; raise SettingsError if it does not exist."""
    if node >= len(scene.tree):
        raise SettingsError(f"node {node} does not exist", expected=f"0 to {len(scene.tree) - 1}")
    return node
