"""Rays cast in packets have the hits of rays cast one by one."""

import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from hilsplat.world.rays import RayCaster
from hilsplat.world.scenes.kinds import build_scene


@pytest.fixture(scope="module")
def triangles():
    return build_scene("tabletop", 100, 3).triangles


def rays_at(triangles, count):
    rng = np.random.default_rng(count)
    origins = rng.uniform(-4, 4, (count, 3)).astype(np.float32)
    targets = triangles[rng.integers(len(triangles), size=count)].mean(axis=1)
    return origins, targets + rng.normal(0, 0.3, (count, 3)).astype(np.float32) - origins


@pytest.mark.parametrize("count", (0, 1, 15, 16, 4001))
def test_packets_have_the_hits_of_single_rays(triangles, count):
    origins, directions = rays_at(triangles, count)
    plain = EmbreeScene(robust=True)
    TriangleMesh(plain, triangles)
    single = plain.run(origins, directions, query="INTERSECT", output=True)
    hits = RayCaster(triangles).nearest(origins, directions)
    met = hits.triangle >= 0
    np.testing.assert_array_equal(met, single["primID"] >= 0)
    np.testing.assert_allclose(hits.distance[met], single["tfar"][met], rtol=1e-6)
    assert np.isinf(hits.distance[~met]).all()
    same = hits.triangle == single["primID"]
    assert same.sum() >= 0.995 * count  # where two triangles are at one distance, either is right
    for weights in ("u", "v"):
        np.testing.assert_allclose(getattr(hits, weights)[met & same], single[weights][met & same], atol=1e-5)


def test_a_ray_is_blocked_if_it_hits_something_within_its_reach(triangles):
    origins, directions = rays_at(triangles, 999)
    caster = RayCaster(triangles)
    distance = caster.nearest(origins, directions).distance
    reach = np.where(np.arange(999) % 2, distance * 0.999, distance * 1.001).astype(np.float32)
    expected = np.isfinite(distance) & (np.arange(999) % 2 == 0)
    assert 300 < expected.sum() < 500
    np.testing.assert_array_equal(caster.blocked(origins, directions, reach), expected)


def test_hits_of_a_triangle_match_values_worked_by_hand():
    caster = RayCaster(np.array([[[0, 0, 2], [4, 0, 2], [0, 8, 2]]], np.float32))
    ways = np.array([[1, 1, 2], [0.5, 2, 1], [-1, 1, 2]], np.float32)  # the second ends halfway to its hit
    hits = caster.nearest(np.zeros((1, 3), np.float32), ways)
    assert hits.triangle.tolist() == [0, 0, -1]
    assert hits.distance.tolist() == pytest.approx([1, 2, np.inf])
    assert hits.u[:2].tolist() == pytest.approx([1 / 4, 1 / 4])
    assert hits.v[:2].tolist() == pytest.approx([1 / 8, 1 / 2])
    reach = np.array([0.9, 2.1, 9], np.float32)
    assert caster.blocked(np.zeros((1, 3), np.float32), ways, reach).tolist() == [False, True, False]
