"""LERF-Mask: which views are tested, and which folder of masks belongs to which."""

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.errors import ImageError, SceneError
from hilsplat.base.images import write_png
from hilsplat.base.levels import Level
from hilsplat.datasets.images.lerf_mask import open_scene
from hilsplat.scene.poses import run_poses
from hilsplat.scene.scene import Scene
from hilsplat.settings import PosesSettings
from tests.unit.datasets.writers.labelled import write_lerf_mask
from tests.unit.datasets.writers.true_world import write_sparse


@pytest.fixture
def root(tmp_path, true_world):
    """The small world as scene `teatime`; its second and fourth view are for testing."""
    write_lerf_mask(true_world, tmp_path / "lerf_mask", "teatime", ["003.png", "001.png"], Level.PART)
    return tmp_path / "lerf_mask"


def test_a_written_world_is_read_back_equal(true_world, root):
    scene = open_scene(root, "teatime")
    assert list(scene.views) == ["frame_00002.png", "frame_00004.png"]
    assert scene.prompts == ("head", "paw")
    for name, view in (("001.png", "frame_00002.png"), ("003.png", "frame_00004.png")):
        nodes = true_world.nodes(name, Level.PART)
        assert [region.text for region in scene.views[view]] == ["head", "paw"]
        for region in scene.views[view]:
            assert np.array_equal(region.mask(), true_world.mask(name, nodes[region.text]))
    assert open_scene(root, "teatime").report().facts["posed views"] == 4


def test_test_views_are_posed_images_that_images_train_lacks(root):
    folder = root / "teatime"
    (folder / "images_train" / "frame_00001.jpg").unlink()
    write_png(folder / "test_mask" / "2" / "head.png", np.zeros((24, 40), np.uint8))
    # Now frame 1 is a test view too, and the first of them: every folder moves on by one view.
    scene = open_scene(root, "teatime")
    assert list(scene.views) == ["frame_00001.png", "frame_00002.png", "frame_00004.png"]
    assert not scene.views["frame_00004.png"][0].mask().any()


def test_the_poses_stage_holds_the_test_views_out(root, tmp_path):
    settings = PosesSettings(test_every=2)
    run_poses(root / "teatime", tmp_path / "scene", "lerf_mask/teatime", "arbitrary", False, settings, 0, 1)
    split = Scene.load(tmp_path / "scene").split
    assert [view for view in split if split[view] == "test"] == list(open_scene(root, "teatime").views)


def test_an_image_without_a_pose_is_not_a_test_view(true_world, root):
    write_png(root / "teatime" / "images" / "frame_00000.png", np.zeros((24, 40, 3), np.uint8))
    assert list(open_scene(root, "teatime").views) == ["frame_00002.png", "frame_00004.png"]
    cameras = [true_world.cameras[name] for name in true_world.cameras.names[:3]]
    names = [f"frame_0000{n}.jpg" for n in (1, 2, 3)]
    write_sparse(root / "teatime" / "sparse" / "0", cameras, names, np.zeros((0, 3)))
    with pytest.raises(SceneError, match=r"not match the test views\n.*0 to 0, for frame_00002.png\n.*0, 1"):
        open_scene(root, "teatime")


def test_foreground_is_above_128(root):
    values = np.full((24, 40), 128, np.uint8)
    values[0, 0], values[0, 1] = 129, 255
    write_png(root / "teatime" / "test_mask" / "0" / "head.png", values)
    (head,) = [r for r in open_scene(root, "teatime").views["frame_00002.png"] if r.text == "head"]
    assert np.argwhere(head.mask()).tolist() == [[0, 0], [0, 1]]


def test_masks_are_read_only_when_requested(root):
    path = root / "teatime" / "test_mask" / "0" / "head.png"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    scene = open_scene(root, "teatime")  # the header is whole
    with pytest.raises(ImageError, match=r"head.png cannot be read"):
        scene.views["frame_00002.png"][0].mask()


def test_a_prompt_with_a_dot_is_refused(root):
    write_png(root / "teatime" / "test_mask" / "0" / "dr. bear.png", np.zeros((24, 40), np.uint8))
    with pytest.raises(SceneError, match="a prompt without a dot"):
        open_scene(root, "teatime")


def test_strange_folders_of_masks_are_named(root):
    (root / "teatime" / "test_mask" / "first").mkdir()
    with pytest.raises(SceneError, match="0, 1, first"):
        open_scene(root, "teatime")


def test_images_train_as_a_copy_of_images_is_refused(root):
    for name in ("frame_00002", "frame_00004"):
        Image.new("RGB", (40, 24)).save(root / "teatime" / "images_train" / f"{name}.jpg")
    with pytest.raises(SceneError, match=r"has no test view\n.*\n.*4 posed images, all of them"):
        open_scene(root, "teatime")


def test_missing_parts_are_named(root):
    (root / "teatime" / "images_train").rename(root / "teatime" / "train")
    with pytest.raises(SceneError, match=r"also teatime/images_train\n"):
        open_scene(root, "teatime")


def test_a_distorted_model_is_refused(root, true_world):
    from hilsplat.scene.colmap import pycolmap

    folder = root / "teatime" / "sparse" / "0"
    model = pycolmap.Reconstruction(folder)
    for camera in model.cameras.values():
        camera.model = pycolmap.CameraModelId.OPENCV
        camera.params = [50, 50, 20, 12, 0.1, 0, 0, 0]
    model.write(folder)
    with pytest.raises(SceneError, match=r"are distorted\n.*PINHOLE or SIMPLE_PINHOLE.*\n.*OPENCV"):
        open_scene(root, "teatime")
