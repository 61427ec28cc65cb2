"""Annotations of other programs: each format's own pixels, names of photographs, and what is left out."""

import base64
import io
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from pycocotools import mask as coco_masks

from hilsplat.annotate.exchange import export_labels, imported, merged
from hilsplat.annotate.labels import Label, label_path, write_labels
from hilsplat.base.errors import HilsplatError, SceneError
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.scene import Scene
from hilsplat.web.file_changes import NO_FILE
from tests.unit.segment.handmade import save_scene

SIZE = HEIGHT, WIDTH = 60, 80
VIEWS = ("IMG_0001.png", "IMG_0002.png", "cam1_a.png")
CAMERAS = Cameras(
    VIEWS, np.tile(np.eye(4), (3, 1, 1)), np.tile(np.eye(3), (3, 1, 1)), np.tile(np.int32([SIZE]), (3, 1))
)


def box(left: int, top: int, right: int, bottom: int) -> np.ndarray:
    """The region of columns left to right - 1 and rows top to bottom - 1."""
    mask = np.zeros(SIZE, bool)
    mask[top:bottom, left:right] = True
    return mask


def flat(left, top, right, bottom):
    return [left, top, right, top, right, bottom, left, bottom]


def regions(content, name: str = "x.json", notes=None, photos=None) -> dict[str, list[np.ndarray]]:
    found = imported(name, json.dumps(content), CAMERAS, notes, photos)
    return {view: [label.mask(SIZE) for label in labels] for view, labels in found.items()}


def only(content) -> np.ndarray:
    ((mask,),) = regions(content).values()
    return mask


def coco(*segmentations, image=None, **keys):
    image = {"id": 7, "file_name": "IMG_0001.jpg", "height": HEIGHT, "width": WIDTH, **(image or {})}
    given = {"image_id": 7, "category_id": 0, "iscrowd": 0, "bbox": [1, 1, 4, 4]}
    return {
        "images": [image],
        "categories": [{"id": 0, "name": "cup"}],
        "annotations": [{"id": n, **given, "segmentation": s, **keys} for n, s in enumerate(segmentations)],
    }


def labelme(*shapes, **keys):
    image = {"imagePath": "IMG_0001.jpg", "imageHeight": HEIGHT, "imageWidth": WIDTH, "imageData": None}
    return {
        "version": "5.5.0",
        "flags": {},
        **image,
        "shapes": [{"label": "cup", **s} for s in shapes],
        **keys,
    }


def runs_of(mask: np.ndarray) -> list[int]:
    """COCO's run lengths: column by column, zeros first."""
    runs, value = [0], False
    for pixel in mask.T.ravel().tolist():
        if pixel != value:
            runs.append(0)
            value = pixel
        runs[-1] += 1
    return runs


BLOB = np.random.default_rng(0).random(SIZE) < 0.3


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (coco([flat(50, 20, 70, 40)]), box(50, 20, 70, 40)),  # the far sides are outside, as in COCO
        (coco([flat(5, 5, 9, 9), flat(20, 5, 24, 9)]), box(5, 5, 9, 9) | box(20, 5, 24, 9)),
        (coco([flat(5, 5, 9, 9), [3, 3, 30, 30]]), box(5, 5, 9, 9)),  # two vertices have no area
        (coco(flat(5, 5, 9, 9)), box(5, 5, 9, 9)),  # without the outer list
        (coco([[[5, 5], [9, 5], [9, 9], [5, 9]]]), box(5, 5, 9, 9)),  # pairs
        (coco({"size": list(SIZE), "counts": runs_of(BLOB)}, iscrowd=1), BLOB),
        (coco({"size": list(SIZE), "counts": runs_of(~BLOB)}), ~BLOB),
        (coco([flat(200, 80, 280, 160)], image={"height": 240, "width": 320}), box(50, 20, 70, 40)),
        (coco([flat(25, 10, 35, 20)], image={"height": 30, "width": 40}), box(50, 20, 70, 40)),
        (coco([flat(50, 20, 70, 40)], image={"height": 60.0, "width": 80.0}), box(50, 20, 70, 40)),
        (coco([flat(50, 20, 70, 40)], image_id=7.0, category_id="0"), box(50, 20, 70, 40)),
        # The size of run lengths is that of the mask that a network made.
        (coco({"size": [120, 160], "counts": runs_of(BLOB.repeat(2, 0).repeat(2, 1))}), BLOB),
    ],
)  # fmt: skip
def test_coco_regions_by_hand(content, expected):
    np.testing.assert_array_equal(only(content), expected)


