"""Server of the annotation page: access, versions of saved files, shapes, proposals, transfer to views."""

import errno
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from anyio.from_thread import start_blocking_portal
from starlette.testclient import TestClient

from hilsplat.annotate.app import Annotator, OpenedScene
from hilsplat.annotate.labels import Label, traced
from hilsplat.base.errors import ArtifactError
from hilsplat.base.tables import write_csv
from hilsplat.datasets.registry import open_labelled
from hilsplat.segment.masks import HierarchicalMasks
from tests.unit.annotate.test_clicks import iou
from tests.unit.artifact_changes import write_again
from tests.unit.finished_desk import HEIGHT, NUM_VIEWS, WIDTH, region_mask
from tests.unit.viewer.conftest import ADDRESS, TOKEN, browser_of

SIZE = (HEIGHT, WIDTH + NUM_VIEWS)
MUG = {"id": 1, "level": 1, "text": "mug", "polygons": [[[1, 1], [12, 1], [12, 20], [1, 20]]]}
HANDLE = {"id": 2, "level": 2, "parent": 1, "text": "handle"}
HANDLE["polygons"] = [[[8, 4], [30, 4], [30, 9], [8, 9]]]


@pytest.fixture
def labels(tmp_path) -> Path:
    return tmp_path / "annotated/photos/desk"


def opened(desk: Path, labels: Path) -> TestClient:
    return browser_of(Annotator(OpenedScene(desk, labels, "default", 1)).app(TOKEN))


@pytest.fixture
def client(desk, labels) -> TestClient:
    return opened(desk, labels)


def put(client, number, labels, version):
    return client.put(f"/api/labels/{number}", json={"labels": labels}, headers={"if-match": f'"{version}"'})


def mask_of(polygons) -> np.ndarray:
    return Label(id=1, level=1, text="x", polygons=polygons).mask(SIZE)


def test_requests_of_strangers_are_refused_and_photographs_must_exist(desk, labels, client):
    stranger = TestClient(Annotator(OpenedScene(desk, labels, "default", 1)).app(TOKEN), base_url=ADDRESS)
    for path in ("/", "/api/labels", f"/api/labels?token={TOKEN}"):
        assert stranger.get(path).status_code == 403, path
    assert put(stranger, 0, [MUG], "none").status_code == 403
    assert put(client, 99, [MUG], "none").status_code == 422
    assert not labels.exists()


def test_the_page_shows_the_saved_scores_and_whether_they_are_older_than_the_annotations(own_desk, labels):
    def line() -> str:
        return opened(own_desk, labels).get("/api/scene").json()["scores"]

    assert line() == ""
    means = own_desk / "scores.csv"
    of_methods = [("tree", "65.0"), ("field", "40.1"), ("LangSplat", "30.2"), ("LERF", "20.0"), ("none", "")]
    rows = [(method, iou, "12", "lerf/langsplat@3") for method, iou in of_methods]
    rows.insert(0, ("tree", "80.0", "9", "3d-ovs/argmax@3"))  # of fewer queries
    write_csv(means, ("method", "mIoU", "queries", "protocol"), rows)
    shown = [f"{method} {iou} % (lerf/langsplat@3)" for method, iou in of_methods[:3]]
    assert line() == "; ".join([*shown, f"all in {means.with_suffix('.md')}"])
    assert put(opened(own_desk, labels), 0, [MUG], "none").status_code == 200
    os.utime(means, (0, 0))
    assert line().endswith("; of earlier annotations: the next run updates them")
    means.write_text("a,b\n1\n")
    assert "scores.csv cannot be read" in line()


# -- saving -----------------------------------------------------------------------------------------


def test_saved_labels_are_cut_to_their_parents_versioned_and_a_data_set(client, labels, tmp_path):
    saved = put(client, 2, [MUG, HANDLE], "none").json()
    parent, child = (mask_of(each["polygons"]) for each in saved["labels"])
    np.testing.assert_array_equal(child, mask_of(HANDLE["polygons"]) & parent)
    assert client.get("/api/labels").json()[2] == saved
    again = put(client, 2, [MUG, HANDLE], saved["version"])
    assert again.status_code == 200
    for old in ("none", "", "another"):
        stale = put(client, 2, [], old)
        assert stale.status_code == 412 and "repeat the change" in stale.json()["error"]
    assert client.put("/api/labels/2", json={"labels": []}).status_code == 412
    assert client.get("/api/labels").json()[2] == saved
    scene = open_labelled("annotated/photos/desk", tmp_path)
    assert [region.path for region in scene.views["002.png"]] == [("mug",), ("mug", "handle")]
    np.testing.assert_array_equal(scene.views["002.png"][1].mask(), child)


