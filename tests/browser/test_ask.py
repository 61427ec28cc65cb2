"""Queries, choices, names and saved files in both painters; elements are found by role and label."""

import re
import shutil

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.atomic import atomic_folder
from hilsplat.base.images import write_png
from hilsplat.query.names import read_names
from tests.browser.conftest import HEIGHT, PANEL_PX, WIDTH, ScenePage, projected, serving
from tests.unit.artifact_changes import change_index
from tests.unit.many_nodes import add_nodes

both = pytest.mark.parametrize("painter", ["gl", "server"])


@both
def test_a_query_typed_after_the_slash_key_paints_its_answer(opened, desk_address, scene, painter):
    page = opened(desk_address, painter)
    assert page.evaluate("document.activeElement.id") == "text"  # the text box is first
    page.press("/")
    page.keyboard.type("mug > handle")
    page.drawn(lambda: page.keyboard.press("Enter"))
    page.answers().first.wait_for()
    (hit,) = scene.query("mug > handle")
    assert f"1 answer, best {hit.score:.2f}, part" in page.get_by_role("status").inner_text()
    assert page.locator("#overlay path.answer").get_attribute("data-node") == str(hit.node)
    page.wait_for_timeout(600)
    if painter == "gl":
        picture = page.pixels().astype(int)
        orange = (picture[..., 0] - picture[..., 2] > 90) & (picture[..., 0] > 120)
        assert 0.01 < orange.mean() < 0.4
        grey = (np.ptp(picture, axis=2) < 8) & (picture.max(axis=2) > 8)
        assert grey.mean() > 0.1 and (orange | grey | (picture.max(axis=2) <= 8)).mean() > 0.9
    page.ask("unicorn")
    doubt = "'unicorn' may not be in the scene: the model's vocabulary lacks 'unicorn'."
    status = page.get_by_role("status").filter(has_text=doubt).inner_text()
    assert status.index(doubt) < status.index("answer")  # a doubt comes first


def test_an_answer_outside_the_view_is_one_click_away_until_it_is_cleared(page):
    page.locator("#colour").select_option("relevancy")
    page.get_by_text("Run a query first").wait_for()
    page.locator("#colour").select_option("answers")
    look = page.get_by_role("button", name="No answer is in view: fly to the best one")
    page.ask_and_wait("mug > handle")
    assert look.is_hidden()
    page.evaluate("hilsplat.camera.orbit(3, 0); hilsplat.redraw()")
    look.click()
    look.wait_for(state="hidden")
    page.locator("#save summary").click()
    page.keyboard.press("Escape")  # closes the menu
    assert not page.get_by_role("button", name="Boxes, JSON").is_visible()
    assert page.answers().count() == 1
    page.keyboard.press("Escape")
    assert not page.answers().count()


@both
def test_what_others_hides_is_not_chosen(opened, desk_address, painter):
    page = opened(desk_address, painter)
    page.get_by_label("Others").select_option("isolate")
    page.ask_and_wait("book")
    mug, book = page.on_page((6, 20, 0), (30, 20, 0)).tolist()
    card = page.get_by_role("region", name="Chosen node")
    page.mouse.click(*book)
    card.wait_for()
    page.press("Escape")
    page.mouse.click(*mug)
    page.wait_for_timeout(500)
    assert not card.is_visible()


def test_a_photograph_is_not_shown_over_the_view_of_another(page):
    page.press("o")
    page.locator("#photo").wait_for()
    held = []
    page.route("**/api/photo/1*", lambda route: held.append(route))
    page.keyboard.press("]")
    page.until(lambda: held)
    page.locator("#photo").wait_for(state="hidden")
    held[0].continue_()
    page.locator("#photo").wait_for()


@pytest.mark.parametrize("path", ["splats/0", "variant/default", "nodes/default"])
def test_what_a_lost_connection_interrupts_is_loaded_later_with_the_query_typed_meanwhile(page, opened, path):
    opened.expected.append("ERR_FAILED")
    lost = []
    page.route(f"**/api/{path}?**", lambda route: route.abort() or lost.append(1), times=1)
    page.reload()
    page.ask("mug > handle")
    page.get_by_text("Your query runs as soon as the semantic tree is loaded").wait_for()
    page.answers().first.wait_for()
    assert lost and page.locator("#view").get_attribute("data-painter") == "gl"
    assert page.locator("#text").input_value() == "mug > handle"


