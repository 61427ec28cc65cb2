"""Runs of projects inside folders of photographs, and dry runs after a user's files changed."""

import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.workflow.conftest import Project

SCENE = "results/photos/desk/scene"
WIDTH, HEIGHT, FOCAL_PX, VIEWS = 48, 32, 40.0, 4


def write_pictures(folder: Path) -> None:
    folder.mkdir(parents=True)
    for number in range(VIEWS):
        pixels = np.random.default_rng(number).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"{number}.png")


def write_colmap(folder: Path) -> None:
    """Write a scene of COLMAP: cameras in a row, looking along z."""
    write_pictures(folder / "images")
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    lens = f"{FOCAL_PX} {FOCAL_PX} {WIDTH / 2} {HEIGHT / 2}"
    (model / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {lens}\n")
    poses = (f"{number + 1} 1 0 0 0 {number / 10} 0 0 1 {number}.png\n\n" for number in range(VIEWS))
    (model / "images.txt").write_text("".join(poses))
    (model / "points3D.txt").write_text("".join(f"{row} {row} 0 5 9 9 9 0\n" for row in range(1, 4)))


def write_flat(folder: Path) -> None:
    """Write the same scene as transforms.json with the photographs beside it."""
    write_pictures(folder)
    matrix = np.diag([1.0, -1, -1, 1])
    frames = []
    for number in range(VIEWS):
        matrix[0, 3] = -number / 10
        frames.append({"file_path": f"{number}.png", "transform_matrix": matrix.tolist()})
    lens = {"fl_x": FOCAL_PX, "w": WIDTH, "h": HEIGHT}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))


def start(root: Path, package: Path, source: str) -> Project:
    """Make a project with the scene `photos/desk`, and pose it."""
    place = Project(root, package)
    hilsplat(place, "new", "desk", source)
    hilsplat(place, "run", "desk", SCENE)
    return place


def hilsplat(place: Project, *words: str) -> str:
    done = place.run(sys.executable, "-m", "hilsplat", *words)
    return done.stdout + done.stderr


def is_done(place: Project) -> bool:
    """Return whether a run has nothing to do; otherwise, its first job is `poses`."""
    printed = hilsplat(place, "run", "desk", SCENE, "--", "-n")
    assert "Nothing to be done" in printed or "rule poses:" in printed
    return "Nothing to be done" in printed


@pytest.mark.parametrize(
    ("write", "inside", "source"), [(write_flat, ".", "."), (write_colmap, "my project", "..")]
)
def test_a_project_among_its_photographs_finishes_and_has_nothing_left_to_do(
    project: Path, tmp_path: Path, write: Callable[[Path], None], inside: str, source: str
) -> None:
    write(tmp_path / "desk")
    (tmp_path / "desk" / inside).mkdir(exist_ok=True)
    place = start(tmp_path / "desk" / inside, project, source)
    assert json.loads((place.root / SCENE / "registration.json").read_text())["registered"] == VIEWS
    assert is_done(place)


def test_contents_decide_whether_photographs_and_poses_changed(project: Path, tmp_path: Path) -> None:
    write_colmap(tmp_path / "project/desk")
    for path in (tmp_path / "project/desk/images").iterdir():
        path.write_bytes(path.read_bytes() + bytes(2**20))  # Snakemake's default limit of checksums is 1 MB
    place = start(tmp_path / "project", project, "desk")
    photo, other = (place.root / "desk/images" / f"{number}.png" for number in (0, 1))
    lens = place.root / "desk/sparse/0/cameras.txt"
    first, text, stat = photo.read_bytes(), lens.read_text(), lens.stat()
    photo.write_bytes(other.read_bytes())
    os.utime(photo, (0, 0))
    assert not is_done(place), "another photograph that is older than the scene"
    photo.write_bytes(first)
    lens.write_text(text.replace("40.0", "30.0"))
    os.utime(lens, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert not is_done(place), "poses of the same size and time"
    lens.write_text(text)
    os.utime(photo)
    moved = Project(place.root.rename(tmp_path / "moved"), project)
    assert is_done(moved), "the same files with new times, in another place"
    (photo := moved.root / "desk/images/0.png").unlink()
    assert not is_done(moved), "a photograph less"
    shutil.rmtree(moved.root / ".snakemake")
    photo.write_bytes((moved.root / "desk/images/1.png").read_bytes())
    os.utime(photo, (0, 0))
    assert not is_done(moved), "an older photograph, without Snakemake's records"
