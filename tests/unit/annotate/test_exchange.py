"""Files of other programs, there and back, and against pycocotools."""

import io
import json
import zipfile

import numpy as np
import pytest
from pycocotools import mask as coco_masks

from hilsplat.annotate.exporting import exported
from hilsplat.annotate.importing import imported, unpacked_counts
from hilsplat.annotate.labels import Label
from hilsplat.base.errors import SceneError
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
def test_what_is_exported_comes_back_with_levels_and_parents(kind, known, cameras):
    found: dict[str, list[Label]] = {}
    for name, text in files_of(exported(kind, known, cameras)).items():
        found |= imported(name, text, cameras)
    assert found.keys() == known.keys()
    for view, labels in known.items():
        by_id = {label.id: label for label in found[view]}
        for ours, theirs in ((label, by_id[label.id]) for label in labels):
            assert theirs.model_dump(exclude={"polygons"}) == ours.model_dump(exclude={"polygons"})
            np.testing.assert_array_equal(theirs.mask(SIZE), ours.mask(SIZE))


def test_coco_is_what_pycocotools_reads(known, cameras):
    content = json.loads(exported("coco", known, cameras))
    for each, ours in zip(content["annotations"], known["DSC_1.png"], strict=False):
        runs = coco_masks.frPyObjects(each["segmentation"], *SIZE)
        np.testing.assert_array_equal(coco_masks.decode(runs).astype(bool), ours.mask(SIZE))
        assert coco_masks.toBbox(runs).tolist() == each["bbox"] and coco_masks.area(runs) == each["area"]


@pytest.mark.parametrize("seed", range(6))
def test_compressed_run_lengths_are_those_of_pycocotools(seed, cameras):
    mask = np.random.default_rng(seed).random(SIZE) < (0.5, 0.02, 0.98)[seed % 3]
    if seed > 2:
        mask = np.repeat(mask[:3], 10, axis=0)
    runs = coco_masks.encode(np.asfortranarray(mask, np.uint8))
    counts = unpacked_counts(runs["counts"].decode())
    assert sum(counts) == mask.size
    content = {
        "images": [{"id": 5, "file_name": "photos/DSC_2.jpg", "height": 30, "width": 40}],
        "categories": [{"id": 2, "name": "mug"}],
        "annotations": [
            {"image_id": 5, "category_id": 2, "segmentation": {**runs, "counts": runs["counts"].decode()}}
        ],
    }
    (label,) = imported("coco.json", json.dumps(content), cameras)["DSC_2.png"]
    np.testing.assert_array_equal(label.mask(SIZE), mask)


def test_labels_of_lerf_come_in_as_wholes_whose_groups_mean_nothing(cameras):
    square = [[2.7, 2.2], [9.9, 2.2], [9.9, 9.1], [2.7, 9.1]]
    objects = [
        {"category": text, "group": 1, "segmentation": square, "iscrowd": False}
        for text in ("mug", "mug", "cup")
    ]
    content = {"info": {"name": "DSC_1.jpg", "width": 40, "height": 30}, "objects": objects}
    labels = imported("DSC_1.json", json.dumps(content), cameras)["DSC_1.png"]
    assert [(label.id, label.text, label.level) for label in labels] == [
        (1, "mug", 1),
        (2, "mug", 1),
        (3, "cup", 1),
    ]
    assert labels[0].mask(SIZE).sum() == 64  # vertices are truncated, as in the published evaluation


def test_labelme_rectangles_and_groups(cameras):
    shapes = [
        {"label": "mug", "points": [[2, 2], [9, 9]], "shape_type": "rectangle", "group_id": None},
        {"label": "cup", "points": [[2, 2], [9, 2], [9, 9]], "group_id": 7},
        {"label": "cup", "points": [[20, 2], [29, 2], [29, 9]], "group_id": 7},
    ]
    content = {"shapes": shapes, "imagePath": "..\\photos\\DSC_1.jpg", "imageHeight": 30, "imageWidth": 40}
    mug, cup = imported("x.json", json.dumps(content), cameras)["DSC_1.png"]
    assert mug.mask(SIZE).sum() == 64 and len(cup.polygons) == 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "cannot be read"),
        ("[]", "of no known format"),
        ('{"shapes": [], "imagePath": "DSC_9.jpg"}', "belongs to no photograph"),
        ('{"shapes": [], "imagePath": "DSC_1.jpg", "imageHeight": 60, "imageWidth": 80}', "80 x 60 px"),
        (
            '{"shapes": [{"label": "a", "points": [[1, 1]], "shape_type": "circle"}], "imagePath": "DSC_1"}',
            "circle",
        ),
        ('{"shapes": [{"label": "", "points": [[1, 1], [5, 5]]}], "imagePath": "DSC_1"}', "text: "),
        ('{"annotations": [{}], "images": []}', "'categories'"),
    ],
)
def test_a_file_that_does_not_fit_says_why(content, message, cameras):
    with pytest.raises(SceneError, match=message):
        imported("file.json", content, cameras)
