"""Several queries at once, files of them, and films along a path of the user's own."""

import json
import re
import shutil
import zipfile
from urllib.parse import urlencode

import av
import pytest

from tests.unit.many_nodes import add_nodes


def greenish(page) -> float:
    """Share of the picture in the colour of the first kept query."""
    picture = page.pixels().astype(int)
    return float(((picture[..., 1] - picture[..., 0] > 60) & (picture[..., 2] > 60)).mean())


def test_kept_queries_have_colours_and_can_be_hidden_and_dropped(page, scene):
    page.keep("book")
    page.keep("mug > handle")
    assert page.evaluate("document.activeElement.id") == "text" and not page.answers().count()
    assert [chip.inner_text().split("\n")[0] for chip in page.chips().all()] == ["book", "mug > handle"]
    (book,), (handle,) = scene.query("book"), scene.query("mug > handle")
    painted = {int(path.get_attribute("data-node")) for path in page.locator("#overlay path.kept").all()}
    assert painted == {book.node, handle.node}
    page.until(lambda: greenish(page) > 0.02)
    page.drawn(page.get_by_role("button", name="Show book").click)
    assert page.get_by_role("button", name="Show book").get_attribute("aria-pressed") == "false"
    page.until(lambda: greenish(page) < 0.005)
    page.get_by_role("button", name="Remove book").click()
    assert page.chips().count() == 1
    page.late("api/query")
    page.get_by_label("Answers by").select_option("default|field")  # they are sent again
    show = page.get_by_role("button", name="Show mug > handle")
    show.click()
    assert show.get_attribute("aria-pressed") == "false"
    page.wait_for_timeout(900)
    assert page.chips().count() == 1
    asked = [("keep", json.dumps({"text": text, "level": "auto"})) for text in ("word " * 60, *"abcdefghijk")]
    page = page.beside(f"{page.url.partition('#')[0]}#{urlencode(asked)}")
    page.until(lambda: page.chips().count() == 12)
    colours = page.locator("#kept .swatch").evaluate_all("all => all.map((one) => one.style.cssText)")
    assert len(set(colours)) == 12
    for button in (page.locator("#kept .swatch"), page.get_by_role("button", name=re.compile("Remove"))):
        assert all(box >= 20 for box in button.evaluate_all("all => all.map((one) => one.offsetWidth)"))
    page.ask_and_wait("book")
    page.get_by_role("button", name="Keep").click()
    page.get_by_text("At most 12 queries can be kept").wait_for()


def test_the_overlap_of_two_queries_is_reported(page):
    page.keep("mug")
    page.ask("mug > handle")
    page.get_by_text("1 answer inside an answer to another query.").wait_for()
    page.ask("mug")
    page.get_by_text("White: 1 node found by several queries.").wait_for()
    page.locator("#overlay text", has_text=re.compile(r"^mug 0\.\d\d \+ ")).wait_for()


def test_a_kept_query_is_edited_with_its_threshold_at_its_photograph(page):
    options = [
        page.get_by_role("checkbox", name=name) for name in ("score at least", "only what this photograph")
    ]
    for option in options:
        option.check()
    page.get_by_label("Minimum score").fill("0.3")
    view = page.evaluate("hilsplat.camera.view")
    page.keep("book")
    assert "score at least 0.30" in page.chips().first.inner_text()
    for option in options:
        option.uncheck()
    page.locator("#view").focus()
    page.drawn(lambda: page.keyboard.press("ArrowLeft"))
    page.chips().first.get_by_title("Edit").click()
    page.answers().first.wait_for()
    assert page.locator("#text").input_value() == "book" and not page.chips().count()
    assert all(option.is_checked() for option in options)
    assert page.evaluate("hilsplat.camera.view") == view


