"""HTTP server of the annotation page: `hilsplat annotate`.

All geometry is computed here, with the polygon filling used in evaluation; the page only displays it.
"""

import shlex
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any, get_args

import cv2
import numpy as np
from pydantic import Field
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hilsplat.annotate.exchange import Kind, exported, imported, merged
from hilsplat.annotate.labels import (
    Label,
    Place,
    Rings,
    cut_to_parents,
    known_labels,
    label_path,
    traced,
    write_labels,
)
from hilsplat.annotate.proposals import Clicks, Proposals
from hilsplat.base.artifacts import read_json, rebuild_command, run_command
from hilsplat.base.errors import ArtifactError, HilsplatError, SettingsError, first_line
from hilsplat.base.tables import read_csv
from hilsplat.datasets.images.isat import fill_polygons
from hilsplat.scene.scene import Scene
from hilsplat.web.file_changes import version_of
from hilsplat.web.guard import Guard
from hilsplat.web.messages import Message
from hilsplat.web.scene_thread import SceneThread, ShownScene
from hilsplat.web.server import Ready, answer, files_of, guarded, plain, read, serve, version_sent, view_name

SCORES = 3  # maximum number of methods whose mean scores the page shows
MAX_BODY_BYTES = 16 << 20  # maximum size of a request, enough for a COCO file of a whole scene


class Stroke(Message):
    """A brush stroke: discs of the same radius along points, px."""

    points: Annotated[list[tuple[Place, Place]], Field(min_length=1, max_length=20_000)]
    radius: Annotated[float, Field(ge=0.5, le=500)]
    erase: bool = False


class Shape(Message):
    """A region: the union of polygons, with a stroke added or removed, clipped to `inside`."""

    view: int
    add: Rings
    stroke: Stroke | None = None
    inside: Rings | None = None


class At(Message):
    """A pixel of a photograph."""

    view: int
    x: int
    y: int


class Segment(Message):
    """Clicks on one object in a photograph (x, y, inside), or a box around it (left, top, right, bottom)."""

    view: int
    clicks: Annotated[tuple[tuple[int, int, bool], ...], Field(max_length=64)] = ()
    box: tuple[int, int, int, int] | None = None


class Carry(Message):
    """Ids of objects, and the view to transfer these objects to."""

    ids: Annotated[list[int], Field(min_length=1, max_length=2000)]
    view: int


class Labels(Message):
    """All annotations of a view."""

    labels: Annotated[list[Label], Field(max_length=2000)]


class File(Message):
    """An annotation file."""

    name: Annotated[str, Field(max_length=300)]
    text: str


class Files(Message):
    """Annotation files."""

    files: Annotated[list[File], Field(min_length=1, max_length=5000)]


