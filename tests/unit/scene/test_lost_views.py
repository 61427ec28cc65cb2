"""Photographs that were not registered are shown beside the registered ones that share most matches."""

import json

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.errors import RegistrationError
from hilsplat.base.images import read_image
from hilsplat.scene.colmap import pycolmap
from hilsplat.scene.lost_views import MAX_ROWS, name_neighbours, plot_lost, stack_pictures
from tests.unit.scene.test_poses import plane_views, pose_photos, write_noise


def database_with(path, shared):
    """A database of views a to e with that many verified matches per pair."""
    with pycolmap.Database.open(path) as opened:
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 50.0, 40, 30)
        camera_id = opened.write_camera(camera)
        ids = {name: opened.write_image(pycolmap.Image(name=name, camera_id=camera_id)) for name in "abcde"}
        for (one, other), count in shared.items():
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = np.column_stack([np.arange(count)] * 2).astype(np.uint32)
            opened.write_two_view_geometry(ids[one], ids[other], geometry)


def test_lost_views_belong_near_the_registered_ones_with_most_shared_matches(tmp_path):
    database_with(tmp_path / "db", {"ab": 3, "ac": 9, "ad": 5, "ae": 7, "bc": 80})
    views = {name: {"registered": name not in "ad"} for name in "abcde"}
    name_neighbours(tmp_path / "db", views)
    near = [{"view": "c", "matches": 9}, {"view": "e", "matches": 7}, {"view": "b", "matches": 3}]
    assert views["a"]["belongs_near"] == near
    assert views["d"]["belongs_near"] == []
    assert "belongs_near" not in views["b"]


def test_the_picture_has_a_row_for_each_lost_view(tmp_path):
    write_noise(tmp_path / "images", MAX_ROWS + 3)

    def size_with(lost):
        views = {
            f"{number}.png": {
                "file": f"{number}.jpg",
                "registered": number >= lost,
                "why_not": "too few matches: none",
                "belongs_near": [{"view": "14.png", "matches": 20}][: number % 2],
            }
            for number in range(MAX_ROWS + 3)
        }
        path = tmp_path / "lost.png"
        path.unlink(missing_ok=True)
        if not plot_lost(path, tmp_path / "images", {"images": MAX_ROWS + 3, "views": views}):
            assert not path.exists()
            return None
        return Image.open(path).size

    assert size_with(0) is None
    width, height = size_with(1)
    assert size_with(3) == (width, height + 2 * 210)  # 2.1 inches each, 100 dots per inch
    assert size_with(MAX_ROWS + 2) == size_with(MAX_ROWS)


def test_pictures_are_stacked_with_a_white_margin(tmp_path):
    for name, size in (("upper", (6, 2)), ("lower", (4, 3))):
        Image.new("RGB", size, (10, 20, 30)).save(tmp_path / f"{name}.png")
    stack_pictures(tmp_path / "upper.png", tmp_path / "lower.png")
    found = read_image(tmp_path / "upper.png")
    assert found.shape == (5, 6, 3)
    assert (found[2:, 4:] == 255).all()
    assert (found[2:, :4] == (10, 20, 30)).all()


def test_an_unrelated_photograph_is_shown_in_the_report(tmp_path):
    plane_views(tmp_path / "photos")
    write_noise(tmp_path / "other", 1, (160, 160))
    (tmp_path / "other/0.png").rename(tmp_path / "photos/other.png")
    pose_photos(tmp_path / "photos", tmp_path / "scene")
    views = json.loads((tmp_path / "scene/registration.json").read_text())["views"]
    assert [name for name, entry in views.items() if not entry["registered"]] == ["other.png"]
    assert views["other.png"]["belongs_near"] == []
    assert views["other.png"]["why_not"].startswith(("too few matches", "no features"))
    assert Image.open(tmp_path / "scene/registration.png").size[1] == 600 + 330
    assert not (tmp_path / "not_registered.png").exists()

    with pytest.raises(RegistrationError, match=r"(?s)too few photographs.*picture .*not_registered\.png"):
        pose_photos(tmp_path / "photos", tmp_path / "strict", min_registered_share=0.9)
    assert Image.open(tmp_path / "not_registered.png").size == (1200, 330)
    pose_photos(tmp_path / "photos", tmp_path / "scene")  # the next success removes it
    assert not (tmp_path / "not_registered.png").exists()