def test_kept_queries_and_saved_files_have_scores_and_doubts(page, scene, tmp_path):
    page.keep("book")
    page.keep("unicorn > rim")
    (book,), (rim,) = scene.query("book"), scene.query("unicorn > rim")
    assert rim.doubts and not book.doubts
    sure, doubtful = page.chips().all()
    assert f"1 answer, best {book.score:.2f}" in sure.inner_text() and "doubtful" not in sure.inner_text()
    assert f"best {rim.score:.2f}" in doubtful.inner_text() and "doubtful" in doubtful.inner_text()
    assert str(rim.doubts[0]) in doubtful.locator(".words").get_attribute("title")
    assert page.locator("#overlay text", has_text=f"book {book.score:.2f}").count() == 1
    style = page.evaluate("Array.from(hilsplat.painted()[0].style.table)")
    assert style[4 * rim.node + 7] == pytest.approx(style[4 * book.node + 7] / 2, abs=1)
    boxes = json.loads(page.save("Boxes, JSON", tmp_path / "boxes.json").read_text())["boxes"]
    found = [(box["group"], box["node"], box["doubts"]) for box in boxes]
    assert found == [("book", book.node, []), ("unicorn > rim", rim.node, [str(rim.doubts[0])])]
    masks = page.save("Masks in all photographs", tmp_path / "masks.zip")
    told = f"Saved desk-masks.zip, {-(-masks.stat().st_size // 1000)} kB."
    page.get_by_role("status").get_by_text(told).wait_for()
    assert page.locator("#saving").is_hidden()
    with zipfile.ZipFile(masks) as archive:
        coco = json.loads(archive.read("coco.json"))
    assert [category["doubts"] for category in coco["categories"]] == [[], [str(rim.doubts[0])]]
    scores = {each["node"]: each["score"] for each in coco["annotations"]}
    assert scores == pytest.approx({book.node: book.score, rim.node: rim.score}, abs=1e-4)
    offline = page.saved_page(tmp_path)
    told = [[chip.locator(".words").inner_text() for chip in each.chips().all()] for each in (page, offline)]
    assert told[0] == told[1]


@pytest.mark.parametrize("answerer", ["tree", "field"])
def test_a_saved_page_has_the_answers_and_settings_of_the_page(page, scene, tmp_path, answerer):
    page.get_by_label("Answers by").select_option(f"default|{answerer}")
    page.keep("mug")
    page.get_by_role("radio", name="part", exact=True).check(force=True)
    page.get_by_label("Others").select_option("ghost")
    page.ask_and_wait("mug")
    shown = page.answers().first.inner_text()
    (part,), (whole,) = scene.query("mug", "part", answerer=answerer), scene.query("mug", answerer=answerer)
    assert f"{part.score:.2f}" in shown and part.node != whole.node
    offline = page.saved_page(tmp_path)
    offline.answers().first.wait_for()
    assert offline.answers().first.inner_text() == shown
    assert offline.locator("#answers li").get_attribute("data-node") == str(part.node)
    assert offline.get_by_label("Others").input_value() == "ghost"


def test_a_kept_answer_has_the_present_name_of_its_node(served, own_desk):
    page = served(own_desk)
    page.keep("book")
    page.get_by_role("treeitem").last.wait_for()
    page.late("api/names")
    page.choose_row(int(page.locator("#overlay path.kept").get_attribute("data-node")))
    page.get_by_role("textbox", name="Name").fill("atlas")
    page.keyboard.press("Enter")
    page.press("Escape")
    page.locator("#overlay text", has_text=re.compile(r"^book: atlas 0\.\d\d$")).wait_for()