@pytest.mark.parametrize(
    ("number", "words"),
    [(errno.EROFS, "000.json is on a read-only disk"), (errno.ESTALE, "000.json cannot be read or written")],
)
def test_the_page_is_told_why_annotations_cannot_be_saved(client, labels, monkeypatch, number, words):
    def refuse(path, text):
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr("hilsplat.annotate.labels.write_text", refuse)
    sent = put(client, 0, [MUG], "none")
    assert sent.status_code == 500 and words in sent.json()["error"]


def test_a_page_that_is_closed_while_it_sends_leaves_no_traceback(desk, labels):
    app = Annotator(OpenedScene(desk, labels, "default", 1)).app(TOKEN)
    headers = {"host": "127.0.0.1:1", "cookie": f"{app.cookie}={TOKEN}", "origin": "http://127.0.0.1:1"}
    headers["content-type"] = "application/json"
    fields = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope = {"type": "http", "method": "POST", "path": "/api/at", "query_string": b"", "headers": fields}

    async def receive() -> dict:
        return {"type": "http.disconnect"}

    async def send(message: dict) -> None:
        sent.append(message["type"])

    sent: list[str] = []
    with start_blocking_portal() as portal:  # in a thread: browser tests leave a loop in this one
        portal.call(app, scope, receive, send)
    assert sent == ["http.response.start", "http.response.body"]


HALVES = [[[0.5, 1], [2, 2], [3, 1]]]


@pytest.mark.parametrize(
    "change", [{"level": 4}, {"text": "x" * 201}, {"polygons": HALVES}, {"path": "/etc/passwd"}]
)
def test_invalid_labels_are_refused(client, labels, change):
    sent = put(client, 0, [{**MUG, **change}], "none")
    assert sent.status_code == 400 and sent.json()["error"] and not labels.exists()


# -- shapes -----------------------------------------------------------------------------------------


def test_a_brush_adds_discs_erases_and_stays_inside_the_parent(client):
    square, stroke = [[[2, 2], [12, 2], [12, 12], [2, 12]]], {"points": [[12, 7], [24, 7]], "radius": 3}

    def region(**more) -> np.ndarray:
        shape = client.post("/api/shape", json={"view": 0, "add": square, "stroke": stroke, **more}).json()
        found = mask_of(shape["polygons"]) if shape["polygons"] else np.zeros(SIZE, bool)
        assert shape["area_px"] == found.sum()
        return found

    painted, drawn = region(add=[]), mask_of(square)
    rows, columns = np.indices(SIZE)
    assert painted[(abs(rows - 7) <= 2) & (columns >= 10) & (columns <= 26)].all()
    assert not painted[(abs(rows - 7) > 4) | (columns < 8) | (columns > 28)].any()
    np.testing.assert_array_equal(region(), drawn | painted)
    np.testing.assert_array_equal(region(stroke={**stroke, "erase": True}), drawn & ~painted)
    np.testing.assert_array_equal(region(inside=square), drawn)
    left = [[[2, 2], [6, 2], [6, 12], [2, 12]]]
    np.testing.assert_array_equal(region(stroke=None, inside=left), mask_of(left))
    assert not region(inside=[[[30, 15], [33, 15], [33, 18]]]).any()


# -- proposals --------------------------------------------------------------------------------------


def test_nodes_are_proposed_at_a_pixel_from_whole_to_subpart(client):
    view, shift = 3, 3
    rim = {"view": view, "x": 6 + shift, "y": 6}
    offers = client.post("/api/at", json=rim).json()
    assert [offer["level"] for offer in offers] == [1, 2, 3]
    assert all(offer["what"].startswith("node ") for offer in offers)
    for offer, name in zip(offers, ("mug", "handle", "rim"), strict=True):
        expected = region_mask(name, shift)
        if name == "mug":
            expected = expected | region_mask("handle", shift)
        assert iou(mask_of(offer["polygons"]), expected) > 0.7, name
    assert client.post("/api/at", json={"view": view, "x": 999, "y": 0}).status_code == 422


def test_a_running_workflow_adds_proposals_of_masks_and_then_of_nodes(desk, labels, tmp_path):
    young = tmp_path / "results/photos/desk"
    with pytest.raises(ArtifactError, match="has no photographs to annotate yet"):
        opened(young, labels)
    shutil.copytree(desk / "scene", young / "scene")
    client = opened(young, labels)
    assert client.get("/api/scene").json()["proposes"] == ""
    shutil.copytree(desk / "default/masks", young / "default/masks")
    assert client.get("/api/changes").json()["changed"] == ["masks"]
    described = client.get("/api/scene").json()
    assert described["proposes"] == "masks" and not described["carries"]
    offers = client.post("/api/at", json={"view": 1, "x": 25, "y": 8}).json()
    masks = HierarchicalMasks.load(young / "default/masks/001.png.npz")
    for offer in offers:
        dense = masks.dense(np.array([int(offer["what"].removeprefix("mask "))]))[0]
        assert dense[8, 25] and iou(mask_of(offer["polygons"]), dense) > 0.8
    assert offers
    assert client.post("/api/carry", json={"ids": [1], "view": 0}).status_code == 422
    shutil.copy(desk / "gaussians.ply", young)
    shutil.copytree(desk / "default/semantic_tree", young / "default/semantic_tree")
    assert client.get("/api/scene").json()["proposes"] == "nodes"


