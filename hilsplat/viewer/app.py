"""HTTP server of the viewer page."""

import base64
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hilsplat.base.errors import SettingsError
from hilsplat.query.names import StaleNamesError, write_names
from hilsplat.scene.scene import Scene
from hilsplat.viewer import answers, exports, wire
from hilsplat.viewer.file_changes import StaleSceneError
from hilsplat.viewer.guard import Guard
from hilsplat.viewer.openapi import description
from hilsplat.viewer.payload import packed_nodes
from hilsplat.viewer.picking import pick
from hilsplat.viewer.saved_files import SavedFiles, node_of
from hilsplat.viewer.scene_thread import SceneThread
from hilsplat.viewer.server import (
    BYTES,
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
)
from hilsplat.viewer.viewer_scene import ViewerScene


class Viewer:
    """Request handlers of the viewer page for one scene."""

    def __init__(self, shown: ViewerScene) -> None:
        self.thread = SceneThread(shown)
        self.pages = Pages("index.html", static_files())

    def app(self, token: str, *, embedded: bool = False) -> Guard:
        """Return the guarded application, for a page of its own or a frame in another page."""
        routes = [
            *self.pages.routes(),
            Route("/openapi.json", self.described),
            Route("/api/scene", self.scene),
            Route("/api/changes", self.changes),
            Route("/api/variant/{variant}", self.variant),
            Route("/api/splats/{chunk:int}", self.splats),
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
            *SavedFiles(self.thread, self.pages.static).routes(),
        ]
        return guarded(routes, token, {StaleNamesError: 412, StaleSceneError: 409}, embedded=embedded)

    async def described(self, request: Request) -> Response:
        """Send the OpenAPI description."""
        return answer_json(description())

    # -- the scene --------------------------------------------------------------------------------

    async def scene(self, request: Request) -> Response:
        """Send the views, counts, and the variants that can be queried now."""
        return answer_json(await self.thread.opened_anew())

    async def changes(self, request: Request) -> Response:
        """Send which parts of the scene changed on disk since they were opened."""
        return answer_json(await self.thread.changes())

    async def variant(self, request: Request) -> Response:
        """Send the outline of a variant."""
        variant = request.path_params["variant"]
        return answer_json(await self.thread.do(request, lambda shown: shown.described_variant(variant)))

    async def splats(self, request: Request) -> Response:
        """Send a chunk of the Gaussians as SPZ."""
        chunk = request.path_params["chunk"]
        tag = f'"{await self.thread.do(request, lambda shown: shown.splats_tag)}"'
        if request.headers.get("if-none-match") == tag:
            return Response(status_code=304, headers={"etag": tag})
        data = await self.thread.do(request, lambda shown: shown.chunk(chunk))
        return Response(data, headers={"etag": tag, "cache-control": "no-cache"})

    async def nodes(self, request: Request) -> Response:
        """Send the packed nodes of the Gaussians."""
        variant = request.path_params["variant"]
        data = await self.thread.do(
            request, lambda shown: packed_nodes(shown.answering(variant).tree, shown.order)
        )
        return plain(data, BYTES)

    async def photo(self, request: Request) -> Response:
        """Send an undistorted photograph."""
        return await self._photograph(request, photograph)

    async def thumb(self, request: Request) -> Response:
        """Send a thumbnail of a photograph."""
        return await self._photograph(request, thumbnail)

    async def _photograph(self, request: Request, send: Callable[[Scene, int], Response]) -> Response:
        def find(shown: ViewerScene) -> Response:
            with shown.unchanged():
                return send(shown.scene, request.path_params["number"])

        return await self.thread.do_behind(request, find)

    async def crop(self, request: Request) -> Response:
        """Send a crop of a node from the photograph that shows it largest."""

        def draw(shown: ViewerScene) -> bytes:
            scene = shown.answering(request.path_params["variant"])
            node = node_of(scene, request.path_params["node"])
            with shown.unchanged():
                return encoded(exports.crop(scene, node, shown.threads))

        return plain(await self.thread.do_behind(request, draw), "image/jpeg", cached=True)

    # -- answers ----------------------------------------------------------------------------------

    async def query(self, request: Request) -> Response:
        """Send the answers to a text or a path."""
        asked = await read(request, wire.Query)

        def answer(shown: ViewerScene) -> answers.Answer:
            return answers.answer(shown.answering(asked.variant), asked, asked.answerer)

        return answer_json(await self.thread.do(request, answer))

    async def like(self, request: Request) -> Response:
        """Send the nodes that look like a node or a picture."""
        asked = await read(request, wire.Like)

        def answer(shown: ViewerScene) -> answers.Answer:
            scene = shown.answering(asked.variant)
            if asked.node is not None:
                hits = scene.like_node(asked.node, limit=answers.LISTED)
                what = scene.name_of(asked.node) or f"node {asked.node}"
                return answers.alike(scene, hits, f"like {what}", [asked.node])
            hits = scene.like_picture(_picture(asked.picture), limit=answers.LISTED)
            return answers.alike(scene, hits, "like the picture")

        return answer_json(await self.thread.do(request, answer))

    async def field(self, request: Request) -> Response:
        """Send the field's relevancy of each Gaussian, one byte each."""
        asked = await read(request, wire.FieldRelevancy)

        def answer(shown: ViewerScene) -> bytes:
            found = shown.field_relevancy(asked.variant, asked.text, asked.level)
            return (found[shown.order] if asked.order == "page" else found).tobytes()

        return plain(await self.thread.do(request, answer), BYTES)

    async def pick(self, request: Request) -> Response:
        """Send the nodes and the 3D point that a pixel shows."""
        asked = await read(request, wire.Pick)

        def find(shown: ViewerScene) -> dict[str, Any]:
            has = asked.variant in shown.variants
            nodes = shown.answering(asked.variant).tree.node_of_gaussian if has else None
            found = pick(shown.gaussians, nodes, asked.camera.camera(), asked.x, asked.y, shown.threads)
            if found is None:
                return {"nodes": [], "alpha": 0}
            return {"nodes": found.nodes, "alpha": found.alpha, "point": found.point}

        return answer_json(await self.thread.do(request, find))

    async def frame(self, request: Request) -> Response:
        """Send a rendered picture of the scene."""
        asked = await read(request, wire.Frame)

        def draw(shown: ViewerScene) -> bytes:
            from hilsplat.viewer.frames import painted

            paint = shown.paint(asked.variant, asked.style)
            pixels = painted(shown.gaussians, asked.camera.camera(), paint, shown.threads)
            return encoded(pixels, asked.image, asked.quality)

        return plain(await self.thread.do(request, draw), f"image/{asked.image}")

    async def names(self, request: Request) -> Response:
        """Replace the names of a tree's nodes; `If-Match` is the version that was read."""
        asked = await read(request, wire.Names)
        version = request.headers.get("if-match", "").strip('"')

        def write(shown: ViewerScene) -> dict[str, Any]:
            found, scene = shown.found(asked.variant), shown.answering(asked.variant)
            tree = found.parts.semantic_tree
            with shown.unchanged():  # otherwise the names could be assigned to nodes of a rebuilt tree
                names = write_names(found.folder, tree, asked.names, len(scene.tree), version)
            shown.renamed(asked.variant, names)
            return {"version": names.version, "names": dict(names.of_node)}

        return answer_json(await self.thread.do(request, write))


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
    folder: Path, *, variant: str, port: int, browser: bool, threads: int, on_ready: Callable[[str], None]
) -> None:
    """Serve the page of a scene on this machine until Ctrl-C.

    Args:
        folder: `results/<dataset>/<scene>`, or a copy of it anywhere.
        variant: the initially selected variant.
        port: TCP port; 0 for any free port.
        browser: whether to open the page in a browser.
        threads: number of threads for rendering.
        on_ready: called with the address once the page can be opened.

    Raises:
        ArtifactError: the scene has no Gaussians yet.
        SettingsError: the port is taken.
    """
    shown = ViewerScene(folder, variant, threads)
    viewer = Viewer(shown)
    viewer.thread.worker.submit(shown.warm_up).result()
    about = f"{shown.scene.name}: {len(shown.gaussians)} Gaussians"
    serve(viewer.app, about, port=port, browser=browser, on_ready=on_ready)
