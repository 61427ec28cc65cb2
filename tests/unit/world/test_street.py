"""Objects of a street are in their places, views overlap, and lidar points are on surfaces."""

import cv2
import numpy as np
import pytest

from hilsplat.base.levels import LEVELS, Level
from hilsplat_world import lidar
from hilsplat_world.render import label_view, render_view
from hilsplat_world.scenes.kinds import scene_cameras
from hilsplat_world.scenes.scene import WorldScene
from hilsplat_world.scenes.street import FRONT, KERB, LANE, LANE_Y, MAX_STEP, SWEEP_DEG, WALK_Z
from hilsplat_world.truth import true_depth
from hilsplat_world.views import square_camera
from tests.unit.world.scenes import built


@pytest.fixture(scope="module")
def street() -> WorldScene:
    return built("street")


@pytest.fixture(scope="module")
def cameras(street):
    return scene_cameras(street, 40, 384, 360.0)


@pytest.fixture(scope="module")
def centres(cameras):
    return np.stack([cameras[name].centre for name in cameras.names])


def things(scene: WorldScene) -> dict[int, np.ndarray]:
    """Corners of all wholes but the surroundings, by id."""
    ids = sorted(set(np.unique(scene.node_ids[:, 0]).tolist()) - scene.background)
    return {node: scene.triangles[scene.node_ids[:, 0] == node].reshape(-1, 3) for node in ids}


def test_vehicles_are_on_the_road_and_pedestrians_on_the_sidewalk(street):
    for node, points in things(street).items():
        text = street.nodes[node].text
        low, high = points.min(axis=0), points.max(axis=0)
        on_road = text in ("car", "truck", "bus", "cyclist")
        assert low[2] == pytest.approx(0.0 if on_road else WALK_Z, abs=1e-5)
        if on_road:
            assert low[1] > -KERB and high[1] < KERB
        elif text == "pedestrian":
            assert np.abs(points[:, 1]).min() > KERB and np.abs(points[:, 1]).max() < FRONT
    texts = {street.nodes[node].text for node in things(street)}
    assert {"car", "pedestrian", "cyclist", "building", "tree", "traffic sign", "traffic light"} <= texts
    assert texts & {"truck", "bus"}


def test_every_pixel_has_a_label_and_the_sky_is_self_luminous(street):
    assert (label_view(street, scene_cameras(street, 40, 64, 360)["020.png"])[0] >= 0).all()
    # Straight up from the road there is only sky; its colours lie between blue and white.
    up = np.array([0.0, LANE_Y, 1.8]), np.array([0.3, LANE_Y, 12.0])
    camera = square_camera(up, 16, 62.0)
    sky = next(node for node in street.background if street.nodes[node].text == "sky")
    assert (label_view(street, camera)[0] == sky).all()
    image = render_view(street, camera, 1).astype(int)
    assert (image[..., 2] >= image[..., 0]).all() and image[..., 2].min() > 200


def test_neighbouring_views_differ_little_in_position_and_direction(street, cameras, centres):
    forward, step = cameras.cam_from_world[:, 2, :3], np.diff(centres, axis=0)
    # One step along the lane, the sway (0.8 m) of a sixteenth of a turn, and the jitter of both.
    assert (step[:, 0] > 0.3).all() and (step[:, 0] < MAX_STEP + 0.11).all()
    assert np.abs(step[:, 1]).max() < 0.8 * 2 * np.sin(np.pi / 16) + 0.31
    turn = np.degrees(np.arccos((forward[1:] * forward[:-1]).sum(axis=1)))
    assert turn.max() < 9 + 4 + 5  # the sweep, the jitter of yaw and that of pitch
    yaw = np.degrees(np.arctan2(forward[:, 1], forward[:, 0]))
    assert yaw.max() == pytest.approx(SWEEP_DEG, abs=2.1) and yaw.min() == pytest.approx(-SWEEP_DEG, abs=2.1)
    # The camera stays in its own lane.
    assert (centres[:, 1] > -LANE + 0.3).all() and (centres[:, 1] < 0).all()
    # Fewer views shorten the drive and keep the step.
    few = scene_cameras(street, 6, 64, 360)
    assert few["005.png"].centre[0] - few["000.png"].centre[0] == pytest.approx(5 * MAX_STEP, abs=0.11)


def test_cameras_of_the_drive_are_outside_all_objects(street, centres):
    for points in things(street).values():
        inside = (centres > points.min(axis=0) - 0.2) & (centres < points.max(axis=0) + 0.2)
        assert not inside.all(axis=1).any()


def test_noise_has_the_stated_deviation_and_a_share_of_returns_is_dropped(street, centres, monkeypatch):
    scan = lidar.scan_street(street, centres)
    monkeypatch.setattr(lidar, "RANGE_NOISE_M", 0.0)
    exact = lidar.scan_street(street, centres)
    monkeypatch.setattr(lidar, "LOST_SHARE", 0.0)
    full = lidar.scan_street(street, centres)
    assert len(scan.points) / len(full.points) == pytest.approx(0.95, abs=0.01)
    texts = {street.nodes[node].text for node in np.unique(full.node_ids[:, 0])}
    assert "sky" not in texts and {"road", "sidewalk", "building"} <= texts
    assert scan.origins == pytest.approx(centres[[0, 10, 20, 29, 39]] + [0, 0, lidar.ABOVE_CAMERA_M])
    # A scanner h above the road meets it with a beam d degrees down at range h / sin(d).
    low, high = lidar.INCLINATION_DEG
    drop = exact.range_m * np.sin(np.radians(low + (exact.beam + 0.5) / lidar.BEAMS * (high - low)))
    on_road = exact.node_ids[:, 0] == next(node.id for node in street.nodes if node.text == "road")
    # Repaired patches are up to 6 mm above the road.
    assert on_road.sum() > 1000 and np.abs(exact.origins[exact.pose_index, 2] + drop)[on_road].max() < 0.01
    away = np.linalg.norm(scan.points - scan.origins[scan.pose_index], axis=1)
    assert away == pytest.approx(scan.range_m, abs=1e-4)
    assert np.array_equal(scan.node_ids, exact.node_ids)  # noise moves points and changes no label
    error = (scan.range_m - exact.range_m).astype(np.float64)
    assert error.std() == pytest.approx(0.015, rel=0.1) and abs(error.mean()) < 0.001
    assert scan.range_m.max() < lidar.MAX_RANGE_M + 0.1


def test_visible_points_have_the_label_of_their_pixel(street, cameras, centres):
    scan = lidar.scan_street(street, centres)
    assert 50_000 < len(scan.points) < 150_000
    for name in ("004.png", "021.png"):
        camera = cameras[name]
        labels, depth = label_view(street, camera), true_depth(street.caster, camera)
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
