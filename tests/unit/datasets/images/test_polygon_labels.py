"""LERF-OVS, Hi-LERF, Hi-3DOVS and own annotations: label files of polygons."""

import json

import cv2
import numpy as np
import pytest

from hilsplat.base.errors import SceneError, SettingsError
from hilsplat.base.images import write_png
from hilsplat.base.levels import Level
from hilsplat.datasets.images.hi import ANNOTATED, HI_LERF
from hilsplat.datasets.images.isat import fill_polygons, read_isat, trace_polygons
from hilsplat.datasets.images.lerf_ovs import open_scene
from hilsplat.datasets.published import PAIRS, PROMPTS
from hilsplat.datasets.registry import open_labelled
from hilsplat.datasets.sources import label_files, label_sets
from tests.conftest import PROJECT
from tests.unit.datasets.writers.labelled import LERF_STEMS, write_hi, write_lerf_ovs

SQUARE = [[2.0, 3.0], [5.0, 3.0], [5.0, 6.0], [2.0, 6.0]]
LABELLED = (("001.png", "frame_00002.png"), ("003.png", "frame_00004.png"))
"""Labelled views of the small world, and their names in the data sets."""


def thing(category="knife", segmentation=SQUARE, **keys):
    return {"category": category, "segmentation": segmentation, "group": 1, **keys}


def label_file(folder, objects, size_wh=(20, 10), name="frame_00001"):
    path = folder / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    info = {"name": f"{name}.jpg", "width": size_wh[0], "height": size_wh[1]}
    path.write_text(json.dumps({"info": info, "objects": objects}))
    return path


@pytest.mark.parametrize(("layer", "num_px"), [(2.0, 16 - 4), (1.0, 16), (None, 16)])
def test_the_background_of_isat_is_a_hole_in_lower_layers_and_no_object(layer, num_px, tmp_path):
    hole = thing("__background__", [[3, 4], [4, 4], [4, 5], [3, 5]], layer=layer)
    labels = read_isat(label_file(tmp_path, [thing(layer=1.0), hole]))
    (knife,) = labels.objects
    assert fill_polygons(knife.polygons, labels.size_hw).sum() == num_px
    assert knife.box_xyxy.tolist() == [2, 3, 5, 6]


@pytest.fixture
def lerf(tmp_path, true_world):
    """The small world as LERF-OVS's scene `figurines`, its second and fourth view labelled."""
    write_lerf_ovs(true_world, tmp_path / "lerf_ovs", "figurines", [name for name, _ in LABELLED])
    return tmp_path / "lerf_ovs"


@pytest.fixture
def hi(tmp_path, true_world):
    """The small world as Hi-LERF's scene `ramen`, its second and fourth view labelled."""
    views = [name for name, _ in LABELLED]
    write_hi(true_world, tmp_path / "hi_lerf", tmp_path / "lerf_ovs", "ramen", views, LERF_STEMS)
    return tmp_path / "hi_lerf"


def test_polygons_are_filled_with_border_by_whole_vertices_and_even_odd():
    triangle, angle = np.array([[0.9, 0.2], [2, 0], [0, 2.7]]), 4 * np.pi * np.arange(5) / 5
    filled = ["###.", "##..", "#...", "...."]
    assert np.where(fill_polygons([triangle], (4, 4)), "#", ".").tolist() == [list(row) for row in filled]
    star = fill_polygons([50 + 45 * np.stack([np.sin(angle), -np.cos(angle)], axis=1)], (100, 100))
    assert not star[50, 50] and star[20, 50]
    square = np.array([[1, 1], [5, 1], [5, 5], [1, 5]])
    assert fill_polygons([square, square + 2], (9, 9)).sum() == 25 + 25 - 9  # their overlap is filled


