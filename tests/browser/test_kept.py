"""Several queries at once, files of them, and films along a path of the user's own."""

import json
import re

import av

from tests.browser.conftest import answers, ask, ask_and_wait, chips, drawn, keep, pixels, save


def greenish(page) -> float:
    """Share of the picture in the colour of the first kept query."""
    page.wait_for_timeout(500)
    picture = pixels(page).astype(int)
    return float(((picture[..., 1] - picture[..., 0] > 60) & (picture[..., 2] > 60)).mean())


def test_kept_queries_have_colours_and_can_be_hidden_and_dropped(opened, desk_address, scene):
    page = opened(desk_address)
    keep(page, "book")
    keep(page, "mug > handle")
    assert page.evaluate("document.activeElement.id") == "text" and not answers(page).count()
    assert [chip.inner_text().split("\n")[0] for chip in chips(page).all()] == ["book", "mug > handle"]
    (book,), (handle,) = scene.query("book"), scene.query("mug > handle")
    painted = {int(path.get_attribute("data-node")) for path in page.locator("#overlay path.kept").all()}
    assert painted == {book.node, handle.node}
    assert greenish(page) > 0.02
    drawn(page, page.get_by_role("button", name="Show book").click)
    assert page.get_by_role("button", name="Show book").get_attribute("aria-pressed") == "false"
    assert greenish(page) < 0.005
    page.get_by_role("button", name="Remove book").click()
    assert chips(page).count() == 1


def test_the_overlap_of_two_queries_is_reported(opened, desk_address):
    page = opened(desk_address)
    keep(page, "mug")
    ask(page, "mug > handle")
    page.get_by_text("1 answer inside an answer to another query.").wait_for()
    ask(page, "mug")
    page.get_by_text("White: 1 node found by several queries.").wait_for()
    page.locator("#overlay text", has_text=re.compile(r"^mug \+ ")).wait_for()


def test_a_kept_query_is_edited_with_its_threshold_at_its_photograph(opened, desk_address):
    page = opened(desk_address)
    options = [
        page.get_by_role("checkbox", name=name) for name in ("score at least", "only what this photograph")
    ]
    for option in options:
        option.check()
    page.get_by_label("Minimum score").fill("0.3")
    view = page.evaluate("hilsplat.camera.view")
    keep(page, "book")
    assert "score at least 0.30" in chips(page).first.inner_text()
    for option in options:
        option.uncheck()
    page.locator("#view").focus()
    drawn(page, lambda: page.keyboard.press("ArrowLeft"))
    chips(page).first.get_by_title("Edit").click()
    answers(page).first.wait_for()
    assert page.locator("#text").input_value() == "book" and not chips(page).count()
    assert all(option.is_checked() for option in options)
    assert page.evaluate("hilsplat.camera.view") == view


def test_kept_queries_are_saved_together(opened, desk_address, scene, tmp_path):
    page = opened(desk_address)
    keep(page, "book")
    ask_and_wait(page, "mug > handle")
    (book,), (handle,) = scene.query("book"), scene.query("mug > handle")
    boxes = json.loads(save(page, "Boxes, JSON", tmp_path / "boxes.json").read_text())["boxes"]
    found = [(box["group"], box["node"]) for box in boxes]
    assert found == [("book", book.node), ("mug > handle", handle.node)]
    size = save(page, "Masks in all photographs", tmp_path / "masks.zip").stat().st_size
    page.get_by_role("status").get_by_text(f"Saved desk-masks.zip, {-(-size // 1000)} kB.").wait_for()
    assert page.locator("#saving").is_hidden()


def test_a_film_follows_the_path_of_the_user(opened, desk_address, tmp_path):
    page = opened(desk_address, "server")
    page.locator("#view").focus()
    page.keyboard.press("v")
    page.get_by_text("The path begins here").wait_for()
    page.get_by_role("option", name="003.png").click()
    page.locator("#view").focus()
    page.keyboard.press("v")
    page.get_by_text("2 views in the path").wait_for()
    film = save(page, "Film, MP4", tmp_path / "film.mp4")
    with av.open(str(film)) as frames:
        assert sum(1 for _ in frames.decode(video=0)) == 120
    page.locator("#save summary").click()
    assert page.locator("#path").input_value() == "path"
    page.locator("#path").select_option("around")
    page.get_by_role("button", name="Clear").click()
    assert page.locator("#path").input_value() == "around"
