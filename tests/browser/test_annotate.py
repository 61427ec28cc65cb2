"""The annotation page in a real browser; elements are found by role and label."""

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hilsplat.annotate.labels import Label, label_path, write_labels
from hilsplat.base.tables import write_csv
from hilsplat.datasets.registry import open_labelled
from hilsplat.web.file_changes import version_of
from tests.browser.conftest import serving
from tests.conftest import PROJECT
from tests.unit.annotate.label_files import read_labels
from tests.unit.artifact_changes import change_index, write_again
from tests.unit.finished_desk import HEIGHT, NUM_VIEWS, WIDTH

SIZE = (HEIGHT, WIDTH + NUM_VIEWS)


@pytest.fixture
def page(annotating, desk):
    return annotating(desk)


def saved(page) -> None:
    """Wait until every change has been saved."""
    # by the page's own clock: a slow machine has then dealt with all keys and clicks before
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => setTimeout(done, 150)))")
    page.locator("body[data-saved=true]").wait_for()


def kept(root: Path, view: str = "000.png") -> list[Label]:
    return read_labels(label_path(root / "annotated/photos/desk", view))


def place(page, x: float, y: float) -> tuple[float, float]:
    """Position on the page of a pixel of the photograph."""
    box = page.locator("#view").bounding_box()
    sheet = page.evaluate("({s: hilsplat.sheet.scale, x: hilsplat.sheet.x, y: hilsplat.sheet.y})")
    return box["x"] + sheet["x"] + (x + 0.5) * sheet["s"], box["y"] + sheet["y"] + (y + 0.5) * sheet["s"]


def click(page, *pixels: tuple[int, int], held: str = "") -> None:
    """Click pixels of the photograph."""
    if held:
        page.keyboard.down(held)
    for pixel in pixels:
        page.mouse.click(*place(page, *pixel))
    if held:
        page.keyboard.up(held)


def polygon(page, *corners: tuple[int, int]) -> None:
    draw_polygon(page, *corners)
    saved(page)


def draw_polygon(page, *corners: tuple[int, int]) -> None:
    page.press("p")
    click(page, *corners)
    page.keyboard.press("Enter")


def name(page, text: str) -> None:
    page.get_by_role("textbox", name="Text").or_(page.get_by_role("combobox", name="Text")).fill(text)
    page.keyboard.press("Enter")


MUG, BOOK = ((1, 1), (15, 1), (15, 20), (1, 20)), ((22, 2), (36, 2), (36, 20))


def draw(page, text: str, corners: tuple[tuple[int, int], ...] = BOOK) -> None:
    """Draw a new thing."""
    page.press("Escape", "n")
    name(page, text)
    draw_polygon(page, *corners)


def draw_mug(page) -> None:
    draw(page, "mug", MUG)
    saved(page)


def draw_book(page) -> None:
    draw(page, "book")
    saved(page)


def texts(root: Path, view: str = "000.png") -> list[str]:
    return sorted(label.text for label in kept(root, view))


def drag_over(page, *pixels: tuple[int, int]) -> None:
    """Drag over pixels of the photograph."""
    page.drag(*[place(page, *pixel) for pixel in pixels])


def things(page) -> list[str]:
    """Labels of the things that the photograph's list shows."""
    items = page.get_by_role("tree", name="In this photograph").get_by_role("treeitem")
    return [item.get_attribute("aria-label") for item in items.all()]


def offers_at(page, x: int, y: int):
    """Click a pixel with the proposing tool, and return the buttons of its proposals."""
    page.press("x")
    click(page, (x, y))
    offers = page.get_by_role("region", name="Proposals at this pixel").get_by_role("button")
    offers.first.wait_for()
    return offers


def test_a_whole_and_its_part_are_drawn_cut_saved_and_scored(page, tmp_path):
    draw_mug(page)
    page.press("j")  # a part of it
    name(page, "handle")
    polygon(page, (10, 4), (30, 4), (30, 10), (10, 10))
    assert things(page) == ["mug, whole", "handle, part"]
    mug, handle = kept(tmp_path)
    assert (handle.parent, handle.level, handle.origin) == (mug.id, 2, "drawn")
    expected = np.zeros(SIZE, bool)
    expected[4:11, 10:16] = True  # cut at the mug's side
    np.testing.assert_array_equal(handle.mask(SIZE), expected)
    scene = open_labelled("annotated/photos/desk", tmp_path)
    assert [region.path for region in scene.views["000.png"]] == [("mug",), ("mug", "handle")]


