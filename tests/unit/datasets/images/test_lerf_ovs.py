"""LERF-OVS: polygons as regions, and what label files bring."""

import json

import numpy as np
import pytest

from hilsplat.base.errors import SceneError
from hilsplat.base.images import write_png
from hilsplat.datasets.images.isat import read_isat
from hilsplat.datasets.images.lerf_ovs import open_scene
from hilsplat.datasets.images.polygons import fill_polygons
from hilsplat.datasets.labelled import posed_images
from hilsplat.datasets.published import PAIRS, PROMPTS
from tests.unit.datasets.writers.labelled import write_lerf_ovs

SQUARE = [[2.0, 3.0], [5.0, 3.0], [5.0, 6.0], [2.0, 6.0]]


def thing(category="knife", segmentation=SQUARE, **keys):
    return {"category": category, "segmentation": segmentation, "group": 1, "iscrowd": 0, **keys}


def label_file(folder, objects, size_wh=(20, 10), name="frame_00001"):
    path = folder / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    info = {"folder": "x", "name": f"{name}.jpg", "width": size_wh[0], "height": size_wh[1], "note": ""}
    path.write_text(json.dumps({"info": info, "objects": objects}))
    return path


@pytest.fixture
def root(tmp_path, true_world):
    """The small world as scene `figurines`, its second and fourth view labelled."""
    write_lerf_ovs(true_world, tmp_path / "lerf_ovs", "figurines", ["001.png", "003.png"])
    return tmp_path / "lerf_ovs"


def test_polygons_are_filled_with_border_by_whole_vertices_and_even_odd():
    triangle, angle = np.array([[0.9, 0.2], [2, 0], [0, 2.7]]), 4 * np.pi * np.arange(5) / 5
    filled = ["###.", "##..", "#...", "...."]
    assert np.where(fill_polygons([triangle], (4, 4)), "#", ".").tolist() == [list(row) for row in filled]
    star = fill_polygons([50 + 45 * np.stack([np.sin(angle), -np.cos(angle)], axis=1)], (100, 100))
    assert not star[50, 50] and star[20, 50]
    square = np.array([[1, 1], [5, 1], [5, 5], [1, 5]])
    assert fill_polygons([square, square + 2], (9, 9)).sum() == 25 + 25 - 9  # their overlap is filled


def test_a_written_world_is_read_back_equal(true_world, root):
    scene = open_scene(root, "figurines")
    assert list(scene.images) == [f"frame_0000{n}.png" for n in (1, 2, 3, 4)]  # numbered from 1
    assert list(scene.views) == ["frame_00002.png", "frame_00004.png"]
    for name, view in (("001.png", "frame_00002.png"), ("003.png", "frame_00004.png")):
        nodes = true_world.nodes(name)
        assert {region.text for region in scene.views[view]} == set(nodes)
        for region in scene.views[view]:
            assert region.size_hw == (24, 40)
            assert np.array_equal(region.mask(), true_world.mask(name, nodes[region.text]))
    assert scene.prompts == ("Ring", "bear", "head", "nose", "paw")
    assert scene.num_pairs == 9  # the fourth view does not show the ring


def test_written_poses_are_read_back_equal(true_world, root):
    posed = posed_images(root / "figurines", "LERF-OVS")
    for name, view in zip(true_world.cameras.names, posed.values(), strict=True):
        camera = true_world.cameras[name]
        assert np.allclose(view.cam_from_source, camera.cam_from_world, atol=1e-12)
        assert np.array_equal(view.camera.calibration_matrix(), camera.K)


def test_objects_of_one_category_are_one_region_with_all_boxes(root):
    (paw,) = [
        region for region in open_scene(root, "figurines").views["frame_00002.png"] if region.text == "paw"
    ]
    # View 1: paws of rows 14 to 17, columns 3 to 6 and 13 to 18.
    assert paw.boxes().tolist() == [[3, 14, 6, 17], [13, 14, 18, 17]]
    assert paw.mask().sum() == 4 * 4 + 4 * 6


def test_boxes_are_corners_not_sizes(tmp_path):
    path = label_file(tmp_path, [thing(bbox=[2.0, 3.0, 5.0, 6.0])])
    assert read_isat(path).objects[0].box_xyxy.tolist() == [2, 3, 5, 6]
    path = label_file(tmp_path, [thing(segmentation=[[4, 3], [8, 3], [8, 6]], bbox=[4, 3, 4, 3])])
    with pytest.raises(SceneError, match=r"object 0 \(knife\): bbox is not \[x1, y1, x2, y2\]"):
        read_isat(path)


def test_a_box_with_decimals_keeps_the_whole_pixels_inside(tmp_path):
    polygon = [[2.5, 3.5], [5.5, 3.5], [5.5, 6.5]]
    path = label_file(tmp_path, [thing(segmentation=polygon, bbox=[2.5, 3.5, 5.5, 6.5])])
    assert read_isat(path).objects[0].box_xyxy.tolist() == [3, 4, 5, 6]


