"""An HTML table of the report at a common width of a window."""

import pytest

from hilsplat.evaluate.tables.formats import as_html
from hilsplat.evaluate.tables.rows import Block, Cell, Row, Table


@pytest.mark.parametrize("columns", [6, 30])
def test_the_method_stays_in_view_beside_every_column(browser, columns):
    values = [f"lerf/langsplat: mIoU of scene number {number}" for number in range(columns)]
    rows = tuple(
        Row(
            {"Method": f"Method {row} of the table", "Kind": "trained"},
            {value: Cell("61.3") for value in values},
        )
        for row in range(5)
    )
    table = Table(
        "wide", "A wide table", (Block("measured", "lerf", "LERF", rows, tuple(values)),), ("A note.",)
    )
    page = browser.new_page(viewport={"width": 1280, "height": 600})
    page.set_content(as_html(table))
    scroll = page.locator(".scroll")
    is_wide = scroll.evaluate("area => area.scrollWidth > area.clientWidth")
    assert is_wide == (columns == 30)
    assert page.evaluate("document.documentElement.scrollWidth") <= 1280  # the table scrolls, not the page
    scroll.evaluate("area => { area.scrollLeft = area.scrollWidth }")
    for row in range(5):
        name, last = (page.locator("tbody tr").nth(row).locator("td").nth(place) for place in (0, -1))
        left, right = name.bounding_box(), last.bounding_box()
        assert left["x"] >= 0 and left["x"] + left["width"] < right["x"]
        assert right["x"] + right["width"] <= 1280
        on_top = "([x, y]) => document.elementFromPoint(x, y).textContent"
        assert page.evaluate(on_top, [left["x"] + 5, left["y"] + 5]) == f"Method {row} of the table"
    page.close()
