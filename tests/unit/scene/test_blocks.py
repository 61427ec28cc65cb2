"""Division of scenes into blocks: what a view sees, and which places and views belong together."""

from dataclasses import replace

import numpy as np
import pytest

from hilsplat.base.errors import ArtifactError, SettingsError
from hilsplat.base.images import write_png
from hilsplat.scene.assemble import move_cameras
from hilsplat.scene.blocks import BLOCKS, Blocks, block_centres, seen_points, split_scene
from hilsplat.scene.cameras import Camera
from hilsplat.scene.poses import run_poses
from hilsplat.scene.scene import Scene
from hilsplat.settings import PosesSettings
from tests.unit.evaluate.builders import cameras_of

K = np.array([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]])  # 32 x 32 px: a cell is a pixel


def test_a_view_sees_the_nearest_point_of_each_cell_in_front_of_it():
    points = np.array(
        [
            [0.0, 0, 4],  # behind the next one
            [0, 0, 2],
            [0, 0, -2],  # behind the camera
            [1, 0, 4],  # beside it
            [3, 0, 4],  # beyond the right edge: column 40
            [0, -2, 4],  # at the upper edge: row 0
        ]
    )
    seen = seen_points(points, Camera("0.png", np.eye(4), K, (32, 32)))
    assert sorted(seen.tolist()) == [1, 3, 5]


@pytest.mark.parametrize(
    ("count", "expected"),
    [(1, [[5.5, 0, 0]]), (2, [[2.5, 0, 0], [8.5, 0, 0]]), (3, [[1.5, 0, 0], [5.5, 0, 0], [9.5, 0, 0]])],
)
def test_places_are_divided_across_their_longest_direction_into_equal_groups(count, expected):
    places = np.stack([np.arange(12.0), np.tile([-0.1, 0.1], 6), np.zeros(12)], axis=1)
    shuffled = places[np.random.default_rng(0).permutation(12)]
    found = block_centres(shuffled, count)
    np.testing.assert_allclose(sorted(found.tolist()), expected, atol=0.1)


def row_of_views(folder, number):
    """Views in a row, one unit apart; each sees two units of a row of points."""
    poses = np.tile(np.eye(4), (number, 1, 1))
    poses[:, :, 3] = [[-view, 0, 2, 1] for view in range(number)]
    points = np.stack([np.arange(-1, number, 0.25), *np.zeros((2, 4 * number + 4))], axis=1)
    cameras = cameras_of(poses, K, (32, 32))
    for name in cameras.names:
        write_png(folder / "images" / name, np.zeros((32, 32, 3), np.uint8))
    split, colours = dict.fromkeys(cameras.names, "train"), np.zeros((len(points), 3), np.uint8)
    scene = Scene(
        folder, "photos/row", "arbitrary", cameras, split, points.astype(np.float32), colours, np.eye(4)
    )
    scene.save()
    return scene


@pytest.mark.parametrize(("share", "borrowed"), [(0.3, [(), ()]), (0.25, [("006.png",), ("005.png",)])])
def test_a_view_is_lent_to_a_block_in_which_it_sees_enough(tmp_path, share, borrowed):
    """Views 5 and 6 see a quarter of their points beyond the border at x = 5.375."""
    scene = row_of_views(tmp_path / "scene", 12)
    blocks = split_scene(scene, tmp_path / "blocks", 2, share)
    assert [block.owned for block in blocks.blocks.values()] == [
        scene.cameras.names[:6],
        scene.cameras.names[6:],
    ]
    assert [block.borrowed for block in blocks.blocks.values()] == borrowed
    assert Blocks.load(tmp_path / "blocks") == blocks


def test_a_block_has_the_poses_and_the_split_of_its_scene(tmp_path):
    scene = row_of_views(tmp_path / "scene", 20)
    scene = replace(scene, split=scene.split | {"002.png": "test"})
    blocks = split_scene(scene, tmp_path / "blocks", 2, 1.0).blocks
    held_out = []
    for name, block in blocks.items():
        out = tmp_path / name
        run_poses(tmp_path / "blocks" / name, out, name, "arbitrary", False, PosesSettings(), 0, 1)
        imported = Scene.load(out)
        assert imported.views() == list(block.owned)  # ten views; the settings would hold out two
        held_out += imported.views("test")
        whole_from_block = np.linalg.inv(imported.scene_from_source)
        moved = move_cameras(imported.cameras.cam_from_world, whole_from_block)
        expected = [scene.cameras[view].cam_from_world for view in imported.views()]
        np.testing.assert_allclose(moved, expected, atol=1e-12)
    assert held_out == ["002.png"]


def test_too_many_blocks_are_refused(tmp_path):
    with pytest.raises(SettingsError, match="too few views for 4 blocks"):
        split_scene(row_of_views(tmp_path / "scene", 11), tmp_path / "blocks", 4, 0.1)
    assert not (tmp_path / "blocks").exists()


@pytest.mark.parametrize("text", ["{}", "[", '{"scene": "a", "cameras_sha256": "b", "blocks": {"c": 1}}'])
def test_damaged_blocks_are_refused(tmp_path, text):
    (tmp_path / BLOCKS).write_text(text)
    with pytest.raises(ArtifactError, match=BLOCKS):
        Blocks.load(tmp_path)
