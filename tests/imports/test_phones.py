"""Phone exports: Polycam and Record3D, to the pixel."""

import functools
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.errors import HilsplatError
from hilsplat.scene.importers import phones
from hilsplat.scene.importers.reading import read_source
from hilsplat.scene.layouts import find_known_poses
from hilsplat.workflow.new_scene import add_scene
from tests.imports import analytic_world as world

WIDTH, HEIGHT = 112, 84
POSES = world.cameras(6)
LENSES = [(90.0 + 2 * row, 91.0 + row, 56 + 2 * np.sin(row), 42 + np.cos(row)) for row in range(6)]
# ARKit's world has y up; x, y, z of ARKit are y, z, x of a world with z up.
ARKIT = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


@pytest.fixture(autouse=True)
def no_points(monkeypatch):
    """Phone exports have no points; `test_colmap.py` triangulates them."""
    points = np.zeros((99, 3)), np.zeros((99, 3), np.uint8)
    monkeypatch.setattr("hilsplat.scene.importers.importing.triangulate", lambda *args: points)


def phone_pose(pose):
    return ARKIT @ pose @ world.OPENGL


@functools.cache
def picture(row, lens):
    return world.picture(world.pinhole(*lens), WIDTH, HEIGHT, POSES[row])


def save_pictures(folder, lenses):
    world.save(folder, {str(row): picture(row, lens) for row, lens in enumerate(lenses)}, ".png")


def record3d(folder, lenses=LENSES, **more):
    save_pictures(folder / "rgb", lenses)
    rows = []
    for pose in POSES:
        w, *xyz = world.quaternion(phone_pose(pose)[:3, :3])
        rows.append([*xyz, w, *phone_pose(pose)[:3, 3]])
    fx, fy, cx, cy = lenses[0]
    by_columns = [fx, 0, 0, 0, fy, 0, cx, cy, 1]
    content = {"K": by_columns, "w": WIDTH, "h": HEIGHT, "poses": rows, "fps": 60, "dw": 192, **more}
    (folder / "metadata.json").write_text(json.dumps(content))
    return folder


def polycam(folder, border_px=0, **more):
    prefix = "corrected_" if border_px else ""
    save_pictures(folder / f"keyframes/{prefix}images", LENSES)
    (folder / f"keyframes/{prefix}cameras").mkdir(parents=True)
    for row, (lens, pose) in enumerate(zip(LENSES, POSES, strict=True)):
        matrix = phone_pose(pose)
        content = {f"t_{i}{j}": matrix[i, j] for i in range(3) for j in range(4)}
        content |= dict(zip(("fx", "fy", "cx", "cy"), lens, strict=True))
        content |= {"width": WIDTH, "height": HEIGHT, "blur_score": 3.5, "timestamp": 17, **more}
        (folder / f"keyframes/{prefix}cameras/{row}.json").write_text(json.dumps(content))
    return folder


RIGHT = {f"{row}.png": pose for row, pose in enumerate(POSES)}


@pytest.mark.parametrize("own", [True, False])
def test_record3d_s_lenses_of_frames_are_applied(own, tmp_path, imported):
    lenses = LENSES if own else LENSES[:1] * 6
    more = {"perFrameIntrinsicCoeffs": [list(lens) for lens in lenses]} if own else {}
    views, _, _, report = imported(record3d(tmp_path / "in", lenses, **more))
    world.require_right(views, RIGHT, 45)
    assert not report["warnings"]


def test_polycam_s_pictures_are_right_with_and_without_their_border(tmp_path, imported):
    views, *_ = imported(polycam(tmp_path / "plain"))
    world.require_right(views, RIGHT, 45)
    views, *_ = imported(polycam(tmp_path / "corrected", border_px=15))
    world.require_right(views, RIGHT, 45)
    view = views[0]
    assert (view.camera.width, view.camera.height) == (WIDTH - 30, HEIGHT - 30)
    assert view.photo.size_hw == (HEIGHT, WIDTH)  # labels drawn on the picture with its border


@pytest.mark.parametrize("missing", [{"width": None}, {"width": None, "height": None}])
def test_polycam_s_size_is_that_of_the_picture_if_it_is_missing(missing, tmp_path):
    source = read_source(find_known_poses(polycam(tmp_path, **missing)))
    assert {(view.camera.width, view.camera.height) for view in source.views} == {(WIDTH, HEIGHT)}


@pytest.mark.parametrize("content", ["{", "[]", '{"t_00": 1}', '{"fx": null}'])
def test_one_damaged_camera_of_polycam_leaves_out_its_view(content, tmp_path, imported):
    folder = polycam(tmp_path / "in")
    (folder / "keyframes/cameras/2.json").write_text(content)
    views, _, _, report = imported(folder)
    world.require_right(views, {name: pose for name, pose in RIGHT.items() if name != "2.png"}, 45)
    assert "2.json" in report["views"]["2.png"]["why_not"]


