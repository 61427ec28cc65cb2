"""Objects of a room do not intersect, are supported, and leave the camera path free."""

import itertools

import numpy as np
import pytest

from hilsplat.world.objects.catalogue import CLASSES
from hilsplat.world.scenes.kinds import build_scene, scene_cameras
from hilsplat.world.scenes.room import room_of
from hilsplat.world.scenes.street import part_boxes

CLASSES_SEEN = {
    # 16 of ScanNet's 19 classes; bathrooms have the other three
    *("wall", "floor", "cabinet", "bed", "chair", "sofa", "table", "door", "window", "bookshelf"),
    *("picture", "counter", "desk", "curtain", "refrigerator", "sink"),
    *("television", "monitor", "nightstand", "tv stand", "lamp", "rug", "stool"),
}


@pytest.fixture(scope="module")
def rooms():
    return [build_scene("room", seed, (9, 12, 15)[seed % 3]) for seed in range(100, 108)]


def box_of(scene, thing):
    """Lowest and highest corner of an object."""
    points = scene.triangles[scene.node_ids[:, 0] == thing.node].reshape(-1, 3)
    return points.min(axis=0), points.max(axis=0)


def half_of(scene):
    """Half the width and depth of a room, m."""
    room = room_of(scene)
    return np.array([room.width, room.depth]) / 2


def test_eight_rooms_contain_the_classes_of_scannet(rooms):
    assert {node.text for scene in rooms for node in scene.nodes if node.level == 1} >= CLASSES_SEEN


def test_a_room_contains_the_requested_objects_and_its_fixtures(rooms):
    for scene in rooms:
        assert len(scene.placed) == scene.asked or scene.asked == 20  # 15 objects do not always fit
        assert len(scene.placed) >= scene.asked - 3
        yaw_deg = {thing.name: thing.yaw_deg for thing in scene.placed}
        names = set(yaw_deg)
        assert {"door", "window", "curtain", "picture"} <= names
        assert yaw_deg["curtain"] == yaw_deg["window"]
        assert len(names & set(CLASSES["room"])) >= 8


def test_objects_do_not_intersect(rooms):
    for scene in rooms:
        boxes = []
        for thing in scene.placed:
            own = scene.node_ids[:, 0] == thing.node
            _, part, subpart = scene.node_ids[own].T
            boxes.append((thing, *part_boxes(scene.triangles[own], np.where(subpart >= 0, subpart, part))))
        for (a, low_a, high_a), (b, low_b, high_b) in itertools.combinations(boxes, 2):
            # Boxes around parts and subparts, or circles around turned things: either proves that they do not
            # meet. The depth of an overlap is that on the best axis, m.
            depth = (np.minimum(high_a[:, None], high_b) - np.maximum(low_a[:, None], low_b)).min(axis=2)
            apart = np.linalg.norm(np.subtract(a.centre_xy, b.centre_xy)) - a.footprint - b.footprint
            assert depth.max() < 0.012 or apart > 0, (scene.seed, a.name, b.name)


def test_every_object_has_support_or_hangs_on_a_wall(rooms):
    for scene in rooms:
        half = half_of(scene)
        for thing in scene.placed:
            low, high = box_of(scene, thing)
            assert low[2] == pytest.approx(thing.base_z, abs=1e-5)
            if thing.name in ("window", "curtain", "picture", "mirror", "door"):
                assert min(np.abs(half - high[:2]).min(), np.abs(half + low[:2]).min()) < 1e-5
            elif thing.base_z > 0:
                below = scene.triangles[scene.node_ids[:, 0] != thing.node]
                middle = np.array(thing.centre_xy)
                near = (below[..., :2].min(axis=1) < middle + 0.5 * thing.footprint).all(axis=1)
                near &= (below[..., :2].max(axis=1) > middle - 0.5 * thing.footprint).all(axis=1)
                tops = below[near][..., 2].max(axis=1)
                gap = thing.base_z - tops[tops < thing.base_z + 0.001].max()
                assert gap < 0.01, (scene.seed, thing.name)


def test_all_triangles_are_inside_the_room(rooms):
    for scene in rooms:
        half, points = half_of(scene), scene.triangles.reshape(-1, 3)
        assert (half > (2.15, 1.85)).all() and (half < (2.55, 2.2)).all()
        assert (np.abs(points[:, :2]) <= half + 1e-5).all() and points[:, 2].min() >= -1e-6


def test_cameras_are_clear_of_objects_and_overlap_enough_for_structure_from_motion(rooms):
    for scene in rooms:
        cameras = scene_cameras(scene, 40, 96, 360)
        ordered = [cameras[name] for name in cameras.names]
        centres = np.stack([camera.centre for camera in ordered])
        assert (np.abs(centres[:, :2]) < half_of(scene) - 0.5).all()
        for thing in scene.placed:
            low, high = box_of(scene, thing)
            away = np.linalg.norm(np.maximum(0, np.maximum(low - centres, centres - high)), axis=1)
            assert away.min() > 0.1, (scene.seed, thing.name)
        for a, b in itertools.pairwise([*ordered, ordered[0]]):
            turn = a.cam_from_world[:3, :3] @ b.cam_from_world[:3, :3].T
            assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 20
            assert 0.1 < np.linalg.norm(a.centre - b.centre) < 0.7
