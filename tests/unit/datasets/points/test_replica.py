"""Replica by hand: three quads of three objects, sequences in both layouts."""

import json
from pathlib import Path

import numpy as np
import pytest

from hilsplat.base.errors import SceneError
from hilsplat.base.images import write_png
from hilsplat.datasets.points.replica import (
    object_of_vertices,
    open_scene,
    read_images,
    read_semantic_mesh,
)
from hilsplat.datasets.registry import DATASETS
from hilsplat.scene.posed_images import PosedImage
from tests.unit.datasets.writers.labelled import flat_images
from tests.unit.datasets.writers.points import write_ply, write_sequence

# Three quads in a row, of objects 2, 1 and 3:   0--1--2--3
#                                                4--5--6--7
XYZ = np.array([[x, y, 0] for y in (1, 0) for x in range(4)], np.float32)
QUADS = np.array([[4, 5, 1, 0], [5, 6, 2, 1], [6, 7, 3, 2]], np.int32)
OBJECT = np.array([2, 1, 3], np.int32)
NAMED = [{"id": 20, "name": "chair"}, {"id": 93, "name": "wall"}]
SOFA = [{"id": 20, "name": "sofa"}]


def make_habitat(folder: Path, labels=(-2, 20, 93, -1)) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    places = {axis: XYZ[:, column] for column, axis in enumerate("xyz")}
    write_ply(folder / "mesh_semantic.ply", places, QUADS, {"object_id": OBJECT})
    info = {"classes": NAMED, "id_to_label": list(labels), "objects": [], "gravity_dir": [0, 0, -1]}
    (folder / "info_semantic.json").write_text(json.dumps(info))
    return folder


def make_images(folder: Path, frames: int) -> list[PosedImage]:
    return flat_images(folder, [np.eye(4)] * frames, np.array([[7.0, 0, 5], [0, 7.0, 3], [0, 0, 1]]), (6, 10))


def make_semantic_nerf(folder: Path, frames: int, lines: int | None = None) -> Path:
    """A sequence whose frame n is at x = n."""
    for name in (*(f"rgb_{number}" for number in range(frames)), "vis_rgb_0"):
        write_png(folder / "rgb" / f"{name}.png", np.zeros((6, 10, 3), np.uint8))
    rows = np.tile(np.eye(4).ravel(), (frames if lines is None else lines, 1))
    rows[:, 3] = np.arange(len(rows))
    np.savetxt(folder / "traj_w_c.txt", rows)
    return folder


def test_a_vertex_belongs_to_the_object_of_most_faces_or_the_smallest_id_on_ties(tmp_path):
    points = read_semantic_mesh(make_habitat(tmp_path))
    # vertices 1 and 5 lie on objects 2 and 1, vertices 2 and 6 on 1 and 3: object 1 both times
    assert points.instance_id.tolist() == [3, 2, 2, 0, 3, 2, 2, 0]
    assert points.class_id.tolist() == [93, 20, 20, 0, 93, 20, 20, 0]
    np.testing.assert_array_equal(points.xyz, XYZ)
    # object 3 twice at vertex 0: most faces win over the smaller id
    faces = np.array([[0, 1], [0, 2], [0, 3]])
    assert object_of_vertices(faces, np.array([3, 3, 1]), 5).tolist() == [3, 3, 3, 1, -1]


def test_frames_are_sorted_by_number_and_other_pictures_are_ignored(tmp_path):
    images, warnings = read_images(make_semantic_nerf(tmp_path / "seq", 12, lines=15))
    assert [image.name for image in images] == [f"rgb_{number}.png" for number in range(12)]
    assert [image.world_from_cam[0, 3] for image in images] == list(range(12))
    assert warnings == ("3 poses have no image and are skipped",)


def test_focal_length_is_half_the_width_without_cam_params(tmp_path):
    images, _ = read_images(make_semantic_nerf(tmp_path / "seq", 1))
    assert images[0].K.tolist() == [[5, 0, 5], [0, 5, 3], [0, 0, 1]]  # of 10 x 6 px
    write_sequence(tmp_path / "slam" / "room0", make_images(tmp_path / "own", 2))
    images, _ = read_images(tmp_path / "slam" / "room0")
    assert images[0].K.tolist() == [[7, 0, 5], [0, 7, 3], [0, 0, 1]]
    lens = json.loads((tmp_path / "slam" / "cam_params.json").read_text())["camera"]
    assert (lens["cx"], lens["cy"], lens["scale"]) == (4.5, 2.5, 6553.5)  # pixel centres from 0, as 599.5


def test_a_scene_is_read_from_either_sequence(tmp_path):
    make_habitat(tmp_path / "room_0" / "habitat")
    with pytest.raises(SceneError, match=r"no rendered sequence(.|\n)*expected  room0/ or room_0/imap/00/"):
        open_scene(tmp_path, "room_0")
    make_semantic_nerf(tmp_path / "room_0" / "imap" / "00", 3)
    assert len(open_scene(tmp_path, "room_0").images) == 3
    write_sequence(tmp_path / "room0", make_images(tmp_path / "own", 2))
    scene = open_scene(tmp_path, "room_0")
    assert [image.name for image in scene.images] == ["frame000000.jpg", "frame000001.jpg"]
    assert open_scene(tmp_path, "room_0").report().facts["replica classes"] == 2
    assert DATASETS["replica"].found(tmp_path) == ("room_0",)


def habitat_with(folder: Path, **info) -> Path:
    (make_habitat(folder) / "info_semantic.json").write_text(json.dumps(info))
    return folder


def sequence_with(folder: Path, poses: str) -> Path:
    (make_semantic_nerf(folder, 1) / "traj_w_c.txt").write_text(poses)
    return folder


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (
            lambda at: read_semantic_mesh(make_habitat(at, labels=(-2, 20))),
            "do not match\n  expected  object ids 0 to 1\n  found     1 to 3",
        ),
        (
            lambda at: read_semantic_mesh(make_habitat(at, labels=(-2, 20, 205, 93))),
            "classes that are not in Replica.*found     class id 205",
        ),
        (
            lambda at: read_semantic_mesh(habitat_with(at, classes=SOFA, id_to_label=[0, 1, 2, 3])),
            "found     20 sofa",
        ),
        (lambda at: read_semantic_mesh(habitat_with(at)), "expected  an object with the keys classes, id"),
        (
            lambda at: (make_habitat(at) / "info_semantic.json").unlink() or read_semantic_mesh(at),
            r"info_semantic\.json is missing\n  found     mesh_semantic\.ply",
        ),
        (
            lambda at: read_images(make_semantic_nerf(at, 3, lines=1)),
            "1 lines, 3 images; the first frame without a line is 1",
        ),
        (
            lambda at: read_images(make_semantic_nerf(at / "room0", 1).parent),
            "not contain a rendered sequence.*fix       use the folder .*room0",
        ),
        (
            lambda at: read_images(sequence_with(at, "1 0 0 0\n")),
            "cannot be read: 4 columns\n  expected  16 numbers per line",
        ),
        (
            lambda at: open_scene(at, "room_1"),
            r"mesh_semantic\.ply is missing",
        ),
    ],
)
def test_unusable_scenes_are_refused_with_a_fix(tmp_path, read, message):
    with pytest.raises(SceneError, match=f"(?s){message}"):
        read(tmp_path)
