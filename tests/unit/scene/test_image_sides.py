"""Photographs too small or narrow for later stages are refused when added, and before poses are computed."""

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.errors import ImageError, SceneError
from hilsplat.photos.check import inspect_photos
from hilsplat.scene.assemble import PosedView, undistort
from hilsplat.scene.colmap import pycolmap
from hilsplat.scene.features import prepare_images
from hilsplat.workflow.new_scene import add_scene
from tests.unit.scene.test_importers import import_scene, write_colmap, write_images

SMALL_OR_NARROW = [(1, 64), (15, 64), (20, 30_000), (30_000, 20)]


@pytest.mark.parametrize("size_hw", SMALL_OR_NARROW)
def test_they_are_refused_by_new(tmp_path, size_hw):
    write_images(tmp_path / "photos", ["a.png", "b.png"])
    write_images(tmp_path / "photos", ["d.png"], size_hw)
    ((name, reason),) = inspect_photos(tmp_path / "photos").unreadable
    words = f"too small or too narrow: {size_hw[1]} x {size_hw[0]} px"
    assert name == "d.png" and words in reason and "\n" not in reason
    with pytest.raises(SceneError, match=words):
        add_scene(tmp_path / "scenes.tsv", "a", tmp_path / "photos")
    assert not (tmp_path / "scenes.tsv").exists()


@pytest.mark.parametrize(
    ("size_hw", "max_side_px"), [*((size, 800) for size in SMALL_OR_NARROW), ((100, 800), 64)]
)
def test_they_are_refused_before_structure_from_motion(tmp_path, size_hw, max_side_px):
    write_images(tmp_path, ["a.png"], size_hw)
    with pytest.raises(ImageError, match=r"a.png is too small or too narrow(.|\n)*also at poses.max_side_px"):
        prepare_images([tmp_path / "a.png"], tmp_path / "work", max_side_px)


def test_they_are_refused_with_known_poses(tmp_path):
    write_colmap(tmp_path / "in")
    write_images(tmp_path / "in/images", ["a.jpg", "b.jpg", "c.jpg"], (12, 16))
    with pytest.raises(SceneError, match=r"a.jpg is too small or too narrow: 16 x 12 px"):
        import_scene(tmp_path / "in", tmp_path / "scene")


def test_they_are_refused_after_correcting_the_lens(tmp_path):
    Image.fromarray(np.zeros((20, 20, 3), np.uint8)).save(tmp_path / "a.png")
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=20, height=20, params=[10.0, 10.0, 10.0, 0.5])
    with pytest.raises(ImageError, match=r"a.png is too small or too narrow"):
        undistort(PosedView("a.png", tmp_path / "a.png", camera, np.eye(4)), tmp_path / "pinhole")
