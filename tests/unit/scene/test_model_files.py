"""Damaged COLMAP models are refused before pycolmap reads them, and so are impossible poses and lenses."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilsplat.base.errors import SceneError
from hilsplat.scene.colmap import pycolmap
from hilsplat.scene.importers.known_views import KnownView, checked
from hilsplat.scene.importers.model_files import RECORDS, require_whole_files
from hilsplat.scene.layouts import KnownPoses
from tests.unit.scene.test_importers import write_colmap

FILES = sorted(f"{name}.bin" for name in RECORDS)


@pytest.fixture
def model(tmp_path) -> Path:
    write_colmap(tmp_path)
    folder = tmp_path / "sparse/0"
    assert sorted(path.name for path in folder.glob("*.bin")) == FILES
    return folder


@pytest.mark.parametrize("name", FILES)
def test_a_file_truncated_anywhere_is_damaged(model, name):
    require_whole_files(model)
    whole = (model / name).read_bytes()
    for length in range(len(whole)):
        (model / name).write_bytes(whole[:length])
        with pytest.raises(SceneError, match=rf"{name} is damaged"):
            require_whole_files(model)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("more", [1, 1000, 2**40, 2**63])
def test_a_count_that_is_too_large_is_damaged(model, name, more):
    data = bytearray((model / name).read_bytes())
    data[:8] = struct.pack("<Q", int.from_bytes(data[:8], "little") + more)
    (model / name).write_bytes(data)
    with pytest.raises(SceneError, match=rf"{name} is damaged"):
        require_whole_files(model)


def test_bytes_after_the_last_record_are_damage(model):
    with (model / "images.bin").open("ab") as stream:
        stream.write(b"\0")
    with pytest.raises(SceneError, match="1 bytes follow its 3 records"):
        require_whole_files(model)


def lens(*params: float, width: int = 40) -> pycolmap.Camera:
    return pycolmap.Camera(model="PINHOLE", width=width, height=30, params=params)


def view(name: str = "a.png", **changes) -> KnownView:
    return replace(KnownView(name, None, lens(50, 50, 20, 15), np.eye(4)), **changes)


def pose(rotation: np.ndarray | float = 1.0, position: float = 0.0) -> np.ndarray:
    made = np.eye(4)
    made[:3, :3] *= rotation
    made[0, 3] = position
    return made


FAULTY_LENSES = [lens(focal, 50, 20, 15) for focal in (-50, 0, np.inf)]
FAULTY_LENSES += [lens(50, 50, np.nan, 15), lens(50, 50, 20, 15, width=0)]


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        *(({"camera": camera}, "lens") for camera in FAULTY_LENSES),
        *(({"cam_from_source": pose(factor)}, "rotation") for factor in (0.0, 2.0, np.nan)),
        ({"cam_from_source": pose(position=1e30)}, "position"),
    ],
)
def test_impossible_lenses_and_poses_are_refused(changes, fault):
    with pytest.raises(SceneError, match=rf"the {fault} of b\.png"):
        checked([view(), view("b.png", **changes)], KnownPoses(Path(), "colmap", (Path("model"),)))


def test_views_that_all_have_one_pose_are_refused():
    known = KnownPoses(Path(), "colmap", (Path("model"),))
    with pytest.raises(SceneError, match="same pose"):
        checked([view(str(number)) for number in range(3)], known)
    moved = [view(str(number), cam_from_source=pose(position=number)) for number in range(3)]
    assert checked(moved, known) == moved
