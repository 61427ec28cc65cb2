"""The page's server: routes, and the one thread that touches the scene.

`ViewStore` and the known texts of a `LanguageScene` are not made for threads, so everything that reads the
scene runs on one worker; its loops release the interpreter, and the server stays responsive meanwhile. Films
take long and read only arrays, so they have a thread of their own.
"""

import asyncio
import base64
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hilsplat.base.errors import SettingsError
from hilsplat.query.names import StaleNamesError, write_names
from hilsplat.viewer import answers, exports, wire
from hilsplat.viewer.guard import Guard
from hilsplat.viewer.html_page import html_page
from hilsplat.viewer.payload import packed_gaussians, packed_nodes
from hilsplat.viewer.picking import pick
from hilsplat.viewer.server import (
    BYTES,
    TYPES,
    Pages,
    answer_json,
    encoded,
    guarded,
    photograph,
    plain,
    read,
    serve,
    static_files,
    thumbnail,
    view_name,
)
from hilsplat.viewer.shown import ShownScene

Made = TypeVar("Made")


class Viewer:
    """Answers the page's requests about one scene."""

    def __init__(self, shown: ShownScene) -> None:
        self.shown = shown
        self.pages = Pages("index.html", static_files())
        self.worker = ThreadPoolExecutor(1, thread_name_prefix="scene")
        self.films = ThreadPoolExecutor(1, thread_name_prefix="film")

    def app(self, token: str) -> Guard:
        """The application, guarded."""
        routes = [
            *self.pages.routes(),
            Route("/api/scene", self.scene),
            Route("/api/variant/{variant}", self.variant),
            Route("/api/splats", self.splats),
            Route("/api/nodes/{variant}", self.nodes),
            Route("/api/photo/{number:int}", self.photo),
            Route("/api/thumb/{number:int}", self.thumb),
            Route("/api/crop/{variant}/{node:int}", self.crop),
            Route("/api/query", self.query, methods=["POST"]),
            Route("/api/like", self.like, methods=["POST"]),
            Route("/api/field", self.field, methods=["POST"]),
            Route("/api/pick", self.pick, methods=["POST"]),
            Route("/api/frame", self.frame, methods=["POST"]),
            Route("/api/names", self.names, methods=["PUT"]),
            Route("/api/export/ply", self.export_ply, methods=["POST"]),
            Route("/api/export/boxes", self.export_boxes, methods=["POST"]),
            Route("/api/export/masks", self.export_masks, methods=["POST"]),
            Route("/api/export/film", self.export_film, methods=["POST"]),
            Route("/api/export/page", self.export_page, methods=["POST"]),
        ]
        return guarded(routes, token, StaleNamesError)

    async def _do(self, work: Callable[..., Made], *arguments: Any) -> Made:
        """Run on the thread of the scene."""
        return await asyncio.get_running_loop().run_in_executor(self.worker, work, *arguments)

    # -- the scene --------------------------------------------------------------------------------

    async def scene(self, request: Request) -> Response:
        """Views, counts, and the variants that answer by now."""
        return answer_json(await self._do(self.shown.described))

    async def variant(self, request: Request) -> Response:
        """The outline of a variant."""
        return answer_json(await self._do(self.shown.described_variant, request.path_params["variant"]))

    async def splats(self, request: Request) -> Response:
        """The Gaussians, packed."""
        tag = f'"{await self._do(lambda: self.shown.splats_tag)}"'
        if request.headers.get("if-none-match") == tag:
            return Response(status_code=304, headers={"etag": tag})
        data = await self._do(packed_gaussians, self.shown.gaussians)
        return Response(data, headers={"etag": tag, "cache-control": "no-cache"})

    async def nodes(self, request: Request) -> Response:
        """Nodes of the Gaussians, packed."""
        variant = request.path_params["variant"]
        return plain(await self._do(lambda: packed_nodes(self.shown.answering(variant).tree)), BYTES)

    async def photo(self, request: Request) -> Response:
        """An undistorted photograph."""
        return await self._do(photograph, self.shown.scene, request.path_params["number"])

    async def thumb(self, request: Request) -> Response:
        """A small photograph."""
        return await self._do(thumbnail, self.shown.scene, request.path_params["number"])

    async def crop(self, request: Request) -> Response:
        """A node as its best photograph shows it."""

        def draw() -> bytes:
            scene = self.shown.answering(request.path_params["variant"])
            node = _node(scene, request.path_params["node"])
            return encoded(exports.crop(scene, node, self.shown.threads))

        return plain(await self._do(draw), "image/jpeg", cached=True)

    # -- answers ----------------------------------------------------------------------------------

    async def query(self, request: Request) -> Response:
        """A text or a path."""
        asked = await read(request, wire.Query)

        def answer() -> dict[str, Any]:
            view = None if asked.view is None else view_name(self.shown.scene, asked.view)
            scene = self.shown.answering(asked.variant)
            return answers.answer(scene, asked.text, asked.level, asked.answerer, view, asked.threshold)

        return answer_json(await self._do(answer))

    async def like(self, request: Request) -> Response:
        """What looks like a node or a picture."""
        asked = await read(request, wire.Like)

        def answer() -> dict[str, Any]:
            scene = self.shown.answering(asked.variant)
            if asked.node is not None:
                hits = scene.like_node(asked.node, limit=answers.LISTED)
                what = scene.names.of_node.get(asked.node) or f"node {asked.node}"
                return answers.alike(scene, hits, f"like {what}", [asked.node])
            hits = scene.like_picture(_picture(asked.picture), limit=answers.LISTED)
            return answers.alike(scene, hits, "like the picture")

        return answer_json(await self._do(answer))

    async def field(self, request: Request) -> Response:
        """The field's relevancy of every Gaussian, a byte each."""
        asked = await read(request, wire.FieldRelevancy)
        found = await self._do(self.shown.field_relevancy, asked.variant, asked.text, asked.level)
        return plain(found.tobytes(), BYTES)

    async def pick(self, request: Request) -> Response:
        """What a pixel shows."""
        asked = await read(request, wire.Pick)

        def find() -> dict[str, Any]:
            has = asked.variant in self.shown.variants
            nodes = self.shown.answering(asked.variant).tree.node_of_gaussian if has else None
            found = pick(
                self.shown.gaussians, nodes, asked.camera.camera(), asked.x, asked.y, self.shown.threads
            )
            if found is None:
                return {"nodes": [], "alpha": 0}
            return {"nodes": found.nodes, "alpha": found.alpha, "point": found.point}

        return answer_json(await self._do(find))

    async def frame(self, request: Request) -> Response:
        """A picture of the scene."""
        asked = await read(request, wire.Frame)

        def draw() -> bytes:
            from hilsplat.viewer.frames import painted

            paint = self.shown.paint(asked.variant, asked.style)
            pixels = painted(self.shown.gaussians, asked.camera.camera(), paint, self.shown.threads)
            return encoded(pixels, asked.image, asked.quality)

        return plain(await self._do(draw), f"image/{asked.image}")

    async def names(self, request: Request) -> Response:
        """Replace the names of a tree's nodes; `If-Match` is the version that was read."""
        asked = await read(request, wire.Names)
        version = request.headers.get("if-match", "").strip('"')

        def write() -> dict[str, Any]:
            found, scene = self.shown.found(asked.variant), self.shown.answering(asked.variant)
            tree = found.parts.semantic_tree
            names = write_names(found.folder, tree, asked.names, len(scene.tree), version)
            self.shown.renamed(asked.variant, names)
            return {"version": names.version, "names": dict(names.of_node)}

        return answer_json(await self._do(write))

    # -- files to keep ----------------------------------------------------------------------------

    async def export_ply(self, request: Request) -> Response:
        """Gaussians of nodes."""
        asked = await read(request, wire.Selection)

        def make() -> bytes:
            scene = self.shown.answering(asked.variant)
            rows = scene.gaussians_of(_nodes(scene, asked.nodes))
            return exports.selection_ply(self.shown.folder / "gaussians.ply", rows)

        return plain(await self._do(make), BYTES)

    async def export_boxes(self, request: Request) -> Response:
        """Boxes of nodes."""
        asked = await read(request, wire.Selection)

        def make() -> dict[str, Any]:
            scene = self.shown.answering(asked.variant)
            return answers.boxes(scene, _nodes(scene, asked.nodes))

        return answer_json(await self._do(make))

    async def export_masks(self, request: Request) -> Response:
        """Masks of nodes in all views."""
        asked = await read(request, wire.Selection)

        def make() -> bytes:
            scene = self.shown.answering(asked.variant)
            return exports.masks_zip(scene, _nodes(scene, asked.nodes))

        return plain(await self._do(make), "application/zip")

    async def export_film(self, request: Request) -> Response:
        """A fly-around in the colours of the page."""
        asked = await read(request, wire.Film)
        paint = await self._do(self.shown.paint, asked.variant, asked.style)

        def make() -> bytes:
            return exports.film(
                self.shown.gaussians,
                self.shown.scene,
                paint,
                kind=asked.format,
                frames=asked.frames,
                side_px=asked.side_px,
                threads=self.shown.threads,
            )

        data = await asyncio.get_running_loop().run_in_executor(self.films, make)
        return plain(data, "video/mp4" if asked.format == "mp4" else "image/gif")

    async def export_page(self, request: Request) -> Response:
        """The scene as one HTML file, with its answers to some texts."""
        asked = await read(request, wire.Page)
        return plain(await self._do(html_page, self.shown, asked, self.pages.static), TYPES["html"])


