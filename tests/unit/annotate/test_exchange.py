"""Files of other programs: export and import (tests/imports has each format's regions)."""

import io
import json
import zipfile

import numpy as np
import pytest

from hilsplat.annotate.exchange import exported, imported, merged
from hilsplat.annotate.labels import Label
from hilsplat.base.errors import HilsplatError
from hilsplat.scene.cameras import Cameras

SIZE = (30, 40)
RING = [[(4, 4), (35, 4), (35, 12), (4, 12)], [(4, 13), (12, 13), (12, 25), (4, 25)]]  # two pieces


@pytest.fixture
def cameras() -> Cameras:
    names = ("DSC_1.png", "DSC_2.png")
    eye, sizes = np.tile(np.eye(4), (2, 1, 1)), np.full((2, 2), SIZE, np.int32)
    return Cameras(names, eye, np.tile(np.eye(3), (2, 1, 1)), sizes)


@pytest.fixture
def known() -> dict[str, list[Label]]:
    mug = Label(id=3, level=1, text="mug", polygons=RING)
    handle = Label(id=9, level=2, parent=3, text="handle", polygons=[RING[1]], origin="edited")
    other = Label(id=4, level=1, text="mug", polygons=[[(0, 0), (3, 0), (0, 3)]], origin="proposed")
    return {
        "DSC_1.png": [mug, handle, other],
        "DSC_2.png": [handle.model_copy(update={"level": 1, "parent": None})],
    }


def files_of(data: bytes) -> dict[str, str]:
    if data[:2] != b"PK":
        return {"coco.json": data.decode()}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name).decode() for name in archive.namelist()}


@pytest.mark.parametrize("kind", ["hilsplat", "isat", "labelme", "coco"])
def test_exported_files_are_read_back_with_levels_and_parents_and_change_nothing(
    kind, known, cameras, caplog
):
    files = [imported(name, text, cameras) for name, text in files_of(exported(kind, known, cameras)).items()]
    if kind != "hilsplat":  # other programs would take a proposal as ground truth
        del known["DSC_1.png"][2]
        assert "1 unaccepted proposals are not exported" in caplog.text
    number = sum(map(len, known.values()))
    assert merged(known, files, dict.fromkeys(cameras.names, SIZE)) == ({}, 0, number)
    found = {view: labels for file in files for view, labels in file.items()}
    assert found.keys() == known.keys()
    for view, labels in known.items():
        by_id = {label.id: label for label in found[view]}
        for ours, theirs in ((label, by_id[label.id]) for label in labels):
            assert theirs.model_dump(exclude={"polygons"}) == ours.model_dump(exclude={"polygons"})
            np.testing.assert_array_equal(theirs.mask(SIZE), ours.mask(SIZE))


def test_labels_of_lerf_are_imported_as_wholes_regardless_of_groups(cameras):
    square = [[2.7, 2.2], [9.9, 2.2], [9.9, 9.1], [2.7, 9.1]]
    keys = {"group": 1, "segmentation": square, "iscrowd": False}
    objects = [{"category": text, **keys} for text in ("mug", "mug", "cup")]
    content = {"info": {"name": "DSC_1.jpg", "width": 40, "height": 30}, "objects": objects}
    labels = imported("DSC_1.json", json.dumps(content), cameras)["DSC_1.png"]
    found = [(label.id, label.text, label.level) for label in labels]
    assert found == [(1, "mug", 1), (2, "mug", 1), (3, "cup", 1)]
    assert labels[0].mask(SIZE).sum() == 64  # vertices are truncated, as in the published evaluation


