"""Accessibility of both pages: axe-core's rules, the user's colours, large text."""

from pathlib import Path

import pytest

SERIOUS = ("serious", "critical")


def violations(page) -> list[str]:
    """What axe-core calls serious or worse, with the first elements."""
    import axe_playwright_python as axe  # of the extra that brings playwright: without it nothing gets here

    page.evaluate((Path(axe.__file__).parent / "axe.min.js").read_text(encoding="utf-8"))
    found = page.evaluate("axe.run(document, { resultTypes: ['violations'] })")["violations"]
    return [
        f"{each['id']}: {each['help']}: {[node['html'][:120] for node in each['nodes'][:4]]}"
        for each in found
        if each["impact"] in SERIOUS
    ]


@pytest.mark.parametrize(("scheme", "brightness"), [("dark", (0, 150)), ("light", (600, 765))])
def test_the_viewer_has_no_serious_violation_in_the_colours_of_the_user(
    opened, desk_address, scheme, brightness
):
    page = opened(desk_address, color_scheme=scheme)
    colour = page.evaluate("getComputedStyle(document.getElementById('panel')).backgroundColor")
    assert brightness[0] <= sum(int(value) for value in colour[4:-1].split(",")) <= brightness[1]
    assert violations(page) == []
    page.ask("mug > handle")
    page.answers().first.click()
    page.keyboard.press("x")
    page.keyboard.press("v")
    page.get_by_text("Scenes", exact=True).click()
    page.locator("#scene-list a").first.wait_for()
    page.locator("#save summary").click()
    assert violations(page) == []
    page.press("?")
    assert violations(page) == []


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_the_annotator_has_no_serious_violation(annotating, desk, scheme):
    label = {"id": 1, "level": 1, "parent": None, "text": "mug", "origin": "proposed"}
    label["polygons"] = [[[1, 1], [15, 1], [15, 20], [1, 20]]]
    page = annotating(desk, color_scheme=scheme)
    page.evaluate("(label) => hilsplat.store.change([[0, [label]]])", label)
    page.locator("#save summary").click()
    assert violations(page) == []


def test_the_chosen_level_is_visible_in_forced_colours(opened, desk_address):
    page = opened(desk_address, forced_colors="active")
    outlines = """[...document.querySelectorAll('#levels label')].map((label) => [
        label.querySelector('input').checked, getComputedStyle(label.querySelector('span')).outlineStyle])"""
    assert all((style == "solid") == checked for checked, style in page.evaluate(outlines))


def test_the_picture_and_controls_are_large_enough_with_large_text_and_on_a_phone(opened, desk_address):
    page = opened(desk_address, viewport={"width": 640, "height": 360})
    box = page.locator("#view").bounding_box()
    assert box["height"] > 250 and box["width"] > 300
    assert page.evaluate("document.documentElement.scrollWidth") <= 640
    page.locator("#save summary").click()
    menu = page.get_by_role("group", name="Save").bounding_box()
    assert menu["y"] + menu["height"] <= 360
    page.keyboard.press("Escape")
    assert page.phone_fits()
    low = """[...document.querySelectorAll('#tools select, #tools summary, #tools button, #views button')]
        .filter((each) => each.getBoundingClientRect().height > 0 && each.getBoundingClientRect().height < 24)
        .map((each) => each.id || each.textContent)"""
    assert page.evaluate(low) == []
