"""Camera, labels, history, pending pictures and refused queries of the viewer."""

import re
from urllib.parse import quote_plus

import numpy as np
import pytest


def distance(page) -> float:
    """From the camera to what it orbits about."""
    return page.evaluate("Math.hypot(...hilsplat.camera.c.map((v, k) => v - hilsplat.camera.target[k]))")


def test_a_refused_query_removes_the_previous_answers(page, opened):
    opened.expected.append("422")
    page.ask_and_wait("mug > handle")
    page.ask("mug > ")
    page.locator("#status.error").wait_for()
    assert not page.answers().count() and not page.locator("#overlay path.answer").count()
    assert page.evaluate("hilsplat.painted()[0].style.table.every((value) => value === 0)")


def test_zooming_out_is_limited_and_home_returns_to_the_start(page):
    begun = page.wire_camera()
    page.locator("#view").focus()
    for _ in range(120):
        page.keyboard.press("-")
    far = distance(page)
    assert far <= 20.01 * page.evaluate("hilsplat.camera.reach")
    page.keyboard.press("-")
    assert distance(page) == pytest.approx(far)
    page.keyboard.press("Home")
    page.until(lambda: np.allclose(page.wire_camera()["cam_from_world"], begun["cam_from_world"]))


def test_a_held_key_moves_evenly(opened, desk_address):
    page = opened(desk_address, reduced_motion="no-preference")
    page.locator("#view").focus()
    page.evaluate("""() => {
        window.places = [];
        const look = () => { window.places.push(hilsplat.camera.c.slice()); requestAnimationFrame(look); };
        look();
    }""")
    page.keyboard.down("d")
    page.wait_for_timeout(900)
    page.keyboard.up("d")
    places = np.array(page.evaluate("window.places"))
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    moved = np.flatnonzero(steps > 0)
    assert len(moved) > 5 and steps.max() < 0.4 * steps.sum()  # the keyboard repeats no key here
    page.wait_for_timeout(800)
    before = page.evaluate("hilsplat.camera.c")
    page.wait_for_timeout(300)
    assert page.evaluate("hilsplat.camera.c") == before


def test_back_returns_to_the_previous_query(page):
    page.until(lambda: "#" in page.url)
    for text in ("mug > handle", "book"):
        page.ask_and_wait(text)
        page.until(lambda text=text: f"q={quote_plus(text)}" in page.url)
    for go, text in (
        (page.go_back, "mug > handle"),
        (page.go_forward, "book"),
        (page.go_back, "mug > handle"),
        (page.go_back, ""),
    ):
        go()
        page.wait_for_function("(text) => document.getElementById('text').value === text", arg=text)
        page.until(lambda text=text: page.answers().count() == bool(text))


@pytest.mark.parametrize(("painter", "colour"), [("gl", "relevancy"), ("gl", "field"), ("server", "field")])
def test_a_threshold_cuts_the_colours_and_counts_the_gaussians_above(opened, desk_address, painter, colour):
    page = opened(desk_address, painter)
    page.ask_and_wait("mug")
    page.locator("#colour").select_option(colour)
    scale = page.get_by_role("group", name="Colours of relevancy")
    scale.wait_for()
    assert scale.inner_text().split() == page.evaluate(
        "[hilsplat.painted()[0].style.low, hilsplat.painted()[0].style.high].map((value) => value.toFixed(2))"
    )
    page.get_by_label("score at least").check()
    for least, count in (("0.5", 24 * 16), ("0.9", 0)):  # the mug's, whose score is 0.79
        page.get_by_role("slider", name="Minimum score").fill(least)
        page.until(lambda count=count: scale.inner_text().split()[2:3] == [str(count)])
    page.until(lambda: "least=0.9" in page.url)


def test_another_scene_opens_on_the_same_server(three_scenes, served):
    page = served(three_scenes / "photos/desk")
    page.get_by_text("Scenes", exact=True).click()
    scenes = page.locator("#scene-list li")
    scenes.nth(2).wait_for()
    assert [scene.inner_text().split("\n")[0] for scene in scenes.all()] == [
        *("photos/desk", "photos/other", "photos/posed")
    ]
    assert "tree, field" in scenes.nth(1).inner_text() and "poses" in scenes.nth(2).inner_text()
    assert scenes.nth(0).locator("a").get_attribute("aria-current") == "page"
    origin = page.url.partition("/?")[0]
    with page.expect_request(f"{origin}/api/scene?*scene=photos%2Fother*"):
        scenes.nth(1).locator("a").click()
    page.locator("body[data-ready=yes]").wait_for()
    page.ask_and_wait("mug")
    page.until(lambda: "q=mug" in page.url)
    assert page.url.startswith(origin) and "scene=photos%2Fother" in page.url
    page.get_by_text("Scenes", exact=True).click()
    scenes.nth(1).wait_for()
    assert scenes.nth(1).locator("a").get_attribute("aria-current") == "page"
    assert scenes.nth(2).locator("a").get_attribute("href") is None


def test_two_fingers_do_not_choose_a_node(opened, desk_address):
    page = opened(desk_address, has_touch=True)
    ((x, y),) = page.on_page((6, 6, 0))
    fingers = page.context.new_cdp_session(page.page)
    for kind, count in (("Start", 1), ("Start", 2), ("End", 1), ("End", 0)):
        points = [{"x": x + 40 * number, "y": y} for number in range(count)]
        fingers.send("Input.dispatchTouchEvent", {"type": f"touch{kind}", "touchPoints": points})
    page.wait_for_timeout(500)
    assert not page.get_by_role("region", name="Chosen node").is_visible()


def test_a_box_beside_the_picture_has_no_label_and_labels_stay_clear_of_the_tools(opened, desk_address):
    page = opened(desk_address, "server")
    page.ask("mug > handle")
    label = page.locator("#overlay text")
    label.first.wait_for(state="attached")
    tools = page.locator("#tools").bounding_box()
    for _ in range(40):
        page.evaluate("hilsplat.camera.move(0, 3, 0); hilsplat.redraw()")  # until the box leaves the picture
        page.wait_for_timeout(100)
        top = page.evaluate("document.querySelector('#overlay text')?.getBoundingClientRect().toJSON()")
        if top is None:
            break
        assert top["y"] + top["height"] > tools["y"] + tools["height"]
    page.wait_for_function("!document.querySelector('#overlay text')")  # the last picture may be on its way


def test_a_flight_ends_with_the_whole_node_in_view_and_no_node_hovered(opened, desk_address, scene):
    page = opened(desk_address, "server")
    for text in ("mug", "mug > handle"):
        page.choose_row(scene.query(text)[0].node)
        page.locator("[role=treeitem] > .row .label").last.hover()
        page.locator("#overlay path.hover").first.wait_for(state="attached")
        page.press("f")
        page.locator("#overlay path.hover").first.wait_for(state="detached")
        page.wait_for_timeout(1500)
        box = page.locator("#overlay path.chosen")
        box.wait_for(state="attached")
        places = np.array(re.findall(r"[-\d.]+", box.get_attribute("d")), float).reshape(-1, 2)
        wire = page.wire_camera()
        middle, half = np.array(wire["K"])[:2, 2], np.array(wire["size_hw"])[::-1] / 2
        assert (np.abs(places - middle) < half).all() and np.ptp(places, axis=0).max() > 0.3 * half.min()
