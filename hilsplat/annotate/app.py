"""HTTP server of the annotation page: `hilsplat annotate`.

It shares socket, guard and photographs with `hilsplat view`. All geometry is computed here, with the polygon
filling that evaluation uses; the page only displays it.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hilsplat.annotate import wire
from hilsplat.annotate.exporting import Kind, exported
from hilsplat.annotate.importing import imported
from hilsplat.annotate.labels import (
    Label,
    StaleLabelsError,
    cut_to_parents,
    label_path,
    read_labels,
    version_of,
    write_labels,
)
from hilsplat.annotate.merging import merged
from hilsplat.annotate.opened_scene import OpenedScene
from hilsplat.annotate.shapes import shaped
from hilsplat.base.errors import SettingsError
from hilsplat.scene.scene import Scene
from hilsplat.viewer.file_changes import StaleSceneError
from hilsplat.viewer.guard import Guard
from hilsplat.viewer.server import (
    BYTES,
    Pages,
    answer_json,
    guarded,
    photograph,
    plain,
    read,
    serve,
    static_files,
    thumbnail,
    view_name,
)

MAX_BODY_BYTES = 16 << 20
"""Maximum size of a request, enough for a COCO file of a whole scene."""
Made = TypeVar("Made")


class Annotator:
    """Request handlers of the annotation page for one scene.

    Args:
        folder: the scene's folder, such as results/photos/desk.
        labels: folder of its label files; created when the first one is written.
        variant: variant whose masks and tree are proposed.
        threads: number of threads for rendering.

    Raises:
        ArtifactError: the scene has no photographs with poses yet.
    """

    def __init__(self, folder: Path, labels: Path, variant: str, threads: int) -> None:
        self.opened, self.labels = OpenedScene(folder, variant, threads), Path(labels)
        self.open = lambda: OpenedScene(folder, variant, threads)
        shared = {name: data for name, data in static_files().items() if name in SHARED}
        self.pages = Pages("annotate.html", {**shared, **static_files("hilsplat.annotate")})
        self.files = ThreadPoolExecutor(1, thread_name_prefix="files")
        self.drawing = ThreadPoolExecutor(1, thread_name_prefix="drawing")  # so saving does not wait for it

    def app(self, token: str) -> Guard:
        """Return the guarded application."""
        routes = [
            *self.pages.routes(),
            Route("/api/scene", self.described),
            Route("/api/changes", self.changes),
            Route("/api/photo/{number:int}", self.photo),
            Route("/api/thumb/{number:int}", self.thumb),
            Route("/api/labels", self.all_labels),
            Route("/api/labels/{number:int}", self.save, methods=["PUT"]),
            Route("/api/shape", self.shape, methods=["POST"]),
            Route("/api/at", self.at, methods=["POST"]),
            Route("/api/segment", self.segment, methods=["POST"]),
            Route("/api/carry", self.carry, methods=["POST"]),
            Route("/api/import", self.take_in, methods=["POST"]),
            Route("/api/export/{kind}", self.export),
        ]
        return guarded(routes, token, {StaleLabelsError: 412, StaleSceneError: 409}, MAX_BODY_BYTES)

    async def _do(self, work: Callable[..., Made], *arguments: Any) -> Made:
        """Run on the only thread that accesses files."""
        return await asyncio.get_running_loop().run_in_executor(self.files, work, *arguments)

    async def _propose(self, work: Callable[..., Made], *arguments: Any) -> Made:
        """Run on the only thread that renders views."""
        return await asyncio.get_running_loop().run_in_executor(self.drawing, work, *arguments)

    def _of(self, request: Request) -> OpenedScene:
        """Return the scene if the page was loaded with its current state, or sent no state.

        Raises:
            StaleSceneError: the page was loaded with another state.
        """
        if request.query_params.get("of") not in (None, self.opened.state):
            raise StaleSceneError("the scene has changed since this page was loaded", fix="reload it")
        return self.opened

    # -- the scene --------------------------------------------------------------------------------

    async def described(self, request: Request) -> Response:
        """Send the photographs and available proposals to a new page, after reopening a changed scene."""

        def describe() -> dict[str, Any]:
            if self.opened.changed():
                self.opened = self.open()
            scene, proposals, cameras = self.opened.scene, self.opened.proposals, self.opened.scene.cameras
            return {
                "name": scene.name,
                "of": self.opened.state,
                "folder": str(self.labels),
                "proposes": proposals.of,
                "segments": self.opened.clicks.name,
                "carries": proposals.gaussians is not None,
                "views": [
                    {"name": name, "split": scene.split[name], "size_hw": list(cameras[name].size_hw)}
                    for name in cameras.names
                ],
            }

        return answer_json(await self._do(describe))

    async def changes(self, request: Request) -> Response:
        """Send which parts of the scene changed on disk since they were opened."""
        opened = self.opened
        return answer_json({"of": opened.state, "changed": await self._do(opened.changed)})

    async def photo(self, request: Request) -> Response:
        """Send an undistorted photograph."""
        return await self._photograph(request, photograph)

    async def thumb(self, request: Request) -> Response:
        """Send a thumbnail of a photograph."""
        return await self._photograph(request, thumbnail)

    async def _photograph(self, request: Request, send: Callable[[Scene, int], Response]) -> Response:
        opened = self._of(request)

        def find() -> Response:
            with opened.same_photographs():
                return send(opened.scene, request.path_params["number"])

        return await self._do(find)

    # -- annotations ------------------------------------------------------------------------------

    def known(self, scene: Scene) -> dict[str, list[Label]]:
        """Return the annotations of all views that have any."""
        found = {}
        for view in scene.cameras.names:
            labels = read_labels(label_path(self.labels, view), scene.cameras[view].size_hw)
            if labels:
                found[view] = labels
        return found

    async def all_labels(self, request: Request) -> Response:
        """Send the annotations of every view with their versions, in view order."""
        scene = self._of(request).scene

        def read_all() -> list[dict[str, Any]]:
            known = self.known(scene)
            return [
                {
                    "version": version_of(label_path(self.labels, view)),
                    "labels": [label.model_dump() for label in known.get(view, ())],
                }
                for view in scene.cameras.names
            ]

        return answer_json(await self._do(read_all))

    async def save(self, request: Request) -> Response:
        """Replace the annotations of a view; `If-Match` is the version that was read."""
        asked, opened = await read(request, wire.Labels), self._of(request)
        version = request.headers.get("if-match", "").strip('"')

        def write() -> dict[str, Any]:
            view = view_name(opened.scene, request.path_params["number"])
            size_hw = opened.scene.cameras[view].size_hw
            labels = cut_to_parents(asked.labels, size_hw)
            with opened.same_photographs():  # otherwise labels could be saved for other photographs
                saved = write_labels(label_path(self.labels, view), view, size_hw, labels, version)
            return {"version": saved, "labels": [label.model_dump() for label in labels]}

        return answer_json(await self._do(write))

    async def shape(self, request: Request) -> Response:
        """Send the polygons of a region: drawn polygons and a brush stroke, cut to the parent."""
        asked, scene = await read(request, wire.Shape), self._of(request).scene
        polygons, area_px = await self._do(shaped, asked, scene.cameras[view_name(scene, asked.view)].size_hw)
        return answer_json({"polygons": polygons, "area_px": area_px})

    # -- proposals --------------------------------------------------------------------------------

    async def at(self, request: Request) -> Response:
        """Send the outlines of the nodes or masks that contain a pixel."""
        asked, opened = await read(request, wire.At), self._of(request)

        def find() -> list[dict[str, Any]]:
            with opened.unchanged():
                view = view_name(opened.scene, asked.view)
                return [vars(proposal) for proposal in opened.proposals.at(view, asked.x, asked.y)]

        return answer_json(await self._propose(find))

    async def segment(self, request: Request) -> Response:
        """Send the outlines that the scene's SAM finds around clicks or in a box."""
        asked, opened = await read(request, wire.Segment), self._of(request)

        def find() -> list[dict[str, Any]]:
            with opened.same_photographs():
                view = view_name(opened.scene, asked.view)
                return [vars(found) for found in opened.clicks.outlines(view, asked.clicks, asked.box)]

        return answer_json(await self._propose(find))

    async def carry(self, request: Request) -> Response:
        """Send things of other views, transferred to a view, as proposals; nothing is written."""
        asked, opened = await read(request, wire.Carry), self._of(request)

        def carried() -> list[dict[str, Any]]:
            with opened.unchanged():
                view, known = view_name(opened.scene, asked.view), self.known(opened.scene)
                found = opened.proposals.carried(known, asked.ids, view)
            return [
                {**label.model_dump(), "polygons": polygons, "origin": "proposed"}
                for label, polygons in found
            ]

        return answer_json(await self._propose(carried))

    # -- other programs ---------------------------------------------------------------------------

    async def take_in(self, request: Request) -> Response:
        """Send the annotations merged with those of files, by view number; nothing is written."""
        asked, scene = await read(request, wire.Given), self._of(request).scene
        cameras = scene.cameras

        def merge() -> dict[str, Any]:
            files = [imported(file.name, file.text, cameras) for file in asked.files]
            sizes_hw = {view: cameras[view].size_hw for view in cameras.names}
            found = merged(self.known(scene), files, sizes_hw)
            numbers = {view: number for number, view in enumerate(cameras.names)}
            views = {
                numbers[view]: [label.model_dump() for label in labels]
                for view, labels in found.views.items()
            }
            return {"views": views, "added": found.added, "known": found.known}

        return answer_json(await self._do(merge))

    async def export(self, request: Request) -> Response:
        """Send all annotations in the format of another program."""
        kind, scene = request.path_params["kind"], self._of(request).scene
        if kind not in KINDS:
            raise SettingsError(f"{kind!r} cannot be written", expected=", ".join(KINDS))
        data = await self._do(lambda: exported(kind, self.known(scene), scene.cameras))
        return plain(data, "application/json" if kind == "coco" else BYTES)


