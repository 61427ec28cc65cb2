"""The annotation page's server: `hilsplat annotate`.

It shares socket, guard and photographs with `hilsplat view`. All geometry is computed here, with the filling
that evaluation uses; the page only shows it.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any, TypeVar

import cv2
import numpy as np
from pydantic import Field
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hilsplat.annotate.exchange import Kind, exported, imported
from hilsplat.annotate.labels import (
    Label,
    Place,
    Rings,
    StaleLabelsError,
    cut_to_parents,
    fill_rings,
    label_path,
    read_labels,
    traced,
    version_of,
    write_labels,
)
from hilsplat.annotate.proposals import Proposals
from hilsplat.base.errors import ArtifactError, SettingsError
from hilsplat.scene.scene import Scene
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
from hilsplat.viewer.wire import Message

MAX_BODY_BYTES = 16 << 20
"""A COCO file of a whole scene fits."""
Made = TypeVar("Made")


class Stroke(Message):
    """A brush stroke: discs of a radius along points, px."""

    points: Annotated[list[tuple[Place, Place]], Field(min_length=1, max_length=20_000)]
    radius: Annotated[float, Field(ge=0.5, le=500)]
    erase: bool = False


class Shape(Message):
    """A region to be made from polygons and a stroke, inside its parent."""

    view: int
    add: Rings
    stroke: Stroke | None = None
    inside: Rings | None = None


class At(Message):
    """A pixel of a photograph."""

    view: int
    x: int
    y: int


class Carry(Message):
    """Things, and the view to carry them into."""

    ids: Annotated[list[int], Field(min_length=1, max_length=2000)]
    view: int


class Labels(Message):
    """All annotations of a view."""

    labels: Annotated[list[Label], Field(max_length=2000)]


class Given(Message):
    """A file of annotations."""

    name: Annotated[str, Field(max_length=300)]
    text: str


class Annotator:
    """Answers the annotation page's requests about one scene.

    Args:
        folder: of the scene, such as results/photos/desk.
        labels: folder of its label files; made when the first is written.
        variant: whose masks and tree are proposed.
        threads: number of threads for drawing.

    Raises:
        ArtifactError: the scene has no photographs with poses yet.
    """

    def __init__(self, folder: Path, labels: Path, variant: str, threads: int) -> None:
        if not (folder / "scene" / "index.json").is_file():
            raise ArtifactError(
                f"{folder} has no photographs to annotate yet: {folder / 'scene'} is missing",
                expected="results/<dataset>/<scene> of a run, or a copy of it",
                fix=f"snakemake --cores 2 {folder / 'scene'}",
            )
        self.scene, self.labels = Scene.load(folder / "scene"), Path(labels)
        self.proposals = Proposals(self.scene, folder, variant, threads)
        shared = {name: data for name, data in static_files().items() if name in SHARED}
        self.pages = Pages("annotate.html", {**shared, **static_files("hilsplat.annotate")})
        self.files = ThreadPoolExecutor(1, thread_name_prefix="files")
        self.drawing = ThreadPoolExecutor(1, thread_name_prefix="drawing")  # saving does not wait for it

    def app(self, token: str) -> Guard:
        """The application, guarded."""
        routes = [
            *self.pages.routes(),
            Route("/api/scene", self.described),
            Route("/api/photo/{number:int}", self.photo),
            Route("/api/thumb/{number:int}", self.thumb),
            Route("/api/labels", self.all_labels),
            Route("/api/labels/{number:int}", self.save, methods=["PUT"]),
            Route("/api/shape", self.shape, methods=["POST"]),
            Route("/api/at", self.at, methods=["POST"]),
            Route("/api/carry", self.carry, methods=["POST"]),
            Route("/api/import", self.take_in, methods=["POST"]),
            Route("/api/export/{kind}", self.export),
        ]
        return guarded(routes, token, {StaleLabelsError: 412}, MAX_BODY_BYTES)

    async def _do(self, work: Callable[..., Made], *arguments: Any) -> Made:
        """Run on the one thread that touches files."""
        return await asyncio.get_running_loop().run_in_executor(self.files, work, *arguments)

    async def _propose(self, work: Callable[..., Made], *arguments: Any) -> Made:
        """Run on the one thread that draws views."""
        return await asyncio.get_running_loop().run_in_executor(self.drawing, work, *arguments)

    # -- the scene --------------------------------------------------------------------------------

    async def described(self, request: Request) -> Response:
        """Photographs, and what can be proposed."""
        cameras = self.scene.cameras
        views = [
            {"name": name, "split": self.scene.split[name], "size_hw": list(cameras[name].size_hw)}
            for name in cameras.names
        ]
        carries = self.proposals.gaussians is not None
        about = {"name": self.scene.name, "folder": str(self.labels), "proposes": self.proposals.of}
        return answer_json({**about, "carries": carries, "views": views})

    async def photo(self, request: Request) -> Response:
        """An undistorted photograph."""
        return await self._do(photograph, self.scene, request.path_params["number"])

    async def thumb(self, request: Request) -> Response:
        """A small photograph."""
        return await self._do(thumbnail, self.scene, request.path_params["number"])

    # -- annotations ------------------------------------------------------------------------------

    def known(self) -> dict[str, list[Label]]:
        """Annotations of all views that have any."""
        found = {}
        for view in self.scene.cameras.names:
            labels = read_labels(label_path(self.labels, view), self.scene.cameras[view].size_hw)
            if labels:
                found[view] = labels
        return found

    async def all_labels(self, request: Request) -> Response:
        """Annotations of every view with their versions, in the order of the views."""

        def read_all() -> list[dict[str, Any]]:
            known = self.known()
            return [
                {
                    "version": version_of(label_path(self.labels, view)),
                    "labels": [label.model_dump() for label in known.get(view, ())],
                }
                for view in self.scene.cameras.names
            ]

        return answer_json(await self._do(read_all))

    async def save(self, request: Request) -> Response:
        """Replace the annotations of a view; `If-Match` is the version that was read."""
        asked = await read(request, Labels)
        version = request.headers.get("if-match", "").strip('"')

        def write() -> dict[str, Any]:
            view = view_name(self.scene, request.path_params["number"])
            size_hw = self.scene.cameras[view].size_hw
            labels = cut_to_parents(asked.labels, size_hw)
            saved = write_labels(label_path(self.labels, view), view, size_hw, labels, version)
            return {"version": saved, "labels": [label.model_dump() for label in labels]}

        return answer_json(await self._do(write))

    async def shape(self, request: Request) -> Response:
        """Polygons of a region: what was drawn, and a brush stroke, inside the parent."""
        asked = await read(request, Shape)
        size_hw = self.scene.cameras[view_name(self.scene, asked.view)].size_hw
        mask = await self._do(shaped, asked, size_hw)
        return answer_json({"polygons": traced(mask), "area_px": int(np.count_nonzero(mask))})

    # -- proposals --------------------------------------------------------------------------------

    async def at(self, request: Request) -> Response:
        """Outlines that nodes or masks have around a pixel."""
        asked = await read(request, At)
        view = view_name(self.scene, asked.view)
        found = await self._propose(self.proposals.at, view, asked.x, asked.y)
        return answer_json([vars(proposal) for proposal in found])

    async def carry(self, request: Request) -> Response:
        """Things of other views carried into a view, as proposals; nothing is written."""
        asked = await read(request, Carry)

        def carried() -> list[dict[str, Any]]:
            found = self.proposals.carried(self.known(), asked.ids, view_name(self.scene, asked.view))
            return [
                {**label.model_dump(), "polygons": polygons, "origin": "proposed"}
                for label, polygons in found
            ]

        return answer_json(await self._propose(carried))

    # -- other programs ---------------------------------------------------------------------------

    async def take_in(self, request: Request) -> Response:
        """What a file holds, by the number of the view; nothing is written."""
        asked = await read(request, Given)
        found = await self._do(imported, asked.name, asked.text, self.scene.cameras)
        names = self.scene.cameras.names
        return answer_json(
            {names.index(view): [label.model_dump() for label in labels] for view, labels in found.items()}
        )

    async def export(self, request: Request) -> Response:
        """All annotations as files of a program."""
        kind = request.path_params["kind"]
        if kind not in KINDS:
            raise SettingsError(f"{kind!r} cannot be written", expected=", ".join(KINDS))
        data = await self._do(lambda: exported(kind, self.known(), self.scene.cameras))
        return plain(data, "application/json" if kind == "coco" else BYTES)


KINDS: tuple[Kind, ...] = ("hilsplat", "isat", "labelme", "coco")
SHARED = ("style.css", "elements.js", "http.js", "styles.js")
"""Files of `hilsplat view` that this page uses too."""


def shaped(asked: Shape, size_hw: tuple[int, int]) -> np.ndarray:
    """Union of polygons, plus or minus a stroke, cut to the region that it must stay inside."""
    mask = fill_rings(asked.add, size_hw)
    if asked.stroke is not None:
        painted = np.zeros(size_hw, np.uint8)
        points = np.array(asked.stroke.points, np.int32)
        radius = asked.stroke.radius
        cv2.polylines(painted, [points], False, 1, max(1, round(2 * radius)))
        for x, y in points:  # round ends, and dots
            cv2.circle(painted, (int(x), int(y)), round(radius), 1, cv2.FILLED)
        mask = mask & (painted == 0) if asked.stroke.erase else mask | (painted > 0)
    if asked.inside is not None:
        mask &= fill_rings(asked.inside, size_hw)
    return mask


def run_annotate(
    folder: Path,
    labels: Path,
    *,
    variant: str,
    port: int,
    browser: bool,
    threads: int,
    told: Callable[[str], None],
) -> None:
    """Serve the annotation page of a scene on this machine until Ctrl-C.

    Args:
        folder: `results/<dataset>/<scene>`, or a copy of it anywhere.
        labels: folder of the label files.
        variant: whose masks and tree are proposed.
        port: 0: any that is free.
        browser: whether to open the page in a browser.
        threads: number of threads for drawing.
        told: gets the address, once the page can be opened.

    Raises:
        ArtifactError: the scene has no photographs with poses yet.
        SceneError: a label file cannot be used.
        SettingsError: the port is taken.
    """
    annotator = Annotator(folder, labels, variant, threads)
    annotated = len(annotator.known())
    annotator.drawing.submit(annotator.proposals.at, annotator.scene.cameras.names[0], 0, 0)  # compiles loops
    about = f"{annotator.scene.name}: {annotated} photographs annotated in {labels}, the page"
    serve(annotator.app, about, port=port, browser=browser, told=told)