@pytest.mark.parametrize("seed", range(40))
def test_traced_polygons_fill_the_same_pixels(seed):
    rng = np.random.default_rng(seed)
    values = rng.random(rng.integers(1, 40, 2))
    if seed % 2:  # large shapes with holes instead of noise
        values = cv2.GaussianBlur(values, (5, 5), 0).reshape(values.shape)
    mask = values < rng.random()
    polygons = trace_polygons(mask)
    np.testing.assert_array_equal(fill_polygons(polygons, mask.shape), mask)
    areas = [np.count_nonzero(fill_polygons([polygon], mask.shape)) for polygon in polygons]
    assert sum(areas) == np.count_nonzero(mask)  # without common pixels
    assert all(len(polygon) >= 3 for polygon in polygons)


# ---- LERF-OVS -------------------------------------------------------------------------------------


def test_a_world_written_as_lerf_ovs_is_read_back_equal(true_world, lerf):
    scene = open_scene(lerf, "figurines")
    assert list(scene.images) == [f"frame_0000{n}.png" for n in (1, 2, 3, 4)]  # numbered from 1
    assert list(scene.views) == [view for _, view in LABELLED]
    for name, view in LABELLED:
        nodes = true_world.nodes(name)
        assert {region.text for region in scene.views[view]} == set(nodes)
        for region in scene.views[view]:
            assert region.size_hw == (24, 40)
            assert np.array_equal(region.mask(), true_world.mask(name, nodes[region.text]))
    assert scene.prompts == ("Ring", "bear", "head", "nose", "paw")
    assert scene.num_pairs == 9  # the fourth view does not show the ring
    (paw,) = [region for region in scene.views["frame_00002.png"] if region.text == "paw"]
    # One region with both boxes: rows 14 to 17, columns 3 to 6 and 13 to 18.
    assert paw.boxes().tolist() == [[3, 14, 6, 17], [13, 14, 18, 17]]
    reported = "; ".join(scene.report().warnings)
    assert "frames that have no label: frame_00041.png, frame_00105.png, frame_00152.png" in reported
    assert "texts missing from the published list: Ring, bear, head, nose, paw" in reported


def test_categories_differ_by_case_and_boxes_keep_the_whole_pixels_inside(lerf):
    triangle = thing("pot", [[2.5, 3.5], [5.5, 3.5], [5.5, 6.5]], bbox=[2.5, 3.5, 5.5, 6.5])
    label_file(lerf / "label" / "figurines", [thing("Pot"), triangle, thing("pot")], (40, 24), "frame_00001")
    large, small = open_scene(lerf, "figurines").views["frame_00001.png"]
    assert (large.text, small.text) == ("Pot", "pot")
    assert small.boxes().tolist() == [[3, 4, 5, 6], [2, 3, 5, 6]]


def test_labels_are_matched_by_name_even_if_an_earlier_image_is_missing(lerf):
    before = open_scene(lerf, "figurines").views["frame_00004.png"][0].mask()
    (lerf / "figurines" / "images" / "frame_00003.jpg").unlink()
    scene = open_scene(lerf, "figurines")
    assert scene.images["frame_00004.png"].name == "frame_00004.jpg"
    assert np.array_equal(scene.views["frame_00004.png"][0].mask(), before)
    scene.check_posed(["frame_00002.png", "frame_00004.png"])
    with pytest.raises(SceneError, match=r"have no pose: frame_00004\.png\n"):
        scene.check_posed(["frame_00002.png", "frame_00003.png"])