def test_the_brush_adds_and_the_eraser_removes_pixels(page, tmp_path):
    draw_mug(page)
    before = kept(tmp_path)[0].mask(SIZE)
    page.get_by_role("slider", name="Radius of the brush, pixels").fill("2")
    for key, changes in (("b", (1, 0)), ("e", (0, 1))):
        page.locator("#view").press(key)
        row = 22 if key == "b" else 10
        drag_over(page, (10, row), (18, row))
        saved(page)
        assert page.evaluate("getSelection().type") != "Range"  # or the photograph turns blue
        after = kept(tmp_path)[0].mask(SIZE)
        more, less = (after & ~before).any(), (before & ~after).any()
        assert (more, less) == changes
        before = after


def test_changes_are_undone_and_redone_even_after_a_reload_and_each_is_saved(page, tmp_path):
    file = label_path(tmp_path / "annotated/photos/desk", "000.png")
    draw_mug(page)
    first = file.read_bytes()
    draw_book(page)
    both = file.read_bytes()
    page.press("Control+z")
    saved(page)
    assert file.read_bytes() == first and things(page) == ["mug, whole"]
    page.reloaded()
    page.get_by_role("button", name="Undo").click()
    saved(page)
    assert not file.exists()
    for key in ("Control+Shift+z", "Control+y"):
        page.press(key)
        saved(page)
    assert file.read_bytes() == both
    page.press("]", "Control+z")
    saved(page)
    assert file.read_bytes() == first and page.url.endswith("view=0")  # the photograph that changed


def test_a_proposed_node_is_scored_only_after_it_is_accepted(page, tmp_path):
    offers = offers_at(page, 6, 6)
    assert offers.count() == 3
    offers.nth(0).click()
    saved(page)
    name(page, "mug")
    saved(page)
    (mug,) = kept(tmp_path)
    assert mug.origin == "proposed" and mug.text == "mug"
    assert open_labelled("annotated/photos/desk", tmp_path).views["000.png"] == ()
    assert things(page) == ["mug, whole, proposed"]
    page.press("a")
    saved(page)
    assert kept(tmp_path)[0].origin == "accepted"
    polygon(page, (1, 1), (4, 1), (4, 4))  # adds to the chosen thing
    assert kept(tmp_path)[0].origin == "edited"


def test_a_new_thing_has_neither_name_nor_parent(page, tmp_path):
    draw_mug(page)
    offers_at(page, 6, 6).get_by_text("subpart").first.click()
    page.get_by_text("Proposed without a parent: the parent of a subpart is a part").wait_for()
    page.press("Escape")
    assert page.locator("#text").input_value() == "" and page.locator("#title").inner_text() == "New thing"
    offers_at(page, 26, 6).first.click()
    saved(page)
    assert [label.text for label in kept(tmp_path)] == ["mug", "unnamed", "unnamed"]
    assert {label.parent for label in kept(tmp_path)} == {None}
    page.press("a")
    page.get_by_role("status").get_by_text("Accepted.").wait_for()
    page.press("Control+z")
    assert page.get_by_role("status").inner_text() == ""


def test_things_are_transferred_to_the_next_photograph(page, tmp_path):
    draw_mug(page)
    page.press("]")
    page.get_by_role("button", name="From others").click()
    page.get_by_text("1 proposed").first.wait_for()
    saved(page)
    (mug,), (carried,) = kept(tmp_path), kept(tmp_path, "001.png")
    assert (carried.id, carried.text, carried.origin) == (mug.id, "mug", "proposed")


def test_concurrent_changes_are_not_overwritten(page, opened, tmp_path):
    opened.expected.append("412 (Precondition Failed)")
    draw_mug(page)
    path = label_path(tmp_path / "annotated/photos/desk", "000.png")
    theirs = [kept(tmp_path)[0].model_copy(update={"text": "cup"})]
    write_labels(path, "000.png", SIZE, theirs, version_of(path))
    draw(page, "book")
    page.get_by_text("have changed since they were read").wait_for()
    page.get_by_role("treeitem", name="cup, whole").wait_for()
    assert kept(tmp_path) == theirs and things(page) == ["cup, whole"]


