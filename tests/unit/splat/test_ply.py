"""Gaussians survive the 3DGS PLY, in the layout that others read."""

import numpy as np
import pytest
from plyfile import PlyData

from hilsplat.base.errors import ArtifactError
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.ply import load_ply, save_ply


def some_gaussians(n: int, bases: int) -> Gaussians:
    generator = np.random.default_rng(0)
    shapes = ((n, 3), (n, 3), (n, 4), (n,), (n, bases, 3))
    return Gaussians(*(generator.standard_normal(shape, np.float32) for shape in shapes))


@pytest.mark.parametrize(("n", "bases"), [(0, 4), (5, 1), (5, 4), (5, 9), (5, 16)])
def test_what_is_written_is_read_back(tmp_path, n, bases):
    gaussians = some_gaussians(n, bases)
    save_ply(tmp_path / "g.ply", gaussians)
    again = load_ply(tmp_path / "g.ply")
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(gaussians, name), getattr(again, name))
    save_ply(tmp_path / "again.ply", again)
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "g.ply").read_bytes()


def test_rest_is_stored_channel_by_channel(tmp_path):
    gaussians = some_gaussians(2, 4)
    save_ply(tmp_path / "g.ply", gaussians)
    vertex = PlyData.read(tmp_path / "g.ply")["vertex"]
    # three rest rows of red come first, then green: f_rest_3 is row 1 of green
    assert vertex["f_rest_3"][1] == gaussians.sh[1, 1, 1].item()
    assert vertex["f_rest_2"][1] == gaussians.sh[1, 3, 0].item()
    assert [prop.name for prop in vertex.properties][:7] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0"]


def test_broken_files_are_refused(tmp_path):
    with pytest.raises(ArtifactError, match="is missing"):
        load_ply(tmp_path / "none.ply")
    (tmp_path / "text.ply").write_text("hello")
    with pytest.raises(ArtifactError, match="is not a readable PLY"):
        load_ply(tmp_path / "text.ply")
    save_ply(tmp_path / "g.ply", some_gaussians(3, 1))
    whole = (tmp_path / "g.ply").read_bytes()
    (tmp_path / "g.ply").write_bytes(whole[:-9])
    with pytest.raises(ArtifactError, match="is not a readable PLY"):
        load_ply(tmp_path / "g.ply")
