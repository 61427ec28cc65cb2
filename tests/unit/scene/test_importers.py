"""Scenes from COLMAP models, and exported scenes that are read back; `tests/imports` has all formats."""

import json
import shutil
import struct

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.errors import SceneError
from hilsplat.scene.colmap import pycolmap
from hilsplat.scene.exporting import write_colmap as export_colmap
from hilsplat.scene.exporting import write_model, write_nerfstudio
from hilsplat.scene.importers.colmap_model import read_model
from hilsplat.scene.layouts import NO_POSES, find_known_poses
from hilsplat.scene.poses import run_poses
from hilsplat.scene.scene import Scene
from hilsplat.settings import PosesSettings
from tests.imports import analytic_world as world


def import_scene(folder, out, unit="metre", **settings):
    run_poses(folder, out, "photos/known", unit, False, PosesSettings(**settings), 0, 1)
    return Scene.load(out)


def write_images(folder, names, size_hw=(30, 40)):
    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(names):
        Image.fromarray(np.full((*size_hw, 3), 20 * number, dtype=np.uint8)).save(folder / name, quality=95)


def write_colmap(folder):
    """Three PINHOLE cameras at x = 0, 1, 2 that look along +z, and two points."""
    poses = {name: np.eye(4) for name in ("a.jpg", "b.jpg", "c.jpg")}
    write_images(folder / "images", poses)
    for x, pose in enumerate(poses.values()):
        pose[0, 3] = x
    points = [(0, 0, 4, 10, 20, 30), (2, 0, 4, 10, 20, 30)]
    world.write_colmap(folder / "sparse/0", "PINHOLE 50 51 19 16", (40, 30), poses, points)


