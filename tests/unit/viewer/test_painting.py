"""Frames and picks of the server against the pipeline's own rendering."""

import base64
import json

import cv2
import numpy as np
import pytest

from hilsplat.base.images import to_uint8
from hilsplat.base.levels import NONE
from hilsplat.splat.rasterise.api import draw, pixel_weights, render
from hilsplat.viewer.frames import GHOST, GREY, TINT, Paint, painted, pick
from hilsplat.viewer.wire import Style
from tests.unit.viewer.conftest import table, wire_camera


def test_a_frame_without_a_style_equals_the_pipeline(shown, client, camera):
    expected = to_uint8(render(shown.gaussians, camera).colours)
    np.testing.assert_array_equal(painted(shown.gaussians, camera), expected)
    sent = client.post("/api/frame", json={"camera": wire_camera(camera), "image": "png"})
    assert sent.headers["content-type"] == "image/png"
    got = cv2.imdecode(np.frombuffer(sent.content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    np.testing.assert_array_equal(got, expected)


def test_the_finest_used_level_with_a_colour_decides(shown, scene):
    nodes = scene.tree.node_of_gaussian
    whole, part = nodes[nodes[:, 1] >= 0][0, :2]
    colours = {whole: (255, 0, 0, 255), part: (0, 0, 255, 51)}
    style = Style(table=table(shown, colours), mode="tint")
    paint = Paint.of(style, nodes, len(scene.tree))
    inside_part, only_whole = nodes[:, 1] == part, (nodes[:, 0] == whole) & (nodes[:, 1] != part)
    assert np.allclose(paint.rgb[inside_part], (0, 0, 1)) and np.allclose(paint.share[inside_part], 0.2)
    assert np.allclose(paint.rgb[only_whole], (1, 0, 0)) and np.allclose(paint.share[only_whole], 1)
    assert not paint.share[nodes[:, 0] != whole].any()
    coarse = Paint.of(style.model_copy(update={"use": (True, False, False)}), nodes, len(scene.tree))
    assert np.allclose(coarse.rgb[nodes[:, 0] == whole], (1, 0, 0))


@pytest.mark.parametrize("mode", ["plain", "tint", "ghost", "isolate"])
def test_unselected_gaussians_are_unchanged_grey_faint_or_hidden(shown, scene, camera, mode):
    nodes = scene.tree.node_of_gaussian
    whole = int(nodes[0, 0])
    style = Style(table=table(shown, {whole: (0, 255, 0, 255)}), mode=mode)
    frame = painted(shown.gaussians, camera, Paint.of(style, nodes, len(scene.tree)))
    chosen = (nodes[:, 0] == whole).astype(np.float32)
    own = draw(shown.gaussians, camera, 0, features=np.stack([chosen, 1 - chosen], axis=1)).image
    plain = render(shown.gaussians, camera).colours
    inside, outside = own[..., 3] > 0.95, own[..., 4] > 0.95
    assert inside.any() and outside.any()
    assert np.abs(frame[inside].astype(int) - (0, 255, 0)).max() <= 0.06 * 255
    expected = {
        "plain": plain,
        "tint": np.repeat((TINT * (plain @ GREY))[..., None], 3, axis=2),
        "isolate": np.zeros_like(plain),
    }
    if mode in expected:
        assert np.abs(frame[outside] / 255 - expected[mode][outside]).max() < 0.08
    else:
        assert 0 < frame[outside].mean() < 3 * GHOST * 255 * plain[outside].mean()


def test_a_pick_returns_the_nodes_with_the_largest_shares_and_the_point(shown, scene, client, camera):
    every = pixel_weights(shown.gaussians, camera, min_weight=0.0)
    height, width = camera.size_hw
    for x, y in np.random.default_rng(3).integers(0, (width, height), (40, 2)).tolist():
        row = every[y * width + x].toarray()[0]
        sent = {"camera": wire_camera(camera), "x": x + 0.4, "y": y + 0.7}
        found = client.post("/api/pick", json=sent).json()
        if row.sum() < 0.049:
            assert found["nodes"] == []
            continue
        assert found["alpha"] == pytest.approx(row.sum(), abs=1e-4)
        np.testing.assert_allclose(found["point"], row @ shown.gaussians.means / row.sum(), atol=1e-3)
        for own, (node, share) in zip(scene.tree.node_of_gaussian.T, found["nodes"], strict=True):
            shares = np.bincount(own + 1, row)
            shares[0] = 0  # Gaussians without a node
            assert node == (shares.argmax() - 1 if shares.any() else NONE)
            assert share == pytest.approx(shares.max() / row.sum(), abs=1e-4)
    for x, y in ((-1.0, 3.0), (float(width), 3.0), (3.0, float(height))):
        assert pick(shown.gaussians, None, camera, x, y) is None


@pytest.mark.parametrize(
    "change",
    [
        {"size_hw": [5000, 5]},
        {"K": np.diag([np.nan, 1, 1]).tolist()},
        {"cam_from_world": np.diag([-1.0, 1, 1, 1]).tolist()},
    ],
)
def test_invalid_cameras_are_refused(client, camera, change):
    body = json.dumps({"camera": {**wire_camera(camera), **change}})
    sent = client.post("/api/frame", content=body, headers={"content-type": "application/json"})
    assert sent.status_code in (400, 422) and sent.json()["error"]


@pytest.mark.parametrize(
    ("style", "status", "message"),
    [
        ({"table": "AAAA"}, 422, "reload the page"),
        ({"table": "not base64!"}, 422, "reload the page"),
        ({"ramp": base64.b64encode(bytes(768)).decode()}, 422, "empty text"),
    ],
)
def test_invalid_styles_are_refused(client, camera, style, status, message):
    sent = client.post("/api/frame", json={"camera": wire_camera(camera), "style": style})
    assert sent.status_code == status and message in sent.json()["error"]


def test_a_frame_shows_relevancy_to_its_own_text_despite_queries_of_other_pages(shown, client, camera):
    ramp = base64.b64encode(np.repeat(np.arange(256, dtype=np.uint8), 3).tobytes()).decode()

    def frame(text: str) -> bytes:
        style = {"ramp": ramp, "text": text, "level": "whole"}
        body = {"camera": wire_camera(camera), "image": "png", "style": style}
        return client.post("/api/frame", json=body).content

    mug, book = frame("mug"), frame("book")
    assert mug != book
    client.post("/api/field", json={"text": "book", "level": "whole"})  # another page, painted by WebGL
    assert frame("mug") == mug
    for number in range(12):  # more than are kept
        client.post("/api/field", json={"text": f"text {number}", "level": "whole"})
    assert frame("mug") == mug
