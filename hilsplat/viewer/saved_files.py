"""Files that the page lets people keep.

Films take long and read only arrays, so they have a thread of their own.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hilsplat.base.errors import SettingsError
from hilsplat.query.language_scene import LanguageScene
from hilsplat.viewer import answers, exports, wire
from hilsplat.viewer.html_page import html_page
from hilsplat.viewer.scene_thread import SceneThread
from hilsplat.viewer.server import BYTES, TYPES, answer_json, plain, read
from hilsplat.viewer.shown import ShownScene


class SavedFiles:
    """Makes them on request."""

    def __init__(self, thread: SceneThread, static: dict[str, bytes]) -> None:
        self.thread, self.static = thread, static
        self.films = ThreadPoolExecutor(1, thread_name_prefix="film")

    def routes(self) -> list[Route]:
        """Where they are."""
        return [
            Route("/api/export/ply", self.ply, methods=["POST"]),
            Route("/api/export/boxes", self.boxes, methods=["POST"]),
            Route("/api/export/masks", self.masks, methods=["POST"]),
            Route("/api/export/film", self.film, methods=["POST"]),
            Route("/api/export/page", self.page, methods=["POST"]),
        ]

    async def ply(self, request: Request) -> Response:
        """Gaussians of nodes."""
        asked = await read(request, wire.Selection)

        def make(shown: ShownScene) -> bytes:
            scene = shown.answering(asked.variant)
            rows = scene.gaussians_of(nodes_of(scene, asked.nodes))
            with shown.unchanged():
                return exports.selection_ply(shown.folder / "gaussians.ply", rows)

        return plain(await self.thread.do(request, make), BYTES)

    async def boxes(self, request: Request) -> Response:
        """Boxes of nodes."""
        asked = await read(request, wire.Selection)

        def make(shown: ShownScene) -> dict[str, Any]:
            scene = shown.answering(asked.variant)
            return answers.boxes(scene, nodes_of(scene, asked.nodes))

        return answer_json(await self.thread.do(request, make))

    async def masks(self, request: Request) -> Response:
        """Masks of nodes in all views."""
        asked = await read(request, wire.Selection)

        def make(shown: ShownScene) -> bytes:
            scene = shown.answering(asked.variant)
            return exports.masks_zip(scene, nodes_of(scene, asked.nodes))

        return plain(await self.thread.do(request, make), "application/zip")

    async def film(self, request: Request) -> Response:
        """A fly-around in the colours of the page."""
        asked = await read(request, wire.Film)

        def prepared(shown: ShownScene) -> Callable[[], bytes]:
            return partial(
                exports.film,
                shown.gaussians,
                shown.scene,
                shown.paint(asked.variant, asked.style),
                kind=asked.format,
                frames=asked.frames,
                side_px=asked.side_px,
                threads=shown.threads,
            )

        make = await self.thread.do(request, prepared)
        data = await asyncio.get_running_loop().run_in_executor(self.films, make)
        return plain(data, "video/mp4" if asked.format == "mp4" else "image/gif")

    async def page(self, request: Request) -> Response:
        """The scene as one HTML file, with its answers to some texts."""
        asked = await read(request, wire.Page)

        def make(shown: ShownScene) -> bytes:
            with shown.unchanged():
                return html_page(shown, asked, self.static)

        return plain(await self.thread.do(request, make), TYPES["html"])


def node_of(scene: LanguageScene, node: int) -> int:
    """A node that the page named.

    Raises:
        SettingsError: there is none.
    """
    if node >= len(scene.tree):
        raise SettingsError(f"node {node} does not exist", expected=f"0 to {len(scene.tree) - 1}")
    return node


def nodes_of(scene: LanguageScene, nodes: list[int]) -> list[int]:
    """Nodes that the page named."""
    return [node_of(scene, node) for node in nodes]
