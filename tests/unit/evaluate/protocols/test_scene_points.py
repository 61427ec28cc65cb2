"""Classes and instances of labelled points in the block world, whose tree and field are exact."""

import numpy as np
import pytest

from hilsplat.base.errors import ArtifactError, SceneError
from hilsplat.datasets.classes.class_set import ClassSet
from hilsplat.datasets.points.labelled_points import LABELLINGS, LabelledPoints
from hilsplat.datasets.registry import DATASETS
from hilsplat.evaluate.asked import STAND_INS, Asked
from hilsplat.evaluate.diagnostics.alignment import camera_error, scene_from_true
from hilsplat.evaluate.metrics.instances import average_precision
from hilsplat.evaluate.protocols.cards import card_named
from hilsplat.evaluate.protocols.carry import carried_to
from hilsplat.evaluate.protocols.points import measure_scene_points, node_instances, point_classes
from hilsplat.evaluate.scores import Measured, read_instances, write_instances
from hilsplat.scene.cameras import Cameras

CLASSES = ClassSet("blocks", "drawn", (7, 9), ("chest", "bear"))


def points_of(block_world, count=1):
    """The Gaussians themselves as labelled points, `count` of each: class 9 is bear, 7 is chest."""
    node = np.repeat(block_world.answers.tree.node_of_gaussian[:, 0], count)
    xyz = np.repeat(block_world.answers.gaussians.means.astype(np.float64), count, axis=0)
    ids = np.array([9, 7, 0])[np.where(node < 0, 2, np.minimum(node, 1))].astype(np.int32)
    return LabelledPoints(xyz, ids, (node + 1).astype(np.int32), "drawn"), ids


@pytest.mark.parametrize("method", ["tree", "field"])
@pytest.mark.parametrize("mode", ["nearest", "vote", "density", "frozen"])
def test_points_get_the_class_of_the_node_or_latent_of_their_gaussians(block_world, method, mode):
    points, ids = points_of(block_world)
    carried = carried_to(points.xyz, block_world.answers.gaussians, mode, radius=0.001)
    found = point_classes(block_world.answers, carried, method, CLASSES.texts)
    labelled = ids > 0
    assert np.array_equal(found[labelled], CLASSES.labels(ids)[labelled])
    if mode in ("nearest", "frozen"):
        assert (found[~labelled] == 0).all()  # no node, no latent: no prediction


def test_a_node_is_an_instance_of_its_best_class_also_after_a_file(block_world, tmp_path):
    points, _ = points_of(block_world, count=2)  # both objects then have 100 points and more
    carried = carried_to(points.xyz, block_world.answers.gaussians, "nearest", radius=0.1)
    matches = node_instances(block_world.answers, carried, points, CLASSES)
    assert matches.has_truth.all()
    assert np.nanmean(average_precision([matches])) == 1.0
    assert matches.misses.sum() == 0
    key = ("synthetic-rooms", "room-1", "default", "sam-tiny", "tree")
    write_instances(tmp_path / "scores.csv", {key: matches})
    found = read_instances([tmp_path / "scores.csv"])[key]
    assert np.array_equal(average_precision([found]), average_precision([matches]), equal_nan=True)
    write_instances(tmp_path / "scores.csv", {})
    assert read_instances([tmp_path / "scores.csv"]) == {}


def test_rows_name_the_mode_and_are_moved_into_the_frame_of_the_scene(block_world, monkeypatch):
    monkeypatch.setitem(LABELLINGS, "drawn", (CLASSES,))
    card = type(card_named("replica/per-scene"))(
        "drawn/points", 1, ("miou_present",), "scenes", "argmax", "drawn", classes="blocks"
    )
    points, _ = points_of(block_world)
    moved = LabelledPoints(points.xyz / 2 - 1, points.class_id, points.instance_id, "drawn")
    transform = np.diag([2.0, 2, 2, 1])
    transform[:3, 3] = 2
    asked = ({"drawn": moved}, transform, [card], ("tree", "field"), "nearest")
    rows = list(measure_scene_points(block_world.answers, *asked))
    assert all(isinstance(row, Measured) for row in rows)
    assert {row.protocol for row in rows} == {"drawn/points@1 (points: nearest)"}
    assert {row.method: row.value for row in rows if row.metric == "miou_present"} == {"tree": 1, "field": 1}


def turned(angle, axis_centres):
    """Cameras at places, all turned about the vertical by an angle."""
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    poses = np.tile(np.eye(4), (len(axis_centres), 1, 1))
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = -(rotation @ np.asarray(axis_centres, dtype=float).T).T
    names = tuple(f"{row}.png" for row in range(len(axis_centres)))
    K = np.tile(np.eye(3), (len(names), 1, 1))
    return Cameras(names, poses, K, np.full((len(names), 2), 8, np.int32))


def test_cameras_on_a_line_still_fix_the_similarity():
    true = turned(0.3, [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    # the scene is the truth turned by 90 degrees, three times as large and moved
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    poses = true.cam_from_world.copy()
    for row, name in enumerate(true.names):
        centre = 3 * turn @ true[name].centre + [5, 0, 1]
        poses[row, :3, :3] = true[name].cam_from_world[:3, :3] @ turn.T
        poses[row, :3, 3] = -poses[row, :3, :3] @ centre
    found = Cameras(true.names, poses, true.K, true.size_hw)
    expected = np.eye(4)
    expected[:3, :3], expected[:3, 3] = 3 * turn, [5, 0, 1]
    assert np.allclose(scene_from_true(true, found), expected)
    assert camera_error(true, found, expected) == pytest.approx(0, abs=1e-9)
    off = expected.copy()
    off[0, 3] += 6  # six units of the scene are two of the truth
    assert camera_error(true, found, off) == pytest.approx(2)


def test_stand_ins_and_data_sets_name_protocols_that_exist():
    for kind in STAND_INS:
        asked = Asked.of_world(kind)
        assert len(asked.flat) + len(asked.points) == len(STAND_INS[kind])
    assert not Asked.of_world("").flat and not Asked.of_world("").points
    for dataset in DATASETS.values():
        asked = Asked.of(dataset.protocols)
        assert len(asked.flat) + len(asked.points) == len(dataset.protocols)
        assert bool(asked.points) == (dataset.labels == "points" and bool(dataset.protocols))
    with pytest.raises(SceneError, match="one of tabletop, room, street"):
        Asked.of_world("table")
    with pytest.raises(ArtifactError, match="there is no protocol 'lerf/langsplatt'"):
        card_named("lerf/langsplatt")
