"""Replica by hand: three quads of three objects, sequences in both layouts."""

import json
from pathlib import Path

import numpy as np
import pytest

from hilsplat.base.errors import SceneError
from hilsplat.base.images import write_png
from hilsplat.datasets.points import replica
from hilsplat.datasets.registry import DATASETS
from tests.unit.datasets.writers.labelled import flat_images
from tests.unit.datasets.writers.points import write_ply, write_sequence

# Three quads in a row, of objects 2, 1 and 3:   0--1--2--3
#                                                4--5--6--7
XYZ = np.array([[x, y, 0] for y in (1, 0) for x in range(4)], np.float32)
QUADS = np.array([[4, 5, 1, 0], [5, 6, 2, 1], [6, 7, 3, 2]], np.int32)
OBJECT = np.array([2, 1, 3], np.int32)
NAMED = [{"id": 20, "name": "chair"}, {"id": 93, "name": "wall"}]
MESH, INFO = "room_0/habitat/mesh_semantic.ply", "room_0/habitat/info_semantic.json"
SEQUENCE = "room_0/imap/00"


def info(labels, classes=NAMED):
    """Return a change that writes the classes of objects."""
    content = json.dumps({"classes": classes, "id_to_label": labels, "gravity_dir": [0, 0, -1]})
    return lambda root: (root / INFO).write_text(content)


def poses(count: int):
    """Return a change that writes poses; that of frame n is at x = n."""
    rows = np.tile(np.eye(4).ravel(), (count, 1))
    rows[:, 3] = np.arange(count)
    return lambda root: np.savetxt(root / SEQUENCE / "traj_w_c.txt", rows)


def text_in(name: str, text: str):
    """Return a change that replaces the text of a file."""
    return lambda root: (root / name).write_text(text)


def moved(name: str, target: str):
    """Return a change that moves a file or folder."""
    return lambda root: (root / name).rename(root / target)


def make_frames(root: Path, count: int) -> None:
    """Write the images of a sequence in the layout of Semantic-NeRF, and a picture that is no frame."""
    for name in (*(f"rgb_{number}" for number in range(count)), "vis_rgb_0"):
        write_png(root / SEQUENCE / "rgb" / f"{name}.png", np.zeros((6, 10, 3), np.uint8))


TRIANGLE = """ply
format ascii 1.0
element vertex 4
property float x\nproperty float y\nproperty float z
element face 2
property list uchar int vertex_indices\nproperty int object_id
end_header
0 0 0\n1 0 0\n1 1 0\n0 1 0
4 0 1 2 3 1
3 0 1 2 1
"""
"""A mesh with a triangle among quads."""


@pytest.fixture
def root(tmp_path) -> Path:
    (tmp_path / MESH).parent.mkdir(parents=True)
    write_ply(tmp_path / MESH, XYZ, QUADS, object_id=OBJECT)
    info([-2, 20, 93, -1])(tmp_path)
    make_frames(tmp_path, 3)
    poses(3)(tmp_path)
    return tmp_path


def test_a_vertex_belongs_to_the_object_of_most_faces_or_the_smallest_id_on_ties(root):
    points = replica.read_semantic_mesh((root / MESH).parent)
    # vertices 1 and 5 lie on objects 2 and 1, vertices 2 and 6 on 1 and 3: object 1 both times
    assert points.instance_id.tolist() == [3, 2, 2, 0, 3, 2, 2, 0]
    assert points.class_id.tolist() == [93, 20, 20, 0, 93, 20, 20, 0]
    np.testing.assert_array_equal(points.xyz, XYZ)
    # object 3 twice at vertex 0: most faces win over the smaller id
    faces = np.array([[0, 1], [0, 2], [0, 3]])
    assert replica.object_of_vertices(faces, np.array([3, 3, 1]), 5).tolist() == [3, 3, 3, 1, -1]


def test_frames_are_sorted_by_number_and_other_pictures_are_ignored(root):
    make_frames(root, 12)
    poses(15)(root)
    images, warnings = replica.read_images(root, "room_0")
    assert [image.name for image in images] == [f"rgb_{number}.png" for number in range(12)]
    assert [image.world_from_cam[0, 3] for image in images] == list(range(12))
    assert warnings == ("3 poses have no image and are skipped",)
    assert images[0].K.tolist() == [[5, 0, 5], [0, 5, 3], [0, 0, 1]]  # half the width of 10 x 6 px


def test_a_sequence_of_nice_slam_is_preferred_and_has_its_own_lens(root, tmp_path):
    K = np.array([[7.0, 0, 5], [0, 7.0, 3], [0, 0, 1]])
    write_sequence(root / "room0", flat_images(tmp_path / "own", [np.eye(4)] * 2, K, (6, 10)))
    scene = replica.open_scene(root, "room_0")
    assert [image.name for image in scene.images] == ["frame000000.jpg", "frame000001.jpg"]
    assert scene.images[0].K.tolist() == K.tolist()
    lens = json.loads((root / "cam_params.json").read_text())["camera"]
    assert (lens["cx"], lens["cy"], lens["scale"]) == (4.5, 2.5, 6553.5)  # pixel centres from 0, as 599.5
    assert scene.report().facts["replica classes"] == 2
    assert DATASETS["replica"].found(root) == ("room_0",)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (info([-2, 20]), "do not match\n  expected  object ids 0 to 1\n  found     1 to 3"),
        (info([-2, 20, 205, 93]), "classes that are not in Replica.*found     class id 205"),
        (info([0, 1, 2, 3], [{"id": 20, "name": "sofa"}]), "found     20 sofa"),
        (text_in(INFO, "{}"), "expected  an object with the keys classes, id"),
        (lambda root: (root / INFO).unlink(), r"info_semantic\.json is missing\n.*mesh_semantic\.ply"),
        (lambda root: (root / MESH).unlink(), r"mesh_semantic\.ply is missing"),
        (
            lambda root: write_ply(root / MESH, XYZ, QUADS[:, :3], object_id=OBJECT),
            "with 3 corners\n  expected  4 corners per face\n  fix       use the labelled file",
        ),
        (text_in(MESH, TRIANGLE), "with 3 corners\n"),
        (lambda root: (root / MESH).write_bytes((root / MESH).read_bytes()[:-9]), "early end.*damaged"),
        (poses(1), "1 lines, 3 images; the first frame without a line is 1"),
        (moved(f"{SEQUENCE}/rgb/rgb_2.png", f"{SEQUENCE}/rgb/rgb_001.png"), "several images of one frame"),
        (text_in(f"{SEQUENCE}/traj_w_c.txt", "1 0 0 0\n"), "1 lines of 4 numbers\n.*16 numbers per line"),
        (moved(SEQUENCE, "00"), "in room0 or room_0/imap/00 or room_0/Sequence_1\n.*unpack the rendered"),
        (moved("room_0/imap", "room0"), "found     00\n.*move the files in .*room0/00 one level up"),
    ],
)
def test_unusable_scenes_are_refused_with_a_fix(root, damage, message):
    damage(root)
    with pytest.raises(SceneError, match=f"(?s){message}"):
        replica.open_scene(root, "room_0")