@pytest.mark.parametrize("seed", range(4))
def test_coco_polygons_are_filled_as_pycocotools_fills_them(seed):
    chance = np.random.default_rng(seed)
    polygon = (chance.random((7, 2)) * [WIDTH, HEIGHT]).ravel().tolist()
    (runs,) = coco_masks.frPyObjects([polygon], *SIZE)
    np.testing.assert_array_equal(only(coco([polygon])), coco_masks.decode(runs))


def packed(mask: np.ndarray) -> str:
    held = io.BytesIO()
    Image.fromarray(mask if mask.dtype == bool else mask.astype(np.uint8)).save(held, "PNG")
    return base64.b64encode(held.getvalue()).decode()


CORNERS = [[2, 3], [9, 3], [9, 12], [2, 12]]
PATCH = BLOB[:10, :12]
PASTED = np.zeros(SIZE, bool)
PASTED[20:30, 50:62] = PATCH
CLIPPED = np.zeros(SIZE, bool)
CLIPPED[:7, :10] = PATCH[3:, 2:]
TRIANGLE = np.zeros(SIZE, bool)  # rows of 11, 10, ... 1 px
for row in range(11):
    TRIANGLE[5 + row, 5 : 16 - row] = True


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ({"points": [[2, 3], [9, 12]], "shape_type": "rectangle"}, box(2, 3, 10, 13)),  # borders included
        ({"points": [[9, 12], [2, 3]], "shape_type": "rectangle"}, box(2, 3, 10, 13)),
        ({"points": CORNERS, "shape_type": "rectangle"}, box(2, 3, 10, 13)),  # X-AnyLabeling
        ({"points": CORNERS, "shape_type": "rotation"}, box(2, 3, 10, 13)),
        ({"points": CORNERS, "shape_type": "oriented_rectangle"}, box(2, 3, 10, 13)),
        ({"points": [[5, 5], [15, 5], [5, 15]]}, TRIANGLE),  # labelme 3 wrote no type
        ({"points": [[5, 5], [15, 5], [5, 15]], "shape_type": "polygon", "group_id": None}, TRIANGLE),
        ({"points": [[50, 20], [61, 29]], "shape_type": "mask", "mask": packed(PATCH)}, PASTED),
        ({"points": [[50.4, 19.6], [61.4, 28.6]], "shape_type": "mask", "mask": packed(PATCH)}, PASTED),
        ({"points": [[-2, -3], [9, 6]], "shape_type": "mask", "mask": packed(PATCH)}, CLIPPED),
        ({"points": [[50, 20], [61, 29]], "shape_type": "mask", "mask": packed(255 * PATCH)}, PASTED),
    ],
)  # fmt: skip
def test_labelme_shapes_by_hand(shape, expected):
    np.testing.assert_array_equal(only(labelme(shape)), expected)


def test_labelme_circle_is_a_disc_around_its_first_point():
    mask = only(labelme({"points": [[30, 25], [30, 40]], "shape_type": "circle"}))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    distance = np.hypot(columns - 30, rows - 25)
    assert mask[distance <= 14.5].all() and not mask[distance >= 16].any()  # the border is one pixel wide


def test_labelme_shapes_of_a_group_are_one_object_and_drawings_may_have_another_size():
    pair = [{"points": [[x, 4], [x + 7, 11]], "shape_type": "rectangle", "group_id": 3} for x in (4, 40)]
    (mask,) = regions(labelme(*pair, imageHeight=2 * HEIGHT, imageWidth=2 * WIDTH))["IMG_0001.png"]
    np.testing.assert_array_equal(mask, box(2, 2, 6, 6) | box(20, 2, 24, 6))
    stream = io.BytesIO()  # old versions store the photograph instead of its size
    Image.new("RGB", (2 * WIDTH, 2 * HEIGHT)).save(stream, "JPEG")
    photo = {
        "imageData": base64.b64encode(stream.getvalue()).decode(),
        "imageHeight": None,
        "imageWidth": None,
    }
    np.testing.assert_array_equal(only(labelme(*pair, **photo)), mask)


