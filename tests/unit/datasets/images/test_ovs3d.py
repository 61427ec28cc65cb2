"""3D-OVS: sorted classes, strict foreground, sizes, and LLFF's axes."""

import numpy as np
import pytest

from hilsplat.base.errors import SceneError
from hilsplat.base.images import write_png
from hilsplat.base.levels import Level
from hilsplat.datasets.images.ovs3d import open_scene, read_classes
from hilsplat.datasets.labelled import posed_images
from hilsplat.scene.poses import run_poses
from hilsplat.scene.scene import Scene
from hilsplat.settings import PosesSettings
from tests.unit.datasets.writers.labelled import write_3d_ovs


@pytest.fixture
def root(tmp_path, true_world):
    """The small world as scene `bed`, without a COLMAP model; its first and last view are segmented."""
    write_3d_ovs(true_world, tmp_path / "3d_ovs", "bed", ["000.png", "003.png"], sparse=False)
    return tmp_path / "3d_ovs"


def test_a_written_world_is_read_back_equal(true_world, root):
    scene = open_scene(root, "bed")
    assert scene.prompts == ("Ring", "bear")  # capitals sort first
    assert list(scene.views) == ["00.png", "03.png"]
    for name, view in (("000.png", "00.png"), ("003.png", "03.png")):
        nodes = true_world.nodes(name, Level.WHOLE)
        assert [region.text for region in scene.views[view]] == ["Ring", "bear"]
        for region in scene.views[view]:
            truth = true_world.mask(name, nodes[region.text]) if region.text in nodes else np.zeros((24, 40))
            assert np.array_equal(region.mask(), truth)
    # The ring of the first view: rows 5 to 13, columns 26 to 34. The last view does not show it.
    assert scene.views["00.png"][0].boxes().tolist() == [[26, 5, 34, 13]]
    assert scene.views["03.png"][0].boxes().shape == (0, 4)
    warnings = scene.report().warnings
    assert "regions without a pixel: 03.png: Ring" in warnings
    assert "published frames without segmentation: 04.png, 10.png, 23.png, 30.png" in warnings


def test_grey_is_foreground_only_for_protocols_that_take_any(root):
    path = root / "bed" / "segmentations" / "00" / "bear.png"
    grey = np.zeros((24, 40), np.uint8)
    grey[:2], grey[2:4], grey[4] = 255, 254, 1
    write_png(path, grey)
    region = open_scene(root, "bed").views["00.png"][1]
    assert np.flatnonzero(region.mask().any(axis=1)).tolist() == [0, 1]
    assert np.flatnonzero(region.mask(any_grey=True).any(axis=1)).tolist() == [0, 1, 2, 3, 4]


def test_poses_of_llff_are_read_back_equal(true_world, root):
    posed = posed_images(root / "bed", "3D-OVS")
    assert list(posed) == ["00.png", "01.png", "02.png", "03.png"]
    for name, view in zip(true_world.cameras.names, posed.values(), strict=True):
        camera = true_world.cameras[name]
        assert np.allclose(view.cam_from_source, camera.cam_from_world, atol=1e-12)
        assert np.allclose(view.camera.calibration_matrix(), camera.K)


def test_llff_columns_are_down_right_and_back(root):
    # World axes as LLFF's camera: its columns (down, right, back) are -y, x, z of the world, so the
    # camera is at (1, 2, 3), looks along -z, and has world x on its right and -y below it.
    matrix = np.array([[0, 1, 0, 1, 30], [-1, 0, 0, 2, 40], [0, 0, 1, 3, 50]], float)
    rows = np.tile([*matrix.ravel(), 0.5, 9.0], (4, 1))
    rows[:, 3] += [0, 1, 2, 3]
    np.save(root / "bed" / "poses_bounds.npy", rows)
    view = posed_images(root / "bed", "3D-OVS")["00.png"]
    ahead, right, below = ([1, 2, 1, 1], [2, 2, 3, 1], [1, 1, 3, 1])
    assert np.allclose(view.cam_from_source @ ahead, [0, 0, 2, 1])
    assert np.allclose(view.cam_from_source @ right, [1, 0, 0, 1])
    assert np.allclose(view.cam_from_source @ below, [0, 1, 0, 1])
    assert view.camera.calibration_matrix().tolist() == [[50, 0, 20], [0, 50, 12], [0, 0, 1]]  # 40 x 24 px


