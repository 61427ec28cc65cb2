"""ScanNet by hand: a mesh of five vertices, two objects, frames that are numbered without zeros."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.errors import SceneError
from hilsplat.datasets.points.scannet import LABEL_TABLE, open_scan, read_label_table
from hilsplat.datasets.registry import DATASETS
from hilsplat.scene.posed_images import write_posed_images
from tests.unit.datasets.points.test_replica import moved, text_in
from tests.unit.datasets.writers.labelled import flat_images
from tests.unit.datasets.writers.points import write_label_table, write_ply, write_scan

SCAN = "scene0000_00"
CATEGORIES = {"chair": (2, 5), "mattress": (1191, 4), "wall": (1, 1), "gizmo": (9999, 40)}
XYZ = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [5, 5, 5]], np.float32)
FACES = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
OBJECTS = ("wall", "mattress", "chair")
OWNER = np.array([0, 0, 1, 2, -1], np.int32)  # object of each vertex; the last has none


def turned(degrees: float) -> np.ndarray:
    pose = np.eye(4)
    angle = np.radians(degrees)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = [degrees, 2.0, 3.0]
    return pose


def make_scan(root: Path, frames: int = 12, lost: tuple[int, ...] = ()) -> Path:
    """Write the scan, with frame n turned by n degrees; return the data set's folder."""
    K = np.array([[10.0, 0, 8.25], [0, 10.0, 6.5], [0, 0, 1]])
    images = flat_images(root.parent / "pictures", [turned(number) for number in range(frames)], K, (12, 16))
    write_label_table(root, CATEGORIES)
    write_scan(root, SCAN, images, XYZ, FACES, OWNER, OBJECTS, CATEGORIES, lost)
    return root


@pytest.fixture
def root(tmp_path):
    return make_scan(tmp_path / "scannet")


def test_labels_and_instances_are_those_of_the_files(root):
    scene = open_scan(root, SCAN)
    points = scene.truth["nyu40"]
    np.testing.assert_array_equal(points.xyz, XYZ)
    assert points.class_id.tolist() == [1, 1, 4, 5, 0]
    assert points.instance_id.tolist() == [1, 1, 2, 3, 0]  # objectId + 1: the first object is not "none"
    assert scene.truth["scannet200"].class_id.tolist() == [1, 1, 1191, 2, 0]
    assert scene.warnings == ()
    facts = scene.report().facts
    assert (facts["posed images"], facts["nyu40 points with a class"]) == (12, 4)
    for name in ("scannet", "scannet200"):
        assert DATASETS[name].found(root) == (SCAN,)


def test_frames_are_sorted_by_number_and_posed_with_centres_moved_by_half_a_pixel(root):
    images = open_scan(root, SCAN).images
    assert [image.name for image in images] == [f"{number}.jpg" for number in range(12)]
    image = images[3]
    np.testing.assert_allclose(image.world_from_cam, turned(3), atol=1e-12)
    # the file counts pixel centres from 0
    stored = np.loadtxt(root / "scans" / SCAN / "intrinsic" / "intrinsic_color.txt")
    assert stored[:2, 2].tolist() == [7.75, 6.0]
    assert image.K[:2, 2].tolist() == [8.25, 6.5]
    assert image.size_hw == (12, 16)


def test_names_may_be_padded_with_zeros(root):
    plain = open_scan(root, SCAN).images
    for path in [*(root / "scans" / SCAN).glob("color/*"), *(root / "scans" / SCAN).glob("pose/*")]:
        path.rename(path.with_name(f"{int(path.stem):06d}{path.suffix}"))
    images = open_scan(root, SCAN).images
    assert [image.name for image in images] == [f"{number:06d}.jpg" for number in range(12)]
    for image, same in zip(images, plain, strict=True):
        np.testing.assert_array_equal(image.cam_from_world, same.cam_from_world)


def test_frames_without_a_pose_are_skipped_and_reported(tmp_path):
    root = make_scan(tmp_path / "scannet", frames=5, lost=(1, 3))
    poses = root / "scans" / SCAN / "pose"
    (poses / "4.txt").unlink()
    scene = open_scan(root, SCAN)
    assert [image.name for image in scene.images] == ["0.jpg", "2.jpg"]
    assert scene.warnings[0].startswith("2 frames are skipped because tracking failed")
    assert scene.warnings[1] == "1 images (first: 4) have no file in pose/ and are skipped"
    for number in (0, 2):
        (poses / f"{number}.txt").unlink()
    with pytest.raises(SceneError, match=r"no usable frames\n.*\n.*5 images; 3 .* 2 with failed tracking"):
        open_scan(root, SCAN)


def test_unknown_categories_and_vertices_of_two_groups(root):
    path = root / "scans" / SCAN / f"{SCAN}.aggregation.json"
    path.write_text(path.read_text().replace('"chair"', '"trashcan"'))
    scene = open_scan(root, SCAN)
    assert scene.truth["scannet200"].class_id.tolist() == [1, 1, 1191, 0, 0]
    assert scene.truth["scannet200"].instance_id.tolist() == [1, 1, 2, 3, 0]
    assert scene.warnings[0].endswith("trashcan (1)")
    record = json.loads(path.read_text())
    record["segGroups"][2]["segments"] += record["segGroups"][1]["segments"]  # the later one wins
    path.write_text(json.dumps(record))
    assert open_scan(root, SCAN).truth["scannet200"].class_id.tolist() == [1, 1, 0, 0, 0]