def shapes(shape: str, size_hw: tuple = SIZE) -> str:
    size = f'"imageHeight": {size_hw[0]}, "imageWidth": {size_hw[1]}'
    return f'{{"shapes": [{shape}], "imagePath": "DSC_1", {size}}}'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "cannot be read"),
        ('{"shapes": [], "imagePath": "DSC_9.jpg"}', "not match a photograph"),
        (shapes('{"label": "a", "points": [[1, 1], [9, 1], [9, 9]]}', (61, 99)), "99 x 61 px"),
        (shapes('{"label": "a", "points": [[1, 1]], "shape_type": "circle"}'), "circle"),
        (shapes('{"label": "  ", "points": [[1, 1], [5, 5], [1, 5]]}'), "text: "),
        (shapes('{"label": "a\\u0007", "points": [[1, 1], [5, 5], [1, 5]]}'), "text: "),
        (200_000 * "[" + 200_000 * "]", "nested too deeply"),
        (shapes('{"label": "a", "points": [[1, 1e999], [5, 5]]}'), "read"),
        (shapes('{"label": "a", "points": [[1, 1]], "group_id": [1]}'), "polygon with 1 points"),
        (shapes("7"), "read"),
        (shapes('{"label": "a", "points": [[1, 1], [9, 1], [9, 9]]}', ("[1]", "NaN")), "valid image size"),
        ('{"objects": [7], "info": {"name": "DSC_1", "width": 40, "height": 30}}', "file.json, object 0"),
        ('{"annotations": [{}], "images": []}', "'categories'"),
    ],
)
def test_invalid_files_are_refused(content, message, cameras):
    with pytest.raises(HilsplatError, match=message):
        imported("file.json", content, cameras)


# -- merging with existing annotations ------------------------------------------------------------

SIZES = {"DSC_1.png": SIZE, "DSC_2.png": SIZE}


def square(left: int, top: int, side: int = 8) -> list[list[tuple[int, int]]]:
    right, bottom = left + side, top + side
    return [[(left, top), (right, top), (right, bottom), (left, bottom)]]


def numbered(view: str, *things: tuple[str, int, int]) -> dict[str, list[Label]]:
    """A file whose shapes are numbered from 1, as by programs without ids."""
    rows = enumerate(things, 1)
    return {view: [Label(id=row, level=1, text=text, polygons=square(x, y)) for row, (text, x, y) in rows]}


def ids(found, view: str) -> dict[str, int]:
    return {label.text: label.id for label in found[view]}


def test_shapes_without_ids_are_matched_by_their_texts():
    files = [
        numbered("DSC_1.png", ("mug", 2, 2), ("cup", 20, 2)),
        numbered("DSC_2.png", ("lamp", 2, 2), ("mug", 20, 2)),
    ]
    turtle = Label(id=1, level=1, text="turtle", polygons=square(2, 15))
    found, added, known = merged({"DSC_1.png": [turtle]}, files, SIZES)
    first, second = ids(found, "DSC_1.png"), ids(found, "DSC_2.png")
    assert (first["turtle"], added, known) == (1, 4, 0)
    assert first["mug"] == second["mug"]
    assert len({first["turtle"], first["mug"], first["cup"], second["lamp"]}) == 4
    files = [numbered(view, ("mug", 2, 2), ("mug", 20, 2)) for view in SIZES]
    found, _, _ = merged({}, files, SIZES)
    assert [[label.id for label in found[view]] for view in SIZES] == [[1, 2], [1, 2]]


def test_a_corrected_region_replaces_that_of_the_same_thing(known, cameras):
    polygons = [[(4, 4), (35, 4), (35, 11), (4, 11)], RING[1]]
    corrected = known["DSC_1.png"][0].model_copy(update={"polygons": polygons, "id": 77})
    found, added, _ = merged(known, [{"DSC_1.png": [corrected]}], SIZES)
    mug = next(label for label in found["DSC_1.png"] if label.id == 3)
    assert (len(found["DSC_1.png"]), added, mug.polygons) == (3, 1, corrected.polygons)


def test_parts_refer_to_the_new_id_of_their_whole():
    lamp = Label(id=1, level=1, text="lamp", polygons=square(2, 2, 20))
    mug = Label(id=1, level=1, text="mug", polygons=square(2, 2, 20))
    handle = Label(id=2, level=2, parent=1, text="handle", polygons=square(4, 4))
    found, _, _ = merged({"DSC_1.png": [lamp]}, [{"DSC_1.png": [mug, handle]}], SIZES)
    _, new_mug, new_handle = found["DSC_1.png"]
    assert new_mug.id != 1 and new_handle.parent == new_mug.id
