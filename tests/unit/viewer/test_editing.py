"""Selection and removal of Gaussians by the page, and the files without them."""

import base64
import io
import zipfile
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData

from hilsplat.scene.cameras import Camera
from hilsplat.splat.coordinates import source_comments
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import render
from hilsplat.viewer.frames import within
from hilsplat.viewer.viewer_scene import ViewerScene
from tests.unit.artifact_changes import loosen
from tests.unit.finished_desk import SCENE
from tests.unit.splat.spz_reader import decoded
from tests.unit.viewer.conftest import browsing, in_steps, table, wire_camera


def bits(shown, marked: np.ndarray) -> str:
    """Marks of Gaussians in file order, as the page sends them."""
    return base64.b64encode(np.packbits(marked[shown.order], bitorder="little").tobytes()).decode()


def marked(shown, content: bytes) -> np.ndarray:
    """Which Gaussians, in file order, have a bit that the server sent."""
    values = np.unpackbits(np.frombuffer(content, np.uint8), count=len(shown.order), bitorder="little")
    found = np.zeros(len(shown.order), bool)
    found[shown.order] = values
    return found


@pytest.fixture
def left(shown) -> np.ndarray:
    """The left half of the desk."""
    return shown.gaussians.means[:, 0] < 18


def test_a_rectangle_selects_the_visible_gaussians_whose_centres_are_in_it(shown, scene, client, camera):
    region = {"camera": wire_camera(camera), "points": [(20.5, 3), (4, 12.5)]}
    found = marked(shown, client.post("/api/within", json=region).content)
    x, y, _ = shown.gaussians.means.T  # the camera shows Gaussian (x, y) at pixel (x + 1, y)
    np.testing.assert_array_equal(found, (x + 1 >= 4) & (x + 1 <= 20) & (y >= 3) & (y <= 12))
    style = {"table": table(shown, {0: (255, 255, 255, 255)}), "mode": "isolate"}
    region = {"camera": wire_camera(camera), "points": [(0, 0), (42, 24)], "style": style}
    found = marked(shown, client.post("/api/within", json=region).content)
    np.testing.assert_array_equal(found, (scene.tree.node_of_gaussian == 0).any(axis=1))


def test_a_stroke_selects_what_is_within_its_radius():
    rng = np.random.default_rng(0)
    K = np.array([[200.0, 0, 150], [0, 180, 100], [0, 0, 1]])
    camera = Camera("view", np.eye(4), K, (200, 300))
    means = rng.uniform((-2, -2, -1), (2, 2, 3), (4000, 3)).astype(np.float32)
    points, radius = [(40.2, 50.7), (200.0, 90.4), (210.0, 160.0)], 17.3
    found = within(means, camera, points, radius)
    ahead = means[:, 2] > 0.01
    with np.errstate(divide="ignore"):
        x, y = 200 * means[:, 0] / means[:, 2] + 150, 180 * means[:, 1] / means[:, 2] + 100
    distance = np.full(len(means), np.inf)
    for (ax, ay), (bx, by) in pairwise(points):
        along = np.array([bx - ax, by - ay])
        t = np.clip(((x - ax) * along[0] + (y - ay) * along[1]) / (along @ along), 0, 1)
        distance = np.minimum(distance, np.hypot(x - ax - t * along[0], y - ay - t * along[1]))
    in_picture = ahead & (x >= 0) & (x < 300) & (y >= 0) & (y < 200)
    clear = np.abs(distance - radius) > 1.5  # the region is drawn in whole pixels
    np.testing.assert_array_equal(found[clear], (in_picture & (distance < radius))[clear])
    assert found.sum() > 50 and clear.mean() > 0.8
    (single,) = np.flatnonzero(within(np.array([[0, 0, 1]], np.float32), camera, [(152.0, 101.0)], 4.0))
    assert single == 0


def test_nodes_select_their_gaussians(shown, scene, client):
    (mug,), (handle,) = scene.query("mug", "whole"), scene.query("mug > handle")
    found = marked(shown, client.post("/api/members", json={"nodes": [handle.node]}).content)
    np.testing.assert_array_equal(np.flatnonzero(found), scene.views.gaussians_of([handle.node]))
    both = marked(shown, client.post("/api/members", json={"nodes": [mug.node, handle.node]}).content)
    assert both.sum() > found.sum()
    assert client.post("/api/members", json={"nodes": [99]}).status_code == 422


def test_gaussians_of_no_node_are_selected(own_desk):
    loosen(own_desk, np.arange(100, 140))
    shown = ViewerScene(own_desk)
    with browsing(shown) as client:
        found = marked(shown, client.post("/api/members", json={"loose": True}).content)
    np.testing.assert_array_equal(np.flatnonzero(found), np.arange(100, 140))


