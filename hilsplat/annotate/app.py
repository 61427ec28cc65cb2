"""HTTP server of the annotation page: `hilsplat annotate`.

All geometry is computed here, with the polygon filling that evaluation uses; the page only displays it.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hilsplat.annotate import wire
from hilsplat.annotate.exporting import Kind, exported
from hilsplat.annotate.importing import imported
from hilsplat.annotate.labels import (
    StaleLabelsError,
    cut_to_parents,
    fill_rings,
    label_path,
    traced,
    write_labels,
)
from hilsplat.annotate.merging import merged
from hilsplat.annotate.opened_scene import OpenedScene
from hilsplat.base.errors import SettingsError
from hilsplat.query.names import version_of
from hilsplat.web.guard import Guard
from hilsplat.web.scene_thread import SceneThread
from hilsplat.web.server import (
    BYTES,
    Pages,
    answer,
    guarded,
    photograph,
    plain,
    read,
    serve,
    thumbnail,
    version_sent,
    view_name,
)

MAX_BODY_BYTES = 16 << 20
"""Maximum size of a request, enough for a COCO file of a whole scene."""


class Annotator:
    """Request handlers of the annotation page for one scene."""

    def __init__(self, opened: OpenedScene) -> None:
        self.thread = SceneThread(opened)
        self.pages = Pages("annotate.html", "hilsplat.annotate")
        self.drawing = ThreadPoolExecutor(1, thread_name_prefix="drawing")  # so saving does not wait for it

    def app(self, token: str) -> Guard:
        """Return the guarded application."""
        get, post = self.thread.get, self.thread.post
        routes = [
            *self.pages.routes(),
            Route("/api/scene", self.described),
            Route("/api/changes", self.changes),
            Route("/api/photo/{number:int}", get(photo)),
            Route("/api/thumb/{number:int}", get(thumb)),
            Route("/api/labels", get(all_labels)),
            Route("/api/labels/{number:int}", self.save, methods=["PUT"]),
            Route("/api/shape", post(wire.Shape, shape), methods=["POST"]),
            Route("/api/at", post(wire.At, at, self.drawing), methods=["POST"]),
            Route("/api/segment", post(wire.Segment, segment, self.drawing), methods=["POST"]),
            Route("/api/carry", post(wire.Carry, carry, self.drawing), methods=["POST"]),
            Route("/api/import", post(wire.Given, take_in), methods=["POST"]),
            Route("/api/export/{kind}", get(export)),
        ]
        return guarded(routes, token, StaleLabelsError, MAX_BODY_BYTES)

    async def described(self, request: Request) -> Response:
        """Send the photographs and available proposals to a new page, after reopening a changed scene."""
        return answer(await self.thread.opened_anew())

    async def changes(self, request: Request) -> Response:
        """Send which parts of the scene changed on disk since they were opened."""

        def find() -> dict[str, Any]:
            opened = self.thread.shown
            return {"of": opened.state, "changed": opened.changed()}

        return answer(await self.thread.run(find))

    async def save(self, request: Request) -> Response:
        """Replace the annotations of a view; `If-Match` is the version that was read."""
        asked = await read(request, wire.Labels)

        def write(opened: OpenedScene) -> dict[str, Any]:
            view = view_name(opened.scene, request.path_params["number"])
            size_hw = opened.scene.cameras[view].size_hw
            labels = cut_to_parents(asked.labels, size_hw)
            path = label_path(opened.labels, view)
            with opened.same_photographs():  # otherwise labels could be saved for other photographs
                saved = write_labels(path, view, size_hw, labels, version_sent(request))
            return {"version": saved, "labels": [label.model_dump() for label in labels]}

        return answer(await self.thread.do(request, write))


def photo(opened: OpenedScene, of: Mapping[str, Any]) -> Response:
    """Return an undistorted photograph."""
    with opened.same_photographs():
        return photograph(opened.scene, of["number"])


def thumb(opened: OpenedScene, of: Mapping[str, Any]) -> Response:
    """Return a thumbnail of a photograph."""
    with opened.same_photographs():
        return thumbnail(opened.scene, of["number"])


def all_labels(opened: OpenedScene, of: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the annotations of every view with their versions, in view order."""
    known = opened.known()
    return [
        {
            "version": version_of(label_path(opened.labels, view)),
            "labels": [label.model_dump() for label in known.get(view, ())],
        }
        for view in opened.scene.cameras.names
    ]