def test_things_are_transferred_by_their_gaussians_with_their_parts_inside(client):
    view, shift = 1, 1
    mug = region_mask("mug", shift) | region_mask("handle", shift)
    things = [
        Label(id=5, level=1, text="mug", polygons=traced(mug)),
        Label(id=6, level=2, parent=5, text="handle", polygons=traced(region_mask("handle", shift))),
        Label(id=7, level=1, text="guess", polygons=[[(20, 5), (30, 5), (30, 9)]], origin="proposed"),
    ]
    put(client, view, [thing.model_dump() for thing in things], "none")
    carried = client.post("/api/carry", json={"ids": [5, 6, 7], "view": 4}).json()
    assert [(thing["id"], thing["origin"]) for thing in carried] == [(5, "proposed"), (6, "proposed")]
    found, part = (mask_of(thing["polygons"]) for thing in carried)
    assert iou(found, region_mask("mug", 4) | region_mask("handle", 4)) > 0.75
    assert iou(part, region_mask("handle", 4)) > 0.75 and not (part & ~found).any()
    saved = put(client, 4, carried, "none")
    assert saved.status_code == 200
    assert client.post("/api/carry", json={"ids": [5, 6], "view": 4}).json() == []  # they are there now


def test_files_that_cannot_be_imported_are_noted_beside_the_others(client):
    def file(name, *shapes):
        content = {
            "imagePath": f"{name}.jpg",
            "imageHeight": SIZE[0],
            "imageWidth": SIZE[1],
            "shapes": shapes,
        }
        return {"name": f"{name}.json", "text": json.dumps(content)}

    cup = {"label": "cup", "points": [[1, 1], [9, 1], [9, 9]]}
    point = {"label": "cup", "points": [[1, 1]], "shape_type": "point"}
    lost = file("IMG_9", cup)
    sent = client.post("/api/import", json={"files": [lost, file("002", cup, point)]}).json()
    assert (list(sent["views"]), sent["added"], sent["known"]) == (["2"], 1, 0)
    first, second = sent["notes"]
    assert "IMG_9.json does not match a photograph" in first and "1 without an area" in second
    alone = client.post("/api/import", json={"files": [lost]})
    assert alone.status_code == 422 and "does not match a photograph" in alone.json()["error"]


# -- a scene that is rebuilt ------------------------------------------------------------------------


def test_a_rewritten_tree_is_not_used_and_labels_of_rewritten_photographs_are_not_saved(own_desk, labels):
    client = opened(own_desk, labels)
    of = {"of": client.get("/api/scene").json()["of"]}
    assert client.get("/api/changes").json() == {**of, "changed": [], "labels": ["none"] * 6}
    pixel = {"view": 0, "x": 6, "y": 6}
    assert client.post("/api/at", json=pixel, params=of).status_code == 200
    write_again(own_desk / "default/semantic_tree")
    assert client.get("/api/changes").json() == {**of, "changed": ["semantic_tree"], "labels": ["none"] * 6}
    for path, sent in (("at", pixel), ("carry", {"ids": [1], "view": 1})):
        refused = client.post(f"/api/{path}", json=sent, params=of)
        assert refused.status_code == 409
        assert "semantic_tree of photos/desk changed on disk" in refused.json()["error"]
    assert put(client, 0, [MUG], "none").status_code == 200  # what is drawn on the same photographs is kept
    again = client.get("/api/scene").json()["of"]
    assert again != of["of"]
    assert client.post("/api/at", json=pixel, params={"of": again}).status_code == 200
    for path in ("photo/0", "thumb/0", "labels", "export/coco"):
        assert client.get(f"/api/{path}", params=of).status_code == 409
        assert client.get(f"/api/{path}", params={"of": again}).status_code == 200
    write_again(own_desk / "scene")
    assert put(client, 1, [MUG], "none").status_code == 409
    assert client.get("/api/photo/0").status_code == 409
    assert [path.name for path in labels.glob("*.json")] == ["000.json"]
    client.get("/api/scene")
    assert put(client, 1, [MUG], "none").status_code == 200