KINDS: tuple[Kind, ...] = ("hilsplat", "isat", "labelme", "coco")
SHARED = ("style.css", "elements.js", "http.js", "styles.js")
"""Files of `hilsplat view` that this page also uses."""


def run_annotate(
    folder: Path,
    labels: Path,
    *,
    variant: str,
    port: int,
    browser: bool,
    threads: int,
    on_ready: Callable[[str], None],
) -> None:
    """Serve the annotation page of a scene on this machine until Ctrl-C.

    Args:
        folder: `results/<dataset>/<scene>`, or a copy of it anywhere.
        labels: folder of the label files.
        variant: variant whose masks and tree are proposed.
        port: TCP port; 0 for any free port.
        browser: whether to open the page in a browser.
        threads: number of threads for rendering.
        on_ready: called with the address once the page can be opened.

    Raises:
        ArtifactError: the scene has no photographs with poses yet.
        SceneError: a label file cannot be used.
        SettingsError: the port is taken.
    """
    annotator = Annotator(folder, labels, variant, threads)
    scene, proposals = annotator.opened.scene, annotator.opened.proposals
    annotated = len(annotator.known(scene))
    annotator.drawing.submit(proposals.at, scene.cameras.names[0], 0, 0)  # compiles loops
    about = f"{scene.name}: {annotated} photographs annotated in {labels}, the page"
    serve(annotator.app, about, port=port, browser=browser, on_ready=on_ready)
