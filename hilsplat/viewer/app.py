"""The page's server: routes, and the one thread that touches the scene.

`ViewStore` and the known texts of a `LanguageScene` are not made for threads, so everything that reads the
scene runs on one worker; its loops release the interpreter, and the server stays responsive meanwhile. Films
take long and read only arrays, so they have a thread of their own.
"""

import asyncio
import base64
import logging
import secrets
import socket
import webbrowser
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hilsplat.base.errors import HilsplatError, SettingsError
from hilsplat.query.names import StaleNamesError, write_names
from hilsplat.viewer import answers, exports, wire
from hilsplat.viewer.guard import Guard
from hilsplat.viewer.html_page import html_page
from hilsplat.viewer.payload import packed_gaussians, packed_nodes
from hilsplat.viewer.picking import pick
from hilsplat.viewer.shown import ShownScene, as_json

TYPES = {"html": "text/html; charset=utf-8", "js": "text/javascript", "css": "text/css"}
Made = TypeVar("Made")
Sent = TypeVar("Sent", bound=wire.Asked)

logger = logging.getLogger(__name__)


def static_files() -> dict[str, bytes]:
    """Files of the page by name: nothing else can be asked for."""
    folder = files("hilsplat.viewer") / "static"
    return {each.name: each.read_bytes() for each in folder.iterdir() if each.name.endswith(tuple(TYPES))}