@pytest.mark.parametrize("iscrowd", [0, 1, False, True])
def test_iscrowd_may_be_number_or_boolean(tmp_path, iscrowd):
    assert len(read_isat(label_file(tmp_path, [thing(iscrowd=iscrowd)])).objects) == 1


def test_categories_differ_by_case(tmp_path, root):
    label_file(root / "label" / "figurines", [thing("Pot"), thing("pot")], (40, 24), "frame_00001")
    assert [r.text for r in open_scene(root, "figurines").views["frame_00001.png"]] == ["Pot", "pot"]


def test_a_frame_is_found_by_name_when_an_image_before_it_is_missing(root):
    before = open_scene(root, "figurines").views["frame_00004.png"][0].mask()
    (root / "figurines" / "images" / "frame_00003.jpg").unlink()
    scene = open_scene(root, "figurines")
    assert scene.images["frame_00004.png"].name == "frame_00004.jpg"
    assert np.array_equal(scene.views["frame_00004.png"][0].mask(), before)
    scene.check_posed(["frame_00002.png", "frame_00004.png"])


def test_labelled_frames_without_image_or_pose_are_named(root):
    with pytest.raises(SceneError, match=r"have no pose: frame_00004\.png\n"):
        open_scene(root, "figurines").check_posed(["frame_00002.png", "frame_00003.png"])
    (root / "figurines" / "images" / "frame_00004.jpg").unlink()
    with pytest.raises(SceneError, match=r"labelled views have no image: frame_00004\.png\n"):
        open_scene(root, "figurines")


def test_a_polygon_outside_the_image_is_clipped_and_reported_or_refused(tmp_path):
    path = label_file(tmp_path, [thing(segmentation=[[15, 2], [25, 2], [25, 4], [15, 4]])])
    labels = read_isat(path)
    assert labels.objects[0].mask((10, 20)).sum() == 3 * 5  # columns 15 to 19
    assert len(labels.warnings) == 1 and "reaches 5 px outside the image; clipped" in labels.warnings[0]
    path = label_file(tmp_path, [thing(segmentation=[[30, 2], [35, 2], [35, 4]])])
    with pytest.raises(SceneError, match=r"object 0 \(knife\): a polygon is outside the image"):
        read_isat(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"info": ', "cannot be read"),
        ("[]", "has no list `objects`"),
        ('{"shapes": []}', "has no list `objects`"),
        ('{"info": {}, "objects": []}', "does not give the size"),
    ],
)
def test_malformed_label_files_are_refused_by_name(tmp_path, text, message):
    path = tmp_path / "frame_00001.json"
    path.write_text(text)
    with pytest.raises(SceneError, match=rf"frame_00001.json .*{message}"):
        read_isat(path)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (thing(category=None), "object 0 has no category"),
        (thing(segmentation=[[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]), "segmentation is not a polygon"),
        (thing(segmentation=[]), "segmentation is not a polygon"),
        (thing(segmentation="x"), "segmentation is not a polygon"),
        (thing(bbox=[1, 2, 3]), "bbox cannot be used"),
    ],
)
def test_malformed_objects_are_refused_by_number(tmp_path, entry, message):
    with pytest.raises(SceneError, match=message):
        read_isat(label_file(tmp_path, [entry]))


def test_a_label_of_a_scaled_copy_is_resized_and_reported(root):
    for name in ("frame_00002", "frame_00004"):
        (root / "figurines" / "images" / f"{name}.jpg").unlink()
        write_png(root / "figurines" / "images" / f"{name}.png", np.zeros((12, 20, 3), np.uint8))
    scene = open_scene(root, "figurines")
    assert sum("resized by nearest neighbour" in sentence for sentence in scene.warnings) == 2
    (bear,) = [region for region in scene.views["frame_00002.png"] if region.text == "bear"]
    assert bear.mask((12, 20)).sum() * 4 == pytest.approx(bear.mask().sum(), rel=0.2)
    # Columns 3 to 18 and rows 6 to 17 of 40 x 24, at half the size.
    assert bear.boxes((12, 20)).tolist() == [[1, 3, 9, 8]]


def test_a_label_of_another_release_is_refused(root):
    (root / "figurines" / "images" / "frame_00002.jpg").unlink()
    write_png(root / "figurines" / "images" / "frame_00002.png", np.zeros((26, 40, 3), np.uint8))
    with pytest.raises(SceneError, match=r"frame_00002.json does not fit its image\n.*40 x 26 px"):
        open_scene(root, "figurines")


def test_unlisted_texts_and_missing_frames_are_reported(root):
    reported = "; ".join(open_scene(root, "figurines").report().warnings)
    assert (
        "published frames without label: frame_00041.png, frame_00105.png, frame_00152.png, frame_00195.png"
        in reported
    )
    assert "texts that the published list lacks: Ring, bear, head, nose, paw" in reported


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
    assert warning.startswith("43 pairs of frame and category")
