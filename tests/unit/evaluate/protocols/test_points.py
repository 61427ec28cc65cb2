"""Rows of labelled points: classes and instances, pooled and per scene, and of the block world."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilsplat.base.errors import MisalignedArtifactError, SceneError
from hilsplat.datasets import classes as sets
from hilsplat.datasets.generators import GENERATORS
from hilsplat.datasets.points.labelled_points import LabelledPoints, PointScene
from hilsplat.datasets.registry import DATASETS
from hilsplat.evaluate.extra_protocols import ExtraProtocols
from hilsplat.evaluate.metrics.instances import average_precision, match_instances
from hilsplat.evaluate.protocols import points as scoring
from hilsplat.evaluate.protocols.cards import card_of
from hilsplat.evaluate.scores import Measured, read_instances, read_scores, write_instances, write_scores
from hilsplat.evaluate.stage import point_rows, scene_from_true
from hilsplat.settings import EvaluateSettings
from tests.unit.evaluate.builders import cameras_of, score
from tests.unit.evaluate.metrics.test_points import PREDICTION, TRUTH
from tests.unit.round_gaussians import round_gaussians

OPENGAUSSIAN = card_of("scannet/opengaussian-19")
WAYMO = card_of("waymo/segmentation")


def test_rows_of_the_worked_example():
    rows = list(scoring.measure_points(OPENGAUSSIAN, "tree", TRUTH, PREDICTION, sets.SCANNET_19, "frozen"))
    assert {row.protocol for row in rows} == {"scannet/opengaussian-19@1 (points: frozen)"}
    ious = {row.query: row.value for row in rows if row.metric == "class_iou"}
    # the first four of the 19 classes; the bed is only predicted. The wall has 2 hits, 4 true and 3 predicted
    # points, without the prediction on ignored truth: 2 / (4 + 3 - 2)
    assert ious == pytest.approx({"wall": 2 / 5, "floor": 2 / 3, "cabinet": 1 / 2, "bed": 0})
    assert [row.n for row in rows if row.metric == "class_iou"] == [5, 3, 2, 1]
    accuracies = {row.query: (row.value, row.n) for row in rows if row.metric == "class_accuracy"}
    assert accuracies == {"wall": (0.5, 4), "floor": (1, 2), "cabinet": (0.5, 2)}
    means = {row.metric: row.value for row in rows if not row.query}
    assert means == pytest.approx({"miou_present": 0.522222, "macc_present": 0.666667}, abs=1e-6)


def test_missed_points_count_zero_and_a_scene_without_truth_has_no_rows():
    nothing = np.zeros(10, dtype=int)
    rows = list(scoring.measure_points(OPENGAUSSIAN, "tree", TRUTH, nothing, sets.SCANNET_19, "frozen"))
    assert {row.value for row in rows} == {0.0}
    assert {row.query for row in rows} == {"", "wall", "floor", "cabinet"}
    no_truth = nothing, PREDICTION, sets.SCANNET_19, "frozen"
    assert list(scoring.measure_points(OPENGAUSSIAN, "tree", *no_truth)) == []


def test_pooled_rows_equal_points_put_together_also_after_a_file(tmp_path):
    rng = np.random.default_rng(0)
    scenes = [(rng.integers(0, 6, 997), rng.integers(0, 6, 997)) for _ in range(3)]
    rows = [
        row
        for scene in scenes
        for row in scoring.measure_points(WAYMO, "tree", *scene, sets.WAYMO_22, "nearest")
    ]
    assert all(row.query for row in rows)  # no number per scene
    together = np.concatenate(scenes, axis=1)
    expected = scoring.pooled_points(
        WAYMO, scoring.measure_points(WAYMO, "t", *together, sets.WAYMO_22, "x"), sets.WAYMO_22
    )
    write_scores(tmp_path / "scores.csv", [score(**vars(row), view="") for row in rows])
    again = read_scores([tmp_path / "scores.csv"]).itertuples()
    assert scoring.pooled_points(WAYMO, again, sets.WAYMO_22) == expected
    # five of 22 classes occur; the other 17 count 1 under Waymo's own mean
    assert expected["miou_absent_as_one"] == pytest.approx((5 * expected["miou_present"] + 17) / 22)


def test_scannet200_is_split_into_head_common_and_tail():
    card = card_of("scannet200/benchmark")
    places = [members.index(True) + 1 for members in sets.splits_of(sets.SCANNET200).values()]
    truth = np.repeat(places, 2)
    prediction = truth * np.array([1, 1, 1, 0, 0, 0])  # head right, common half, tail missed
    rows = list(scoring.measure_points(card, "tree", truth, prediction, sets.SCANNET200, "nearest"))
    expected = {"miou_occurring": 0.5, "miou_head": 1.0, "miou_common": 0.5, "miou_tail": 0.0}
    assert scoring.pooled_points(card, rows, sets.SCANNET200) == expected


def test_class_sets_turn_file_labels_into_rows():
    classes = sets.ClassSet("c", (7, 3, 1191), ("a", "b", "c"))
    found = classes.labels(np.array([3, 7, 1191, 5, 0, -2, 2000]))
    assert found.tolist() == [2, 1, 3, 0, 0, 0, 0]


def test_instance_rows_are_of_all_scans_together():
    truth = np.repeat([4001, 0], 4)
    mask = np.repeat([[True, False]], 4, axis=1)
    found = (truth, mask, np.array([4]), np.ones(1))
    missed = (truth, mask[:0], np.zeros(0, int), np.zeros(0))
    ids = sets.SCANNET200_INSTANCES.ids
    scans = {"a": match_instances(*found, ids, 1), "b": match_instances(*missed, ids, 1)}
    rows = list(scoring.measure_instances("tree", scans, "nearest"))
    assert {row.n for row in rows} == {2}
    values = {row.metric: row.value for row in rows}
    none = pytest.approx(np.nan, nan_ok=True)  # 4 is a class of the head
    half = dict.fromkeys(("ap", "ap50", "ap25", "ap_head"), pytest.approx(0.5))
    assert values == {**half, "ap_common": none, "ap_tail": none}
    assert rows[0].protocol == "scannet200/instances@1 (points: nearest)"
    nothing = {"a": match_instances(*found, ids[5:], 1)}
    assert list(scoring.measure_instances("tree", nothing, "nearest")) == []


CLASSES = sets.ClassSet("blocks", (7, 9), ("chest", "bear"))


def points_of(block_world, count=1):
    """The Gaussians themselves as labelled points, `count` of each: class 9 is bear, 7 is chest."""
    node = np.repeat(block_world.answers.tree.node_of_gaussian[:, 0], count)
    xyz = np.repeat(block_world.answers.gaussians.means.astype(np.float64), count, axis=0)
    ids = np.array([9, 7, 0])[np.where(node < 0, 2, np.minimum(node, 1))].astype(np.int32)
    return LabelledPoints(xyz, ids, (node + 1).astype(np.int32)), ids


@pytest.mark.parametrize("method", ["tree", "field"])
@pytest.mark.parametrize("mode", ["nearest", "frozen"])
def test_points_get_the_class_of_the_node_or_latent_of_their_gaussians(block_world, method, mode):
    points, ids = points_of(block_world)
    gaussian, _ = scoring.gaussians_of_points(points.xyz, block_world.answers.gaussians, mode)
    found = scoring.classes_of_points(block_world.answers, gaussian, method, CLASSES.texts)
    labelled = ids > 0
    assert np.array_equal(found[labelled], CLASSES.labels(ids)[labelled])
    assert (found[~labelled] == 0).all()  # no node, no latent: no prediction


def test_a_node_is_an_instance_of_its_best_class_also_after_a_file(block_world, tmp_path):
    points, _ = points_of(block_world, count=2)  # both objects then have 100 points and more
    gaussian, _ = scoring.gaussians_of_points(points.xyz, block_world.answers.gaussians, "nearest")
    matches = scoring.node_instances(block_world.answers, gaussian, points, CLASSES)
    assert matches.has_truth.all()
    assert np.nanmean(average_precision([matches])) == 1.0
    assert matches.misses.sum() == 0
    key = ("synthetic-rooms", "room-1", "ours w/ SAM, 100%", "sam-tiny", "tree")
    write_instances(tmp_path / "scores.csv", {key: matches})
    found = read_instances([tmp_path / "scores.csv"])[key]
    assert np.array_equal(average_precision([found]), average_precision([matches]), equal_nan=True)
    write_instances(tmp_path / "scores.csv", {})
    assert read_instances([tmp_path / "scores.csv"]) == {}


def test_rows_name_the_mode_and_are_moved_into_the_frame_of_the_scene(block_world, monkeypatch):
    monkeypatch.setitem(sets.LABELLINGS, "drawn", (CLASSES,))
    card = type(card_of("replica/per-scene"))(
        "drawn/points@1", ("miou_present",), "scenes", "argmax", "drawn", classes="blocks"
    )
    points, _ = points_of(block_world)
    moved = LabelledPoints(points.xyz / 2 - 1, points.class_id, points.instance_id)
    transform = np.diag([2.0, 2, 2, 1])
    transform[:3, 3] = 2
    asked = ({"drawn": moved}, transform, [card], ("tree", "field"), "nearest")
    rows = list(scoring.measure_scene_points(block_world.answers, *asked))
    assert all(isinstance(row, Measured) for row in rows)
    assert {row.protocol for row in rows} == {"drawn/points@1 (points: nearest)"}
    assert {row.method: row.value for row in rows if row.metric == "miou_present"} == {"tree": 1, "field": 1}
    scored = PointScene("s", (), {"drawn": points}), ExtraProtocols(points=(card,))
    of_template = point_rows(block_world.answers, *scored, EvaluateSettings(template="a {}"), 1)
    assert {row.protocol for row in of_template} == {"drawn/points@1 (points: nearest, texts as a ...)"}


def cameras_at(centres, rotation):
    """Cameras with given centres, with one rotation or one each."""
    poses = np.tile(np.eye(4), (len(centres), 1, 1))
    poses[:, :3, :3] = rotation
    poses[:, :3, 3:] = -rotation @ np.asarray(centres, dtype=float)[:, :, None]
    return cameras_of(poses, np.eye(3), (8, 8))


@pytest.mark.parametrize(("moved", "error"), [((0, 0, 0), 0), ((1, -2, 1), 1)])
def test_cameras_on_a_line_still_fix_the_similarity(moved, error):
    c, s = np.cos(0.3), np.sin(0.3)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    # The scene is the truth turned by 90 degrees, three times as large and shifted. Its cameras are off the
    # line, which changes neither scale nor offset: the median of 1, 2 and 1 in the units of the truth.
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    found = cameras_at(3 * (line + np.outer(moved, [0, 0, 1])) @ turn.T + [5, 0, 1], rotation @ turn.T)
    expected = np.eye(4)
    expected[:3, :3], expected[:3, 3] = 3 * turn, [5, 0, 1]
    transform, median = scene_from_true(cameras_at(line, rotation), found)
    assert np.allclose(transform, expected)
    assert median == pytest.approx(error, abs=1e-9)


def test_cameras_that_do_not_fix_the_similarity_are_refused():
    turned = Rotation.from_rotvec([[0, 0, 0], [0.1, 0.2, 0.3], [0.3, 0.1, 0.2]]).as_matrix()
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    for centres in (-line, np.zeros((3, 3)), np.tile([0.1, 0.2, 0.3], (3, 1)), np.tile([5, 0, 1], (3, 1))):
        for pair in (centres, line), (line, centres):
            with pytest.raises(MisalignedArtifactError, match="coincident or mirrored centres"):
                scene_from_true(*(cameras_at(positions, turned) for positions in pair))
    with pytest.raises(MisalignedArtifactError, match="at least 3 shared view names"):
        scene_from_true(cameras_at(line, turned), cameras_at(line[:2], turned[:2]))


def test_stand_ins_and_data_sets_name_protocols_that_exist():
    for name, kind in GENERATORS["world"].kinds.items():
        _, asked = ExtraProtocols.generated(f"world:{name}:1", Path())
        assert len(asked.flat) + len(asked.points) == len(kind.protocols)
    for dataset in DATASETS.values():
        asked = ExtraProtocols.of(dataset.protocols)
        assert len(asked.flat) + len(asked.points) == len(dataset.protocols)
        assert bool(asked.points) == (dataset.labels == "points" and bool(dataset.protocols))
    with pytest.raises(SceneError, match="one of world:tabletop:<seed>, world:room:<seed>"):
        ExtraProtocols.generated("world:table:1", Path())


MEANS = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
OPAQUE = np.array([0.9, 0.5, 0.9])


def gaussians_of(opacities=OPAQUE, means=MEANS):
    """Gaussians with exact opacities, not rounded through their logits."""
    gaussians = round_gaussians(means)

    class Exact(type(gaussians)):
        pass

    Exact.opacities = np.array(opacities, float)
    return Exact(**vars(gaussians))


def carried(xs, mode, opacities=OPAQUE):
    """Assign Gaussians at 0, 1 and 2 on the x axis to the points (x, 0, 0)."""
    points = np.array([[x, 0.0, 0.0] for x in xs])
    return scoring.gaussians_of_points(points, gaussians_of(opacities), mode)


def test_frozen_gaussians_are_the_points_and_transparent_ones_are_not_scored():
    index, is_scored = carried([0, 1, 2], "frozen", [0.09, 0.1, 0.8])
    assert (index.tolist(), is_scored.tolist()) == ([0, 1, 2], [False, True, True])
    with pytest.raises(MisalignedArtifactError, match=r"expected  4 Gaussians, one per point"):
        carried([0, 1, 2, 3], "frozen")


def test_nearest_skips_transparent_gaussians():
    assert carried([0.9, 100], "nearest")[0].tolist() == [1, 2]
    index, is_scored = carried([0.9, 1.1], "nearest", [0.9, 0.05, 0.9])
    assert index.tolist() == [0, 2] and is_scored.all()
    with pytest.raises(MisalignedArtifactError, match=r"3 Gaussians, all below"):
        carried([0.0], "nearest", [0.01] * 3)


def test_threads_change_nothing_even_if_several_gaussians_are_equally_near():
    means, points = np.random.default_rng(0).integers(-2, 3, (2, 500, 3)).astype(float)
    gaussians = gaussians_of(np.linspace(0.2, 0.9, 500), means)
    one, two = (scoring.gaussians_of_points(points, gaussians, "nearest", threads)[0] for threads in (1, 2))
    np.testing.assert_array_equal(two, one)


def test_classes_follow_the_cosine_whatever_the_length_and_the_first_wins_ties():
    texts = np.array([[1.0, 0], [0, 1]])
    features = np.array([[0.1, 0.2], [30.0, 20.0], [0.0, 0.0], [0.5, 0.5], [-0.3, -0.1]])
    assert scoring.classify(features, texts).tolist() == [2, 1, 0, 1, 2]
    assert scoring.classify(np.zeros((0, 2)), texts).shape == (0,)