def test_unsaved_changes_stay_when_another_photograph_was_changed_elsewhere(page, opened, tmp_path):
    opened.expected += ["412 (Precondition Failed)", "507"]
    draw_mug(page)
    full = {"status": 507, "content_type": "application/json", "body": '{"error": "the disk is full"}'}
    page.route("**/api/labels/1*", lambda route: route.fulfill(**full))
    page.press("]")
    draw(page, "cup", MUG)
    page.get_by_text("Not saved: the next change is saved with this one.").wait_for(state="attached")
    assert page.locator("body").get_attribute("data-saved") == "false"
    path = label_path(tmp_path / "annotated/photos/desk", "000.png")
    write_labels(path, "000.png", SIZE, [], version_of(path))
    page.press("[")
    draw(page, "book")
    page.get_by_text(re.compile("have changed since they were read.*the disk is full", re.DOTALL)).wait_for()
    page.unroute("**/api/labels/1*")
    draw_book(page)
    assert (texts(tmp_path), texts(tmp_path, "001.png")) == (["book"], ["cup"])


def test_changes_are_saved_once_an_unreadable_file_is_repaired(page, opened, tmp_path):
    opened.expected += ["412 (Precondition Failed)", "422"]
    draw_mug(page)
    path = label_path(tmp_path / "annotated/photos/desk", "000.png")
    whole = path.read_text()
    path.write_text("{")  # by another program
    draw(page, "book")
    page.get_by_text("000.json is not valid JSON").wait_for()
    path.write_text(whole)
    page.press("]")
    draw_book(page)
    assert (texts(tmp_path), texts(tmp_path, "001.png")) == (["book", "mug"], ["book"])


def test_files_are_exported_and_imported_again(page, tmp_path):
    draw_mug(page)
    page.locator("#save summary").click()
    with page.expect_download() as started:
        page.get_by_role("link", name="COCO").click()
    file = tmp_path / "coco.json"
    started.value.save_as(file)
    assert json.loads(file.read_text())["categories"] == [{"id": 1, "name": "mug"}]
    before = kept(tmp_path)[0].mask(SIZE)
    page.press("Control+z")
    saved(page)
    assert kept(tmp_path) == []
    page.get_by_label("Files to import").set_input_files(file)
    page.get_by_text("1 label imported into 1 photograph.").wait_for()
    saved(page)
    np.testing.assert_array_equal(kept(tmp_path)[0].mask(SIZE), before)
    drop = """(text) => {
        const data = new DataTransfer(), panel = document.getElementById("panel");
        data.items.add(new File([text], "coco.json"));
        const event = new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true });
        return !panel.dispatchEvent(event);   // or the browser would leave the page to open the file
    }"""
    assert page.evaluate(drop, file.read_text())
    page.get_by_text("0 labels imported into 0 photographs; already present: 1.").wait_for()
    assert things(page) == ["mug, whole"]


def test_an_import_keeps_what_is_changed_while_it_runs(page, tmp_path):
    draw_mug(page)
    file = label_path(tmp_path / "annotated/photos/desk", "000.png")
    content = json.loads(file.read_text())
    content["objects"][0] |= {"id": 9, "category": "book", "segmentation": [BOOK]}
    (tmp_path / "book.json").write_text(
        json.dumps(content | {"info": {**content["info"], "name": "000.png"}})
    )
    held = []
    page.route("**/api/import*", lambda route: held.append((route, route.fetch())), times=1)
    page.get_by_label("Files to import").set_input_files(tmp_path / "book.json")
    page.until(lambda: held)
    name(page, "cup")
    page.until(lambda: texts(tmp_path) == ["cup"])
    ((route, reply),) = held
    route.fulfill(response=reply)
    page.get_by_text("1 label imported into 1 photograph.").wait_for()
    saved(page)
    assert texts(tmp_path) == ["book", "cup"]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"level": 2, "parent": 1, "text": "lid"}, "is entirely outside"),
        ({"level": 1, "text": "lid\u202e"}, "text: Value error"),  # as pasted from elsewhere
    ],
)
def test_a_refused_change_and_later_ones_are_undone(page, opened, tmp_path, wrong, message):
    opened.expected += ["422", "400"]
    draw_mug(page)
    (mug,) = first = kept(tmp_path)
    held, free = [], []
    page.route("**/api/labels/**", lambda route: route.continue_() if free else held.append(route))
    parent = {"parent": mug.id} if "parent" in wrong else {}
    lid = {"id": 9, **wrong, **parent, "polygons": [[[30, 2], [36, 2], [36, 9]]]}
    later = {"id": 10, "level": 1, "parent": None, "text": "book", "polygons": [BOOK]}
    for label in (lid, later):  # two quick changes
        page.evaluate("(label) => hilsplat.store.change([[0, [...hilsplat.store.labels(0), label]]])", label)
    page.until(lambda: held)
    free.append(True)
    for route in held:
        route.continue_()
    page.get_by_text(message).wait_for()
    saved(page)
    assert kept(tmp_path) == first and things(page) == ["mug, whole"]
    page.press("Control+z")  # the mug, as before
    saved(page)
    assert kept(tmp_path) == [] and things(page) == []


