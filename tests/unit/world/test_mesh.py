"""The mesh read from a truth folder is the surface that was rendered."""

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


def test_depth_from_the_truth_folder_equals_the_renderers(tmp_path):
    settings = WorldSettings(views=3, image_px=48, arc_deg=30, objects=2, samples=1)
    run_world("world:tabletop:100", settings, tmp_path, threads=1)
    cameras = Cameras.load(tmp_path / "truth" / "cameras.npz")
    mesh = TrueMesh.load(tmp_path / "truth" / "mesh.ply")
    scene = build_scene("tabletop", 100, 2)
    for name in cameras.names:
        np.testing.assert_allclose(mesh.depth(cameras[name]), depth_view(scene, cameras[name]), rtol=1e-4)


def quad(path):
    """Write a mesh whose only face has four corners."""
    vertices = np.zeros(4, dtype=[(axis, "f4") for axis in "xyz"])
    faces = np.empty(1, dtype=[("vertex_indices", object)])
    faces[0] = (np.arange(4, dtype=np.int32),)
    PlyData([PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]).write(str(path))


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: None, r"mesh\.ply is missing"),
        (lambda path: path.write_bytes(b"no mesh"), r"mesh\.ply cannot be read"),
        (quad, r"mesh\.ply cannot be read"),
    ],
)
def test_a_missing_or_damaged_mesh_is_reported(tmp_path, write, message):
    write(tmp_path / "mesh.ply")
    with pytest.raises(ArtifactError, match=message):
        TrueMesh.load(tmp_path / "mesh.ply")
