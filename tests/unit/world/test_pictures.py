"""Pictures of classes and scenes, and the list of classes in docs/world.md."""

import numpy as np
from PIL import Image

from hilsplat.datasets.synthetic.hierarchy import AnnotatedNode
from hilsplat.world.objects.catalogue import TABLETOP
from hilsplat.world.pictures import draw_classes, draw_scenes, node_colours, tree_lines
from tests.conftest import PROJECT

MANUAL = PROJECT / "docs" / "world.md"


def test_the_manual_lists_all_tabletop_classes():
    text = " ".join(MANUAL.read_text().split())
    *names, last = TABLETOP
    assert f"The {len(TABLETOP)} classes are {', '.join(names)} and {last}." in text


def test_a_picture_of_classes_shows_an_object_on_plain_ground(tmp_path):
    draw_classes(tmp_path / "classes.png", ("burger",))
    with Image.open(tmp_path / "classes.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    colourful = np.ptp(pixels, axis=2) > 60  # the ground and the page are grey
    assert 0.01 < colourful.mean() < 0.2


def test_a_picture_of_a_single_scene_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr("hilsplat.world.pictures.SCENE_PX", 48)
    draw_scenes("tabletop", [100], tmp_path / "scenes.png")
    with Image.open(tmp_path / "scenes.png") as picture:
        assert picture.width > picture.height


def test_the_tree_lists_a_shared_text_once():
    rows = [(1, -1, "chair"), (2, 0, "chair leg"), (3, 1, "chair foot"), (2, 0, "chair leg")]
    rows += [(3, 3, "chair foot")]
    nodes = tuple(AnnotatedNode(row, *fields) for row, fields in enumerate(rows))
    assert [(depth, node.id) for depth, node in tree_lines(nodes)] == [(0, 0), (1, 1), (2, 2)]
    assert len(np.unique(node_colours(100), axis=0)) > 95