class Viewer:
    """Answers the page's requests about one scene."""

    def __init__(self, shown: ShownScene) -> None:
        self.shown = shown
        self.static = static_files()
        self.worker = ThreadPoolExecutor(1, thread_name_prefix="scene")
        self.films = ThreadPoolExecutor(1, thread_name_prefix="film")

    def app(self, token: str) -> Guard:
        """The application, guarded."""
        routes = [
            Route("/", self.page),
            Route("/static/{name}", self.static_file),
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
        handlers: dict[Any, Any] = {
            StaleNamesError: _told(412),
            HilsplatError: _told(422),
            ValidationError: _told(400),
        }
        return Guard(Starlette(routes=routes, exception_handlers=handlers), token)

    async def _do(self, work: Callable[..., Made], *arguments: Any) -> Made:
        """Run on the thread of the scene."""
        return await asyncio.get_running_loop().run_in_executor(self.worker, work, *arguments)

    # -- files ------------------------------------------------------------------------------------

    async def page(self, request: Request) -> Response:
        """The page."""
        return _plain(self.static["index.html"], TYPES["html"])

    async def static_file(self, request: Request) -> Response:
        """A script or style of the page, by a fixed list of names."""
        name = request.path_params["name"]
        if name not in self.static:
            return _plain(b"no such file", "text/plain", 404)
        return _plain(self.static[name], TYPES[name.rpartition(".")[2]])

    # -- the scene --------------------------------------------------------------------------------

    async def scene(self, request: Request) -> Response:
        """Views, counts, and the variants that answer by now."""
        return _json(await self._do(self.shown.described))

    async def variant(self, request: Request) -> Response:
        """The outline of a variant."""
        return _json(await self._do(self.shown.described_variant, request.path_params["variant"]))

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
        return _plain(await self._do(lambda: packed_nodes(self.shown.answering(variant).tree)), _BYTES)

    async def photo(self, request: Request) -> Response:
        """An undistorted photograph."""

        def read() -> tuple[bytes, str]:
            path = self.shown.scene.image_path(self.shown.view_name(request.path_params["number"]))
            return path.read_bytes(), path.suffix.lower()

        data, suffix = await self._do(read)
        return _plain(data, "image/png" if suffix == ".png" else "image/jpeg", cached=True)

    async def thumb(self, request: Request) -> Response:
        """A small photograph."""

        def read() -> bytes:
            from hilsplat.base.images import resize_to_fit

            image = self.shown.scene.image(self.shown.view_name(request.path_params["number"]))
            return exports.encoded(resize_to_fit(image, 160))

        return _plain(await self._do(read), "image/jpeg", cached=True)

    async def crop(self, request: Request) -> Response:
        """A node as its best photograph shows it."""

        def draw() -> bytes:
            scene = self.shown.answering(request.path_params["variant"])
            node = _node(scene, request.path_params["node"])
            return exports.encoded(exports.crop(scene, node, self.shown.threads))

        return _plain(await self._do(draw), "image/jpeg", cached=True)

    # -- answers ----------------------------------------------------------------------------------

    async def query(self, request: Request) -> Response:
        """A text or a path."""
        asked = await _read(request, wire.Query)

        def answer() -> dict[str, Any]:
            view = None if asked.view is None else self.shown.view_name(asked.view)
            scene = self.shown.answering(asked.variant)
            return answers.answer(scene, asked.text, asked.level, asked.answerer, view, asked.threshold)

        return _json(await self._do(answer))

    async def like(self, request: Request) -> Response:
        """What looks like a node or a picture."""
        asked = await _read(request, wire.Like)

        def answer() -> dict[str, Any]:
            scene = self.shown.answering(asked.variant)
            if asked.node is not None:
                hits = scene.like_node(asked.node, limit=answers.LISTED)
                what = scene.names.of_node.get(asked.node) or f"node {asked.node}"
                return answers.alike(scene, hits, f"like {what}", [asked.node])
            hits = scene.like_picture(_picture(asked.picture), limit=answers.LISTED)
            return answers.alike(scene, hits, "like the picture")

        return _json(await self._do(answer))

    async def field(self, request: Request) -> Response:
        """The field's relevancy of every Gaussian, a byte each."""
        asked = await _read(request, wire.FieldRelevancy)
        found = await self._do(self.shown.field_relevancy, asked.variant, asked.text, asked.level)
        return _plain(found.tobytes(), _BYTES)

    async def pick(self, request: Request) -> Response:
        """What a pixel shows."""
        asked = await _read(request, wire.Pick)

        def find() -> dict[str, Any]:
            has = asked.variant in self.shown.variants
            nodes = self.shown.answering(asked.variant).tree.node_of_gaussian if has else None
            found = pick(
                self.shown.gaussians, nodes, asked.camera.camera(), asked.x, asked.y, self.shown.threads
            )
            if found is None:
                return {"nodes": [], "alpha": 0}
            return {"nodes": found.nodes, "alpha": found.alpha, "point": found.point}

        return _json(await self._do(find))

    async def frame(self, request: Request) -> Response:
        """A picture of the scene."""
        asked = await _read(request, wire.Frame)

        def draw() -> bytes:
            from hilsplat.viewer.frames import painted

            paint = self.shown.paint(asked.variant, asked.style)
            pixels = painted(self.shown.gaussians, asked.camera.camera(), paint, self.shown.threads)
            return exports.encoded(pixels, asked.image, asked.quality)

        return _plain(await self._do(draw), f"image/{asked.image}")

    async def names(self, request: Request) -> Response:
        """Replace the names of a tree's nodes; `If-Match` is the version that was read."""
        asked = await _read(request, wire.Names)
        version = request.headers.get("if-match", "").strip('"')

        def write() -> dict[str, Any]:
            found, scene = self.shown.found(asked.variant), self.shown.answering(asked.variant)
            tree = found.parts.semantic_tree
            names = write_names(found.folder, tree, asked.names, len(scene.tree), version)
            self.shown.renamed(asked.variant, names)
            return {"version": names.version, "names": dict(names.of_node)}

        return _json(await self._do(write))

    # -- files to keep ----------------------------------------------------------------------------

    async def export_ply(self, request: Request) -> Response:
        """Gaussians of nodes."""
        asked = await _read(request, wire.Selection)

        def make() -> bytes:
            scene = self.shown.answering(asked.variant)
            rows = scene.gaussians_of(_nodes(scene, asked.nodes))
            return exports.selection_ply(self.shown.folder / "gaussians.ply", rows)

        return _plain(await self._do(make), _BYTES)

    async def export_boxes(self, request: Request) -> Response:
        """Boxes of nodes."""
        asked = await _read(request, wire.Selection)

        def make() -> dict[str, Any]:
            scene = self.shown.answering(asked.variant)
            return answers.boxes(scene, _nodes(scene, asked.nodes))

        return _json(await self._do(make))

    async def export_masks(self, request: Request) -> Response:
        """Masks of nodes in all views."""
        asked = await _read(request, wire.Selection)

        def make() -> bytes:
            scene = self.shown.answering(asked.variant)
            return exports.masks_zip(scene, _nodes(scene, asked.nodes))

        return _plain(await self._do(make), "application/zip")

    async def export_film(self, request: Request) -> Response:
        """A fly-around in the colours of the page."""
        asked = await _read(request, wire.Film)
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
        return _plain(data, "video/mp4" if asked.format == "mp4" else "image/gif")

    async def export_page(self, request: Request) -> Response:
        """The scene as one HTML file, with its answers to some texts."""
        asked = await _read(request, wire.Page)
        return _plain(await self._do(html_page, self.shown, asked, self.static), TYPES["html"])


_BYTES = "application/octet-stream"


async def _read(request: Request, kind: type[Sent]) -> Sent:
    return kind.model_validate_json(await request.body())


def _json(value: Any) -> Response:
    return _plain(as_json(value), "application/json")


def _plain(data: bytes, kind: str, status: int = 200, *, cached: bool = False) -> Response:
    lasting = "private, max-age=3600" if cached else "no-store"
    return Response(data, status, headers={"content-type": kind, "cache-control": lasting})


def _told(status: int) -> Callable[[Request, Exception], Awaitable[Response]]:
    """A handler that sends the error to the page, as text."""

    async def tell(request: Request, error: Exception) -> Response:
        if isinstance(error, ValidationError):
            first = error.errors(include_url=False, include_context=False, include_input=False)[0]
            text = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        else:
            text = str(error)
        return _plain(as_json({"error": text}), "application/json", status)

    return tell


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


def listening_at(port: int) -> socket.socket:
    """A socket that listens on this machine alone; 0: at any free port.

    Raises:
        SettingsError: the port is taken.
    """
    # Named as TCP, or asyncio leaves Nagle's algorithm on, and answers wait 40 ms for an acknowledgement.
    made = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        made.bind(("127.0.0.1", port))
    except OSError as error:
        made.close()
        raise SettingsError(
            f"port {port} cannot be used: {error}", fix="choose another, or leave it out"
        ) from error
    made.listen()  # before the address is printed: whoever connects at once waits instead of being refused
    return made


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
    import uvicorn

    shown = ShownScene(folder, variant, threads)
    viewer, token = Viewer(shown), secrets.token_urlsafe(24)
    viewer.worker.submit(shown.warm_up).result()
    listening = listening_at(port)
    address = f"http://127.0.0.1:{listening.getsockname()[1]}/?token={token}"
    config = uvicorn.Config(viewer.app(token), log_level="warning", access_log=False, server_header=False)
    told(f"{shown.scene.name}: {len(shown.gaussians)} Gaussians at {address}\nCtrl-C ends it")
    if browser:
        webbrowser.open(address)
    uvicorn.Server(config).run(sockets=[listening])
