"""Scene coordinates, the split, and images without distortion."""

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.images import read_image
from hilsplat.scene.assemble import (
    PosedView,
    move_cameras,
    normalising_similarity,
    rotation_to_z_up,
    split_views,
    undistort,
    up_direction,
)
from hilsplat.scene.colmap import pycolmap
from tests.unit.splat.three_gaussians_world import ring


def ring_with_y_up():
    """Poses of six cameras that look down at the origin from a distance of sqrt(10.44), at height 1.2."""
    poses = ring(6, 48).cam_from_world
    poses[:, :3, :3] = poses[:, :3, :3] @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    return poses


def test_every_eighth_view_by_name_is_held_out_of_eight_or_more():
    names = [f"{number:02}.png" for number in range(17)]
    split = split_views(names[::-1], 8)
    assert [name for name in split if split[name] == "test"] == ["00.png", "08.png", "16.png"]
    assert set(split_views(names[:7], 2).values()) == {"train"}
    assert list(split_views(names[:8], 8).values()).count("test") == 1
    assert set(split_views(names, 0).values()) == set(split_views(names, 1).values()) == {"train"}


def test_up_is_found_from_level_cameras_that_look_down():
    poses = ring_with_y_up()
    np.testing.assert_allclose(up_direction(poses), [0, 1, 0], atol=1e-9)
    # an arc of 60 degrees: the mean of the cameras' own up axes would lean
    np.testing.assert_allclose(up_direction(poses[:2]), [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(rotation_to_z_up(np.array([0.0, 1.0, 0.0])) @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    np.testing.assert_array_equal(rotation_to_z_up(np.array([0.0, 0.0, 1.0])), np.eye(3))
    down = np.array([0.0, 0.0, -1.0])
    np.testing.assert_allclose(rotation_to_z_up(down) @ down, [0, 0, 1], atol=1e-12)


def test_scene_coordinates_centre_the_points_and_put_cameras_at_distance_one():
    poses = ring_with_y_up()
    points = np.array([[0.0, 0, 0], [0, 0, 0], [100, 0, 0]])  # the median ignores the outlier
    similarity = normalising_similarity(poses, points, metric=False, turn=True)
    moved = move_cameras(poses, similarity)
    centres = -np.einsum("vji,vj->vi", moved[:, :3, :3], moved[:, :3, 3])
    np.testing.assert_allclose(np.linalg.norm(centres, axis=1), 1.0)
    np.testing.assert_allclose(centres[:, 2], 1.2 / np.sqrt(10.44))  # source y is up, and becomes z
    # a point keeps its pixel: camera coordinates are scaled, not rotated
    point = np.array([1.0, 2.0, 3.0, 1.0])
    expected = (poses[0] @ point)[:3] / np.sqrt(10.44)
    np.testing.assert_allclose((moved[0] @ (similarity @ point))[:3], expected, atol=1e-12)
    # metric sources keep their metre, and imports their axes
    similarity = normalising_similarity(poses, np.array([[1.0, 2, 3]]), metric=True, turn=False)
    np.testing.assert_array_equal(similarity[:3, :3], np.eye(3))
    np.testing.assert_array_equal(similarity[:3, 3], [-1, -2, -3])


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "SIMPLE_RADIAL"])
def test_images_without_distortion_keep_every_pixel(tmp_path, model):
    pixels = np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    camera = pycolmap.Camera.create_from_model_name(1, model, 50.0, 40, 30)  # k = 0
    view = undistort(PosedView("a.png", tmp_path / "a.png", camera, np.eye(4)), tmp_path / "out")
    np.testing.assert_array_equal(read_image(tmp_path / "out" / "a.png"), pixels)
    np.testing.assert_array_equal(view.camera.calibration_matrix(), [[50, 0, 20], [0, 50, 15], [0, 0, 1]])