@pytest.mark.parametrize(
    ("name", "view"),
    [
        ("IMG_0001.jpg", 0),
        ("sub/IMG_0001.PNG", 0),  # CVAT
        ("img_0002.jpeg", 1),
        ("images\\1/90fbb0c7-IMG_0001.jpg", 0),  # Label Studio
        ("..\\..\\label-studio\\media\\upload\\4\\cb0618f6-IMG_0002.jpg", 1),
        ("/data/upload/4/cb0618f6-IMG_0002.jpg", 1),
        ("/data/local-files/?d=IMG_0002.jpg", 1),
        ("https://bucket.s3.amazonaws.com/1/IMG%5F0002.jpg?X-Amz-Expires=60", 1),
        ("IMG_0001_jpg.rf.0123456789abcdef0123456789abcdef.jpg", 0),  # Roboflow
        ("IMG_0001_JPG_jpg.rf.0123456789abcdef0123456789abcdef.jpg", 0),
        ("IMG_0001_heic_jpg.rf.0BRnP3vTq8YcJm2XzK5w.jpg", 0),
        ("cam1/a.jpg", 2),
        ("C:\\scans\\cam1\\a.jpg", 2),
    ],
)
def test_names_of_photographs_in_files_of_other_programs(name, view):
    assert list(regions(coco([flat(5, 5, 9, 9)], image={"file_name": name}))) == [VIEWS[view]]
    assert list(regions(labelme({"points": [[1, 1], [9, 1], [5, 9]]}, imagePath=name))) == [VIEWS[view]]


@pytest.mark.parametrize("name", ["cam2/IMG_0001.jpg", "rig\\cam2\\IMG_0001.jpg"])
def test_a_namesake_in_another_folder_is_not_the_photograph(name):
    photos = {VIEWS[0]: {"file": "cam1/IMG_0001.jpg"}, VIEWS[1]: {"file": "cam1/IMG_0002.jpg"}}
    square = {"points": [[1, 1], [9, 1], [5, 9]]}
    for content in (coco([flat(5, 5, 9, 9)], image={"file_name": name}), labelme(square, imagePath=name)):
        with pytest.raises(SceneError, match=r"not in the scene|does not match a photograph"):
            regions(content, photos=photos)
        text = json.dumps(content).replace("cam2", "cam1")
        assert list(regions(json.loads(text), photos=photos)) == [VIEWS[0]]


@pytest.mark.parametrize("write", [coco, labelme])
def test_the_size_is_that_of_the_photograph_if_a_file_states_none(write):
    photos = {VIEWS[0]: {"file": "IMG_0001.jpg", "photo_hw_px": [2 * HEIGHT, 2 * WIDTH]}}
    drawn = [[10, 10], [41, 10], [41, 31], [10, 31]]
    if write is coco:
        content = coco([np.ravel(drawn).tolist()], image={"height": None, "width": None})
    else:
        content = labelme({"points": drawn}, imageHeight=None, imageWidth=None)
    content["imageData"] = None
    ((mask,),) = regions(content, photos=photos).values()
    np.testing.assert_array_equal(mask, box(5, 5, *((20, 15) if write is coco else (21, 16))))
    with pytest.raises(SceneError, match="does not state a valid image size"):
        regions(content)


GOOD = [flat(5, 5, 9, 9)]


def with_images(*names, content=None):
    """GOOD in each of the images."""
    content = content or coco(*[GOOD for _ in names])
    content["images"] = [
        {"id": number, "file_name": name, "height": HEIGHT, "width": WIDTH}
        for number, name in enumerate(names)
    ]
    for number, each in enumerate(content["annotations"]):
        each["image_id"] = number
    return content


def changed(content, key, rows):
    return {**content, key: [*content[key], *rows]}