def test_the_focal_length_scales_with_the_image_on_disk(true_world, root):
    for n in range(4):
        (root / "bed" / "images" / f"0{n}.jpg").unlink()
        write_png(root / "bed" / "images" / f"0{n}.png", np.zeros((12, 20, 3), np.uint8))
    K = posed_images(root / "bed", "3D-OVS")["00.png"].camera.calibration_matrix()
    assert K.tolist() == [[25, 0, 10], [0, 25, 6], [0, 0, 1]]  # half of 50 and of the centre (20, 12)


def test_the_poses_stage_imports_llff(tmp_path, true_world, root):
    run_poses(root / "bed", tmp_path / "scene", "3d_ovs/bed", "metre", False, PosesSettings(), 0, 1)
    scene = Scene.load(tmp_path / "scene")
    assert scene.cameras.names == ("00.png", "01.png", "02.png", "03.png")
    expected = true_world.cameras
    source = np.linalg.inv(scene.scene_from_source)
    centres = [(source @ [*scene.cameras[name].centre, 1])[:3] for name in scene.cameras.names]
    assert np.allclose(centres, [expected[name].centre for name in expected.names], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[:, :16], r"shape \(4, 16\)"),
        (lambda rows: np.where(np.arange(17) == 3, np.nan, rows), "does not contain LLFF poses"),
        (lambda rows: rows * np.where(np.arange(17) % 5 == 0, -1, 1), "row 0: not a rigid pose"),
        (
            lambda rows: np.where((np.arange(17) == 14) & (np.arange(4) == 2)[:, None], 0, rows),
            "row 2: not a",
        ),
        (lambda rows: rows[:3], "has 3 poses for 4 images"),
    ],
)
def test_unusable_poses_are_refused(root, change, message):
    path = root / "bed" / "poses_bounds.npy"
    np.save(path, change(np.load(path)))
    with pytest.raises(SceneError, match=message):
        posed_images(root / "bed", "3D-OVS")


def test_classes_are_stripped_sorted_and_without_empty_lines(tmp_path):
    (tmp_path / "classes.txt").write_text("  red bag\r\n\r\nbanana \n Gundam\n\n")
    assert read_classes(tmp_path / "classes.txt") == ("Gundam", "banana", "red bag")


@pytest.mark.parametrize(("text", "found"), [("\n \n", "no class"), ("hand\nhand \n", "twice: hand")])
def test_unusable_classes_are_refused(tmp_path, text, found):
    (tmp_path / "classes.txt").write_text(text)
    with pytest.raises(SceneError, match=found):
        read_classes(tmp_path / "classes.txt")


def test_one_name_with_two_suffixes_is_refused(root):
    write_png(root / "bed" / "images" / "00.png", np.zeros((24, 40, 3), np.uint8))
    with pytest.raises(SceneError, match=r"00.jpg, 00.png|00.png, 00.jpg"):
        open_scene(root, "bed")


def test_a_mask_of_another_size_is_resized_to_nearest_and_reported(root):
    small = np.zeros((12, 20), np.uint8)
    small[1, 2] = 255
    write_png(root / "bed" / "segmentations" / "00" / "bear.png", small)
    scene = open_scene(root, "bed")
    bear = scene.views["00.png"][1]
    assert np.argwhere(bear.mask((24, 40))).tolist() == [[2, 4], [2, 5], [3, 4], [3, 5]]
    assert any("bear.png is 20 x 12 px, its image 40 x 24 px: resized" in line for line in scene.warnings)


def test_a_mask_of_another_shape_is_refused(root):
    write_png(root / "bed" / "segmentations" / "00" / "bear.png", np.zeros((40, 24), np.uint8))
    with pytest.raises(SceneError, match=r"bear.png does not fit its image"):
        open_scene(root, "bed")


def test_a_missing_mask_is_refused_and_misspelt_ones_are_named(root):
    place = root / "bed" / "segmentations" / "03"
    (place / "bear.png").rename(place / "Bear.png")
    with pytest.raises(SceneError, match=r"lacks the masks of: bear\n.*\n.*classes.txt lacks: Bear"):
        open_scene(root, "bed")


def test_a_mask_of_an_unknown_class_is_reported(root):
    place = root / "bed" / "segmentations" / "03"
    (place / "wood.png").write_bytes((place / "bear.png").read_bytes())
    assert "03: masks of unknown classes are not read: wood" in open_scene(root, "bed").warnings


def test_a_segmented_view_without_image_is_named(root):
    (root / "bed" / "images" / "03.jpg").unlink()
    with pytest.raises(SceneError, match=r"labelled views have no image: 03\.png"):
        open_scene(root, "bed")


def test_a_scene_without_any_pose_says_so(root):
    (root / "bed" / "poses_bounds.npy").unlink()
    assert open_scene(root, "bed").poses is None
    assert any("no poses" in line for line in open_scene(root, "bed").report().warnings)
