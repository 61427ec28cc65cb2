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


@pytest.mark.parametrize("bases", [1, 4, 9, 16])
def test_what_is_written_is_read_back(tmp_path, bases):
    gaussians = some_gaussians(5, bases)
    save_ply(tmp_path / "g.ply", gaussians)
    again = load_ply(tmp_path / "g.ply")
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(gaussians, name), getattr(again, name))


def test_rest_is_stored_channel_by_channel(tmp_path):
    gaussians = some_gaussians(2, 4)
    save_ply(tmp_path / "g.ply", gaussians)
    vertex = PlyData.read(tmp_path / "g.ply")["vertex"]
    # three rest rows of red come first, then green: f_rest_3 is row 1 of green
    assert vertex["f_rest_3"][1] == gaussians.sh[1, 1, 1].item()
    assert vertex["f_rest_2"][1] == gaussians.sh[1, 3, 0].item()
    assert [prop.name for prop in vertex.properties][:7] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0"]


def test_same_gaussians_same_bytes(tmp_path):
    for name in ("a.ply", "b.ply"):
        save_ply(tmp_path / name, some_gaussians(7, 9))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_no_gaussians_survive_too(tmp_path):
    save_ply(tmp_path / "g.ply", some_gaussians(0, 4))
    assert len(load_ply(tmp_path / "g.ply")) == 0


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
    (tmp_path / "g.ply").write_bytes(whole.replace(b"opacity", b"opaqity"))
    with pytest.raises(ArtifactError, match="without opacity"):
        load_ply(tmp_path / "g.ply")
    gaussians = some_gaussians(3, 1)
    gaussians.means[1, 2] = np.nan
    save_ply(tmp_path / "g.ply", gaussians)
    with pytest.raises(ArtifactError, match="1 of 3 Gaussians"):
        load_ply(tmp_path / "g.ply")
