"""Lidar points are on surfaces and have the labels that cameras see there."""

import cv2
import numpy as np
import pytest

from hilsplat.base.artifacts import read_npz, sha256_of_path
from hilsplat.base.levels import LEVELS, Level
from hilsplat.settings import WorldSettings
from hilsplat.world.lidar import (
    ABOVE_CAMERA_M,
    BEAMS,
    INCLINATION_DEG,
    MAX_RANGE_M,
    beam_directions,
    scan_street,
)
from hilsplat.world.render import label_view
from hilsplat.world.scenes.kinds import build_scene, scene_cameras
from hilsplat.world.stage import run_world
from hilsplat.world.truth import TrueMesh


@pytest.fixture(scope="module")
def cameras(street):
    return scene_cameras(street, 40, 384, 360.0)


@pytest.fixture(scope="module")
def centres(cameras):
    return np.stack([cameras[name].centre for name in cameras.names])


def test_beams_span_the_inclinations_of_the_scanner():
    directions = beam_directions(8).reshape(BEAMS, 8, 3)
    up = np.degrees(np.arcsin(directions[..., 2]))
    low, high = INCLINATION_DEG
    half = (high - low) / BEAMS / 2  # each beam is in the middle of its share
    assert up[0] == pytest.approx(low + half) and up[-1] == pytest.approx(high - half)
    assert np.linalg.norm(directions, axis=-1) == pytest.approx(1.0)


def test_beams_below_the_horizon_measure_the_flat_road(street, centres):
    # A scanner h above the road meets it with a beam d degrees down at range h / sin(d).
    scan = scan_street(street, centres, azimuth_steps=360, poses=2, range_noise_m=0.0, lost_share=0.0)
    road = next(node.id for node in street.nodes if node.text == "road")
    on_road = scan.node_ids[:, 0] == road
    height = scan.origins[scan.pose_index, 2]
    low, high = INCLINATION_DEG
    sine = -np.sin(np.radians(low + (scan.beam + 0.5) / BEAMS * (high - low)))
    assert on_road.sum() > 1000
    # Repaired patches are up to 6 mm above the road.
    assert np.abs(scan.range_m * sine - height)[on_road].max() < 0.01
    assert np.median(np.abs(scan.range_m - height / sine)[on_road]) < 1e-3


def test_points_are_at_the_measured_range_and_noise_has_the_stated_deviation(street, centres):
    scan = scan_street(street, centres, azimuth_steps=90, poses=3)
    exact = scan_street(street, centres, azimuth_steps=90, poses=3, range_noise_m=0.0)
    assert scan.origins == pytest.approx(centres[[0, 20, 39]] + [0, 0, ABOVE_CAMERA_M])
    away = np.linalg.norm(scan.points - scan.origins[scan.pose_index], axis=1)
    assert away == pytest.approx(scan.range_m, abs=1e-4)
    assert np.array_equal(scan.node_ids, exact.node_ids)  # noise moves points and changes no label
    error = (scan.range_m - exact.range_m).astype(np.float64)
    assert error.std() == pytest.approx(0.015, rel=0.1) and abs(error.mean()) < 0.001
    assert scan.range_m.max() < MAX_RANGE_M + 0.1


def test_the_sky_gives_no_return_and_a_share_of_returns_is_dropped(street, centres):
    full = scan_street(street, centres, azimuth_steps=200, poses=1, lost_share=0.0)
    some = scan_street(street, centres, azimuth_steps=200, poses=1, lost_share=0.2)
    texts = {street.nodes[node].text for node in np.unique(full.node_ids[:, 0])}
    assert "sky" not in texts and {"road", "sidewalk", "building"} <= texts
    assert len(some.points) / len(full.points) == pytest.approx(0.8, abs=0.02)


def test_visible_points_have_the_label_of_their_pixel(street, cameras, centres):
    scan, mesh = scan_street(street, centres), TrueMesh(street.triangles)
    assert 50_000 < len(scan.points) < 150_000
    for name in ("004.png", "021.png"):
        camera = cameras[name]
        labels, depth = label_view(street, camera), mesh.depth(camera)
        seen = scan.points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        ahead = seen[:, 2] > 0.5
        xy = (seen[ahead] @ camera.K.T)[:, :2] / seen[ahead, 2:]
        inside = ((xy > 2) & (xy < 382)).all(axis=1)
        column, row = np.floor(xy[inside]).astype(int).T
        z, ids = seen[ahead][inside, 2], scan.node_ids[ahead][inside]
        visible = np.abs(depth[row, column] - z) < 0.005 * z + 0.05
        for level in LEVELS:
            image = labels[level.index].astype(np.float32)
            square = np.ones((5, 5), np.uint8)  # pixels at least two away from a border
            within = visible & (cv2.dilate(image, square) == cv2.erode(image, square))[row, column]
            assert within.sum() > 3000
            # Measured 0.9997, 1.0 and 0.987. What differs at the last level is thinner than a pixel: the
            # scanner beside a bus hits the posts between its windows, which the camera cannot show.
            least = 0.97 if level == Level.SUBPART else 0.995
            assert (image[row, column] == ids[:, level.index])[within].mean() > least


def test_the_truth_folder_of_a_street_contains_the_scan_of_its_views(tmp_path):
    settings = WorldSettings(views=3, image_px=48, objects=3, samples=1)
    run_world("world:street:100", settings, tmp_path, threads=1)
    scene = build_scene("street", 100, 3)
    cameras = scene_cameras(scene, 3, 48, settings.arc_deg)
    scan_street(scene, np.stack([cameras[name].centre for name in cameras.names])).save(tmp_path / "own.npz")
    assert sha256_of_path(tmp_path / "own.npz") == sha256_of_path(tmp_path / "truth" / "lidar.npz")
    arrays = read_npz(tmp_path / "own.npz")
    assert set(arrays) == {"points", "node_ids", "pose_index", "range_m", "beam", "origins"}
    assert set(np.unique(arrays["pose_index"])) == set(range(len(arrays["origins"])))
