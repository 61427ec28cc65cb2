"""HTTP server of the viewer page, started by `hilsplat view` or embedded in a notebook."""

import base64
import io
import secrets
import threading
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
import uvicorn
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hilsplat.base.errors import ImageError, SettingsError
from hilsplat.base.images import read_image
from hilsplat.query.names import write_names
from hilsplat.query.tree_picture import crop
from hilsplat.viewer import exports, payload, wire
from hilsplat.viewer.frames import faded, painted, pick, within
from hilsplat.viewer.openapi import description
from hilsplat.viewer.saved_files import SavedFiles
from hilsplat.viewer.viewer_scene import ViewerScene
from hilsplat.web import server
from hilsplat.web.guard import Guard
from hilsplat.web.messages import MAX_SIDE_PX
from hilsplat.web.scene_thread import SceneThread


class Viewer:
    """Request handlers of the viewer page.

    Args:
        shown: the scene that the page opens with.
        others: whether the page may open the other scenes of the results folder.
    """

    def __init__(self, shown: ViewerScene, *, others: bool = True) -> None:
        self.thread = SceneThread(shown, shown.beside if others else None)
        self.static, self.files = server.files_of("index.html", "hilsplat.viewer")

    def app(self, token: str, *, embedded: bool = False) -> Guard:
        """Return the guarded application, for a standalone page or a frame in another page."""
        get, post = self.thread.get, self.thread.post
        routes = [
            *self.files,
            *self.thread.routes(),
            get("/api/scenes", ViewerScene.listed),
            get("/api/variant/{variant}", ViewerScene.described_variant),
            Route("/api/splats/{chunk:int}", self._splats),
            get("/api/nodes/{variant}", _nodes),
            get("/api/crop/{variant}/{node:int}", _crop, behind=True),
            post("/api/query", wire.Query, _query),
            post("/api/like", wire.Like, _like),
            post("/api/field", wire.FieldRelevancy, _field),
            post("/api/pick", wire.Pick, _pick),
            post("/api/members", wire.Members, _members),
            post("/api/within", wire.Region, _within),
            post("/api/frame", wire.Frame, _frame),
            post("/api/path", wire.Film, _path),
            Route("/api/names", self._names, methods=["PUT"]),
            *SavedFiles(self.thread, self.static).routes(),
        ]
        routes.append(Route("/openapi.json", lambda request: server.answer(description(routes))))
        return server.guarded(routes, token, wire.MAX_BODY_BYTES, embedded=embedded)

    async def _splats(self, request: Request) -> Response:
        """Send a chunk of the Gaussians as SPZ."""
        tag = f'"{await self.thread.do(request, lambda shown: shown.splats_tag)}"'
        if request.headers.get("if-none-match") == tag:
            return Response(status_code=304, headers={"etag": tag})
        chunk = await self.thread.do(request, lambda shown: shown.chunk(request.path_params["chunk"]))
        return Response(chunk, headers={"etag": tag, "cache-control": "no-cache"})

    async def _names(self, request: Request) -> Response:
        """Replace the names of a tree's nodes; the `If-Match` header is the version that the page read."""
        asked = await server.read(request, wire.Names)

        def write(shown: ViewerScene) -> dict[str, Any]:
            scene = shown.answering(asked.variant)
            tree, version = shown.parts(asked.variant).semantic_tree, server.version_sent(request)
            with shown.unchanged():  # otherwise nodes of a rebuilt tree could get the names
                names = write_names(shown.folder, tree, asked.names, len(scene.tree), version)
            return {"version": names.version, "names": dict(names.of_node)}

        return server.answer(await self.thread.do(request, write))


def _nodes(shown: ViewerScene, variant: str) -> bytes:
    return payload.packed_nodes(shown.answering(variant).tree, shown.order)


def _crop(shown: ViewerScene, variant: str, node: int) -> Response:
    """Return a node in the photograph in which it is largest."""
    scene = shown.answering(variant)
    with shown.unchanged():
        picture = crop(scene, scene.existing_node(node))
        return server.plain(server.encoded(picture), "image/jpeg", cached=True)


def _query(shown: ViewerScene, asked: wire.Query) -> payload.Answer:
    """Return the answers to a text or a path."""
    return payload.answer(shown.answering(asked.variant), asked, asked.answerer)


def _like(shown: ViewerScene, asked: wire.Like) -> payload.Answer:
    """Return nodes similar to a node or a picture."""
    scene = shown.answering(asked.variant)
    if asked.node is not None:
        hits = scene.like_node(asked.node, limit=payload.ALIKE)
        what = scene.name_of(asked.node) or f"node {asked.node}"
        return payload.alike(scene, hits, f"like {what}", [asked.node])
    hits = scene.like_picture(_picture(asked.picture), limit=payload.ALIKE)
    return payload.alike(scene, hits, "like the picture")


def _field(shown: ViewerScene, asked: wire.FieldRelevancy) -> bytes:
    """Return each Gaussian's field relevancy, in 1/255."""
    relevancy = shown.field_relevancy(asked.variant, asked.text, asked.level)
    return (relevancy[shown.order] if asked.order == "page" else relevancy).tobytes()