def _node(scene: Any, node: int) -> int:
    if node >= len(scene.tree):
        raise SettingsError(f"node {node} does not exist", expected=f"0 to {len(scene.tree) - 1}")
    return node


def _nodes(scene: Any, nodes: list[int]) -> list[int]:
    return [_node(scene, node) for node in nodes]


def _picture(text: str) -> np.ndarray:
    import cv2

    try:
        data = np.frombuffer(base64.b64decode(text, validate=True), np.uint8)
        pixels = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    except ValueError:
        pixels = None
    if pixels is None:
        raise SettingsError("the picture cannot be read", expected="a JPEG or PNG")
    return np.ascontiguousarray(pixels[..., ::-1])


def run_view(
    folder: Path, *, variant: str, port: int, browser: bool, threads: int, told: Callable[[str], None]
) -> None:
    """Serve the page of a scene on this machine until Ctrl-C.

    Args:
        folder: `results/<dataset>/<scene>`, or a copy of it anywhere.
        variant: the one that answers first.
        port: 0: any that is free.
        browser: whether to open the page in a browser.
        threads: number of threads for drawing.
        told: gets the address, once the page can be opened.

    Raises:
        ArtifactError: the scene has no Gaussians yet.
        SettingsError: the port is taken.
    """
    shown = ShownScene(folder, variant, threads)
    viewer = Viewer(shown)
    viewer.worker.submit(shown.warm_up).result()
    about = f"{shown.scene.name}: {len(shown.gaussians)} Gaussians"
    serve(viewer.app, about, port=port, browser=browser, told=told)