def test_labels_of_boxes_end_in_the_picture_of_a_phone_and_do_not_cover_each_other(page):
    page.set_viewport_size({"width": 390, "height": 780})
    for text in (
        "mug",
        "mug > handle",
        "the book on the left side of the desk beside the mug near the window",
    ):
        page.keep(text)
    label = page.locator("#overlay text", has_text="the book on")
    label.wait_for()
    assert re.fullmatch(r"the book on .*… 0\.\d\d", label.text_content())
    boxes = [label.bounding_box() for label in page.locator("#overlay text").all()]
    assert len(boxes) >= 3
    for number, one in enumerate(boxes):
        assert one["x"] >= 0 and one["x"] + one["width"] <= 390
        for other in boxes[:number]:
            apart = abs(one["y"] - other["y"]) >= 12
            follows = one["x"] >= other["x"] + other["width"] or other["x"] >= one["x"] + one["width"]
            assert apart or follows


def test_a_name_given_in_one_tab_appears_in_another(served, own_desk):
    page = served(own_desk)
    other = page.beside(page.url.partition("#")[0])
    other.ask_and_wait("mug")
    page.ask_and_wait("mug")
    page.answers().first.click()
    page.get_by_role("textbox", name="Name").fill("frog")
    page.keyboard.press("Enter")
    for name in (other.answers(), other.get_by_role("tree", name="Outline")):
        name.get_by_text("frog").first.wait_for()
    other.close()


def test_a_stopped_server_is_reported_until_it_is_started_again_at_its_own_port(opened, own_desk):
    opened.expected += ["ERR_CONNECTION_REFUSED", "403"]
    with serving(own_desk) as address:
        page = opened(address, "server")
        port = re.search(r":(\d+)/", address).group(1)
    page.press("ArrowLeft")
    page.ask("mug > handle")
    notice = page.get_by_role("alert").filter(has_text="The server has stopped")
    notice.wait_for()
    assert f"hilsplat view {own_desk} --port {port}" in notice.text_content()
    with serving(own_desk) as address:
        page.drawn(lambda: page.context.new_page().goto(address))  # the picture that could not be rendered
        notice.wait_for(state="hidden")
        page.ask_and_wait("mug > handle")
        page.context.close()


@both
def test_a_click_chooses_the_whole_and_the_next_click_its_part(opened, desk_address, scene, painter):
    page = opened(desk_address, painter)
    (place,) = page.on_page((6, 6, 0))  # a yellow pixel of the rim
    for text in ("mug", "mug > handle", "mug > handle > rim", "mug"):
        page.mouse.click(*place.tolist())
        node = scene.query(text)[0].node
        page.locator(f"#overlay path.chosen[data-node='{node}']").first.wait_for(state="attached")
        assert page.locator(f"[role=treeitem][data-node='{node}']").get_attribute("aria-selected") == "true"
    page.press("Escape")
    page.locator("#overlay path.chosen").first.wait_for(state="detached")


def test_quick_picks_agree_with_exact_ones(page, scene):
    wire = page.wire_camera()
    height, width = wire["size_hw"]
    rng = np.random.default_rng(1)
    agree = []
    for x, y in rng.integers(0, (width, height), (60, 2)).tolist():
        exact = page.request.post(
            f"{page.url.partition('/?')[0]}/api/pick",
            data={"camera": wire, "x": x, "y": y},
            headers={"origin": page.url.partition("/?")[0]},
        ).json()["nodes"]
        if exact:
            agree.append(page.evaluate(f"hilsplat.quickPick({x}, {y})")[0] == exact[0][0])
    assert len(agree) > 20 and np.mean(agree) > 0.8


def test_keys_move_in_the_outline(page, scene):
    tree = page.get_by_role("tree")
    items = tree.get_by_role("treeitem")
    items.last.wait_for()
    assert items.count() == len(scene.tree)
    items.first.focus()
    focused = "document.activeElement.dataset.node"
    first = page.evaluate(focused)
    page.keyboard.press("ArrowRight")
    child = page.evaluate(focused)
    assert scene.tree.parent[int(child)] == int(first)
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")
    assert page.evaluate(focused) == first
    assert items.first.get_attribute("aria-expanded") == "false"
    page.keyboard.press("End")
    page.keyboard.press("Home")
    page.keyboard.press("Enter")
    assert items.first.get_attribute("aria-selected") == "true"
    card = page.get_by_role("region", name="Chosen node")
    assert card.is_visible()
    page.keyboard.press("j")  # down to its first child
    page.locator(f"#overlay path.chosen[data-node='{child}']").wait_for(state="attached")