def area(root: Path) -> int:
    (mug,) = kept(root)
    return int(np.count_nonzero(mug.mask(SIZE)))


def test_corners_of_the_chosen_outline_are_moved_added_and_removed(page, tmp_path):
    draw_mug(page)
    before = area(tmp_path)
    page.press("v")
    drag_over(page, (15, 20), (20, 22), (25, 20))
    saved(page)
    wider = area(tmp_path)
    assert wider > before + 60 and kept(tmp_path)[0].mask(SIZE)[19, 21]
    drag_over(page, (1, 10), (6, 10))  # the left side gets a corner
    saved(page)
    assert area(tmp_path) < wider - 20 and not kept(tmp_path)[0].mask(SIZE)[10, 2]
    click(page, (25, 20), held="Alt")
    saved(page)
    assert not kept(tmp_path)[0].mask(SIZE)[19, 21]
    page.keyboard.press("Control+z")
    saved(page)
    assert kept(tmp_path)[0].mask(SIZE)[19, 21]


def test_sam_outlines_clicked_things(annotating, own_desk, tmp_path):
    change_index(own_desk / "default/masks", segmenter="sam", model=str(PROJECT / "models/sam-tiny"))
    page = annotating(own_desk)
    page.press("s")
    click(page, (28, 20))
    page.get_by_text("Press Enter to accept this outline").wait_for()
    assert page.locator("#drawing .inside").count() == 1
    assert page.locator("#drawing .offer").count() == 1
    click(page, (4, 20), held="Alt")
    page.locator("#drawing .outside").wait_for(state="attached")
    page.get_by_text("Press Enter to accept this outline").wait_for()
    saved(page)
    page.press("Enter")
    saved(page)
    (found,) = kept(tmp_path)
    assert found.origin == "proposed" and found.mask(SIZE)[20, 28] and not found.mask(SIZE)[20, 4]
    page.press("s")
    drag_over(page, (1, 2), (14, 21))  # a box
    page.get_by_text("Press Enter to accept this outline").wait_for()
    page.keyboard.press("Escape")
    page.locator("#drawing .offer").wait_for(state="detached")


def test_the_page_shows_the_saved_scores_and_reports_a_rewritten_scene(annotating, own_desk, tmp_path):
    write_csv(own_desk / "scores.csv", ("method", "mIoU", "protocol"), [("tree", "65.0", "lerf/langsplat@3")])
    page = annotating(own_desk)
    assert page.get_by_text("mIoU: tree 65.0 % (lerf/langsplat@3).").is_visible()
    assert not page.get_by_role("alert").is_visible()
    write_again(own_desk / "default/semantic_tree")
    page.get_by_role("alert").get_by_text("The scene has changed (semantic_tree).").wait_for()
    name(page, "rim")  # the photographs are the same
    polygon(page, (1, 1), (15, 1), (15, 5), (1, 5))
    assert texts(tmp_path) == ["rim"]
    page.get_by_role("button", name="Reload").click()
    page.get_by_role("alert").wait_for(state="hidden")
    page.get_by_role("treeitem", name="rim, whole").wait_for()


