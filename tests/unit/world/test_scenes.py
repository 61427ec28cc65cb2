"""A seed determines its scene, objects do not intersect, and splits of seeds are disjoint."""

import itertools
from functools import cache

import numpy as np
import pytest

from hilsplat.world.scenes import tabletop
from hilsplat.world.scenes.kinds import build_scene, scene_cameras
from hilsplat.world.scenes.tabletop import TABLE_RADIUS
from hilsplat.world.seeds import SPLITS, split_of_seed


def test_splits_of_seeds_are_disjoint():
    for first, second in itertools.combinations(SPLITS.values(), 2):
        assert first.stop <= second.start or second.stop <= first.start
    assert [split_of_seed(seed) for seed in (99, 100, 199, 200, 299, 300, 1_000_000, 1_999_999)] == [
        "free", "development", "development", "benchmark", "benchmark", "free", "training", "training",
    ]  # fmt: skip


KINDS = ("tabletop", "room", "street")


@cache
def built(kind, seed=100):
    return build_scene(kind, seed, 4)


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_gives_the_same_scene_and_another_seed_another(kind):
    first, again, other = built(kind), build_scene(kind, 100, 4), built(kind, 102)
    for name in ("triangles", "normals", "coords", "node_ids", "material_ids", "materials"):
        assert np.array_equal(getattr(first, name), getattr(again, name))
    assert first.nodes == again.nodes and first.placed == again.placed and first.style == again.style
    assert first.nodes != other.nodes
    poses, same = (scene_cameras(scene, 8, 64, 360).cam_from_world for scene in (first, again))
    assert np.array_equal(poses, same)


def test_placed_objects_do_not_intersect_and_stand_on_the_table():
    for seed in range(100, 103):
        scene = build_scene("tabletop", seed, 7)
        for thing in scene.placed:
            points = scene.triangles[scene.node_ids[:, 0] == thing.node].reshape(-1, 3)
            away = np.linalg.norm(points[:, :2] - np.array(thing.centre_xy), axis=1)
            assert away.max() == pytest.approx(thing.footprint, abs=1e-4)
            assert points[:, 2].min() == pytest.approx(0, abs=1e-6)
            assert np.linalg.norm(thing.centre_xy) < TABLE_RADIUS
        for a, b in itertools.combinations(scene.placed, 2):
            # Disjoint circles from above: whatever their shapes, the objects cannot meet.
            assert np.linalg.norm(np.subtract(a.centre_xy, b.centre_xy)) > a.footprint + b.footprint


@pytest.mark.parametrize("kind", KINDS)
def test_node_ids_of_triangles_follow_the_tree(kind):
    scene = built(kind)
    parents = np.array([node.parent for node in scene.nodes])
    whole, part, subpart = scene.node_ids.T
    assert (parents[whole] == -1).all()
    assert (parents[part[part >= 0]] == whole[part >= 0]).all()
    assert (parents[subpart[subpart >= 0]] == part[subpart >= 0]).all()
    assert [node.id for node in scene.nodes] == list(range(len(scene.nodes)))


@pytest.mark.parametrize(
    ("kind", "always", "sometimes"),
    [
        ("tabletop", {"table", "floor", "wall"}, {"tablecloth", "rug", "picture"}),
        ("room", {"wall", "floor", "ceiling"}, set()),
        ("street", {"road", "lane marker", "curb", "sidewalk", "ground", "sky"}, set()),
    ],
)
def test_surroundings_are_wholes_in_the_background(kind, always, sometimes):
    for seed in (100, 102):
        scene = built(kind, seed)
        texts = [scene.nodes[node].text for node in scene.background]
        assert always <= set(texts) <= always | sometimes and len(texts) == len(set(texts))
        assert {scene.nodes[node].level for node in scene.background} == {1}


def test_objects_that_do_not_fit_are_omitted_and_logged(monkeypatch, caplog):
    monkeypatch.setattr(tabletop, "GAP", 5.0)  # wider than the table: a second object has no place
    scene = build_scene("tabletop", 104, 3)
    assert (scene.asked, len(scene.placed)) == (3, 1)
    assert len([record for record in caplog.records if "no space left" in record.message]) == 2