def test_a_polygon_that_reaches_outside_the_image_is_clipped_and_reported(tmp_path):
    labels = read_isat(label_file(tmp_path, [thing(segmentation=[[15, 2], [25, 2], [25, 4], [15, 4]])]))
    assert fill_polygons(labels.objects[0].polygons, (10, 20)).sum() == 3 * 5  # columns 15 to 19
    assert len(labels.warnings) == 1 and "extends 5 px beyond the image; clipped" in labels.warnings[0]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"info": ', "is not valid JSON"),
        ("[]", "is not a JSON object"),
        ('{"shapes": []}', "has no `objects` list"),
        ('{"info": {}, "objects": []}', "does not state a valid image size"),
        ('{"info": {"height": 20001, "width": 9}, "objects": []}', r"valid image size\n.*at most 20000\n"),
        (thing(category=None), "has no category"),
        (thing(segmentation=[[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]), "segmentation is not a polygon"),
        (thing(segmentation=[]), "segmentation is not a polygon"),
        (thing(segmentation="x"), "segmentation is not a polygon"),
        (thing(segmentation=[[2, 3], [3e9, 3], [9, 9]]), "segmentation is not a polygon"),
        (thing(segmentation=[[2, 3], [10**400, 3], [9, 9]]), "segmentation is not a polygon"),
        (thing(segmentation=[[30, 2], [35, 2], [35, 4]]), r"\(knife\): a polygon is entirely outside"),
        (thing(bbox=[1, 2, 3]), "invalid bbox"),
        (thing(bbox=[1, 2, 3, 10**400]), "invalid bbox"),
        (thing(segmentation=[[4, 3], [8, 3], [8, 6]], bbox=[4, 3, 4, 3]), r"bbox is not \[x1, y1, x2, y2\]"),
    ],
)
def test_malformed_label_files_are_refused_by_name_and_objects_by_number(tmp_path, content, message):
    path = label_file(tmp_path, [content])
    if isinstance(content, str):
        path.write_text(content)
    where = "" if isinstance(content, str) else ", object 0"
    with pytest.raises(SceneError, match=rf"frame_00001.json{where}.*{message}"):
        read_isat(path)


def test_a_label_of_a_scaled_copy_is_resized_and_reported(lerf):
    for _, view in LABELLED:
        (lerf / "figurines" / "images" / view).with_suffix(".jpg").unlink()
        write_png(lerf / "figurines" / "images" / view, np.zeros((12, 20, 3), np.uint8))
    scene = open_scene(lerf, "figurines")
    assert sum("resized by nearest neighbour" in sentence for sentence in scene.warnings) == 2
    (bear,) = [region for region in scene.views["frame_00002.png"] if region.text == "bear"]
    assert bear.mask((12, 20)).sum() * 4 == pytest.approx(bear.mask().sum(), rel=0.2)
    # Columns 3 to 18 and rows 6 to 17 of 40 x 24, at half the size.
    assert bear.boxes((12, 20)).tolist() == [[1, 3, 9, 8]]


def test_labels_without_their_image_or_of_another_release_are_refused(lerf):
    image = lerf / "figurines" / "images" / "frame_00002.jpg"
    image.unlink()
    with pytest.raises(SceneError, match=r"labelled views have no image: frame_00002\.png\n"):
        open_scene(lerf, "figurines")
    write_png(image.with_suffix(".png"), np.zeros((26, 40, 3), np.uint8))
    with pytest.raises(SceneError, match=r"00002.json does not match the size of its image\n.*40 x 26 px"):
        open_scene(lerf, "figurines")


def test_a_wrong_count_of_pairs_is_reported_for_whole_published_scenes(tmp_path, true_world):
    root = tmp_path / "lerf_ovs"
    write_lerf_ovs(true_world, root, "figurines", [])
    for frame in (41, 105, 152, 195):
        name = f"frame_{frame:05d}"
        write_png(root / "figurines" / "images" / f"{name}.png", np.zeros((10, 20, 3), np.uint8))
        objects = [thing(text) for text in PROMPTS["lerf_ovs"]["figurines"][:14]]
        label_file(root / "label" / "figurines", objects, name=name)
    assert open_scene(root, "figurines").num_pairs == PAIRS["figurines"] == 56
    assert not open_scene(root, "figurines").warnings
    label_file(root / "label" / "figurines", [thing("bag")], name="frame_00041")
    (warning,) = open_scene(root, "figurines").warnings
    assert warning.startswith("43 (frame, category) pairs")


# ---- levels and parents ---------------------------------------------------------------------------


def edit(root, change):
    """Change the objects of a label file in place, given by id and as a list."""
    path = root / "label" / "ramen" / "frame_00002.json"
    content = json.loads(path.read_text())
    change({each["id"]: each for each in content["objects"]}, content["objects"])
    path.write_text(json.dumps(content))