def test_nothing_is_lost_while_the_server_is_stopped(opened, desk, tmp_path):
    """A drawing waits for a server at the same port, whose address is opened in the same browser."""
    words = ("annotate", "--data-root", str(tmp_path))
    opened.expected += ["ERR_CONNECTION_REFUSED", "403"]
    with serving(desk, *words) as address:
        page = opened(address)
        port = re.search(r":(\d+)/", address).group(1)
        draw_mug(page)
    name_of = page.get_by_role("tree", name="In this photograph")
    draw(page, "book", ((22, 2), (36, 2), (36, 5)))  # above the notice, which may be there already
    notice = page.get_by_role("alert").filter(has_text="The server has stopped")
    notice.filter(has_text="not saved yet").wait_for()
    assert f"hilsplat annotate {desk} --data-root {tmp_path} --port {port}" in notice.text_content()
    with serving(desk, *words, "--port", port) as address:
        page.context.new_page().goto(address)
        notice.wait_for(state="hidden")
        name_of.get_by_text("book").wait_for()
        saved(page)
        assert texts(tmp_path) == ["book", "mug"]
        page.context.close()


def test_a_text_is_undone_once_it_is_saved_and_not_replaced_by_a_late_reply(page, tmp_path):
    draw_mug(page)
    text = page.locator("#text")
    text.fill("cup")
    text.press("Control+z")  # the browser undoes typing
    assert things(page) == ["mug, whole"]
    text.fill("cup")
    text.press("Enter")
    saved(page)
    text.focus()
    text.press("Control+z")
    saved(page)
    assert texts(tmp_path) == ["mug"]
    page.press("]", "Escape")
    page.late("api/labels")
    draw_polygon(page, *MUG)
    page.locator("#title", has_text="unnamed").wait_for()
    page.keyboard.type("mug")
    saved(page)
    assert page.locator("#text").input_value() == "mug"
    page.keyboard.press("Enter")
    saved(page)
    assert texts(tmp_path, "001.png") == ["mug"]


def test_a_message_stays_until_it_no_longer_applies_and_a_menu_until_something_else_is_done(page):
    assert "First annotation: 1. type what you see" in page.get_by_role("status").text_content()
    page.press("s")
    page.get_by_text("made by a SAM that is installed here").wait_for()
    page.press("?")
    assert page.evaluate("document.activeElement.id") == "help-title"
    page.keyboard.press("Escape")
    page.press("e")
    click(page, (30, 10))
    page.get_by_text("Select the thing to erase from").wait_for()
    draw_mug(page)
    assert not page.get_by_role("status").text_content()
    for close in (lambda: page.keyboard.press("Escape"), lambda: click(page, (2, 22))):
        page.get_by_text("Files", exact=True).click()
        page.get_by_role("button", name="Import").wait_for()
        close()
        page.get_by_role("button", name="Import").wait_for(state="hidden")
    assert page.phone_fits() and not page.locator("#segment-label").is_visible()


def test_regions_and_corners_go_to_the_objects_and_photographs_for_which_they_were_drawn(page, tmp_path):
    page.late("api/shape")
    draw(page, "mug", MUG)
    draw(page, "book")
    draw_polygon(page, (22, 4), (24, 20), (30, 20))  # more of the book
    page.keyboard.press("]")
    saved(page)
    mug, book = kept(tmp_path)
    assert mug.mask(SIZE)[:, :16].sum() == mug.mask(SIZE).sum() == 15 * 20
    assert book.mask(SIZE)[4, 35] and book.mask(SIZE)[19, 25] and not book.mask(SIZE)[:, :20].any()
    assert page.url.endswith("view=1") and things(page) == []
    draw_mug(page)
    page.press("v")
    drag_over(page, (15, 1), (20, 1))
    drag_over(page, (15, 20), (20, 20))
    page.keyboard.press("]")
    saved(page)
    (mug,) = kept(tmp_path, "001.png")
    assert mug.mask(SIZE)[1:20, 17:20].all()


