"""The data set of docs/extending.md can be read as documented."""

import re
import types

import numpy as np
import pytest

from hilsplat.base.errors import SceneError
from hilsplat.base.images import write_png
from hilsplat.evaluate.protocols.cards import card_named
from tests.conftest import PROJECT

EXTENDING = PROJECT / "docs" / "extending.md"


@pytest.fixture(scope="module")
def example() -> types.ModuleType:
    code = re.search(r"```python\n(# hilsplat/datasets/desk_labels\.py.*?)```", EXTENDING.read_text(), re.S)
    module = types.ModuleType("desk_labels")
    exec(compile(code[1], "desk_labels.py", "exec"), module.__dict__)
    return module


def test_the_data_set_of_the_documentation_is_read(example, tmp_path):
    mug = np.zeros((6, 8), np.uint8)
    mug[1:4, 2:5] = 255
    write_png(tmp_path / "mine/images/000.png", np.zeros((6, 8, 3), np.uint8))
    write_png(tmp_path / "mine/labels/000/mug.png", np.repeat(mug[..., None], 3, axis=2))
    scene = example.DESK.open(tmp_path, "mine")
    (region,) = scene.views["000.png"]
    assert region.text == "mug"
    assert np.array_equal(region.mask(), mug > 0)
    assert example.DESK.check(tmp_path, "mine").facts
    assert [card_named(name).name for name in example.DESK.protocols] == list(example.DESK.protocols)
    places = [path for pattern in example.DESK.label_places("mine") for path in tmp_path.glob(pattern)]
    assert tmp_path / "mine/labels/000/mug.png" in places


def test_its_missing_folder_is_named(example, tmp_path):
    (tmp_path / "mine/images").mkdir(parents=True)
    with pytest.raises(SceneError, match="also mine/labels"):
        example.DESK.open(tmp_path, "mine")
