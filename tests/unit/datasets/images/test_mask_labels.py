"""LERF-Mask and 3D-OVS: mask files, the views to which they belong, and LLFF's poses."""

import shutil

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.errors import ArtifactError, ImageError, SceneError
from hilsplat.base.images import write_png
from hilsplat.base.levels import Level
from hilsplat.datasets.images import lerf_mask, ovs3d
from hilsplat.datasets.labelled import posed_images
from hilsplat.scene.colmap import pycolmap
from hilsplat.scene.poses import run_poses
from hilsplat.scene.scene import Scene
from hilsplat.settings import PosesSettings
from tests.unit.datasets.writers.labelled import write_3d_ovs, write_lerf_mask, write_sparse

BLACK = np.zeros((24, 40), np.uint8)


@pytest.fixture
def teatime(tmp_path, true_world):
    """The small world as scene `teatime` of LERF-Mask; its second and fourth view are for testing."""
    write_lerf_mask(true_world, tmp_path / "lerf_mask", "teatime", ["003.png", "001.png"], Level.PART)
    return tmp_path / "lerf_mask" / "teatime"


@pytest.fixture
def bed(tmp_path, true_world):
    """The small world as scene `bed` of 3D-OVS, with LLFF poses; its first and last view are segmented."""
    write_3d_ovs(true_world, tmp_path / "3d_ovs", "bed", ["000.png", "003.png"])
    shutil.rmtree(tmp_path / "3d_ovs" / "bed" / "sparse")
    return tmp_path / "3d_ovs" / "bed"


def open_scene(folder):
    reader = lerf_mask if folder.parent.name == "lerf_mask" else ovs3d
    return reader.open_scene(folder.parent, folder.name)


# ---- LERF-Mask ------------------------------------------------------------------------------------


def test_a_world_written_as_lerf_mask_is_read_back_equal(true_world, teatime):
    scene = open_scene(teatime)
    assert list(scene.views) == ["frame_00002.png", "frame_00004.png"]
    assert scene.prompts == ("head", "paw")
    for name, view in (("001.png", "frame_00002.png"), ("003.png", "frame_00004.png")):
        nodes = true_world.nodes(name, Level.PART)
        assert [region.text for region in scene.views[view]] == ["head", "paw"]
        for region in scene.views[view]:
            assert np.array_equal(region.mask(), true_world.mask(name, nodes[region.text]))
    assert scene.report().facts["posed views"] == 4


def test_test_views_are_posed_images_missing_from_images_train(true_world, teatime):
    write_png(teatime / "images" / "frame_00000.png", np.zeros((24, 40, 3), np.uint8))  # without a pose
    assert list(open_scene(teatime).views) == ["frame_00002.png", "frame_00004.png"]
    (teatime / "images_train" / "frame_00001.jpg").unlink()
    write_png(teatime / "test_mask" / "2" / "head.png", BLACK)
    # Frame 1 is now the first test view, so every folder belongs to the next view.
    scene = open_scene(teatime)
    assert list(scene.views) == ["frame_00001.png", "frame_00002.png", "frame_00004.png"]
    assert not scene.views["frame_00004.png"][0].mask().any()
    cameras = [true_world.cameras[name] for name in true_world.cameras.names[1:3]]
    names = ["frame_00002.jpg", "frame_00003.jpg"]
    write_sparse(teatime / "sparse" / "0", cameras, names, np.zeros((0, 3)))
    with pytest.raises(SceneError, match=r"not match the test views\n.*0 to 0, for frame_00002.*\n.*0, 1, 2"):
        open_scene(teatime)


def test_the_poses_stage_holds_the_test_views_out(teatime, tmp_path):
    settings = PosesSettings(test_every=2)
    run_poses(teatime, tmp_path / "scene", "lerf_mask/teatime", "arbitrary", False, settings, 0, 1)
    split = Scene.load(tmp_path / "scene").split
    assert [view for view in split if split[view] == "test"] == list(open_scene(teatime).views)


def test_prompts_may_have_any_image_format_and_other_files_are_refused(teatime):
    folder = teatime / "test_mask" / "0"
    with Image.open(folder / "head.png") as mask:
        mask.save(folder / "head.JPG", "JPEG", quality=95)
        expected = np.asarray(mask) > 128
    (folder / "head.png").unlink()
    head = open_scene(teatime).views["frame_00002.png"][0]
    assert head.text == "head" and np.array_equal(head.mask(), expected)
    (folder / "tail.npy").write_bytes(b"")
    with pytest.raises(ArtifactError, match=r"tail.npy is not a mask"):
        open_scene(teatime)


