"""The true surface read back from a truth folder is the one that was rendered."""

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from hilsplat.base.errors import ArtifactError
from hilsplat.scene.cameras import Cameras
from hilsplat.settings import WorldSettings
from hilsplat.world.mesh import TrueMesh
from hilsplat.world.scenes.kinds import build_scene
from hilsplat.world.stage import run_world
from tests.unit.world.depth import depth_view


def test_depth_from_the_truth_folder_is_the_renderers(tmp_path):
    settings = WorldSettings(views=3, image_px=48, arc_deg=30, objects=2, samples=1)
    run_world("world:tabletop:100", settings, tmp_path, threads=1)
    cameras = Cameras.load(tmp_path / "truth" / "cameras.npz")
    mesh = TrueMesh.load(tmp_path / "truth" / "mesh.ply")
    scene = build_scene("tabletop", 100, 2)
    for name in cameras.names:
        np.testing.assert_allclose(mesh.depth(cameras[name]), depth_view(scene, cameras[name]), rtol=1e-4)


def test_a_mesh_with_another_face_than_triangles_is_refused(tmp_path):
    vertices = np.zeros(4, dtype=[(axis, "f4") for axis in "xyz"])
    faces = np.empty(1, dtype=[("vertex_indices", object)])
    faces[0] = (np.arange(4, dtype=np.int32),)
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements).write(str(tmp_path / "mesh.ply"))
    with pytest.raises(ArtifactError, match=r"mesh\.ply cannot be read"):
        TrueMesh.load(tmp_path / "mesh.ply")


def test_a_missing_or_damaged_mesh_is_named(tmp_path):
    with pytest.raises(ArtifactError, match=r"mesh\.ply is missing"):
        TrueMesh.load(tmp_path / "mesh.ply")
    (tmp_path / "mesh.ply").write_bytes(b"no mesh")
    with pytest.raises(ArtifactError, match=r"mesh\.ply cannot be read"):
        TrueMesh.load(tmp_path / "mesh.ply")
