"""Gaussians selected by an answer, a box and a brush, removed, restored and saved."""

import io
import re
from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData

from hilsplat.splat.ply import load_ply
from hilsplat.viewer.frames import within
from hilsplat.viewer.wire import WireCamera
from tests.unit.artifact_changes import loosen
from tests.unit.splat.spz_reader import decoded


def edit(page) -> None:
    page.get_by_role("button", name="Edit", exact=True).click()
    page.wait_for_timeout(300)  # the view is lower now


def selected_after(page, act: Callable[[], object]) -> int:
    """Run `act`, and return the number of selected Gaussians once it has changed."""
    told = page.locator("#edit-told")
    before = told.inner_text()
    act()
    page.until(lambda: told.inner_text() != before)
    return int(re.search(r"\d+", told.inner_text()).group())


def has(page, selected: int, removed: int) -> None:
    """Wait until these numbers of Gaussians are selected and removed."""
    told = f"{selected} selected, {removed} removed"
    page.until(lambda: told in page.locator("#edit-told").inner_text())


def use(page, tool: str) -> None:
    page.get_by_role("toolbar", name="Edit").get_by_text(tool, exact=True).click()


def drag_over(page, *points: tuple[float, float], held: str = "") -> None:
    """Drag over points of the desk's plane."""
    page.drag(*page.on_page(*[(x, y, 0) for x, y in points]), held=held)


def colour(page, x: float, y: float) -> np.ndarray:
    """Colour of the picture at a point of the desk's plane."""
    page.mouse.move(5, 5)
    ((left, top),) = page.on_page((x, y, 0))
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)
    return picture[round(top), round(left)]


def shows(page, x: float, y: float, is_right: Callable[[np.ndarray], bool]) -> None:
    """Wait until a point of the desk's plane has the right colour."""
    page.until(lambda: is_right(colour(page, x, y)))


@pytest.mark.parametrize("painter", ["gl", "server"])
def test_gaussians_in_a_box_are_selected_removed_and_restored(opened, desk_address, painter):
    page = opened(desk_address, painter)
    edit(page)
    use(page, "box")
    drag_over(page, (21.5, 16.5), (29.5, 20.5))
    has(page, 8 * 4, 0)
    shows(page, 25, 18, lambda rgb: np.abs(rgb - (0.7 * 255, 0, 0.3 * 250 + 0.7 * 160)).max() < 40)
    page.press("Delete")
    has(page, 0, 32)
    shows(page, 25, 18, lambda rgb: rgb.max() < 40)
    drag_over(page, (19.5, 14.5), (29.5, 20.5))  # what is removed is not selected again
    has(page, 10 * 6 - 32, 32)
    page.press("Control+z", "Control+z")
    has(page, 32, 0)
    page.press("Control+z")
    has(page, 0, 0)
    shows(page, 25, 18, lambda rgb: rgb[2] > 150)
    page.get_by_role("button", name="Redo").click()
    page.press("Control+Shift+z")
    has(page, 0, 32)
    drag_over(page, (-0.5, -0.5), (15.5, 23.5))
    page.get_by_role("button", name="Keep only").click()
    has(page, 0, 864 - 16 * 24)


def test_the_brush_adds_and_subtracts(page, desk):
    gaussians = load_ply(desk / "gaussians.ply")
    edit(page)
    page.press("c")
    page.get_by_label("Size").fill("60")
    camera = WireCamera.model_validate(page.wire_camera()).camera()
    view = page.locator("#view").bounding_box()
    places = page.on_page((6, 8, 0), (26, 14, 0)) - (view["x"], view["y"])
    points = [tuple(place) for place in places.tolist()]
    expected = int(within(gaussians.means, camera, points, 30.0).sum())
    selected = selected_after(page, lambda: drag_over(page, (6, 8), (26, 14)))
    assert abs(selected - expected) <= 0.05 * expected and expected > 60
    assert selected_after(page, lambda: drag_over(page, (6, 20), (8, 20), held="Shift")) > selected
    fewer = selected_after(page, lambda: drag_over(page, (6, 20), (8, 20), held="Control"))
    assert fewer == pytest.approx(selected, abs=2)
    size = float(page.get_by_label("Size").input_value())
    page.press("]")
    assert float(page.get_by_label("Size").input_value()) > size
    inverted = selected_after(page, lambda: page.press("i"))
    assert inverted == pytest.approx(len(gaussians) - selected, abs=2)
    page.press("Escape")  # dragging moves the camera again
    before = page.wire_camera()
    drag_over(page, (6, 8), (12, 8))
    assert page.wire_camera() != before
    page.press("c")
    page.get_by_label("Size").press("Delete")
    has(page, 0, inverted)
    assert page.phone_fits()