def frame(client, camera, **more) -> np.ndarray:
    sent = client.post("/api/frame", json={"camera": wire_camera(camera), "image": "png", **more})
    return cv2.imdecode(np.frombuffer(sent.content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def test_pictures_picks_and_films_leave_out_removed_gaussians(shown, client, camera, left, tmp_path):
    removed = bits(shown, left)
    (tmp_path / "right.ply").write_bytes(
        client.post("/api/export/scene-ply", json={"removed": removed}).content
    )
    expected = np.rint(255 * np.clip(render(load_ply(tmp_path / "right.ply"), camera).colours, 0, 1))
    np.testing.assert_allclose(frame(client, camera, removed=removed), expected, atol=1)
    pick = {"camera": wire_camera(camera), "x": 8.5, "y": 8.5}
    assert client.post("/api/pick", json=pick).json()["alpha"] > 0.9
    assert client.post("/api/pick", json={**pick, "removed": removed}).json()["alpha"] == 0
    path = [wire_camera(camera)] * 2
    sizes = [
        len(in_steps(client, "film", frames=4, side_px=64, path=path, **more)[1])
        for more in ({}, {"removed": bits(shown, np.arange(len(left)) > 0)})
    ]
    assert sizes[1] < 0.8 * sizes[0]  # one Gaussian remains


def test_a_pick_ignores_what_the_style_hides(shown, scene, client, camera):
    (book,) = scene.query("book")
    of_book = table(shown, {book.node: (255, 255, 255, 255)})
    for mode, is_shown in (("isolate", False), ("tint", True), ("ghost", True)):
        style = {"table": of_book, "mode": mode}
        sent = {"camera": wire_camera(camera), "x": 8.5, "y": 8.5, "style": style}
        assert (client.post("/api/pick", json=sent).json()["alpha"] > 0.9) == is_shown  # of the mug
        assert client.post("/api/pick", json={**sent, "x": 24.5}).json()["alpha"] > 0.9
    wide = {"camera": wire_camera(camera.scaled((24, 5000))), "x": 24.5 * 5000 / 42, "y": 8.5}
    assert client.post("/api/pick", json=wide).json()["alpha"] > 0.9  # of a screen that is 5120 px wide


def test_saved_masks_leave_out_removed_gaussians(shown, scene, client, left):
    (book,) = scene.query("book", "whole")
    groups = [{"name": "book", "nodes": [book.node]}]
    _, data = in_steps(client, "masks", groups=groups, removed=bits(shown, left))
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        for shift, view in enumerate(scene.views.names):
            mask = np.array(Image.open(archive.open(f"masks/{Path(view).stem}/{book.node}.png")))
            whole = book.mask(view)
            assert whole[:, : 17 + shift].any() and not mask[:, : 17 + shift].any()
            np.testing.assert_array_equal(mask[:, 19 + shift :], whole[:, 19 + shift :])


def test_selected_gaussians_have_their_colour_in_frames(shown, client, camera, left):
    plain = frame(client, camera).astype(int)
    found = frame(client, camera, style={"marked": bits(shown, left)}).astype(int)
    expected = 0.3 * plain[8, 6] + 0.7 * np.array([255, 0, 160])
    np.testing.assert_allclose(found[8, 6], expected, atol=12)
    np.testing.assert_array_equal(found[:, 26:], plain[:, 26:])


def test_the_cleaned_scene_has_the_values_of_the_scene_and_its_files_do_not_change(
    shown, client, left, desk_project
):
    ply = desk_project / SCENE / "gaussians.ply"
    before = ply.read_bytes()
    sent = client.post("/api/export/scene-ply", json={"removed": bits(shown, left)})
    vertex = PlyData.read(io.BytesIO(sent.content))["vertex"].data
    np.testing.assert_array_equal(vertex, PlyData.read(ply)["vertex"].data[~left])
    content = client.post("/api/export/scene-ply", json={}).content
    line = f"comment {source_comments(ply)[0]}\n".encode()  # the coordinates; the rest are the file's bytes
    assert content.replace(line, b"", 1) == before != content
    compressed = decoded(client.post("/api/export/scene-spz", json={"removed": bits(shown, left)}).content)
    assert len(compressed) == (~left).sum() and compressed.means[:, 0].min() > 17.9
    assert ply.read_bytes() == before


def test_selections_and_pages_leave_out_removed_gaussians_and_wrong_marks_are_refused(
    shown, scene, client, left
):
    (mug,) = scene.query("mug", "whole")
    rows = scene.views.gaussians_of([mug.node])
    removed = shown.gaussians.means[:, 0] < 5
    sent = {"groups": [{"name": "mug", "nodes": [mug.node]}], "removed": bits(shown, removed)}
    vertex = PlyData.read(io.BytesIO(client.post("/api/export/ply", json=sent).content))["vertex"]
    np.testing.assert_array_equal(vertex["x"], shown.gaussians.means[rows[~removed[rows]], 0])
    assert len(decoded(client.post("/api/export/spz", json=sent).content)) == len(vertex)
    gone = {**sent, "removed": bits(shown, left)}
    assert client.post("/api/export/ply", json=gone).status_code == 422  # the mug is on the left
    _, page = in_steps(client, "page", removed=bits(shown, left))
    assert f'"gaussians":{(~left).sum()},'.encode() in page
    for removed in ("AAAA", "?", bits(shown, np.ones(len(shown.order), bool))):
        refused = client.post("/api/export/scene-ply", json={"removed": removed})
        assert refused.status_code == 422
    assert "every Gaussian is removed" in refused.json()["error"]
