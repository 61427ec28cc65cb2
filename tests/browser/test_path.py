"""Cameras of the photographs in the view, and the camera path of films."""

import json

import numpy as np
import pytest

from hilsplat.scene.scene import Scene


def steps(page):
    return page.get_by_role("region", name="Camera path").get_by_role("listitem")


def places(page) -> list[str]:
    """Photographs whose cameras are the views of the path, in order."""
    return [step.locator("small").inner_text() for step in steps(page).all()]


def add(page, *photographs: str) -> None:
    for name in photographs:
        page.get_by_role("option", name=name).click()
        page.press("v")


@pytest.mark.parametrize("painter", ["gl", "server"])
def test_the_cameras_of_the_photographs_are_drawn_and_a_click_flies_there(
    opened, desk_address, desk, painter
):
    page = opened(desk_address, painter, viewport={"width": 1280, "height": 720})
    page.get_by_role("option", name="005.png").click()  # all other cameras are on its right
    page.locator("#view").focus()
    for _ in range(20):
        page.keyboard.press("-")
    page.keyboard.press("p")
    cameras = Scene.load(desk / "scene").cameras
    shown = page.locator("#overlay path.frustum")
    page.until(lambda: shown.count() == len(cameras))
    assert page.locator("#overlay path.test").count() == 1
    wire, view = page.wire_camera(), page.locator("#view").bounding_box()
    centre = np.array(wire["cam_from_world"]) @ [*cameras[cameras.names[4]].centre, 1]
    x, y, z = np.array(wire["K"]) @ centre[:3]
    apex = [float(value) for value in shown.nth(4).get_attribute("d").split("M")[-1].split("L")[0].split()]
    assert apex == pytest.approx((x / z, y / z), abs=0.1)
    rim = shown.nth(4).get_attribute("d")[1:].split("Z")[0].split("L")
    corners = np.array([[float(value) for value in corner.split()] for corner in rim])
    x, y = corners.mean(axis=0)
    page.mouse.click(view["x"] + x, view["y"] + y)
    page.until(lambda: page.evaluate("hilsplat.camera.view") == 4)
    page.get_by_role("button", name="cameras").click()
    page.until(lambda: shown.count() == 0)


def test_the_views_of_a_path_are_reordered_replaced_removed_and_kept(page):
    add(page, "000.png", "003.png", "001.png")
    assert places(page) == ["000.png", "003.png", "001.png"]
    page.get_by_role("button", name="Move view 3 up").click()
    assert places(page) == ["000.png", "001.png", "003.png"]
    steps(page).nth(0).drag_to(steps(page).nth(2))
    assert places(page) == ["001.png", "003.png", "000.png"]
    page.get_by_role("option", name="004.png").click()
    page.get_by_role("button", name="Replace view 2 by the current view").click()
    page.get_by_role("button", name="Remove view 3").click()
    assert places(page) == ["001.png", "004.png"]
    assert page.evaluate("document.activeElement.getAttribute('aria-label')") == "Remove view 2"
    steps(page).nth(0).get_by_title("Go to this view").click()
    page.until(lambda: page.evaluate("hilsplat.camera.view") == 1)

    def without_first(route):
        described = route.fetch().json()
        route.fulfill(json={**described, "views": described["views"][1:]})

    page.route("**/api/scene?**", without_first, times=1)  # the path follows its photographs
    page.reloaded()
    assert places(page) == ["001.png", "004.png"]
    page.get_by_role("button", name="Clear").click()
    page.reloaded()
    assert not steps(page).count()


def test_the_preview_shows_the_cameras_of_the_film_until_it_is_stopped(page):
    add(page, "000.png", "004.png")
    page.locator("#save summary").click()
    page.get_by_label("Length, s").fill("2")
    page.locator("#save summary").click()
    page.get_by_role("option", name="002.png").click()
    page.wait_for_timeout(300)
    before = page.wire_camera()
    page.evaluate("""() => {
        window.places = [];
        const look = () => {
            window.places.push([performance.now(), hilsplat.camera.c[0]]);
            requestAnimationFrame(look);
        };
        look();
    }""")
    page.get_by_role("button", name="Preview").click()
    page.get_by_role("button", name="Stop").wait_for()
    page.get_by_role("button", name="Preview").wait_for()
    shown = np.array(page.evaluate("window.places"))
    moving = np.flatnonzero(np.abs(np.diff(shown[:, 1])) > 1e-6)
    lasted = (shown[moving[-1], 0] - shown[moving[0], 0]) / 1000
    assert 1.5 < lasted < 3 and len(moving) > 8
    xs = shown[moving[0] + 1 : moving[-1] + 1, 1]  # the last is from the film's last camera
    assert (np.diff(xs) <= 1e-9).all() and np.ptp(xs) > 3  # from view 0 to view 4, never back
    assert page.wire_camera() == before
    page.late("api/path")
    with page.expect_response("**/api/path*"):
        page.get_by_role("button", name="Preview").click()
        page.get_by_role("button", name="Stop").click()
        assert page.get_by_role("button", name="Preview").is_visible()
    page.wait_for_timeout(300)
    assert page.wire_camera() == before


def test_a_path_is_saved_as_json_and_opened_again(page, tmp_path):
    add(page, "000.png", "004.png")
    with page.expect_download() as started:
        page.get_by_role("button", name="Save JSON").click()
    started.value.save_as(tmp_path / "path.json")
    content = json.loads((tmp_path / "path.json").read_text())
    assert (content["format"], content["scene"], content["frames"]) == ("hilsplat-path-1", "photos/desk", 120)
    page.get_by_role("button", name="Clear").click()
    page.locator("#path-file").set_input_files(tmp_path / "path.json")
    steps(page).nth(1).wait_for()
    page.drawn(steps(page).nth(1).get_by_title("Go to this view").click)
    np.testing.assert_allclose(page.wire_camera()["cam_from_world"], content["path"][1]["cam_from_world"])
    (tmp_path / "other.json").write_text(json.dumps({**content, "scene": "photos/other"}))
    page.locator("#path-file").set_input_files(tmp_path / "other.json")
    page.get_by_text("This path was saved for photos/other").wait_for()
    (tmp_path / "wrong.json").write_text("[1]")
    page.locator("#path-file").set_input_files(tmp_path / "wrong.json")
    page.get_by_text("wrong.json is not a camera path").wait_for()
    assert steps(page).count() == 2
