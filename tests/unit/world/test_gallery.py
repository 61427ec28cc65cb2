"""The manual's list of classes and its pictures show the current world."""

import numpy as np
from PIL import Image

from hilsplat.world.gallery import draw_classes, draw_scenes
from hilsplat.world.objects.catalogue import TABLETOP
from tests.conftest import PROJECT

MANUAL = PROJECT / "docs" / "world.md"


def test_the_manual_lists_the_classes_of_the_catalogue():
    text = " ".join(MANUAL.read_text().split())
    *names, last = TABLETOP
    assert f"The {len(TABLETOP)} classes are {', '.join(names)} and {last}." in text


def test_a_picture_of_classes_shows_each_on_a_plain_ground(tmp_path):
    draw_classes(tmp_path / "classes.png", ("burger",))
    with Image.open(tmp_path / "classes.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    colourful = np.ptp(pixels, axis=2) > 60  # the ground and the page are grey
    assert 0.01 < colourful.mean() < 0.2


def test_a_picture_of_scenes_is_written_for_any_number_of_them(tmp_path, monkeypatch):
    monkeypatch.setattr("hilsplat.world.gallery.SCENE_PX", 48)
    draw_scenes("tabletop", [100], tmp_path / "scenes.png")
    with Image.open(tmp_path / "scenes.png") as picture:
        assert picture.width > picture.height