def test_ids_outside_the_200_are_none(root):
    path = root / LABEL_TABLE
    # id 107 occurs twice in the real table; cells may be empty
    path.write_text("id\traw_category\tcount\tnyu40id\n107\tone\t\t38\n107\tother\t\t40\n5\tdoor\t\t\n")
    table = read_label_table(path)
    assert table == {"one": 107, "other": 107, "door": 5}
    write_label_table(root, CATEGORIES)
    assert read_label_table(path)["gizmo"] == 0


def mesh_of(xyz: np.ndarray):
    """Return a change that replaces the unlabelled mesh."""
    return lambda folder: write_ply(folder / f"{SCAN}_vh_clean_2.ply", xyz, FACES)


def truncate_labels(folder: Path) -> None:
    (folder / LABELS).write_bytes((folder / LABELS).read_bytes()[:-20])


def keep_frames_in_archive(folder: Path) -> None:
    (folder / f"{SCAN}.sens").touch()
    (folder / "color").rename(folder / "colour")


LABELS, GROUPS = f"{SCAN}_vh_clean_2.labels.ply", f"{SCAN}.aggregation.json"
SEGMENTS = f"{SCAN}_vh_clean_2.0.010000.segs.json"
STRANGER = '{"segGroups": [{"objectId": 0, "label": "wall", "segments": [123456]}]}'
LARGE = '{"segGroups": [{"objectId": 3000000000, "label": "wall", "segments": [7]}]}'
NUMBERLESS = '{"segGroups": [{"label": "wall", "segments": [7]}]}'


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (mesh_of(np.tile(XYZ, (2, 1))), "does not match.*the same 10 vertices.*found     5 vertices"),
        (mesh_of(XYZ + np.float32([0.5, 0, 0])), "does not match.*found     vertices at other positions"),
        (truncate_labels, r"labels\.ply cannot be read.*expected  a PLY mesh.*fix "),
        (moved(LABELS, "labels.ply"), r"scene0000_00 of ScanNet v2 is incomplete.*labels\.ply.*unpack"),
        (moved("color/0.jpg", "color/first.jpg"), r"first\.jpg is not named like a frame\n.*<number>\.jpg"),
        (moved("", f"../../{SCAN}"), "wrong place.*fix       move .*scannet/scene0000_00 to .*scans"),
        (keep_frames_in_archive, r"still inside scene0000_00\.sens.*SensReader"),
        (text_in(GROUPS, STRANGER), r"group 0 \(wall\): none of its segments.*fix "),
        (text_in(GROUPS, NUMBERLESS), r"group 0 cannot be read: 'objectId' is missing"),
        (text_in(GROUPS, LARGE), r"group 0 cannot be read: Python integer 3000000001 out of bounds"),
        (text_in(GROUPS, '{"segGroups": null}'), r"aggregation\.json cannot be read"),
        (text_in(SEGMENTS, '{"segIndices": [[1], [2, 3]]}'), r"segs\.json cannot be read"),
        (text_in(f"{SCAN}.txt", "colorHeight = a\ncolorWidth = 9\n"), r"\.txt cannot be read.*whole numbers"),
        (
            text_in(f"{SCAN}.txt", "colorHeight = 12\ncolorWidth = 0\n"),
            r"\.txt cannot be read: its sides are not",
        ),
        (lambda scan: (scan / f"../../{LABEL_TABLE}").write_bytes(b"\xe9"), r"tsv cannot be read: 'utf-8'"),
        (text_in(SEGMENTS, '{"segIndices": [1]}'), r"segs\.json does not match.*each of 5 .*found     1 val"),
        (text_in("pose/0.txt", "2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"), "the pose is not a rotation"),
        (text_in("pose/0.txt", "1 0 0\n"), r"0\.txt cannot be read: 1 lines of 3 numbers\n.*4 lines"),
        (text_in(f"../../{LABEL_TABLE}", "id,nyu40id\n"), "is not ScanNet's label table.*found     id,nyu40"),
    ],
)
def test_unusable_scans_are_refused_with_a_fix(root, damage, message):
    damage(root / "scans" / SCAN)
    with pytest.raises(SceneError, match=f"(?s){message}"):
        open_scan(root, SCAN)


@pytest.mark.parametrize(
    ("scale", "info"),
    [
        (0.5, ""),  # images made smaller than intrinsic_color.txt
        (1.0, "colorHeight = 24\ncolorWidth = 32\n"),  # both made smaller than the .txt
    ],
)
def test_a_lens_of_another_image_size_is_refused(root, scale, info):
    folder = root / "scans" / SCAN
    (folder / f"{SCAN}.txt").write_text(info)
    for path in (folder / "color").iterdir():
        with Image.open(path) as image:
            image.resize((round(16 * scale), round(12 * scale))).save(path)
    with pytest.raises(SceneError, match=r"cx and cy of \S*intrinsic_color.txt belong to another size"):
        open_scan(root, SCAN)


def test_two_images_of_one_name_are_refused(root, tmp_path):
    image = open_scan(root, SCAN).images[0]
    with pytest.raises(SceneError, match=r"same name: 0\.jpg"):
        write_posed_images(tmp_path / "posed", [image, image])
