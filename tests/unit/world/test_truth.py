"""The true mesh has short edges, node ids on both sides of borders, views per vertex, and exact depth."""

from collections import Counter

import numpy as np
import pytest
from plyfile import PlyData

from hilsplat.base.errors import SceneError
from hilsplat.base.levels import LEVELS
from hilsplat.scene.cameras import Cameras
from hilsplat_world.shapes import Mesh, box
from hilsplat_world.truth import load_surface, refined, true_depth, unique_rows, views_of_points, write_mesh
from hilsplat_world.views import numbered_cameras
from tests.unit.world.scenes import scene_of


def cameras_at(*centres: tuple[float, float, float]) -> Cameras:
    return numbered_cameras([(np.array(centre), np.zeros(3)) for centre in centres], 64, 60.0)


def area(triangles: np.ndarray) -> float:
    edges = (triangles[:, 1:] - triangles[:, :1]).astype(np.float64)
    return float(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() / 2)


def test_refined_triangles_cover_the_same_surface_with_short_edges():
    solid = box((2.0, 1.0, 0.3)).triangles.astype(np.float32)
    fine, owner = refined(solid, 0.25)
    assert area(fine) == pytest.approx(area(solid)) == pytest.approx(2 * (2.0 + 0.6 + 0.3))
    assert np.linalg.norm(fine - np.roll(fine, 1, axis=1), axis=2).max() <= 0.25
    assert all(area(fine[owner == row]) == pytest.approx(area(solid[row, None])) for row in range(12))
    facing = np.cross(fine[:, 1] - fine[:, 0], fine[:, 2] - fine[:, 0])
    before = np.cross(solid[:, 1] - solid[:, 0], solid[:, 2] - solid[:, 0])[owner]
    assert ((facing * before).sum(axis=1) > 0).all()
    unchanged, owner = refined(solid, 3.0)
    assert np.array_equal(unchanged, solid) and np.array_equal(owner, np.arange(12))


def test_refined_triangles_have_no_cracks():
    # Each edge of a closed surface has two triangles; a corner in the middle of an edge would leave one.
    fine, _ = refined(box((2.0, 1.0, 0.3)).triangles.astype(np.float32), 0.4)
    edges = Counter(
        frozenset((tuple(triangle[k].tolist()), tuple(triangle[(k + 1) % 3].tolist())))
        for triangle in fine
        for k in range(3)
    )
    assert set(edges.values()) == {2}


def test_a_vertex_on_a_border_has_one_copy_per_node(tmp_path):
    # Two triangles of a square share its diagonal; they belong to two wholes, one of which has a part.
    square = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]], np.float32)
    scene = scene_of(Mesh(square, square), node_ids=[[0, -1, -1], [1, 2, -1]])
    write_mesh(tmp_path / "mesh.ply", scene, cameras_at((0.1, 0.0, 3.0), (0.1, 0.0, -3.0)))
    mesh = PlyData.read(tmp_path / "mesh.ply")
    vertices, faces = mesh["vertex"].data, mesh["face"].data
    places = Counter((float(v["x"]), float(v["y"])) for v in vertices)
    assert places == {(0, 0): 2, (1, 1): 2, (1, 0): 1, (0, 1): 1}
    for face in faces:
        for corner in face["vertex_indices"]:
            assert all(vertices[level.label][corner] == face[level.label] for level in LEVELS)
    assert (vertices["views"] == 2).all()


def test_hidden_points_are_not_counted_as_seen():
    # A plate at z = 0 under a small plate at z = 1: seen from above, its middle is hidden, its corner not.
    plate = np.array([[[-1, -1, 0], [1, -1, 0], [1, 1, 0]], [[-1, -1, 0], [1, 1, 0], [-1, 1, 0]]], np.float32)
    lid = plate * np.float32(0.2) + np.array([0, 0, 1], np.float32)
    both = np.concatenate([plate, lid])
    scene = scene_of(Mesh(both, both))
    points = np.array([[0, 0, 0], [0.9, 0.9, 0], [0, 0, 1], [0, 0, 9]], np.float32)
    above, below, near = cameras_at((0.01, 0, 4.0)), cameras_at((0.01, 0, -4.0)), cameras_at((0.01, 0, 0.5))
    assert views_of_points(scene, above, points).tolist() == [0, 1, 1, 0]
    assert views_of_points(scene, below, points).tolist() == [1, 1, 0, 0]
    assert views_of_points(scene, near, points).tolist() == [1, 0, 0, 0]


def test_unique_rows_equal_numpys():
    rows = np.random.default_rng(0).integers(-2, 3, (2000, 4)).astype(np.float32)
    unique, index = np.unique(rows, axis=0, return_inverse=True)
    for found, expected in zip(unique_rows(rows), (unique, index.reshape(-1)), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_the_written_mesh_gives_the_depth_of_the_scene_along_the_optical_axis(tmp_path):
    # A camera 4 above a box of height 1 sees its top at depth 3.5 in all pixels and nothing around it.
    cameras = cameras_at((0.0, 0.001, 4.0))
    write_mesh(tmp_path / "mesh.ply", scene_of(box((1.0, 1.0, 1.0))), cameras)
    depth = true_depth(load_surface(tmp_path / "mesh.ply"), cameras["000.png"])
    assert depth[24:40, 24:40] == pytest.approx(3.5, abs=2e-3)
    assert np.isinf(depth[:8]).all()


def test_a_damaged_mesh_is_reported(tmp_path):
    (tmp_path / "mesh.ply").write_bytes(b"no mesh")
    with pytest.raises(SceneError, match=r"mesh\.ply cannot be read(.|\n)*rerun the world stage"):
        load_surface(tmp_path / "mesh.ply")