def test_a_world_written_as_hi_lerf_is_read_back_equal(true_world, hi):
    scene = HI_LERF.open(hi, "ramen")
    nodes = true_world.annotations.nodes
    for name, view in LABELLED:
        shown = true_world.annotations.views[name]
        assert len(scene.views[view]) == len(shown)
        for region, node in zip(scene.views[view], shown, strict=True):
            assert (region.text, region.level) == (nodes[node].text, Level(nodes[node].level))
            assert region.path == true_world.annotations.path_of(node)
            assert np.array_equal(region.mask(), true_world.mask(name, [node]))
            rows, columns = np.nonzero(region.mask())
            assert region.boxes().tolist() == [[columns.min(), rows.min(), columns.max(), rows.max()]]
    assert not any("parent" in line for line in scene.warnings)


def test_frames_without_image_or_label_are_reported(hi):
    images = hi.parent / "lerf_ovs"
    (images / "ramen" / "images" / "frame_00004.jpg").unlink()
    scene = HI_LERF.open(hi, "ramen")
    assert list(scene.views) == ["frame_00002.png"]
    reported = "; ".join(scene.warnings)
    assert "frame_00004.json has no image" in reported
    for what in ("image", "label"):
        assert f"published frames that have no {what}: frame_00006.png, frame_00024.png" in reported
    images.rename(hi.parent / "lerf")
    with pytest.raises(SceneError, match=r"also ../lerf_ovs/ramen/images"):
        HI_LERF.open(hi, "ramen")


def test_invalid_parents_and_children_outside_their_parent_are_reported(hi):
    def change(by_id, objects):
        by_id[1]["parent"], by_id[2]["parent"] = 99, [0]
        by_id[4]["parent"] = 0  # a subpart below a whole
        square = [[0, 0], [9, 0], [9, 9], [0, 9]]
        beside = [square, [[10, 0], [10, 0], [10, 0]]]  # 101 px, one of them outside the square
        wide = [[0, 0], [10, 0], [10, 9], [0, 9]]  # 110 px, ten of them outside
        objects.append(thing("a", square, id=90, level=1))
        for number, text, polygon in ((91, "b", beside), (92, "c", wide)):
            objects.append(thing(text, polygon, id=number, level=2, parent=90))

    edit(hi, change)
    scene = HI_LERF.open(hi, "ramen")
    reported = "; ".join(scene.warnings)
    assert "frame_00002.json, id 1 (head): parent 99 does not exist" in reported
    assert "id 2 (paw): parent [0] does not exist" in reported
    assert "id 4 (nose), level 3: parent 0 has level 1" in reported
    assert "id 92 (c): 9.1% of its area is outside its parent 90 (a)" in reported
    assert "id 91" not in reported  # one percent can be due to rasterisation
    paths = {region.text: region.path for region in scene.views["frame_00002.png"]}
    assert paths["head"] == ("head",) and paths["nose"] == ("nose",) and paths["paw"] == ("bear", "paw")


def test_repeated_objects_are_ignored_and_similar_texts_reported(tmp_path):
    first = {"id": 1, "level": 1, "segmentation": SQUARE}
    other = [[2.0, 3.0], [5.0, 3.0], [5.0, 7.0]]
    objects = [
        thing("mug", **first),
        thing(" Mug", **{**first, "id": 2}),
        thing("mug", **{**first, "id": 3, "segmentation": other}),  # another mug
        thing("mug", **{**first, "id": 4, "level": 2}),
        thing("red  Cup", **{**first, "id": 5}),
        thing("Red cup", **{**first, "id": 6, "segmentation": other}),
    ]
    label_file(tmp_path / "annotated/photos/desk", objects, name="DSC_1")
    scene = open_labelled("annotated/photos/desk", tmp_path)
    found = [(region.text, region.level) for region in scene.views["DSC_1.png"]]
    assert found == [("mug", 1), ("mug", 1), ("mug", 2), ("red  Cup", 1), ("Red cup", 1)]
    ignored, similar = scene.warnings
    assert ignored == "DSC_1.json: id 2 ( Mug) repeats id 1; ignored"
    assert similar == "'Red cup' and 'red  Cup' differ only in case or spaces, but are scored separately"
    assert scene.report().warnings[:2] == scene.warnings


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("id", 0, r"object 1 \(head\): invalid id"),
        ("id", "1", r"object 1 \(head\): invalid id\n.*\n.*'1'"),
        ("level", 4, r"object 1 \(head\): invalid level"),
        ("level", None, r"labels without levels \(LERF-OVS\) belong"),
        ("level", True, r"object 1 \(head\): invalid level"),
    ],
)
def test_unusable_ids_and_levels_are_refused(hi, key, value, message):
    edit(hi, lambda by_id, _: by_id[1].update({key: value}))
    with pytest.raises(SceneError, match=message):
        HI_LERF.open(hi, "ramen")