def test_colmap_model_keeps_intrinsics_and_metric_poses(tmp_path):
    write_colmap(tmp_path / "in")
    scene = import_scene(tmp_path / "in", tmp_path / "scene")
    assert scene.cameras.names == ("a.png", "b.png", "c.png")
    np.testing.assert_array_equal(scene.cameras["b.png"].K, [[50, 0, 19], [0, 51, 16], [0, 0, 1]])
    # the median of the points, (1, 0, 4), becomes the origin; a metre stays a metre
    np.testing.assert_allclose(scene.cameras["a.png"].centre, [-1, 0, -4])
    np.testing.assert_allclose(scene.cameras["c.png"].centre, [1, 0, -4])
    np.testing.assert_allclose(scene.cameras["a.png"].cam_from_world[:3, :3], np.eye(3))
    np.testing.assert_allclose(scene.points_xyz, [[-1, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(scene.points_rgb, [[10, 20, 30]] * 2)
    assert scene.unit == "metre"


def test_images_and_poses_without_a_partner_are_named(tmp_path):
    write_colmap(tmp_path / "in")
    (tmp_path / "in" / "images" / "c.jpg").unlink()
    write_images(tmp_path / "in" / "images", ["new.jpg"])
    with pytest.raises(
        SceneError, match=r"1 of 3 views(.|\n)*at least 70%(.|\n)*c\.jpg: its image is missing"
    ):
        import_scene(tmp_path / "in", tmp_path / "scene")
    import_scene(tmp_path / "in", tmp_path / "scene", min_registered_share=0.5)
    report = json.loads((tmp_path / "scene" / "registration.json").read_text())
    assert (report["images"], report["registered"]) == (4, 2)
    assert report["views"]["c.jpg"]["why_not"] == "its image file is missing"
    assert report["views"]["new.jpg"]["why_not"] == "the source has no pose for it"


@pytest.mark.parametrize("write", [export_colmap, write_nerfstudio])
def test_an_exported_scene_is_read_back_in_the_sources_coordinates(tmp_path, write):
    write_colmap(tmp_path / "in")
    scene = import_scene(tmp_path / "in", tmp_path / "scene", unit="arbitrary")
    assert not np.allclose(scene.scene_from_source, np.eye(4))  # it was normalised
    write(scene, tmp_path / "out")
    again = import_scene(tmp_path / "out", tmp_path / "again", unit="arbitrary")
    assert again.cameras.names == scene.cameras.names
    # sparse points are float32, and their median is the origin
    np.testing.assert_allclose(again.scene_from_source, scene.scene_from_source, atol=1e-7)
    np.testing.assert_allclose(again.cameras.cam_from_world, scene.cameras.cam_from_world, atol=1e-7)
    np.testing.assert_allclose(again.cameras.K, scene.cameras.K)
    np.testing.assert_allclose(again.points_xyz, scene.points_xyz, atol=1e-6)
    np.testing.assert_array_equal(again.points_rgb, scene.points_rgb)
    assert again.image_path("a.png").read_bytes() == scene.image_path("a.png").read_bytes()


def test_a_model_that_cannot_be_written_raises_the_system_s_error(tmp_path):
    (tmp_path / "points3D.bin").mkdir()
    with pytest.raises(IsADirectoryError):
        write_model(tmp_path, [], np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


@pytest.mark.parametrize("place", ["poses", "poses/sparse/0", "poses/transforms.json"])
def test_poses_named_by_the_user_replace_those_in_the_folder(tmp_path, place):
    write_colmap(tmp_path / "in")
    scene = import_scene(tmp_path / "in", tmp_path / "scene")
    (export_colmap if "json" not in place else write_nerfstudio)(scene, tmp_path / "poses")
    shutil.copytree(tmp_path / "poses/images", tmp_path / "photos/images")
    shutil.copytree(tmp_path / "in/sparse", tmp_path / "photos/sparse")
    (tmp_path / "photos/sparse/0/images.txt").write_bytes(b"")
    out = tmp_path / "out"
    run_poses(tmp_path / "photos", out, "a/b", "metre", False, PosesSettings(), 0, 1, tmp_path / place)
    cameras = Scene.load(out).cameras
    np.testing.assert_allclose(cameras.cam_from_world, scene.cameras.cam_from_world, atol=1e-6)


def test_missing_poses_are_refused_and_none_ignores_those_in_the_folder(tmp_path):
    write_colmap(tmp_path / "in")
    with pytest.raises(SceneError, match="images has no poses for"):
        find_known_poses(tmp_path / "in", tmp_path / "in/images")
    assert find_known_poses(tmp_path / "in").kind == "colmap"
    (tmp_path / "in/sparse/0/images.txt").unlink()
    with pytest.raises(SceneError, match="does not contain a complete COLMAP model"):
        find_known_poses(tmp_path / "in")
    assert find_known_poses(tmp_path / "in", NO_POSES) is None


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_truncated_file_a_larger_count_and_trailing_bytes_are_damage(tmp_path, name):
    write_colmap(tmp_path)
    model = tmp_path / "binary"
    model.mkdir()
    pycolmap.Reconstruction(tmp_path / "sparse/0").write_binary(model)
    read_model(model)
    whole = (model / name).read_bytes()
    count = int.from_bytes(whole[:8], "little")
    truncated = [whole[:length] for length in range(len(whole))]
    larger = [struct.pack("<Q", count + more) + whole[8:] for more in (1, 1000, 2**40, 2**63)]
    for content in (*truncated, *larger, whole + b"\0"):
        (model / name).write_bytes(content)
        with pytest.raises(SceneError, match=rf"{name} cannot be read: "):
            read_model(model)


def test_a_colmap_model_cannot_name_files_outside_its_folder(tmp_path):
    write_colmap(tmp_path / "in")
    images = tmp_path / "in" / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace("b.jpg", "../../../b.jpg"))
    shutil.copy(tmp_path / "in/images/a.jpg", tmp_path / "b.jpg")  # the name means the b.jpg in the folder
    import_scene(tmp_path / "in", tmp_path / "scene", test_every=0)
    report = json.loads((tmp_path / "scene/registration.json").read_text())
    assert report["views"]["b.png"]["registered"]
    (tmp_path / "in/images/b.jpg").unlink()
    with pytest.raises(SceneError, match=r"outside it: \.\./\.\./\.\./b\.jpg"):
        import_scene(tmp_path / "in", tmp_path / "scene")