def test_an_answer_is_removed_and_the_rest_is_saved(page, desk, scene, tmp_path):
    page.keep("book")
    page.ask_and_wait("mug > handle")
    (book,), (handle,) = scene.query("book"), scene.query("mug > handle")
    edit(page)
    page.get_by_role("button", name="Select answers").click()
    both = scene.views.gaussians_of([book.node, handle.node])
    has(page, len(both), 0)
    page.press("Escape")  # clears the answer, but not the selection
    page.get_by_role("button", name="Show book").click()
    page.locator(f"[role=treeitem][data-node='{handle.node}'] > .row .label").click()
    page.get_by_label("Selection").select_option("subtract")
    page.get_by_role("button", name="Select answers").click()
    rows = np.setdiff1d(both, handle.gaussians)
    has(page, len(rows), 0)
    page.get_by_role("button", name="Remove", exact=True).click()
    before = (desk / "gaussians.ply").read_bytes()
    found = PlyData.read(page.save("Whole scene, PLY", tmp_path / "scene.ply"))["vertex"].data
    kept = np.setdiff1d(np.arange(864), rows)
    np.testing.assert_array_equal(found, PlyData.read(desk / "gaussians.ply")["vertex"].data[kept])
    compressed = decoded(page.save("Whole scene, SPZ", tmp_path / "scene.spz").read_bytes())
    assert len(compressed) == len(kept)
    assert (desk / "gaussians.ply").read_bytes() == before


def test_what_is_done_while_a_selection_is_on_its_way_acts_on_it(page, tmp_path):
    page.late("api/within")
    edit(page)
    use(page, "box")
    drag_over(page, (21.5, 16.5), (29.5, 20.5))
    page.press("Delete")
    offline = page.saved_page(tmp_path)
    has(page, 0, 32)
    assert offline.evaluate("hilsplat.painter.count") == 864 - 32
    assert not offline.get_by_role("button", name="Edit", exact=True).is_visible()
    drag_over(page, (19.5, 14.5), (29.5, 20.5))
    page.press("Control+z")  # the selection, not the removal
    page.get_by_role("button", name="Redo").click()  # once it can be
    has(page, 10 * 6 - 32, 32)


def test_loose_gaussians_are_selected_and_steps_that_take_much_memory_are_forgotten(own_desk, served):
    loosen(own_desk, np.arange(100, 140))
    page = served(own_desk)
    edit(page)
    page.get_by_role("button", name="Select loose").click()
    has(page, 40, 0)
    page.press("Control+z")
    has(page, 0, 0)
    click = "([id, times]) => { while (times--) document.getElementById(id).click(); }"
    page.evaluate(click, ["edit-invert", 31])
    has(page, 864, 0)
    page.evaluate(click, ["edit-undo", 25])
    page.until(page.get_by_role("button", name="Undo").is_disabled)  # after 20
    has(page, 864, 0)


@pytest.mark.parametrize("painter", ["gl", "server"])
def test_removed_gaussians_are_kept_over_a_reload_until_they_are_restored(opened, desk_address, painter):
    page = opened(desk_address, painter)
    edit(page)
    use(page, "box")
    drag_over(page, (21.5, 16.5), (29.5, 20.5))
    page.press("Delete")
    has(page, 0, 32)
    page.reloaded()
    has(page, 0, 32)
    shows(page, 25, 18, lambda rgb: rgb.max() < 40)
    page.get_by_role("button", name="Restore all").click()
    has(page, 0, 0)
    shows(page, 25, 18, lambda rgb: rgb[2] > 150)
    page.press("Control+z")
    has(page, 0, 32)


def test_what_is_removed_in_one_tab_is_removed_in_another(page):
    other = page.beside()
    for tab, columns in ((page, (-0.5, 1.5)), (other, (1.5, 3.5))):
        edit(tab)
        use(tab, "box")
        drag_over(tab, *[(column, row) for column, row in zip(columns, (-0.5, 23.5), strict=True)])
        tab.press("Delete")
    for tab in (page, other):
        has(tab, 0, 4 * 24)
    page.reloaded()
    has(page, 0, 4 * 24)
    page.get_by_role("button", name="Restore all").click()
    has(other, 0, 0)
    other.close()
