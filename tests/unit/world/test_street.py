"""Nothing in a street collides, and the cameras of the drive are close enough for structure from motion."""

import itertools

import numpy as np
import pytest

from hilsplat.world.render import label_view, render_view
from hilsplat.world.scenes.kinds import scene_cameras, training_camera
from hilsplat.world.scenes.scene import WorldScene
from hilsplat.world.scenes.street import (
    FRONT,
    KERB,
    LANE,
    LANE_Y,
    MAX_STEP,
    SWAY_M,
    SWEEP_DEG,
    WALK_Z,
    part_boxes,
)
from hilsplat.world.views import square_camera

VEHICLES = {"car", "truck", "bus"}


def things(scene: WorldScene) -> dict[int, np.ndarray]:
    """Corners of all wholes but the surroundings, by id."""
    ids = sorted(set(np.unique(scene.node_ids[:, 0]).tolist()) - scene.background)
    return {node: scene.triangles[scene.node_ids[:, 0] == node].reshape(-1, 3) for node in ids}


def test_boxes_of_parts_of_different_objects_do_not_intersect(street):
    boxes = {}
    for node in things(street):
        own = street.node_ids[:, 0] == node
        boxes[node] = part_boxes(street.triangles[own].astype(np.float64), street.node_ids[own, 1])
    for (low_a, high_a), (low_b, high_b) in itertools.combinations(boxes.values(), 2):
        apart = (low_a[:, None] > high_b) | (high_a[:, None] < low_b)
        assert apart.any(axis=2).all()  # apart along some axis, for every pair of parts


def test_vehicles_are_on_the_road_and_pedestrians_on_the_sidewalk(street):
    for node, points in things(street).items():
        text = street.nodes[node].text
        low, high = points.min(axis=0), points.max(axis=0)
        on_road = text in VEHICLES | {"cyclist"}
        assert low[2] == pytest.approx(0.0 if on_road else WALK_Z, abs=1e-5)
        if on_road:
            assert low[1] > -KERB and high[1] < KERB
        elif text == "pedestrian":
            assert np.abs(points[:, 1]).min() > KERB and np.abs(points[:, 1]).max() < FRONT


def test_a_street_with_seven_objects_has_the_main_classes(street):
    texts = {street.nodes[node].text for node in things(street)}
    assert {"car", "pedestrian", "cyclist", "building", "tree", "traffic sign", "traffic light"} <= texts
    assert texts & {"truck", "bus"}


def test_every_pixel_has_a_label_and_the_sky_is_self_luminous(street):
    assert (label_view(street, scene_cameras(street, 40, 64, 360)["020.png"])[0] >= 0).all()
    # Straight up from the road there is only sky; its colours lie between blue and white.
    up = np.array([0.0, LANE_Y, 1.8]), np.array([0.3, LANE_Y, 12.0])
    camera = square_camera("up.png", up, 16, 62.0)
    sky = next(node for node in street.background if street.nodes[node].text == "sky")
    assert (label_view(street, camera)[0] == sky).all()
    image = render_view(street, camera, 1).astype(int)
    assert (image[..., 2] >= image[..., 0]).all() and image[..., 2].min() > 200


def test_neighbouring_views_differ_little_in_position_and_direction(street):
    cameras = scene_cameras(street, 40, 64, 360)
    centres = np.stack([cameras[name].centre for name in cameras.names])
    forward = cameras.cam_from_world[:, 2, :3]
    step = np.diff(centres, axis=0)
    # One step along the lane, the sway of a sixteenth of a turn, and the jitter of both.
    assert (step[:, 0] > 0.3).all() and (step[:, 0] < MAX_STEP + 0.11).all()
    assert np.abs(step[:, 1]).max() < SWAY_M * 2 * np.sin(np.pi / 16) + 0.31
    turn = np.degrees(np.arccos((forward[1:] * forward[:-1]).sum(axis=1)))
    assert turn.max() < 9 + 4 + 5  # the sweep, the jitter of yaw and that of pitch
    yaw = np.degrees(np.arctan2(forward[:, 1], forward[:, 0]))
    assert yaw.max() == pytest.approx(SWEEP_DEG, abs=2.1) and yaw.min() == pytest.approx(-SWEEP_DEG, abs=2.1)
    # The camera stays in its own lane.
    assert (centres[:, 1] > -LANE + 0.3).all() and (centres[:, 1] < 0).all()
    # Fewer views shorten the drive and keep the step.
    few = scene_cameras(street, 6, 64, 360)
    assert few["005.png"].centre[0] - few["000.png"].centre[0] == pytest.approx(5 * MAX_STEP, abs=0.11)


def test_cameras_of_the_drive_are_outside_all_objects(street):
    cameras = scene_cameras(street, 40, 64, 360)
    centres = np.stack([cameras[name].centre for name in cameras.names])
    for points in things(street).values():
        inside = (centres > points.min(axis=0) - 0.2) & (centres < points.max(axis=0) + 0.2)
        assert not inside.all(axis=1).any()


def test_training_cameras_are_outside_objects_and_half_are_close_ups(street):
    rng = np.random.default_rng(0)
    large, wholes = 0, list(things(street))
    for _ in range(16):
        labels = label_view(street, training_camera(street, rng, 32))
        middle = labels[0, 10:22, 10:22]
        large += np.isin(middle, wholes).mean() > 0.3
        assert len(np.unique(labels[1])) > 3  # not inside a wall
    assert large >= 6