def test_foreground_is_above_128_and_a_truncated_mask_is_refused(teatime):
    values = np.full((24, 40), 128, np.uint8)
    values[0, 0], values[0, 1] = 129, 255
    path = teatime / "test_mask" / "0" / "head.png"
    write_png(path, values)
    head = open_scene(teatime).views["frame_00002.png"][0]
    assert np.argwhere(head.mask()).tolist() == [[0, 0], [0, 1]]
    path.write_bytes(path.read_bytes()[:-40])  # the header stays whole
    head = open_scene(teatime).views["frame_00002.png"][0]
    with pytest.raises(ImageError, match=r"head.png cannot be read"):
        head.mask()


def train_on_all(folder):
    for name in ("frame_00002", "frame_00004"):
        Image.new("RGB", (40, 24)).save(folder / "images_train" / f"{name}.jpg")


def distort(folder):
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    for camera in model.cameras.values():
        camera.model = pycolmap.CameraModelId.OPENCV
        camera.params = [50, 50, 20, 12, 0.1, 0, 0, 0]
    model.write(folder / "sparse" / "0")


# ---- 3D-OVS ---------------------------------------------------------------------------------------


def test_a_world_written_as_3d_ovs_is_read_back_equal(true_world, bed):
    scene = open_scene(bed)
    assert scene.prompts == ("Ring", "bear")  # capitals sort first
    assert list(scene.views) == ["00.png", "03.png"]
    for name, view in (("000.png", "00.png"), ("003.png", "03.png")):
        nodes = true_world.nodes(name, Level.WHOLE)
        assert [region.text for region in scene.views[view]] == ["Ring", "bear"]
        for region in scene.views[view]:
            truth = true_world.mask(name, nodes[region.text]) if region.text in nodes else BLACK
            assert np.array_equal(region.mask(), truth)
    # The ring of the first view: rows 5 to 13, columns 26 to 34. The last view does not show it.
    assert scene.views["00.png"][0].boxes().tolist() == [[26, 5, 34, 13]]
    assert scene.views["03.png"][0].boxes().shape == (0, 4)
    warnings = scene.report().warnings
    assert "regions without pixels: 03.png: Ring" in warnings
    assert "published frames that have no segmentation: 04.png, 10.png, 23.png, 30.png" in warnings
    posed = posed_images(bed, "3D-OVS")
    assert list(posed) == ["00.png", "01.png", "02.png", "03.png"]
    for name, view in zip(true_world.cameras.names, posed.values(), strict=True):
        camera = true_world.cameras[name]
        assert np.allclose(view.cam_from_source, camera.cam_from_world, atol=1e-12)
        assert np.allclose(view.camera.calibration_matrix(), camera.K)


def test_grey_is_foreground_only_for_protocols_that_accept_it(bed):
    grey = BLACK.copy()
    grey[:2], grey[2:4], grey[4] = 255, 254, 1
    write_png(bed / "segmentations" / "00" / "bear.png", grey)
    region = open_scene(bed).views["00.png"][1]
    assert np.flatnonzero(region.mask().any(axis=1)).tolist() == [0, 1]
    assert np.flatnonzero(region.mask(any_grey=True).any(axis=1)).tolist() == [0, 1, 2, 3, 4]


def test_llff_columns_are_down_right_and_back(bed):
    # World axes as LLFF's camera: its columns (down, right, back) are -y, x, z of the world, so the
    # camera is at (1, 2, 3), looks along -z, and has world x on its right and -y below it.
    matrix = np.array([[0, 1, 0, 1, 30], [-1, 0, 0, 2, 40], [0, 0, 1, 3, 50]], float)
    rows = np.tile([*matrix.ravel(), 0.5, 9.0], (4, 1))
    rows[:, 3] += [0, 1, 2, 3]
    np.save(bed / "poses_bounds.npy", rows)
    (bed / "images/01.jpg").unlink()
    write_png(bed / "images/01.png", np.zeros((12, 20, 3), np.uint8))
    view, halved, *_ = posed_images(bed, "3D-OVS").values()
    assert halved.camera.calibration_matrix().tolist() == [[25, 0, 10], [0, 25, 6], [0, 0, 1]]
    ahead, right, below = ([1, 2, 1, 1], [2, 2, 3, 1], [1, 1, 3, 1])
    assert np.allclose(view.cam_from_source @ ahead, [0, 0, 2, 1])
    assert np.allclose(view.cam_from_source @ right, [1, 0, 0, 1])
    assert np.allclose(view.cam_from_source @ below, [0, 1, 0, 1])
    assert view.camera.calibration_matrix().tolist() == [[50, 0, 20], [0, 50, 12], [0, 0, 1]]  # 40 x 24 px