def test_a_link_and_back_restore_the_settings_of_a_query(page, opened, desk_address):
    page.keep("book")
    page.keep("mug")
    page.get_by_role("button", name="Show book").click()  # hides it
    page.get_by_label("only what this photograph shows").check()
    page.get_by_label("score at least").check()
    page.get_by_label("Minimum score").fill("0.3")
    page.ask_and_wait("mug > handle")
    view = page.evaluate("hilsplat.camera.view")
    page.press("ArrowLeft")  # the answer remains that of the photograph
    page.until(lambda: "q=mug" in page.url and "c=v" not in page.url)
    asked = []

    def note(sent) -> None:
        if "api/query" in sent.url and sent.post_data_json["text"] == "mug > handle":
            asked.append(sent.post_data_json)

    again = opened(desk_address)
    again.until(lambda: "#" in again.url)
    again.on("request", note)
    again.goto(f"{again.url.partition('#')[0]}{page.url[page.url.index('#') :]}")  # in the same tab
    again.until(lambda: asked)
    again.answers().first.wait_for()
    question = {"text": "mug > handle", "level": "auto", "threshold": 0.3, "view": view}
    assert asked == [{"variant": "default", "answerer": "tree", **question}]
    camera = [each.evaluate("hilsplat.camera.toText()") for each in (page, again)]
    assert camera[0] == camera[1] and "token" not in page.url
    assert again.chips().all_inner_texts() == page.chips().all_inner_texts()
    shown = [button.get_attribute("aria-pressed") for button in again.locator("#kept .swatch").all()]
    assert shown == ["false", "true"]
    page.get_by_label("only what this photograph shows").uncheck()
    page.ask_and_wait("book")
    page.get_by_label("score at least").uncheck()
    page.until(lambda: "q=book" in page.url and "least" not in page.url)
    page.on("request", note)
    page.go_back()
    page.until(lambda: len(asked) > 1)
    assert asked[1] == asked[0] and page.get_by_label("score at least").is_checked()


def test_a_film_follows_the_path_of_the_user(opened, desk_address, tmp_path):
    page = opened(desk_address, "server")
    page.press("v")
    page.get_by_text("The path begins here").wait_for()
    page.get_by_role("option", name="003.png").click()
    page.press("v")
    page.get_by_text("2 views in the path").wait_for()
    page.locator("#seconds").evaluate("input => { input.value = 1; }")
    film = page.save("Film, MP4", tmp_path / "film.mp4")
    with av.open(str(film)) as frames:
        assert sum(1 for _ in frames.decode(video=0)) == 24
    page.locator("#save summary").click()
    assert page.locator("#path").input_value() == "path"
    page.locator("#path").select_option("around")
    page.get_by_role("button", name="Clear").click()
    assert page.locator("#path").input_value() == "around"


def two_trees(own_desk):
    """Add a variant whose nodes have numbers of their own."""
    records = shutil.ignore_patterns("*.provenance.json")  # otherwise, its parts would be those of default
    shutil.copytree(own_desk / "default", own_desk / "other", ignore=records)
    add_nodes(own_desk, 50)


def test_kept_answers_of_another_tree_are_neither_painted_nor_saved(served, own_desk, tmp_path):
    two_trees(own_desk)
    page = served(own_desk)
    page.keep("book")
    book = int(page.locator("#overlay path.kept").get_attribute("data-node"))
    held, free = [], []
    page.route("**/api/query**", lambda route: route.continue_() if free else held.append(route))
    page.get_by_label("Answers by").select_option("other|tree")
    page.until(lambda: held)
    page.locator("#overlay path.kept").wait_for(state="detached")
    page.locator("#save summary").click()
    page.until(page.get_by_role("button", name="Boxes, JSON").is_disabled)
    free.append(True)
    held[0].continue_()
    page.locator(f"#overlay path.kept[data-node='{book - 50}']").wait_for(state="attached")


def test_similar_nodes_are_those_of_the_node_in_its_own_tree(served, own_desk, tmp_path):
    two_trees(own_desk)
    page = served(own_desk)
    page.get_by_label("Beside").select_option("other|tree")
    page.ask_and_wait("mug > handle")
    page.answers().first.click()
    page.get_by_role("button", name="More like this").click()
    page.get_by_role("status").get_by_text("most similar first").wait_for()
    assert not page.locator("#answers-beside li").count()
    assert page.locator("#answers li").count() == 24
    assert "The first 5 are highlighted." in page.get_by_role("status").inner_text()
    table = page.evaluate("Array.from(hilsplat.painted()[0].style.table)")
    assert sum(share > 0 for share in table[3::4]) == 6  # with the selected node
    shown = (
        "import('/static/styles.js').then((own) => own.shownHits({ route: 'tree', hits: Array(7) }).length)"
    )
    assert page.evaluate(shown) == 7  # of a query, all are
    page.press("Escape")
    boxes = json.loads(page.save("Boxes, JSON", tmp_path / "boxes.json").read_text())["boxes"]
    assert len(boxes) == page.locator("#overlay path.answer").count() == 5  # as painted