def test_queries_with_an_image_a_framed_part_of_the_view_and_a_node(page, opened, scene, tmp_path):
    opened.expected.append("ERR_FAILED")
    book = scene.query("book", "whole")[0].node
    write_png(tmp_path / "blue.png", np.full((40, 30, 3), (0, 0, 250), np.uint8))
    page.get_by_label("Picture to look for").set_input_files(tmp_path / "blue.png")
    page.locator(f"#answers li[data-node='{book}']").first.wait_for()
    assert page.locator("#answers li").first.get_attribute("data-node") == str(book)
    page.press("Escape")
    low, high = page.on_page((18, 18, 0), (34, 22, 0))  # corners of the book
    page.route("**/api/photo/**", lambda route: route.abort(), times=1)
    page.drag(low, high, held="Alt")
    page.locator("#status.error").get_by_text("The server has stopped.").wait_for()
    page.drag(low, high, held="Alt")
    page.answers().first.wait_for()
    assert page.locator("#answers li").first.get_attribute("data-node") == str(book)
    page.press("Escape")
    mug = scene.query("mug", "whole")[0].node
    ((x, y),) = page.on_page((14, 16, 0))
    page.drag((x, y), (PANEL_PX - 40, y + 30), held="Alt")  # ends beside the view
    page.answers().first.wait_for()
    assert page.locator("#answers li").first.get_attribute("data-node") == str(mug)
    page.get_by_label("Beside").select_option("default|field")
    for moved in (0, 0.01):  # from the photograph and from the rendered picture, both in the right half
        page.press("Escape")
        page.evaluate(f"{moved} && hilsplat.camera.orbit({moved}, 0); hilsplat.redraw()")
        width = page.locator("#view").bounding_box()["width"] / 2
        wire = page.evaluate(f"hilsplat.camera.wire({width}, document.getElementById('view').clientHeight)")
        low, high = projected(wire, (18, 18, 0), (34, 22, 0)) + np.array([PANEL_PX + width, 0])
        page.drag(low, high, held="Alt")
        page.answers().first.wait_for()
        assert page.locator("#answers li").first.get_attribute("data-node") == str(book)
    page.get_by_label("Beside").select_option("")
    page.press("Escape")
    handle = scene.query("mug > handle")[0].node
    page.choose_row(handle)
    page.get_by_role("button", name="More like this").click()
    page.answers().first.wait_for()
    assert page.locator("#answers li").first.get_attribute("data-node") == str(
        scene.like_node(handle)[0].node
    )


def test_two_answerers_are_shown_side_by_side(page):
    page.ask_and_wait("mug")
    page.drawn(lambda: page.get_by_label("Beside").select_option("default|field"))
    right = page.get_by_role("list", name="On the right, by default, field: 1 of 1 are on the left too")
    right.get_by_role("button").wait_for()  # exactly one
    page.locator("#overlay .split").wait_for(state="attached")
    page.wait_for_timeout(1500)
    picture = page.pixels()
    half = picture.shape[1] // 2
    left, right = picture[:, :half].astype(int), picture[:, half : 2 * half].astype(int)
    assert left.std() > 10 and np.abs(left - right).mean() < 12  # both answer the mug, from one camera


def test_films_show_progress_and_gifs_and_pictures_have_the_chosen_size(opened, desk_address, tmp_path):
    page = opened(desk_address, "server")
    page.locator("#save summary").click()
    page.get_by_label("Longer side of the GIF").select_option("240")
    page.get_by_label("Longer side of the picture").select_option("1280")
    page.locator("#save summary").click()
    assert max(Image.open(page.save("Picture, PNG", tmp_path / "picture.png")).size) == 1280
    gif = Image.open(page.save("Film, GIF", tmp_path / "flight.gif"))
    assert max(gif.size) == 240 and gif.n_frames > 10
    page.get_by_role("progressbar", name="Film").wait_for(state="hidden")
    page.locator("#save summary").click()
    page.get_by_role("button", name="Film, MP4").click()
    page.get_by_text("of 120 pictures").wait_for()
    page.get_by_role("button", name="Cancel").click()
    page.get_by_role("status").get_by_text("Cancelled: nothing was saved.").wait_for()
    body = "new ReadableStream({ start(body) { body.error(new TypeError('network error')); } })"
    read = f"import('/static/http.js').then((own) => own.streamed(new Response({body})))"
    read += ".catch(({ status, message }) => [status, message])"
    assert page.evaluate(read) == [0, "The server has stopped."]
    page.locator("#save summary").click()
    assert page.get_by_role("button", name="Film, MP4").is_enabled()


def test_an_exported_page_opens_from_a_file_with_its_answers(page, browser, tmp_path, scene):
    page.keep("book")
    page.ask_and_wait("mug > handle")
    page.press("ArrowLeft")
    file = page.save("Page with answers, HTML", tmp_path / "page.html")
    context = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}, offline=True)
    alone, wrong = ScenePage(context.new_page()), []
    alone.on("pageerror", lambda error: wrong.append(str(error)))
    alone.on("console", lambda said: said.type == "error" and wrong.append(said.text))
    alone.goto(file.as_uri())
    alone.locator("body[data-ready=yes]").wait_for()
    alone.answers().first.wait_for()  # the page opens with its answer and the last camera
    assert alone.locator("#text").input_value() == "mug > handle"
    found, expected = alone.wire_camera(), page.wire_camera()
    np.testing.assert_allclose(found["cam_from_world"], expected["cam_from_world"], atol=1e-3)
    (hit,) = scene.query("mug > handle")
    assert alone.locator("#answers li").get_attribute("data-node") == str(hit.node)
    alone.ask("spoon")
    alone.get_by_text("This page contains only the answers to: book, mug > handle").wait_for()
    assert [chip.inner_text().split("\n")[0] for chip in alone.chips().all()] == ["book"]
    assert alone.locator("#overlay path.kept").count() == 1
    alone.locator("#save summary").click()
    assert alone.locator("#save > div").inner_text().startswith("Picture, PNG") and not wrong
    context.close()


