"""Outlines around clicks and boxes, by the SAM that made the masks of a scene."""

import cv2
import numpy as np
import pytest

from hilsplat.annotate.proposals import Clicks
from hilsplat.base.artifacts import write_index
from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import Level
from hilsplat.datasets.images.isat import fill_polygons
from hilsplat.scene.scene import Scene
from tests.conftest import PROJECT
from tests.unit.segment.handmade import save_scene

SIZE = (192, 192)
LEFT, RIGHT = ((60, 90), (26, 30)), ((140, 110), (24, 34))
"""Middle and half axes of two discs of one colour, px."""


def disc(middle: tuple[int, int], axes: tuple[int, int]) -> np.ndarray:
    mask = np.zeros(SIZE, np.uint8)
    cv2.ellipse(mask, middle, axes, 0, 0, 360, 1, cv2.FILLED)
    return mask > 0


def iou(found: np.ndarray, expected: np.ndarray) -> float:
    return np.count_nonzero(found & expected) / np.count_nonzero(found | expected)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """A photograph of two discs on a grey table."""
    folder = tmp_path_factory.mktemp("scene")
    pixels = np.full((*SIZE, 3), 120.0) + np.random.default_rng(0).normal(0, 6, (*SIZE, 1))
    for each in (LEFT, RIGHT):
        pixels[disc(*each)] = (215, 60, 40)
    pixels = np.clip(pixels, 0, 255).astype(np.uint8)
    return Scene.load(save_scene(folder, {"000.png": pixels}, K=np.diag([200.0, 200, 1])))


@pytest.fixture(scope="module")
def clicks(scene, tmp_path_factory) -> Clicks:
    masks = tmp_path_factory.mktemp("masks")
    write_index(masks, {}, segmenter="sam", model=str(PROJECT / "models/sam-tiny"))
    return Clicks(scene, masks)


def test_a_click_or_a_box_outlines_the_thing_at_it(clicks):
    best, *others = clicks.outlines("000.png", [(*LEFT[0], True)], None)
    assert iou(fill_polygons(best.polygons, SIZE), disc(*LEFT)) > 0.8
    assert best.what == "by sam-tiny" and best.level == Level.WHOLE  # the three heads agree
    assert len(others) < 3
    (x, y), (a, b) = RIGHT
    best, *_ = clicks.outlines("000.png", [], (x - a, y - b, x + a, y + b))
    assert iou(fill_polygons(best.polygons, SIZE), disc(*RIGHT)) > 0.8


def test_things_at_clicks_outside_are_not_outlined(clicks):
    asked = [(*LEFT[0], True), (*RIGHT[0], False), (10, 10, False)]
    best, *_ = clicks.outlines("000.png", asked, None)
    found = fill_polygons(best.polygons, SIZE)
    assert found[LEFT[0][::-1]] and not found[RIGHT[0][::-1]] and not found[10, 10]


def test_something_must_be_clicked_inside_the_photograph(clicks):
    for asked in ([], [(5, 5, False)], [(192, 5, True)], [(-1, 5, True)]):
        with pytest.raises(SettingsError, match=r"no click(.|\n)*x < 192, y < 192"):
            clicks.outlines("000.png", asked, None)


def test_a_scene_without_sam_masks_reports_it(scene, tmp_path):
    assert Clicks(scene, tmp_path / "masks").name == ""  # before there are masks
    write_index(tmp_path / "masks", {}, segmenter="graph", model=None)
    with pytest.raises(SettingsError, match="without SAM"):
        Clicks(scene, tmp_path / "masks").outlines("000.png", [(60, 90, True)], None)
