"""Both pages used by the keyboard alone."""

from hilsplat.annotate.labels import label_path
from hilsplat.base.artifacts import read_json
from tests.unit.annotate.label_files import read_labels

MOST_STEPS = 80


def tab_to(page, selector: str) -> None:
    """Press Tab until an element has the focus."""
    for _ in range(MOST_STEPS):
        if page.evaluate("(selector) => document.activeElement.matches(selector)", selector):
            return
        page.keyboard.press("Tab")
    raise AssertionError(f"Tab never reaches {selector}")


def press(page, *keys: str) -> None:
    for key in keys:
        page.keyboard.press(key)


def test_querying_choosing_naming_and_saving_in_the_viewer(served, own_desk, tmp_path):
    page = served(own_desk)
    page.keyboard.type("/ o ? [")  # the text box has the focus: these keys do not act
    assert page.locator("#text").input_value() == "/ o ? [" and not page.get_by_role("dialog").is_visible()
    press(page, "Control+a")
    page.keyboard.type("mug > handle")
    press(page, "Enter")
    page.locator("#answers button").first.wait_for()
    tab_to(page, "#answers button")
    press(page, "Enter", "u")  # the handle is chosen, then the mug that it is part of
    press(page, "?")
    assert page.get_by_role("dialog", name="Keys").is_visible()
    press(page, "Escape")
    press(page, "n")
    page.keyboard.type("Souvenir <b")
    press(page, "Enter")
    page.get_by_text("Named “Souvenir <b”").wait_for()
    mug = page.locator("#overlay path.chosen").get_attribute("data-node")
    (names,) = read_json(own_desk / "names.json")["trees"].values()
    assert names == {mug: "Souvenir <b"}
    tab_to(page, "#text")
    press(page, "Control+a")
    page.keyboard.type("souvenir <B")
    press(page, "Enter")
    page.locator("#answers").get_by_text("Souvenir <b").wait_for()  # as text, not as markup
    tab_to(page, "#save summary")
    press(page, "Enter")
    tab_to(page, "[data-save=boxes]")
    with page.expect_download() as started:
        press(page, "Enter")
    started.value.save_as(tmp_path / "boxes.json")
    assert read_json(tmp_path / "boxes.json")
    tab_to(page, "#answers button")
    press(page, "Enter", "n", "Control+a", "Delete", "Enter")
    page.get_by_text("The name was removed.").wait_for()


def test_naming_drawing_and_saving_in_the_annotator(annotating, desk, tmp_path):
    page = annotating(desk)
    tab_to(page, "#text")
    page.keyboard.type("mug")
    press(page, "Enter")
    tab_to(page, "#view")
    for corner in ("Shift+ArrowLeft", "Shift+ArrowRight", "Shift+ArrowDown"):
        press(page, *(["p"] if corner.endswith("Left") else []), corner, "Space")
    press(page, "Enter")
    tab_to(page, "[role=treeitem]")
    press(page, "Enter")
    page.locator("body[data-saved=true]").wait_for()
    path = label_path(tmp_path / "annotated/photos/desk", "000.png")
    (label,) = read_labels(path)
    assert label.text == "mug"


def send_key(page, key: str, selector: str = "#view", **more) -> None:
    """Dispatch a key as another keyboard layout or an input method does, which Playwright cannot type."""
    code = """([key, selector, more]) => document.querySelector(selector).dispatchEvent(
        new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true, ...more }))"""
    page.evaluate(code, [key, selector, more])


BRACKETS = [
    {"altKey": True},
    {"altKey": True, "ctrlKey": True},
    {"key": "\N{CYRILLIC SMALL LETTER HARD SIGN}"},
]
"""The closing bracket of a Mac's German layout, of Windows's, and its place on a Russian one."""


def test_other_layouts_reach_all_keys_of_the_annotator(annotating, desk):
    page = annotating(desk)
    status = page.locator("#status")
    for row, more in enumerate(BRACKETS, 1):
        send_key(page, **{"key": "]", "code": "BracketRight", **more})
        assert status.inner_text().startswith(f"00{row}.png")
    send_key(page, "]", ctrlKey=True)
    send_key(page, "\N{LEFT DOUBLE QUOTATION MARK}", code="BracketLeft", altKey=True)  # a Mac's US layout
    assert status.inner_text().startswith("003.png")
    page.locator("#view").focus()
    page.locator("#text").fill("mug")
    send_key(page, "з", code="KeyP")
    for corner in ("Shift+ArrowLeft", "Shift+ArrowRight", "Shift+ArrowDown"):
        page.press(corner, "Space")
    page.press("Enter")
    thing = page.locator("#things [role=treeitem]")
    thing.wait_for()
    send_key(page, "я", code="KeyZ", ctrlKey=True)
    thing.wait_for(state="detached")
    send_key(page, "Я", code="KeyZ", ctrlKey=True, shiftKey=True)
    thing.wait_for()
    page.locator("body[data-saved=true]").wait_for()


def test_other_layouts_reach_all_keys_of_the_viewer(page):
    send_key(page, "ч", code="KeyX")
    page.locator("#edit").wait_for()
    send_key(page, "Escape")
    send_key(page, "ч", code="KeyX")
    for more in BRACKETS:
        before = page.wire_camera()
        send_key(page, **{"key": "]", "code": "BracketRight", **more})
        page.until(lambda before=before: page.wire_camera() != before)


def test_keys_of_an_input_method_are_no_shortcuts(page, annotating, desk):
    """Enter takes over what an input method composes; in Safari it comes after the composition."""
    for more in ({"isComposing": True}, {"keyCode": 229}):
        page.locator("#text").focus()
        send_key(page, "Escape", "#text", **more)
        send_key(page, "x", **more)
        assert page.locator("#edit").is_hidden()
    drawing = annotating(desk)
    for more in ({"isComposing": True}, {"keyCode": 229}):
        drawing.locator("#text").focus()
        send_key(drawing, "Enter", "#text", **more)
        assert drawing.evaluate("document.activeElement.id") == "text"
    send_key(drawing, "Enter", "#text")
    assert drawing.evaluate("document.activeElement.id") == "view"


def test_pages_work_in_a_safari_that_lacks_or_limits_what_others_have(page, annotating, desk):
    page.evaluate("delete URLSearchParams.prototype.size")  # before Safari 17
    page.until(lambda: "#" in page.url)
    page.press("]")
    before = page.url
    page.until(lambda: page.url != before)
    assert "?painter=gl#" in page.url
    drawing = annotating(desk)
    drawing.evaluate(
        "() => { history.replaceState = () => { throw new DOMException('', 'SecurityError'); }; }"
    )
    drawing.press("]")
    assert drawing.locator("#status").inner_text().startswith("001.png")
    assert drawing.locator("#views [aria-selected=true]").get_attribute("title") == "001.png"
