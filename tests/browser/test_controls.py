"""Camera, history, pending pictures and refused queries of the viewer."""

import numpy as np
import pytest

from tests.browser.conftest import answers, ask, ask_and_wait, wire_camera


def distance(page) -> float:
    """From the camera to what it orbits about."""
    return page.evaluate("Math.hypot(...hilsplat.camera.c.map((v, k) => v - hilsplat.camera.target[k]))")


def test_a_refused_query_removes_the_previous_answers(opened, desk_address):
    opened.expected.append("422")
    page = opened(desk_address)
    ask_and_wait(page, "mug > handle")
    ask(page, "mug > ")
    page.locator("#status.error").wait_for()
    assert not answers(page).count() and not page.locator("#overlay path.answer").count()
    assert page.evaluate("hilsplat.painted()[0].style.table.every((value) => value === 0)")


def test_zooming_out_is_limited_and_home_returns_to_the_start(opened, desk_address):
    page = opened(desk_address)
    begun = wire_camera(page)
    page.locator("#view").focus()
    for _ in range(120):
        page.keyboard.press("-")
    far = distance(page)
    assert far <= 20.01 * page.evaluate("hilsplat.camera.reach")
    page.keyboard.press("-")
    assert distance(page) == pytest.approx(far)
    page.keyboard.press("Home")
    page.wait_for_timeout(300)
    np.testing.assert_allclose(wire_camera(page)["cam_from_world"], begun["cam_from_world"])


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


def test_back_returns_to_the_previous_query(opened, desk_address):
    page = opened(desk_address)
    page.wait_for_timeout(800)
    for text in ("mug > handle", "book"):
        ask_and_wait(page, text)
        page.wait_for_timeout(1200)  # until the address is updated
    page.go_back()
    page.wait_for_function("document.getElementById('text').value === 'mug > handle'")
    answers(page).first.wait_for()
    page.wait_for_timeout(1000)
    page.go_forward()
    page.wait_for_function("document.getElementById('text').value === 'book'")
    page.wait_for_timeout(1000)
    page.go_back()
    page.wait_for_timeout(1000)
    page.go_back()
    page.wait_for_function("document.getElementById('text').value === ''")
    assert not answers(page).count()


@pytest.mark.parametrize(("painter", "colour"), [("gl", "relevancy"), ("gl", "field"), ("server", "field")])
def test_a_threshold_cuts_the_colours_and_counts_the_gaussians_above(opened, desk_address, painter, colour):
    page = opened(desk_address, painter)
    ask_and_wait(page, "mug")
    page.locator("#colour").select_option(colour)
    scale = page.get_by_role("group", name="Colours of relevancy")
    scale.wait_for()
    assert scale.inner_text().split() == page.evaluate(
        "[hilsplat.painted()[0].style.low, hilsplat.painted()[0].style.high].map((value) => value.toFixed(2))"
    )
    counts = []
    page.get_by_label("score at least").check()
    for least in ("0.5", "0.9"):
        page.get_by_role("slider", name="Minimum score").fill(least)
        page.wait_for_timeout(800)
        counts.append(int(scale.inner_text().split()[2].replace(",", "")))
    assert counts == [24 * 16, 0]  # the mug's, whose score is 0.79
    assert "least=0.9" in page.url
