"""Visible details of the viewer: labels, colours and messages."""

import re

import numpy as np


def test_a_box_beside_the_picture_has_no_label_and_labels_stay_clear_of_the_tools(opened, desk_address):
    page = opened(desk_address, "server")
    page.ask("mug > handle")
    label = page.locator("#overlay text")
    label.first.wait_for(state="attached")
    tools = page.locator("#tools").bounding_box()
    for _ in range(40):
        page.evaluate("hilsplat.camera.move(0, 3, 0); hilsplat.redraw()")  # until the box leaves the picture
        page.wait_for_timeout(100)
        top = page.evaluate("document.querySelector('#overlay text')?.getBoundingClientRect().toJSON()")
        if top is None:
            break
        assert top["y"] + top["height"] > tools["y"] + tools["height"]
    page.wait_for_function("!document.querySelector('#overlay text')")  # the last picture may be on its way


def test_a_flight_ends_with_the_whole_node_in_view_and_no_node_hovered(opened, desk_address, scene):
    page = opened(desk_address, "server")
    for text in ("mug", "mug > handle"):
        page.choose_row(scene.query(text)[0].node)
        page.locator("[role=treeitem] > .row .label").last.hover()
        page.locator("#overlay path.hover").first.wait_for(state="attached")
        page.press("f")
        page.locator("#overlay path.hover").first.wait_for(state="detached")
        page.wait_for_timeout(1500)
        box = page.locator("#overlay path.chosen")
        box.wait_for(state="attached")
        places = np.array(re.findall(r"[-\d.]+", box.get_attribute("d")), float).reshape(-1, 2)
        wire = page.wire_camera()
        middle, half = np.array(wire["K"])[:2, 2], np.array(wire["size_hw"])[::-1] / 2
        assert (np.abs(places - middle) < half).all() and np.ptp(places, axis=0).max() > 0.3 * half.min()