@pytest.mark.parametrize(
    ("content", "num", "reason"),
    [
        (coco(GOOD, []), 1, "1 of 2 annotations are left out: 1 without a region (boxes, keypoints)"),
        (coco(GOOD, None, {}), 1, "2 without a region"),
        (changed(coco(GOOD), "annotations", coco(GOOD, isbbox=True)["annotations"]), 1, "1 without a region"),
        (coco(GOOD, [[3, 3, 9, 9]]), 1, "1 without pixels"),
        (coco(GOOD, [[3, 3, 9]]), 1, "1 invalid"),
        (coco(GOOD, GOOD, [[0, 0, 900, 0, 900, 90]]), 2, "far outside the image of 80 x 60 px"),
        (with_images("IMG_0001.jpg", "IMG_9.jpg"), 1, "1 of images that are not in the scene (IMG_9.jpg)"),
        (with_images("IMG_0001.jpg", "cam2/a.jpg"), 1, "(cam2/a.jpg)"),
        (with_images("cam1/a.jpg", "a/IMG_0002.jpg", "b/IMG_0002.jpg"), 1, "2 of different images"),
        (changed(coco(GOOD), "annotations", coco(GOOD, category_id=5)["annotations"]), 1, "unknown"),
        (labelme({"points": CORNERS}, {"points": [[5, 5]], "shape_type": "point"}), 1, "(points, lines)"),
        (labelme({"points": CORNERS}, {"points": CORNERS[:2], "shape_type": "line"}), 1, "without an area"),
        (labelme({"points": CORNERS}, {"points": CORNERS[:2]}), 1, "polygon with 2 points"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_counted_and_the_rest_is_imported(content, num, reason):
    notes: list[str] = []
    found = regions(content, notes=notes)
    assert sum(map(len, found.values())) == num
    assert len(notes) == 1 and notes[0].startswith("x.json: ") and reason in notes[0]


def test_an_image_without_annotations_may_have_any_size_and_name():
    content = changed(
        coco(GOOD), "images", [{"id": 8, "file_name": "b/IMG_0001.jpg", "height": 3, "width": 99}]
    )
    notes: list[str] = []
    assert len(regions(content, notes=notes)["IMG_0001.png"]) == 1 and not notes


def test_ids_that_occur_twice_override_nothing():
    two = changed(coco(GOOD, GOOD), "images", [{"id": 7, "file_name": "IMG_0002.jpg"}])
    with pytest.raises(HilsplatError, match="2 of images that are not in the scene"):
        regions(two)
    names = changed(coco(GOOD), "categories", [{"id": 0, "name": "mug"}])
    with pytest.raises(HilsplatError, match="1 of unknown categories"):
        regions(names)
    same = coco(GOOD, [flat(20, 5, 24, 9)], id=1, thing=4)  # two texts, but one id
    same["categories"].append({"id": 1, "name": "mug"})
    same["annotations"][1]["category_id"] = 1
    labels = imported("x.json", json.dumps(same), CAMERAS)["IMG_0001.png"]
    assert sorted((label.id, label.text) for label in labels) == [(1, "cup"), (2, "mug")]


RUNS = {"size": list(SIZE), "counts": runs_of(BLOB)}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (coco([]), "no annotation for this scene(.|\n)*1 without a region"),
        (labelme({"points": [[5, 5]], "shape_type": "point"}), "no annotation for this scene(.|\n)*an area"),
        (coco(GOOD, [[3, 3, 9]], [[3, 3, 9]]), "annotation 1(.|\n)*2 of 3 annotations in x.json"),
        (coco(GOOD, image={"height": 60, "width": 60}), "60 x 60 px"),
        (coco(GOOD, image={"height": "60"}), "valid image size"),
        (coco([flat(50, 20, 70, 40)], image={"height": None, "width": None}), "valid image size"),
        (labelme({"points": CORNERS}, imageHeight=None, imageWidth=None), "valid image size"),
        # These crashed pycocotools, or made it read random memory.
        (coco([[0, 0, 1e9, 0, 1e9, 1e9]]), "outside the image"),
        (coco([[0, 0, float("nan"), 0, 9, 9]]), "outside the image"),
        (coco({**RUNS, "counts": [5, 5]}), "do not cover"),
        (coco({**RUNS, "counts": []}), "do not cover"),
        (coco({**RUNS, "counts": [5, 10**6]}), "annotation 0 cannot be read"),
        (coco({**RUNS, "counts": [5, -5, HEIGHT * WIDTH]}), "annotation 0 cannot be read"),
        (coco({**RUNS, "counts": "`1a0"}), "do not cover"),
        (coco({**RUNS, "counts": "oooo"}), "damaged"),
        (coco({**RUNS, "counts": ""}), "damaged"),
        (coco({**RUNS, "size": [20_000, 20_000]}), "20000 x 20000"),
        ({"objects": [], "size": {}}, "valid image size"),  # Supervisely
        ({"annotations": [{}], "item": {}}, "'images' is missing(.|\n)*export the annotations as COCO"),  # V7
        ([{"data": {}}], "unknown format(.|\n)*export the annotations as COCO"),  # Label Studio's own JSON
    ],
)  # fmt: skip
def test_files_without_a_usable_annotation_are_refused_with_the_reason(content, message):
    with pytest.raises(HilsplatError, match=message):
        regions(content)


def test_a_bad_object_of_isat_leaves_the_others():
    square = [[2.7, 2.2], [9.9, 2.2], [9.9, 9.1], [2.7, 9.1]]
    objects = [{"category": "mug", "segmentation": square}] * 2
    content = {"info": {"name": "IMG_0002.jpg", "width": WIDTH, "height": HEIGHT}}
    notes: list[str] = []
    found = regions({**content, "objects": [*objects, {"category": "", "segmentation": square}]}, notes=notes)
    for mask in found["IMG_0002.png"]:
        np.testing.assert_array_equal(mask, box(2, 2, 10, 10))  # truncated and filled by OpenCV
    assert len(found["IMG_0002.png"]) == 2 and "1 invalid (x.json, object 2 has no category" in notes[0]


def test_the_background_of_isat_is_cut_out_of_lower_layers_only():
    def thing(category, layer, left, top, right, bottom):
        points = [[left, top], [right - 1, top], [right - 1, bottom - 1], [left, bottom - 1]]
        return {"category": category, "layer": layer, "segmentation": points}

    info = {"name": "IMG_0001.jpg", "width": WIDTH, "height": HEIGHT}
    hole = thing("__background__", 2.0, 20, 10, 30, 30)
    lost = {**hole, "segmentation": [[900, 900]]}
    gem, coin = thing("gem", 3.0, 22, 12, 26, 20), thing("coin", 2.0, 20, 10, 24, 14)
    objects = [thing("ring", None, 10, 5, 40, 40), gem, hole, lost, coin]
    notes: list[str] = []
    ring, gem, coin = regions({"info": info, "objects": objects}, notes=notes)["IMG_0001.png"]
    np.testing.assert_array_equal(ring, box(10, 5, 40, 40) & ~box(20, 10, 30, 30))
    np.testing.assert_array_equal(gem, box(22, 12, 26, 20))
    np.testing.assert_array_equal(coin, box(20, 10, 24, 14))
    assert "2 of 5 annotations are left out: 1 of the background (__background__)" in notes[0]


# -- labels for LangSplat's evaluation --------------------------------------------------------------


def test_langsplats_evaluation_finds_exported_labels_images_and_numbers(tmp_path):
    names = [f"frame_{number:05d}.png" for number in (1, 2, 3)]
    smooth = np.tile(np.linspace(0, 250, WIDTH).astype(np.uint8)[:, None], (HEIGHT, 1, 3))
    images = {name: smooth // (row + 1) for row, name in enumerate(names)}
    scene = Scene.load(save_scene(tmp_path / "scene", images))
    view = names[1]
    rings = [[(4, 4), (35, 4), (35, 12), (4, 12)], [(50, 13), (60, 13), (60, 25)]]
    label = Label(id=3, level=1, text="mug", polygons=rings)
    proposed = Label(id=4, level=1, text="unchecked", polygons=rings, origin="proposed")
    path = label_path(tmp_path / "annotated/set/scene", view)
    version = write_labels(path, view, SIZE, [proposed], NO_FILE)
    with pytest.raises(SceneError, match="has no labels"):
        export_labels(scene, tmp_path, tmp_path, tmp_path / "label")
    write_labels(path, view, SIZE, [label, proposed], version)
    out = tmp_path / "label"
    assert export_labels(scene, tmp_path, tmp_path, out) == 1
    # What eval_openclip_lerf does with a label folder, in its order.
    (json_path,), (image_path,) = sorted(out.glob("frame_*.json")), sorted(out.glob("frame_*.jpg"))
    content = json.loads(json_path.read_text())
    assert int(content["info"]["name"].split("_")[-1].split(".jpg")[0]) - 1 == names.index(view)
    image = cv2.imread(str(image_path))
    assert image.shape[:2] == (content["info"]["height"], content["info"]["width"]) == SIZE
    assert np.abs(image[..., ::-1].astype(int) - images[view]).max() < 8  # JPEG
    drawn = np.zeros(SIZE, np.uint8)
    for thing in content["objects"]:
        points = np.array(thing["segmentation"])
        cv2.fillPoly(drawn, [points.astype(np.int32)], 1)
        assert thing["category"] == "mug" and thing["bbox"] == [*points.min(0), *points.max(0)]
    np.testing.assert_array_equal(drawn > 0, label.mask(SIZE))
    again = imported(json_path.name, json_path.read_text(), scene.cameras)
    assert merged({view: [label]}, [again], {view: SIZE}) == ({}, 0, 1)
    assert Path(image_path).stem == Path(view).stem
