"""The fly-around: a smooth closed path, a film and a contact sheet."""

import av
import numpy as np
import pytest
from PIL import Image

from hilsplat.scene.cameras import Camera
from hilsplat.splat import flyaround
from tests.unit.splat.three_gaussians_world import ring


def circle(number: int) -> list[Camera]:
    cameras = ring(number, 48)
    return [cameras[name] for name in cameras.names]


def test_the_closed_path_circles_a_ring_once_in_any_order():
    cameras = circle(24)
    path = flyaround.closed_path([cameras[row] for row in np.random.default_rng(3).permutation(24)], 60)
    centres = np.stack([camera.centre for camera in path])
    radius = np.linalg.norm(centres[:, :2], axis=1)
    assert 2.85 < radius.min() <= radius.max() < 3.0  # smoothing cuts the corners a little
    np.testing.assert_allclose(centres[:, 2], 1.2, atol=1e-9)
    angle = np.unwrap(np.arctan2(centres[:, 1], centres[:, 0]))
    assert abs(abs(angle[-1] - angle[0]) - 2 * np.pi * 59 / 60) < 0.05
    steps = np.linalg.norm(np.diff(centres, axis=0, append=centres[:1]), axis=1)
    assert steps.max() < 1.1 * steps.min()  # closed, and at even speed
    for camera in path:
        rotation = camera.cam_from_world[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        # it looks at the origin, upright
        np.testing.assert_allclose(rotation[2], -camera.centre / np.linalg.norm(camera.centre), atol=0.02)
        assert rotation[1, 2] < 0


def test_an_open_path_goes_through_its_cameras_in_their_order():
    stops = circle(8)[:4]
    path = flyaround.open_path(stops, 31)
    centres = np.stack([camera.centre for camera in path])
    for stop, frame in zip(stops, (0, 10, 20, 30), strict=True):
        np.testing.assert_allclose(centres[frame], stop.centre, atol=0.05)
        np.testing.assert_allclose(path[frame].cam_from_world[:3, :3], stop.cam_from_world[:3, :3], atol=0.05)
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert steps.max() < 2.5 * steps.min()
    for camera in path:
        np.testing.assert_allclose(camera.K, stops[0].K)
        np.testing.assert_allclose(np.linalg.det(camera.cam_from_world[:3, :3]), 1)


def test_camera_shake_is_smoothed():
    shaky = circle(40)
    shake = np.random.default_rng(0).normal(0, 0.1, (40, 3))
    for camera, by in zip(shaky, shake, strict=True):
        camera.cam_from_world[:3, 3] += by

    def jerk(cameras: list[Camera]) -> float:
        return np.abs(np.diff([camera.centre for camera in cameras], 2, axis=0)).max()

    assert jerk(flyaround.closed_path(shaky, 40)) < 0.4 * jerk(shaky)


def test_one_camera_is_repeated_and_opposite_cameras_do_not_break_the_path():
    [camera] = circle(1)
    for stop in flyaround.closed_path([camera], 5) + flyaround.open_path([camera, camera], 3):
        np.testing.assert_allclose(stop.cam_from_world, camera.cam_from_world, atol=1e-9)
    for camera in flyaround.closed_path(circle(2), 16):
        assert np.isfinite(camera.cam_from_world).all()


def flat_picture(camera: Camera) -> np.ndarray:
    """A colour that encodes where the camera is."""
    return np.full((48, 48, 3), int(128 + 40 * camera.centre[0]), np.uint8)


def test_the_film_shows_every_frame_and_the_sheet_every_tenth(tmp_path):
    path = circle(12)
    flyaround.write_flyaround(tmp_path, path, flat_picture, threads=1)
    with av.open(tmp_path / "flyaround.mp4") as film:
        shown = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
        assert film.streams.video[0].average_rate == flyaround.FRAMES_PER_S
    expected = [flat_picture(camera) for camera in flyaround.closed_path(path, flyaround.FRAMES)]
    assert len(shown) == flyaround.FRAMES
    np.testing.assert_allclose(np.array(shown, int), np.array(expected, int), atol=3)
    assert Image.open(tmp_path / "flyaround.png").size == (4 * 52, 3 * 52)


def test_odd_sides_are_cropped_and_equal_frames_give_equal_bytes(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (3, 47, 61, 3), np.uint8)
    list(flyaround.encoded_film(tmp_path / "a.mp4", noise))
    with av.open(tmp_path / "a.mp4") as film:
        assert [frame.to_ndarray(format="rgb24").shape for frame in film.decode(video=0)] == [(46, 60, 3)] * 3
    tile = np.random.default_rng(0).integers(0, 255, (15, 20, 3)).repeat(8, axis=0).repeat(8, axis=1)
    frames = [np.roll(tile, 3 * shift, axis=1).astype(np.uint8) for shift in range(40)]
    written = set()
    for _ in range(8):
        list(flyaround.encoded_film(tmp_path / "film.mp4", frames))
        written.add((tmp_path / "film.mp4").read_bytes())
    assert len(written) == 1


def test_sheet_shrinks_by_averages(monkeypatch):
    monkeypatch.setattr(flyaround, "MAX_SIDE_PX", 4)
    picture = np.zeros((6, 8, 3), np.uint8)
    picture[:, ::2] = 100
    sheet = flyaround.contact_sheet([picture, picture], columns=1)
    assert sheet.shape == (2 * 7, 8, 3)
    assert (sheet[:3, :4] == 50).all()
    assert (sheet[3:7] == 255).all()


def test_titles_are_above_their_pictures_and_stay_within_them():
    picture = np.full((30, 60, 3), 200, np.uint8)
    sheet = flyaround.contact_sheet([picture, picture], 2, ["a", "a very long name of a photograph.jpg"])
    assert sheet.shape == (flyaround.TITLE_PX + 34, 2 * 64, 3)
    titles, below = sheet[: flyaround.TITLE_PX], sheet[flyaround.TITLE_PX :]
    np.testing.assert_array_equal(below, flyaround.contact_sheet([picture, picture], 2))
    is_drawn = (titles < 128).any(axis=(0, 2))
    assert is_drawn[:10].any() and not is_drawn[10:64].any()
    assert is_drawn[64:].sum() > 20 and not is_drawn[124:].any()