def test_a_rewritten_scene_is_reported_and_reloaded_without_the_old_choice(opened, served, own_desk):
    opened.expected.append("409")  # the browser reports what was refused
    page = served(own_desk, painter="server")
    page.locator("#view").focus()
    page.ask("mug > handle")
    page.answers().first.click()
    page.locator("#overlay path.chosen").first.wait_for(state="attached")
    page.until(lambda: "node=" in page.url)
    assert not page.get_by_role("alert").is_visible()
    tree = own_desk / "default/semantic_tree"
    with np.load(tree / "tree.npz") as held:
        arrays = {**held, "quality": held["quality"] * 0.5}
    with atomic_folder(tree) as new:
        shutil.copytree(tree, new, dirs_exist_ok=True)
        np.savez(new / "tree.npz", **arrays)
        change_index(new)
    page.get_by_role("alert").get_by_text("The scene has changed (semantic_tree)").wait_for()
    page.locator("#overlay path.chosen").first.wait_for(state="attached")  # as it was
    page.get_by_role("button", name="Reload").click()
    page.get_by_role("alert").wait_for(state="hidden")
    page.answers().first.wait_for()  # the question is asked again
    assert page.locator("#text").input_value() == "mug > handle"
    assert not page.locator("#overlay path.chosen").count()


def test_a_tree_of_70000_nodes_looks_like_a_small_one(opened, served, own_desk, desk_address):
    add_nodes(own_desk, 70_000)
    found = []
    for page, unfold in ((served(own_desk), ("ArrowRight",)), (opened(desk_address), ())):
        page.ask("mug > handle")
        page.answers().first.wait_for()
        page.wait_for_timeout(800)
        picture = page.pixels()
        items = page.locator("[role=treeitem]").count()
        (place,) = page.on_page((6, 6, 0))  # a yellow pixel of the rim
        page.mouse.click(*place.tolist())
        chosen = page.locator("#overlay path.chosen").first
        chosen.wait_for(state="attached")
        node = int(chosen.get_attribute("data-node"))
        item = page.locator(f"[role=treeitem][data-node='{node}']")
        assert item.get_attribute("aria-selected") == "true" and item.is_visible()
        for key in (*unfold, "ArrowRight"):
            item.press(key)
        below = int(page.evaluate("document.activeElement.dataset.node"))
        found.append((picture, items, node, below))
    (many, items, node, below), (few, own_items, own_node, own_below) = found
    np.testing.assert_array_equal(many, few)
    assert (items, own_items) == (702, 5)  # parts of a folded whole are not made
    assert (node, below) == (own_node + 70_000, own_below + 70_000)


def test_late_replies_do_not_undo_what_was_done_meanwhile(served, own_desk):
    page = served(own_desk)
    for path in ("api/pick", "api/names"):
        page.late(path)
    name = page.get_by_role("textbox", name="Name")
    for node, text in ((0, "frog"), (1, "hat")):
        page.choose_row(node)
        name.fill(text)
        page.keyboard.press("Enter")
    ((x, y),) = page.on_page((6, 6, 0))
    page.mouse.click(x, y)
    page.choose_row(3)
    page.get_by_text("Named “hat”").wait_for()
    page.wait_for_timeout(900)
    names = read_names(own_desk, own_desk / "default/semantic_tree").of_node
    assert names == {0: "frog", 1: "hat"}
    assert page.locator("[role=treeitem][aria-selected=true]").get_attribute("data-node") == "3"
    page.late("api/like")
    page.press("m")
    page.ask_and_wait("book")
    page.wait_for_timeout(900)
    assert page.get_by_role("status").inner_text().startswith("1 answer")


def test_the_field_of_an_earlier_query_is_not_painted(page):
    held = []
    page.route("**/api/field**", lambda route: route.continue_() if held else held.append(route))
    page.ask_and_wait("mug")
    page.locator("#colour").select_option("field")
    page.until(lambda: held)
    page.ask("book")
    field = "hilsplat.painted()[0].style.field?.text"
    page.until(lambda: page.evaluate(field) == "book")
    held[0].continue_()
    page.wait_for_timeout(500)
    assert page.evaluate(field) == "book"