def test_late_proposals_and_photographs_are_not_shown_with_the_next_photograph(page):
    page.late("api/at")
    page.press("x")
    click(page, (8, 8))
    page.keyboard.press("]")
    saved(page)
    assert not page.get_by_role("region", name="Proposals at this pixel").is_visible()
    assert page.locator("#status").inner_text() == "001.png"
    held = []
    page.route("**/api/photo/2*", lambda route: held.append(route))
    page.press("]")
    page.until(lambda: held)
    assert not page.locator("#picture").is_visible()
    held[0].continue_()
    page.locator("#picture").wait_for()


def test_two_fingers_move_the_photograph_without_drawing(annotating, desk, tmp_path):
    page = annotating(desk, has_touch=True)
    name(page, "mug")
    fingers = page.context.new_cdp_session(page.page)
    for tool, moves in (("b", True), ("p", True), ("p", False)):
        page.press(tool)
        scale = page.evaluate("hilsplat.sheet.scale")
        touches = {
            "Start": ([10], [10, 20]),
            "Move": ([8, 26],) if moves else (),
            "End": ([8] if moves else [10], []),
        }
        for kind, columns in ((kind, columns) for kind, steps in touches.items() for columns in steps):
            points = [dict(zip("xy", place(page, column, 10), strict=True)) for column in columns]
            fingers.send("Input.dispatchTouchEvent", {"type": f"touch{kind}", "touchPoints": points})
        saved(page)
        assert (page.evaluate("hilsplat.sheet.scale") > 1.1 * scale) == moves
        assert kept(tmp_path) == [] and not page.locator("#drawing .draft").count()


def test_an_unfinished_polygon_is_kept_when_the_tool_or_the_photograph_changes(page, tmp_path):
    for text, key in (("mug", "b"), ("cup", "]")):
        page.press("Escape", "n")
        name(page, text)
        page.press("p")
        click(page, *MUG[:3])
        page.keyboard.press(key)
        saved(page)
    assert texts(tmp_path) == ["cup", "mug"]


def test_annotations_of_another_tab_appear_and_ids_stay_apart(page, tmp_path):
    other, held, is_held = page.beside(), [], [True]

    def hold(route) -> None:  # this tab has yet to learn about the mug
        held.append(route) if is_held else route.continue_()

    page.route("**/api/changes*", hold)
    draw_mug(other)
    page.press("]")
    draw_book(page)
    is_held.clear()
    for route in held:
        route.continue_()
    for tab, number, label in ((page, 0, "mug, whole"), (other, 1, "book, whole")):
        tab.locator("#views button").nth(number).click()
        tab.get_by_role("treeitem", name=label).wait_for()
    (mug,), (book,) = kept(tmp_path), kept(tmp_path, "001.png")
    assert mug.id != book.id
    other.close()


def test_a_very_large_photograph_is_not_enlarged_by_zooming_out(page):
    page.evaluate("hilsplat.sheet.show(0, [9000, 12000])")
    scale = page.evaluate("hilsplat.sheet.scale")
    for factor, expected in ((0.8, scale), (1.25, 1.25 * scale)):
        page.evaluate(f"hilsplat.sheet.zoom({factor})")
        assert page.evaluate("hilsplat.sheet.scale") == pytest.approx(expected)


def test_outlines_are_as_thin_on_a_small_photograph_as_on_a_large_one(page):
    draw_mug(page)
    page.press("v", "Escape")
    page.mouse.move(5, 5)
    for factor in (1, 2):
        page.evaluate(f"hilsplat.sheet.zoom({factor})")
        x, y = place(page, 15, 10)
        clip = {"x": x - 30, "y": y, "width": 60, "height": 1}
        row = np.asarray(Image.open(io.BytesIO(page.screenshot(clip=clip))).convert("RGB")).astype(int)[0]
        stroke = page.evaluate("getComputedStyle(document.querySelector('#drawing .thing')).stroke")
        colour = [int(value) for value in re.findall(r"\d+", stroke)]
        assert 1 <= (np.abs(row - colour).max(axis=1) < 12).sum() <= 4


def test_a_part_is_kept_in_a_photograph_without_its_whole(page, tmp_path):
    draw_mug(page)
    page.press("j")
    name(page, "handle")
    page.press("]")
    polygon(page, (1, 1), (15, 1), (15, 20))
    (handle,) = kept(tmp_path, "001.png")
    assert (handle.text, handle.level, handle.parent) == ("handle", 2, None)
