"""Damaged input files raise an error that names them, and accepted input is always usable."""

import copy
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hilsplat.annotate.exchange import imported
from hilsplat.base.errors import HilsplatError
from hilsplat.configuration import read_config
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.importers.known_views import read_colmap, read_transforms
from hilsplat.scene.layouts import find_known_poses
from hilsplat.splat.ply import load_ply, save_ply
from hilsplat.workflow.plan import Plan
from tests.conftest import PROJECT
from tests.damage.damages import byte_damages, damaged_bytes, damaged_texts, damaged_values
from tests.unit.round_gaussians import round_gaussians
from tests.unit.scene.test_importers import write_colmap

ANY = settings(suppress_health_check=list(HealthCheck))


def accepted(read: Callable[[], Any]) -> Any:
    """Return the result of a reader, or None if it refuses with a message."""
    try:
        return read()
    except HilsplatError as error:
        assert str(error).strip()
        return None


@pytest.mark.parametrize("name", ["config.yaml", "paper.yaml", "demo.yaml"])
@given(data=st.data())
@ANY
def test_configurations(name: str, data: st.DataObject, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / name
    path.write_text(data.draw(damaged_texts((PROJECT / "config" / name).read_text())), encoding="utf-8")
    found = accepted(lambda: read_config(path))
    if found is not None:
        accepted(lambda: Plan({"groups": ["ci"], "only": [], **found, "scenes": "config/scenes.tsv"}))


POSE = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 1.0, 2.0], [0.0, 0.0, 0.0, 1.0]]
TRANSFORMS = {
    "fl_x": 50.0, "fl_y": 51.0, "cx": 20.0, "cy": 15.0, "w": 40, "h": 30, "k1": 0.01,
    "frames": [{"file_path": f"images/{name}.jpg", "transform_matrix": POSE} for name in "abc"],
}  # fmt: skip


def usable(views: list) -> bool:
    if not views:  # refused later because there are too few
        return True
    poses = np.stack([view.cam_from_source for view in views])
    lenses = np.concatenate([np.asarray(view.camera.params) for view in views])
    return bool(np.isfinite(poses).all() and np.isfinite(lenses).all())


@given(content=damaged_values(TRANSFORMS))
@ANY
def test_transforms(content, tmp_path_factory):
    folder = tmp_path_factory.mktemp("transforms")
    write_colmap(folder)
    (folder / "transforms.json").write_text(json.dumps(content))
    for path in (folder / "sparse/0").iterdir():
        path.unlink()
    found = accepted(lambda: read_transforms(find_known_poses(folder)))
    assert found is None or usable(found[0])


@pytest.mark.parametrize("suffix", ["bin", "txt"])
@given(data=st.data(), damage=byte_damages())
@ANY
def test_colmap_models(suffix: str, data: st.DataObject, damage: tuple[str, float, int], tmp_path_factory):
    folder = tmp_path_factory.mktemp("colmap")
    write_colmap(folder, suffix)
    path = data.draw(st.sampled_from(sorted((folder / "sparse/0").iterdir())))
    path.write_bytes(damaged_bytes(path.read_bytes(), damage))
    found = accepted(lambda: read_colmap(find_known_poses(folder)))
    assert found is None or usable(found[0])


@given(damage=byte_damages())
@ANY
def test_gaussians(damage: tuple[str, float, int], tmp_path_factory):
    path = tmp_path_factory.mktemp("ply") / "gaussians.ply"
    save_ply(path, round_gaussians(np.arange(15.0).reshape(5, 3), log_scale=-1.0, opacity_logit=1.0))
    path.write_bytes(damaged_bytes(path.read_bytes(), damage))
    found = accepted(lambda: load_ply(path))
    assert found is None or all(np.isfinite(array).all() for array in vars(found).values())


BOX = [[2.0, 3.0], [10.0, 3.0], [10.0, 12.0], [2.0, 12.0]]
ANNOTATIONS = {
    "labelme": {
        "imagePath": "000.png", "imageHeight": 24, "imageWidth": 42,
        "shapes": [
            {"label": "mug", "points": BOX, "shape_type": "polygon", "group_id": 1, "level": "whole"},
            {"label": "mug", "points": BOX[::2], "shape_type": "rectangle", "group_id": 1},
        ],
    },
    "coco": {
        "images": [{"id": 1, "file_name": "000.png", "height": 24, "width": 42}],
        "categories": [{"id": 7, "name": "mug"}],
        "annotations": [
            {"id": 1, "image_id": 1, "category_id": 7, "segmentation": [[2, 3, 10, 3, 10, 12]], "iscrowd": 0},
            {"id": 2, "image_id": 1, "category_id": 7, "iscrowd": 1,
             "segmentation": {"size": [24, 42], "counts": [50, 20, 938]}},
            {"id": 3, "image_id": 1, "category_id": 7, "segmentation": {"size": [24, 42], "counts": "`1a0"}},
        ],
    },
    "isat": {
        "info": {"name": "000.png", "height": 24, "width": 42},
        "objects": [
            {"category": "mug", "group": 1, "segmentation": BOX, "bbox": [2, 3, 10, 12], "level": "whole",
             "id": 1, "parent": None},
            {"category": "rim", "group": 2, "segmentation": BOX, "bbox": [2, 3, 10, 12], "level": "part",
             "id": 2, "parent": 1},
        ],
    },
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(ANNOTATIONS))
@given(data=st.data())
@ANY
def test_annotations(name: str, data: st.DataObject):
    content = data.draw(damaged_values(copy.deepcopy(ANNOTATIONS[name])))
    K = np.array([[30.0, 0, 21], [0, 30, 12], [0, 0, 1]])
    cameras = Cameras(("000.png",), np.eye(4)[None], K[None], np.array([[24, 42]], np.int32))
    found = accepted(lambda: imported("file.json", json.dumps(content), cameras))
    for label in (found or {}).get("000.png", ()):
        assert label.text.strip() and label.mask((24, 42)).shape == (24, 42)