def shape(opened: OpenedScene, asked: wire.Shape) -> dict[str, Any]:
    """Return polygons and area of a region: polygons, plus or minus a stroke, inside another region."""
    scene = opened.scene
    size_hw = scene.cameras[view_name(scene, asked.view)].size_hw
    drawn = fill_rings(asked.add, size_hw)
    mask = drawn
    if asked.stroke is not None:
        painted = np.zeros(size_hw, np.uint8)
        points, radius = np.array(asked.stroke.points, np.int32), asked.stroke.radius
        cv2.polylines(painted, [points], False, 1, max(1, round(2 * radius)))
        for x, y in points:  # round ends, and dots
            cv2.circle(painted, (int(x), int(y)), round(radius), 1, cv2.FILLED)
        mask = mask & (painted == 0) if asked.stroke.erase else mask | (painted > 0)
    if asked.inside is not None:
        mask = mask & fill_rings(asked.inside, size_hw)
    is_drawn = len(asked.add) == 1 and np.array_equal(mask, drawn)  # few corners are easier to edit
    return {"polygons": asked.add if is_drawn else traced(mask), "area_px": int(np.count_nonzero(mask))}


# -- proposals ------------------------------------------------------------------------------------


def at(opened: OpenedScene, asked: wire.At) -> list[dict[str, Any]]:
    """Return the outlines of the nodes or masks that contain a pixel."""
    with opened.unchanged():
        view = view_name(opened.scene, asked.view)
        return [vars(proposal) for proposal in opened.proposals.at(view, asked.x, asked.y)]


def segment(opened: OpenedScene, asked: wire.Segment) -> list[dict[str, Any]]:
    """Return the outlines that the scene's SAM finds around clicks or in a box."""
    with opened.same_photographs():
        view = view_name(opened.scene, asked.view)
        return [vars(found) for found in opened.clicks.outlines(view, asked.clicks, asked.box)]


def carry(opened: OpenedScene, asked: wire.Carry) -> list[dict[str, Any]]:
    """Return things of other views, transferred to a view, as proposals; nothing is written."""
    with opened.unchanged():
        view = view_name(opened.scene, asked.view)
        found = opened.proposals.carried(opened.known(), asked.ids, view)
    return [{**label.model_dump(), "polygons": polygons, "origin": "proposed"} for label, polygons in found]


# -- other programs -------------------------------------------------------------------------------


def take_in(opened: OpenedScene, asked: wire.Given) -> dict[str, Any]:
    """Return the annotations merged with those of files, by view number; nothing is written."""
    cameras = opened.scene.cameras
    files = [imported(file.name, file.text, cameras) for file in asked.files]
    found = merged(opened.known(), files, {view: cameras[view].size_hw for view in cameras.names})
    views = {
        cameras.names.index(view): [label.model_dump() for label in labels]
        for view, labels in found.views.items()
    }
    return {"views": views, "added": found.added, "known": found.known}


def export(opened: OpenedScene, of: Mapping[str, Any]) -> Response:
    """Return all annotations in the format of another program."""
    kind = of["kind"]
    if kind not in get_args(Kind):
        raise SettingsError(f"{kind!r} cannot be written", expected=", ".join(get_args(Kind)))
    data = exported(kind, opened.known(), opened.scene.cameras)
    return plain(data, "application/json" if kind == "coco" else BYTES)


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

    Arguments as in `OpenedScene` and `serve`.

    Raises:
        ArtifactError: the scene has no photographs with poses yet.
        SceneError: a label file cannot be used.
        SettingsError: the port is taken.
    """
    opened = OpenedScene(folder, labels, variant, threads)
    annotator, annotated = Annotator(opened), len(opened.known())
    first = opened.scene.cameras.names[0]
    annotator.drawing.submit(opened.proposals.at, first, 0, 0)  # compiles loops
    about = f"{opened.scene.name}: {annotated} photographs annotated in {labels}, the page"
    serve(annotator.app, about, port=port, browser=browser, on_ready=on_ready)
