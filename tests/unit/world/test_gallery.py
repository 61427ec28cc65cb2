"""The pictures and the table of the manual show the current world."""

from collections.abc import Sequence

import numpy as np
from PIL import Image

from hilsplat.base.levels import Level
from hilsplat.world.gallery import draw_classes, draw_scenes
from hilsplat.world.objects.catalogue import TABLETOP, build_object, maker_of
from tests.conftest import PROJECT

MANUAL = PROJECT / "docs" / "world.md"


def class_table(names: Sequence[str] = TABLETOP) -> str:
    """Markdown table of classes: other names, parts, and the subparts of each part in brackets."""
    lines = ["| class | also called | parts (subparts) |", "|---|---|---|"]
    for name in names:
        model = build_object(name, np.random.default_rng(0))
        parts: dict[str, dict[str, None]] = {}  # dicts keep the order and drop repeated legs
        for node in model.nodes[1:]:
            word = node.text.removeprefix(f"{name} ")
            if node.level == Level.PART:
                parts.setdefault(word, {})
            else:
                parts[model.nodes[node.parent].text.removeprefix(f"{name} ")][word] = None
        shown = [f"{part} ({', '.join(fine)})" if fine else part for part, fine in parts.items()]
        also = ", ".join(maker_of(name).aliases)
        lines.append(f"| {name} | {also} | {'; '.join(shown)} |")
    return "\n".join(lines)


def test_the_table_of_classes_in_the_manual_is_that_of_the_catalogue():
    table = class_table()
    assert len(table.splitlines()) == len(TABLETOP) + 2 and table in MANUAL.read_text()


def test_the_table_lists_parts_once_with_their_subparts():
    line = class_table(("chair",)).splitlines()[2]
    assert line == (
        "| chair | dining chair, side chair | seat (cushion); back (top rail, slats); leg (foot) |"
    )


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
