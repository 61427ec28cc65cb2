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