@pytest.mark.parametrize(
    ("write", "more"),
    [
        (record3d, {"perFrameIntrinsicCoeffs": [[90, 90, 56, 42]] * 5}),
        (record3d, {"perFrameIntrinsicCoeffs": [[90, 90, 56]] * 6}),
        (record3d, {"distortion": [0.1, 0]}),
        (record3d, {"poses": [[1, 2, 3]]}),
        (record3d, {"K": [1, 2]}),
        (record3d, {"K": [90, 0, 56, 0, 91, 42, 0, 0, 1]}),  # by rows
        (polycam, {"fx": 0.8, "fy": 0.8, "cx": 0.5, "cy": 0.5}),  # shares of the size
        (polycam, {"width": None, "cx": 112, "cy": 84}),  # those of another size
        (polycam, {"width": None, "cx": 84, "cy": 63}),  # 1.5 times as large
        (record3d, {"K": [90, 0, 0, 0, 91, 0, 84, 63, 1]}),
        (record3d, {"K": None}),
        (record3d, {"w": "wide"}),
        (polycam, {"k1": 0.1}),
        (polycam, {"fx": -1}),
    ],
)
def test_what_cannot_be_applied_is_refused(write, more, tmp_path, imported):
    with pytest.raises(HilsplatError):
        imported(write(tmp_path, **more))


@pytest.mark.parametrize(("write", "file"), [(record3d, "metadata.json"), (polycam, "cameras")])
def test_unknown_keys_are_reported(write, file, tmp_path):
    source = read_source(find_known_poses(write(tmp_path, hdr=True)))
    assert source.notes == [f"keys of {file} that are not used: hdr"]


def test_a_quaternion_that_is_not_a_rotation_leaves_out_its_view(tmp_path):
    folder = record3d(tmp_path)
    path = folder / "metadata.json"
    content = json.loads(path.read_text())
    content["poses"][1][:4] = [0.5, 0.5, 0.5, 0.9]
    path.write_text(json.dumps(content))
    source = read_source(find_known_poses(folder))
    assert len(source.views) == 5 and "pose 1: the pose is not a rotation" in source.left_out["1.png"]


def test_corrected_pictures_of_polycam_come_first_and_their_border_scales(tmp_path, imported):
    polycam(tmp_path / "in")
    images = polycam(tmp_path / "in", border_px=15) / "keyframes/corrected_images"
    for path in images.iterdir():
        Image.open(path).resize((2 * WIDTH, 2 * HEIGHT)).save(path)
    (view, *_), *_ = imported(tmp_path / "in")
    fx, fy, cx, cy = LENSES[0]
    right = [[2 * fx, 0, 2 * cx - 30], [0, 2 * fy, 2 * cy - 30], [0, 0, 1]]
    np.testing.assert_allclose(view.camera.calibration_matrix(), right)
    assert (view.camera.width, view.camera.height) == (2 * WIDTH - 60, 2 * HEIGHT - 60)


def test_corrected_folders_without_cameras_are_passed_over(tmp_path):
    for what in ("images", "cameras"):
        (tmp_path / f"keyframes/corrected_{what}").mkdir(parents=True)
    source = read_source(find_known_poses(polycam(tmp_path)))
    assert [view.image.parent.name for view in source.views] == ["images"] * 6


def test_long_recordings_are_thinned_evenly(tmp_path, monkeypatch):
    monkeypatch.setattr(phones, "MAX_VIEWS", 4)
    folder = record3d(tmp_path)
    shutil.copy(folder / "rgb/0.png", folder / "rgb/\u00b2.png")  # its name isn't a number
    source = read_source(find_known_poses(folder))
    assert [view.name for view in source.views] == ["0.png", "2.png", "3.png", "5.png"]


def test_an_r3d_archive_is_unpacked_without_depth_maps(tmp_path):
    folder = record3d(tmp_path / "in")
    (folder / "metadata.json").rename(folder / "metadata")
    (folder / "rgb").rename(folder / "rgbd")
    (folder / "rgbd/0.depth").touch()
    Path(shutil.make_archive(tmp_path / "scan", "zip", folder)).rename(tmp_path / "scan.r3d")
    assert add_scene(tmp_path / "scenes.tsv", "scan", tmp_path / "scan.r3d").num_readable == 6
    assert find_known_poses(tmp_path / "photos/scan").kind == "record3d"
    assert not list((tmp_path / "photos/scan").rglob("*.depth"))
