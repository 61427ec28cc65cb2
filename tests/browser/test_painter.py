"""Both painters of the page, compared with the pipeline."""

import io

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.images import to_uint8
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import render
from hilsplat.splat.spz import fractional_bits, spz_bytes
from hilsplat.viewer.frames import Paint, faded, painted, within
from hilsplat.viewer.wire import WireCamera
from tests.unit.splat.spz_reader import decoded


def psnr(found: np.ndarray, expected: np.ndarray) -> float:
    error = np.square(found.astype(float) - expected.astype(float)).mean()
    return float(10 * np.log10(255**2 / max(error, 1e-9)))


def rendered(gaussians: Gaussians, page) -> np.ndarray:
    camera = WireCamera.model_validate(page.wire_camera()).camera()
    return to_uint8(render(gaussians, camera).colours)


def test_webgl_equals_the_pipeline_on_the_same_bytes(opened, cloud, cloud_address):
    page = opened(cloud_address)
    gaussians = load_ply(cloud / "gaussians.ply")
    sent = decoded(spz_bytes(gaussians, np.arange(len(gaussians)), fractional_bits(gaussians)))
    for keys in ((), ("ArrowLeft", "ArrowLeft", "ArrowUp"), ("+",) * 9, ("w",) * 9):
        for key in keys:
            page.locator("#view").focus()
            page.drawn(lambda key=key: page.keyboard.press(key))
        page.wait_for_timeout(400)
        found, expected = page.pixels(), rendered(sent, page)
        assert expected.std() > 20
        assert psnr(found, expected) > 40, keys


def test_the_server_painter_equals_the_pipeline(opened, cloud, cloud_address):
    page = opened(cloud_address, "server")
    assert page.locator("#view").get_attribute("data-painter") == "server"
    read = """(() => { const c = document.querySelector('#view canvas');
        return [c.width, c.height, ...c.getContext('2d').getImageData(0, 0, c.width, c.height).data]; })()"""
    width, height, *values = page.evaluate(read)
    found = np.array(values, np.uint8).reshape(height, width, 4)[..., :3]
    assert psnr(found, rendered(load_ply(cloud / "gaussians.ply"), page)) > 30


def test_an_unfinished_scene_is_reported_and_not_redrawn_without_a_change(opened, cloud_address):
    page = opened(cloud_address, "")
    view = page.locator("#view")
    assert "llvmpipe" in view.get_attribute("data-gl")
    assert view.get_attribute("data-painter") == "server"  # because WebGL runs in software
    assert "The run is not finished" in page.get_by_role("status").inner_text()
    assert not page.get_by_role("tree").is_visible()
    page.wait_for_timeout(1000)
    before = view.get_attribute("data-drawn")
    page.wait_for_timeout(1500)
    assert view.get_attribute("data-drawn") == before


@pytest.mark.parametrize("painter", ["gl", "server"])
def test_a_photograph_is_aligned_with_its_view(opened, desk_address, painter):
    page = opened(desk_address, painter)
    page.get_by_role("option", name="003.png").click()
    page.get_by_role("button", name="photo", exact=True).click()
    box = page.locator("#photo").bounding_box()
    wire, view = page.wire_camera(), page.locator("#view").bounding_box()
    # the frame of the photograph, from the camera alone: its corners are pixel (0, 0) and (42, 24)
    scale = wire["K"][0][0] / 30.0
    left, top = wire["K"][0][2] - 0.5 * scale, wire["K"][1][2] - 0.5 * scale
    found = (box["x"] - view["x"], box["y"] - view["y"], box["width"], box["height"])
    np.testing.assert_allclose(found, (left, top, 42 * scale, 24 * scale), atol=0.6)


@pytest.mark.parametrize("painter", ["gl", "server"])
def test_selected_and_removed_gaussians_are_shown_by_both_painters(opened, cloud, cloud_address, painter):
    page = opened(cloud_address, painter)
    gaussians = load_ply(cloud / "gaussians.ply")
    page.press("x")
    page.keyboard.press("b")
    page.wait_for_timeout(600)
    view = page.locator("#view").bounding_box()
    camera = WireCamera.model_validate(page.wire_camera()).camera()
    found = []
    for left, right in ((90.0, 180.0), (200.0, 330.0)):
        page.drag((view["x"] + left, view["y"] + 100), (view["x"] + right, view["y"] + 190))
        found.append(within(gaussians.means, camera, [(left, 100.0), (right, 190.0)], 0.0))
        if len(found) == 1:
            page.keyboard.press("Delete")
    removed, selected = found
    told = f"{selected.sum():,} selected, {removed.sum():,} removed"
    page.until(lambda: told in page.locator("#edit-told").inner_text())
    page.wait_for_timeout(800)
    assert removed.sum() > 100 < selected.sum()
    paint = Paint.plain(len(gaussians)).marking(selected)
    expected = painted(faded(gaussians, ~removed), camera, paint)
    picture = Image.open(io.BytesIO(page.locator("#view > canvas").screenshot())).convert("RGB")
    assert psnr(expected, painted(gaussians, camera)) < 20
    visible = np.s_[120:200]  # neither the tools nor the scale cover these rows
    assert psnr(np.asarray(picture)[visible], expected[visible]) > 30


def test_the_server_renders_a_picture_of_a_large_screen(opened, desk_address, tmp_path):
    page = opened(desk_address, "server", viewport={"width": 2500, "height": 500}, device_scale_factor=2)
    box = page.locator("#view").bounding_box()
    width, height = Image.open(page.save("Picture, PNG", tmp_path / "picture.png")).size
    assert 2 * box["width"] > width == 4096  # the largest that the server renders
    assert height == pytest.approx(box["height"] * width / box["width"], abs=1)


def test_the_server_renders_once_the_graphics_card_is_lost(page):
    view = page.locator("#view")
    page.drawn(lambda: page.evaluate("hilsplat.painter.gl.getExtension('WEBGL_lose_context').loseContext()"))
    page.get_by_role("status").get_by_text("the server renders the scene").wait_for()
    assert view.get_attribute("data-painter") == "server" and page.locator("#view > canvas").count() == 1
    page.ask_and_wait("mug > handle")