class OpenedScene(ShownScene):
    """The parts of a scene that existed when it was opened.

    Args:
        folder: the scene's folder, such as results/photos/desk.
        labels: folder of the scene's label files; created when the first label file is saved.
        variant: variant whose masks and nodes are proposed.

    Raises:
        ArtifactError: the scene has no photographs with poses yet.
    """

    def __init__(self, folder: Path, labels: Path, variant: str, threads: int) -> None:
        super().__init__()
        self.folder, self.labels, self.variant, self.threads = folder, labels, variant, threads
        scene = folder / "scene"
        if not (scene / "index.json").is_file():
            raise ArtifactError(
                f"{folder} has no photographs to annotate yet: {scene} is missing",
                expected="a run's results/<dataset>/<scene>, or a copy of it",
                fix=run_command(scene),
            )
        proposing = (folder / variant / "masks", folder / variant / "semantic_tree")
        parts = (scene, folder / "gaussians.ply", *proposing)
        self.identify(parts)
        self.note(parts)
        self.scene, self.photographs = Scene.load(scene), (scene,)
        self.proposals = Proposals(self.scene, folder, variant, threads)
        self.clicks = Clicks(self.scene, folder / variant / "masks")
        self.texts: dict[int, str] = {}  # of ids that the page has (`known_labels`)

    def opened_again(self) -> "OpenedScene":
        return OpenedScene(self.folder, self.labels, self.variant, self.threads)

    def described(self) -> dict[str, Any]:
        """Describe the photographs and available proposals."""
        cameras, words = self.scene.cameras, ["hilsplat", "annotate", str(self.folder)]
        return {
            "name": self.scene.name,
            "of": self.state,
            "folder": str(self.labels),
            "restart": shlex.join([*words, "--data-root", str(self.labels.parents[2])]),
            "scores": self.scores(),
            "proposes": self.proposals.of,
            "segments": self.clicks.name,
            "carries": self.proposals.gaussians is not None,
            "views": [
                {"name": name, "split": self.scene.split[name], "size_hw": list(cameras[name].size_hw)}
                for name in cameras.names
            ],
        }

    def versions(self) -> list[str]:
        """Return the version of every view's annotations, in view order."""
        return [version_of(label_path(self.labels, view)) for view in self.scene.cameras.names]

    def news(self) -> dict[str, Any]:
        return {**super().news(), "labels": self.versions()}

    def scores(self) -> str:
        """Return each method's mean over the most queries in one line; empty if no run has saved any."""
        means = self.folder / "scores.csv"
        if not means.is_file():
            return ""
        try:
            rows = [row for row in read_csv(means, None, rebuild_command(means)) if row.get("mIoU")]
        except ArtifactError as error:
            return first_line(error)
        best: dict[str, dict[str, str]] = {}
        ranks = [(row.get("labels") == "annotated", row.get("queries", "").zfill(9)) for row in rows]
        for _, row in sorted(zip(ranks, rows, strict=True), key=lambda pair: pair[0], reverse=True):
            best.setdefault(row["method"], row)
        lines = [f"{row['method']} {row['mIoU']} % ({row['protocol']})" for row in [*best.values()][:SCORES]]
        more = [f"all in {means.with_suffix('.md')}"] if len(rows) > SCORES else []
        scored = means.stat().st_mtime
        is_old = any(path.stat().st_mtime > scored for path in self.labels.glob("*.json"))
        old = ["of earlier annotations: the next run updates them"] if is_old else []
        return "; ".join([*lines, *more, *old]) if lines else ""

    def known(self) -> dict[str, list[Label]]:
        """Return the annotations of all annotated views."""
        return known_labels(self.labels, self.scene.cameras, self.scene.cameras.names, self.texts)


class Annotator:
    """Request handlers of the annotation page for one scene."""

    def __init__(self, opened: OpenedScene) -> None:
        self.thread = SceneThread(opened)
        _, self.files = files_of("annotate.html", "hilsplat.annotate")
        self.drawing = ThreadPoolExecutor(1, thread_name_prefix="drawing")  # so that saving doesn't wait

    def app(self, token: str) -> Guard:
        get, post = self.thread.get, self.thread.post
        routes = [
            *self.files,
            *self.thread.routes(),
            get("/api/labels", _all_labels),
            Route("/api/labels/{number:int}", self._save, methods=["PUT"]),
            post("/api/shape", Shape, _shape),
            post("/api/at", At, _at, self.drawing),
            post("/api/segment", Segment, _segment, self.drawing),
            post("/api/carry", Carry, _carry, self.drawing),
            post("/api/import", Files, _import),
            get("/api/export/{kind}", _export),
        ]
        return guarded(routes, token, MAX_BODY_BYTES)

    async def _save(self, request: Request) -> Response:
        """Replace the annotations of a view; the `If-Match` header is the version that the page read."""
        asked = await read(request, Labels)

        def write(opened: OpenedScene) -> dict[str, Any]:
            view = view_name(opened.scene, request.path_params["number"])
            size_hw = opened.scene.cameras[view].size_hw
            labels = cut_to_parents(asked.labels, size_hw)
            path = label_path(opened.labels, view)
            # Otherwise, labels could be saved for other photographs.
            with opened.unchanged(*opened.photographs):
                saved = write_labels(path, view, size_hw, labels, version_sent(request))
            return {"version": saved, "labels": [label.model_dump() for label in labels]}

        return answer(await self.thread.do(request, write))


def _all_labels(opened: OpenedScene) -> list[dict[str, Any]]:
    """Return the annotations and file version of every view, in view order."""
    versions, known = opened.versions(), opened.known()  # in this order
    return [
        {"version": version, "labels": [label.model_dump() for label in known.get(view, ())]}
        for view, version in zip(opened.scene.cameras.names, versions, strict=True)
    ]