# ---- own annotations ------------------------------------------------------------------------------


def test_own_annotations_are_found_and_read_with_or_without_levels(tmp_path):
    mug = {"id": 4, "level": 1, "parent": None, "segmentation": [[2, 2], [11, 2], [11, 9], [2, 9]]}
    rim = {"id": 7, "level": 2, "parent": 4, "segmentation": [[[2, 2], [5, 2], [5, 3], [2, 3]]]}
    folder = tmp_path / "annotated/photos/desk"
    path = label_file(folder, [thing("mug", **mug), thing("rim", **rim)], (16, 12), "DSC_1")
    label_file(folder, [thing(), thing()], (16, 12), "DSC_2")
    views = open_labelled("annotated/photos/desk", tmp_path).views
    found = [(region.level, region.path, int(region.mask().sum())) for region in views["DSC_1.png"]]
    assert found == [(Level.WHOLE, ("mug",), 80), (Level.PART, ("mug", "rim"), 8)]
    assert [(region.level, len(region.boxes())) for region in views["DSC_2.png"]] == [(None, 2)]
    assert ANNOTATED.found(tmp_path / "annotated") == ("photos/desk",)
    assert label_sets("photos/desk", str(tmp_path), "photos/desk") == ("annotated/photos/desk",)
    assert label_sets("photos/desk", str(tmp_path), "photos/shelf") == ()
    with pytest.raises(SceneError, match=r"also photos/shelf"):
        open_labelled("annotated/photos/shelf", tmp_path)
    assert label_files("annotated/photos/desk", str(tmp_path)) == (path, folder / "DSC_2.json")


def test_own_annotations_in_the_working_folder_are_found_beside_a_data_root(tmp_path, monkeypatch):
    (tmp_path / "work/annotated/photos/desk").mkdir(parents=True)
    (tmp_path / "work/annotated/photos/desk/001.json").write_text("{}")
    monkeypatch.chdir(tmp_path / "work")
    data = str(tmp_path / "data")
    assert label_sets("photos/desk", data, "photos/desk") == ("annotated/photos/desk",)
    (found,) = label_files("annotated/photos/desk", data)
    assert found.samefile("annotated/photos/desk/001.json")
    (tmp_path / "data/annotated/photos/shelf").mkdir(parents=True)
    with pytest.raises(SettingsError, match=r"not scored(.|\n)*move annotated/photos/desk to"):
        label_sets("photos/desk", data, "photos/desk")


def test_the_annotation_of_the_bedroom_has_ten_objects_whose_children_are_inside_them():
    """Drawn with `hilsplat annotate` in four photographs, which are not part of the project."""
    bedroom = open_labelled("annotated/photos/plush_bedroom", PROJECT / "tests")
    assert bedroom.warnings == ()  # a child outside its parent would cause one
    regions = [region for regions in bedroom.views.values() for region in regions]
    counts = [sum(region.level == level for region in regions) for level in Level]
    assert (len(bedroom.views), counts) == (4, [23, 38, 31])
    wholes = {region.text for region in regions if region.level is Level.WHOLE}
    assert len(wholes) == 10 and {"plush doll", "black piano", "fox plush toy"} < wholes
