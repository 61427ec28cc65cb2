"""Streets follow from their seed, nothing in them collides, and the drive keeps its distances."""

import itertools
import logging

import numpy as np
import pytest

from hilsplat.world.objects.catalogue import STREET, build_street_object
from hilsplat.world.render import label_view, render_view
from hilsplat.world.scenes.kinds import build_scene
from hilsplat.world.scenes.scene import WorldScene
from hilsplat.world.scenes.street import (
    LANE_Y,
    MAX_STEP,
    SWAY_M,
    SWEEP_DEG,
    drive_cameras,
    part_boxes,
    training_camera,
)
from hilsplat.world.scenes.street_ground import FRONT, KERB, LANE, WALK_Z
from hilsplat.world.views import looking_at

VEHICLES = {"car", "truck", "bus"}


def things(scene: WorldScene) -> list[int]:
    """Ids of all wholes but the surroundings."""
    return sorted(set(np.unique(scene.node_ids[:, 0]).tolist()) - scene.background)


def test_texts_name_the_thing_and_its_waymo_class():
    synonyms = {
        name: build_street_object(name, np.random.default_rng(0)).nodes[0].synonyms for name in STREET
    }
    for name in VEHICLES:
        assert "vehicle" in synonyms[name]
    assert "sign" in synonyms["traffic sign"]
    assert "vegetation" in synonyms["tree"] and "vegetation" in synonyms["bush"]
    assert "tree trunk" in {node.text for node in build_street_object("tree", np.random.default_rng(0)).nodes}


def test_no_part_of_a_thing_reaches_into_another_thing(street):
    boxes = {}
    for node in things(street):
        own = street.node_ids[:, 0] == node
        boxes[node] = part_boxes(street.triangles[own].astype(np.float64), street.node_ids[own, 1])
    for (low_a, high_a), (low_b, high_b) in itertools.combinations(boxes.values(), 2):
        apart = (low_a[:, None] > high_b) | (high_a[:, None] < low_b)
        assert apart.any(axis=2).all()  # apart along some axis, for every pair of parts


def test_things_stand_where_they_belong(street):
    for node in things(street):
        text = street.nodes[node].text
        points = street.triangles[street.node_ids[:, 0] == node].reshape(-1, 3)
        low, high = points.min(axis=0), points.max(axis=0)
        on_road = text in VEHICLES | {"cyclist"}
        assert low[2] == pytest.approx(0.0 if on_road else WALK_Z, abs=1e-5)
        if on_road:
            assert low[1] > -KERB and high[1] < KERB
        elif text == "pedestrian":
            assert np.abs(points[:, 1]).min() > KERB and np.abs(points[:, 1]).max() < FRONT


def test_another_seed_gives_another_street_and_the_log_says_what_was_placed(caplog, street):
    with caplog.at_level(logging.INFO, logger="hilsplat.world.scenes.street"):
        scene = build_scene("street", 103, 3)
    assert len(scene.placed) == 3
    for thing in scene.placed:
        assert scene.nodes[thing.node].text == thing.name
        assert thing.name in VEHICLES | {"pedestrian", "cyclist"}
    assert scene.nodes != street.nodes
    assert "3 of 3 vehicles and people placed" in caplog.text


def test_seven_things_make_a_street_with_the_classes_that_matter(street):
    texts = {street.nodes[node].text for node in things(street)}
    assert {"car", "pedestrian", "cyclist", "building", "tree", "traffic sign", "traffic light"} <= texts
    assert texts & {"truck", "bus"}


def test_every_ray_from_the_road_meets_something_labelled(street):
    labels = label_view(street, drive_cameras(street, 40, 64)["020.png"])
    assert (labels[0] >= 0).all()


def test_the_sky_shines_and_is_not_shaded(street):
    # Straight up from the road there is only sky; its colours lie between blue and white.
    up = looking_at(np.array([0.0, LANE_Y, 1.8]), np.array([0.3, LANE_Y, 12.0]))
    camera = drive_cameras(street, 3, 16)["001.png"]
    camera = type(camera)("up.png", up, camera.K, camera.size_hw)
    sky = next(node for node in street.background if street.nodes[node].text == "sky")
    assert (label_view(street, camera)[0] == sky).all()
    image = render_view(street, camera, 1).astype(int)
    assert (image[..., 2] >= image[..., 0]).all() and image[..., 2].min() > 200


def test_neighbouring_views_are_near_and_see_the_same_things(street):
    cameras = drive_cameras(street, 40, 64)
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
    # The driver stays in the own lane.
    assert (centres[:, 1] > -LANE + 0.3).all() and (centres[:, 1] < 0).all()


def test_few_views_make_a_shorter_drive_not_a_coarser_one(street):
    cameras = drive_cameras(street, 6, 64)
    x = [cameras[name].centre[0] for name in cameras.names]
    assert x[-1] - x[0] == pytest.approx(5 * MAX_STEP, abs=0.11)


def test_the_drive_runs_into_nothing(street):
    cameras = drive_cameras(street, 40, 64)
    for node in things(street):
        points = street.triangles[street.node_ids[:, 0] == node].reshape(-1, 3)
        for name in cameras.names:
            inside = (points.min(axis=0) - 0.2 < cameras[name].centre) & (
                cameras[name].centre < points.max(axis=0) + 0.2
            )
            assert not inside.all()


def test_training_cameras_are_outdoors_and_half_look_at_one_thing(street):
    rng = np.random.default_rng(0)
    large = 0
    for _ in range(16):
        labels = label_view(street, training_camera(street, rng, 32))
        middle = labels[0, 10:22, 10:22]
        large += np.isin(middle, list(set(things(street)))).mean() > 0.3
        assert len(np.unique(labels[1])) > 3  # not inside a wall
    assert large >= 6