def _shape(opened: OpenedScene, asked: Shape) -> dict[str, Any]:
    """Return polygons and area of a region: polygons with a stroke added or removed, clipped to `inside`."""
    size_hw = opened.scene.cameras[view_name(opened.scene, asked.view)].size_hw
    mask = drawn = fill_polygons(asked.add, size_hw)
    if asked.stroke is not None:
        painted = np.zeros(size_hw, np.uint8)
        points, radius = np.array(asked.stroke.points, np.int32), asked.stroke.radius
        cv2.polylines(painted, [points], False, 1, max(1, round(2 * radius)))
        for x, y in points:  # rounds the ends of lines, and draws single points
            cv2.circle(painted, (int(x), int(y)), round(radius), 1, cv2.FILLED)
        mask = mask & (painted == 0) if asked.stroke.erase else mask | (painted > 0)
    if asked.inside is not None:
        mask = mask & fill_polygons(asked.inside, size_hw)
    is_drawn = len(asked.add) == 1 and np.array_equal(mask, drawn)  # the given polygon has fewer corners
    return {"polygons": asked.add if is_drawn else traced(mask), "area_px": int(np.count_nonzero(mask))}


def _at(opened: OpenedScene, asked: At) -> list[dict[str, Any]]:
    with opened.unchanged():
        view = view_name(opened.scene, asked.view)
        return [vars(proposal) for proposal in opened.proposals.at(view, asked.x, asked.y)]


def _segment(opened: OpenedScene, asked: Segment) -> list[dict[str, Any]]:
    with opened.unchanged(*opened.photographs):
        view = view_name(opened.scene, asked.view)
        return [vars(proposal) for proposal in opened.clicks.outlines(view, asked.clicks, asked.box)]


def _carry(opened: OpenedScene, asked: Carry) -> list[dict[str, Any]]:
    """Return objects of other views, transferred to a view, as proposals; nothing is written."""
    with opened.unchanged():
        carried = opened.proposals.carried(opened.known(), asked.ids, view_name(opened.scene, asked.view))
    return [{**label.model_dump(), "polygons": polygons, "origin": "proposed"} for label, polygons in carried]


def _import(opened: OpenedScene, asked: Files) -> dict[str, Any]:
    """Merge the annotations with those in files, and return them by view number; nothing is written.

    A file that cannot be used is noted; a single one is refused.
    """
    cameras, files, notes = opened.scene.cameras, [], list[str]()
    photos = read_json(opened.scene.folder / "registration.json")["views"]
    for file in asked.files:
        try:
            files.append(imported(file.name, file.text, cameras, notes, photos))
        except HilsplatError as error:
            if len(asked.files) == 1:
                raise
            notes.append(first_line(error))
    sizes_hw = {view: cameras[view].size_hw for view in cameras.names}
    changed, added, known = merged(opened.known(), files, sizes_hw)
    views = {
        cameras.names.index(view): [label.model_dump() for label in labels]
        for view, labels in changed.items()
    }
    return {"views": views, "added": added, "known": known, "notes": notes}


def _export(opened: OpenedScene, kind: Kind) -> Response:
    if kind not in get_args(Kind):
        raise SettingsError(f"unknown format {kind!r}", expected=", ".join(get_args(Kind)))
    data = exported(kind, opened.known(), opened.scene.cameras)
    return plain(data, "application/json") if kind == "coco" else answer(data)


def run_annotate(
    folder: Path, labels: Path, *, variant: str, port: int, browser: bool, threads: int, on_ready: Ready
) -> None:
    """Serve the annotation page of a scene until Ctrl-C.

    For arguments and errors, see `OpenedScene`, `known_labels` and `serve`.
    """
    opened = OpenedScene(folder, labels, variant, threads)
    annotator, annotated = Annotator(opened), len(opened.known())
    first = opened.scene.cameras.names[0]
    annotator.drawing.submit(opened.proposals.at, first, 0, 0)  # compiles the loops before the first click
    about = f"{opened.scene.name}: {annotated} photographs annotated in {labels}; page"
    page = f"annotate {labels.resolve()}"
    serve(annotator.app, about, page=page, port=port, browser=browser, on_ready=on_ready)