def test_llff_rows_are_in_the_order_of_whole_file_names(bed):
    """A space, a bracket or a hyphen sorts before the dot of the suffix."""
    before = [view.cam_from_source for view in posed_images(bed, "3D-OVS").values()]
    for old, new in (("00", "a"), ("01", "a (1)"), ("02", "a-1"), ("03", "a_1")):
        (bed / f"images/{old}.jpg").rename(bed / f"images/{new}.jpg")
    posed = posed_images(bed, "3D-OVS")
    found = [posed[f"{stem}.png"].cam_from_source for stem in ("a (1)", "a-1", "a", "a_1")]
    np.testing.assert_array_equal(found, before)
    (bed / "images").rename(bed / "images_4")
    assert posed_images(bed, "3D-OVS").keys() == posed.keys()


ENTRY = np.arange(17)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[:, :16], r"shape \(4, 16\)"),
        (lambda rows: np.where(ENTRY == 3, np.nan, rows), "row 0: the pose is not a rotation"),
        (lambda rows: rows * np.nan, "does not contain LLFF poses"),
        (lambda rows: rows * np.where(ENTRY % 5 == 0, -1, 1), "row 0: the pose is not a rotation"),
        (lambda rows: np.where((ENTRY == 14) & (np.arange(4) == 2)[:, None], 0, rows), "lens of view 02.jpg"),
        (lambda rows: rows[:3], "has 3 poses for 4 images"),
    ],
)
def test_unusable_poses_of_llff_are_refused(bed, change, message):
    path = bed / "poses_bounds.npy"
    np.save(path, change(np.load(path)))
    with pytest.raises(SceneError, match=message):
        posed_images(bed, "3D-OVS")


def test_classes_are_stripped_and_sorted_without_empty_lines(tmp_path):
    (tmp_path / "classes.txt").write_text("  red bag\r\n\r\nbanana \n Gundam\n\n")
    assert ovs3d.read_classes(tmp_path / "classes.txt") == ("Gundam", "banana", "red bag")


def test_file_names_may_be_decomposed_as_on_macos(bed):
    (bed / "segmentations/classes.txt").write_text("Ring\nb\xe4r\n", encoding="utf-8")
    for view in ("00", "03"):
        (bed / f"segmentations/{view}/bear.png").rename(bed / f"segmentations/{view}/ba\u0308r.png")
    assert open_scene(bed).prompts == ("Ring", "b\xe4r")
    assert {region.text for region in open_scene(bed).views["00.png"]} == {"Ring", "b\xe4r"}


def test_masks_of_another_size_or_an_unknown_class_are_reported(bed):
    small = np.zeros((12, 20), np.uint8)
    small[1, 2] = 255
    write_png(bed / "segmentations/00/bear.png", small)
    write_png(bed / "segmentations/03/wood.png", BLACK)
    scene = open_scene(bed)
    bear = scene.views["00.png"][1]
    assert np.argwhere(bear.mask((24, 40))).tolist() == [[2, 4], [2, 5], [3, 4], [3, 5]]
    assert any("20 x 12 px, but its image is 40 x 24 px; resized" in line for line in scene.warnings)
    assert "03: masks of unknown classes are ignored: wood" in scene.warnings


def test_a_scene_without_any_pose_is_reported(bed):
    (bed / "poses_bounds.npy").unlink()
    assert open_scene(bed).poses is None
    assert any("no poses" in line for line in open_scene(bed).report().warnings)


# ---- both -----------------------------------------------------------------------------------------

MASKS = "segmentations"


@pytest.mark.parametrize(
    ("scene", "change", "message"),
    [
        ("teatime", lambda at: write_png(at / "test_mask/0/dr. bear.png", BLACK), "a prompt without a dot"),
        ("teatime", lambda at: (at / "test_mask/first").mkdir(), "0, 1, first"),
        ("teatime", train_on_all, r"has no test views\n.*\n.*4 posed images, all in images_train"),
        ("teatime", lambda at: (at / "images_train").rename(at / "train"), r"also teatime/images_train\n"),
        ("teatime", distort, r"have lens distortion\n.*PINHOLE or SIMPLE_PINHOLE.*\n.*OPENCV"),
        ("bed", lambda at: (at / MASKS / "classes.txt").write_text("\n \n"), "no class"),
        ("bed", lambda at: (at / MASKS / "classes.txt").write_text("hand\nhand \n"), "duplicates: hand"),
        ("bed", lambda at: write_png(at / "images/00.png", BLACK), "00.jpg, 00.png|00.png, 00.jpg"),
        ("bed", lambda at: write_png(at / MASKS / "00/bear.png", BLACK.T.copy()), "bear.png does not match"),
        (
            "bed",
            lambda at: (at / MASKS / "03/bear.png").rename(at / MASKS / "03/Bear.png"),
            r"has no masks for: bear\n.*\n.*not in classes.txt: Bear",
        ),
        ("bed", lambda at: (at / "images/03.jpg").unlink(), r"labelled views have no image: 03\.png"),
    ],
)
def test_unusable_scenes_are_refused(request, scene, change, message):
    folder = request.getfixturevalue(scene)
    change(folder)
    with pytest.raises(SceneError, match=message):
        open_scene(folder)