def _pick(shown: ViewerScene, asked: wire.Pick) -> dict[str, Any]:
    """Return the nodes at a pixel of a camera, with their shares."""
    has_tree = asked.variant in shown.variants
    of_gaussian = shown.answering(asked.variant).tree.node_of_gaussian if has_tree else None
    gaussians, paint = shown.remaining(asked.removed), shown.paint(asked.variant, asked.style)
    if paint is not None:
        gaussians = faded(gaussians, ~paint.hidden)
    picked = pick(gaussians, of_gaussian, asked.camera.camera(), asked.x, asked.y, shown.threads)
    return picked or {"nodes": [], "alpha": 0}


def _members(shown: ViewerScene, asked: wire.Members) -> bytes:
    """Return one bit for each Gaussian: whether it belongs to one of the nodes, or to none."""
    scene = shown.answering(asked.variant)
    members = scene.views.loose if asked.loose else np.zeros(len(shown.gaussians), np.bool_)
    members[scene.views.gaussians_of(asked.nodes)] = True
    return shown.bits_of(members)


def _within(shown: ViewerScene, asked: wire.Region) -> bytes:
    """Return one bit for each Gaussian: whether its centre is in a region of a picture."""
    inside = within(shown.gaussians.means, asked.camera.camera(), asked.points, asked.radius)
    paint = shown.paint(asked.variant, asked.style)
    if paint is not None:
        inside &= ~paint.hidden
    return shown.bits_of(inside)


def _frame(shown: ViewerScene, asked: wire.Frame) -> Response:
    """Return a picture of the scene."""
    paint = shown.paint(asked.variant, asked.style)
    pixels = painted(shown.remaining(asked.removed), asked.camera.camera(), paint, shown.threads)
    return server.plain(server.encoded(pixels, asked.image, asked.quality), f"image/{asked.image}")


def _path(shown: ViewerScene, asked: wire.Film) -> list[dict[str, Any]]:
    """Return the cameras of a film's frames."""
    return [payload.described_camera(camera) for camera in exports.flight(asked, shown.scene)]


def _picture(text: str) -> np.ndarray:
    try:
        return read_image(io.BytesIO(base64.b64decode(text, validate=True)), MAX_SIDE_PX)
    except (ValueError, ImageError) as error:
        expected = f"a JPEG, PNG or WebP with sides of at most {MAX_SIDE_PX} px"
        raise SettingsError("the picture cannot be read", expected=expected) from error


def run_view(
    folder: Path, *, variant: str, port: int, browser: bool, threads: int, on_ready: server.Ready
) -> None:
    """Serve the page of a scene until Ctrl-C; for arguments and errors, see `ViewerScene` and `serve`."""
    shown = ViewerScene(folder, variant, threads)
    viewer = Viewer(shown)
    viewer.thread.worker.submit(shown.warm_up).result()
    about = f"{shown.scene.name}: {len(shown.gaussians)} Gaussians"
    page = f"view {shown.results.resolve()}"  # which also opens the other scenes of the folder
    server.serve(viewer.app, about, page=page, port=port, browser=browser, on_ready=on_ready)


class EmbeddedViewer:
    """A notebook frame with the page of a scene."""

    def __init__(self, viewer: Viewer, text: str, height: int, proxy: str) -> None:
        self.token, self.text, self.height, self.proxy = secrets.token_urlsafe(24), text, height, proxy
        listening = server.listening_at(0)
        self.port: int = listening.getsockname()[1]
        self.server = uvicorn.Server(server.configured(viewer.app(self.token, embedded=True)))
        self.thread = threading.Thread(
            target=self.server.run, kwargs={"sockets": [listening]}, daemon=True, name="hilsplat viewer"
        )
        self.thread.start()

    @property
    def address(self) -> str:
        """Address of the page; anyone who has the address can see the scene until the server stops."""
        base = self.proxy.replace("{port}", str(self.port)) or f"http://127.0.0.1:{self.port}/"
        query = f"#{urlencode({'q': self.text})}" if self.text else ""
        return f"{base}?{urlencode({'token': self.token, 'embedded': 1})}{query}"

    def _repr_html_(self) -> str:
        return (
            f'<iframe src="{escape(self.address)}" title="hilsplat" width="100%" height="{self.height}" '
            'allow="clipboard-write; fullscreen" style="border: 0"></iframe>'
        )

    def close(self) -> None:
        """Stop the server."""
        self.server.should_exit = True
        self.thread.join(timeout=10)


def show(
    folder: Path | str,
    text: str = "",
    *,
    variant: str = "default",
    height: int = 640,
    proxy: str = "",
    threads: int = 1,
) -> EmbeddedViewer:
    """Show a scene in a notebook: the page of `hilsplat view` in a frame, served by this process.

    For the scene's folder and errors, see `ViewerScene`.

    Args:
        text: query to run when the page opens.
        height: height of the frame, px.
        proxy: address containing `{port}` through which browsers on other machines reach a port of this
            machine, such as "/user/me/proxy/{port}/" on a JupyterHub.
    """
    return EmbeddedViewer(
        Viewer(ViewerScene(Path(folder), variant, threads), others=False), text, height, proxy
    )
