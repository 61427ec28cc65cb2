"""COLMAP models as COLMAP and other programs write them."""

import numpy as np
import pycolmap
import pytest
from plyfile import PlyData, PlyElement

from hilsplat.base.errors import HilsplatError
from hilsplat.scene.importers.colmap_model import read_model
from hilsplat.scene.importers.reading import read_source
from hilsplat.scene.layouts import find_known_poses, photo_files
from tests.imports import analytic_world as world

WIDTH, HEIGHT, LENS = 96, 72, "PINHOLE 80 78 47 37"
RAYS = world.pinhole(80, 78, 47, 37)
POSES = world.cameras(6)
PICTURES = [world.picture(RAYS, WIDTH, HEIGHT, pose) for pose in POSES]
POINTS = [(0.5 * row, -0.25, 0.125, 10 * row, 20, 30) for row in range(8)]


def write(folder, name="{:03d}.png", model="sparse/0", count=6):
    """Pictures and the model of the first `count` of them."""
    names = [name.format(number) for number in range(len(POSES))]
    world.save(folder / "images", dict(zip(names, PICTURES, strict=True)), suffix="")
    images = dict(zip(names[:count], POSES, strict=False))
    world.write_colmap(folder / model, LENS, (WIDTH, HEIGHT), images, POINTS)
    return folder


def edit(folder, file, change):
    path = folder / "sparse/0" / file
    path.write_bytes(change(path.read_bytes()))


def without_blank_lines(text):
    return b"\n".join(line for line in text.split(b"\n") if line) + b"\n"


def with_observations(text):
    """Give the first image two observations, of point 3 and of a point that is missing, and a feature."""
    lines = text.split(b"\n")
    lines[1] = b"10.5 20.25 3 1.5 2.5 -1 30.0 40.0 99999"
    return b"\n".join(lines)


FORMS = {
    "as written": [],
    "without blank lines": [("images.txt", without_blank_lines)],
    "some blank lines missing": [("images.txt", lambda text: text.replace(b"\n\n", b"\n", 2))],
    "no newline at the end": [("images.txt", lambda text: text.rstrip(b"\n"))],
    "newlines of Windows": [
        (file, lambda text: text.replace(b"\n", b"\r\n"))
        for file in ("cameras.txt", "images.txt", "points3D.txt")
    ],
    "byte order mark": [("images.txt", lambda text: b"\xef\xbb\xbf" + text)],
    "comments": [("images.txt", lambda text: b"# Image list\n#   POINTS2D[]\n" + text)],
    "tabs and several spaces": [("cameras.txt", lambda text: text.replace(b" ", b" \t "))],
    "spaces at line ends": [("images.txt", lambda text: text.replace(b"png\n", b"png  \n"))],
    "a point that is missing": [("images.txt", with_observations)],
    "numbers with exponents": [("cameras.txt", lambda text: text.replace(b" 80 ", b" 8.0E+01 "))],
}


@pytest.mark.parametrize("form", FORMS)
def test_text_models_are_read(form, tmp_path):
    folder = write(tmp_path)
    for file, change in FORMS[form]:
        edit(folder, file, change)
    source = read_source(find_known_poses(folder))
    assert [view.image.name for view in source.views] == [f"{number:03d}.png" for number in range(6)]
    for view, pose in zip(source.views, POSES, strict=True):
        np.testing.assert_allclose(view.cam_from_source, np.linalg.inv(pose), atol=1e-9)
        assert view.camera.params.tolist() == [80, 78, 47, 37]
    xyz, rgb = source.points
    np.testing.assert_allclose(xyz, [point[:3] for point in POINTS])
    assert rgb.tolist() == [list(point[3:]) for point in POINTS]


@pytest.mark.parametrize(
    "name",
    [
        *("my photo ({}) ä#%.png", "IMG {}.PNG", "{}.png", "cam 1/{}.png", "DSC_{}.JPG.png", "[{}] a+b.png"),
        *("ein Bild mit 3 4 5 {}.png", "-1 {}.png"),
    ],
)
@pytest.mark.parametrize("form", ["text", "binary"])
def test_names_with_spaces_and_signs_are_read(name, form, tmp_path):
    folder = write(tmp_path, name)
    if form == "binary":
        rewrite_as_binary(folder / "sparse/0", name)
    views = {view.image: view for view in read_source(find_known_poses(folder)).views}
    for number, pose in enumerate(POSES):
        view = views.pop(folder / "images" / name.format(number))
        np.testing.assert_allclose(view.cam_from_source, np.linalg.inv(pose), atol=1e-9)
    assert not views


def rewrite_as_binary(folder, name="{}"):
    """Rewrite a text model; images may get names with spaces, at which pycolmap's reader ends names."""
    model = pycolmap.Reconstruction(folder)
    for number, image in model.images.items():
        image.name = image.name if name == "{}" else name.format(number - 1)
    for path in folder.glob("*.txt"):
        path.unlink()
    model.write_binary(folder)


@pytest.mark.parametrize("write_model", ["write_text", "write_binary"])
def test_models_with_observations_are_read_as_by_pycolmap(write_model, tmp_path):
    """Lenses of all models, observations and tracks, in a model made by COLMAP's own synthesiser."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 2, 3
    options.num_points3D = 40
    model = pycolmap.synthesize_dataset(options)
    getattr(model, write_model)(tmp_path)
    read, again = read_model(tmp_path), pycolmap.Reconstruction(tmp_path)
    assert len(read.images) == again.num_reg_images() == 12
    for image in read.images:
        (theirs,) = [other for other in again.images.values() if other.name == image.name]
        np.testing.assert_allclose(image.cam_from_world[:3], theirs.cam_from_world().matrix(), atol=1e-12)
        lens, camera = read.lenses[image.camera_id], theirs.camera
        assert (lens.model, lens.size_hw) == (camera.model_name, (camera.height, camera.width))
        np.testing.assert_array_equal(lens.params, camera.params)
        seen = theirs.get_observation_points2D()
        np.testing.assert_array_equal(image.seen[0], [point.xy for point in seen])
        assert image.seen[1].tolist() == [point.point3D_id for point in seen]
    ids, xyz, _ = read.points
    assert ids.tolist() == sorted(again.points3D)
    np.testing.assert_array_equal(xyz, [again.points3D[point_id].xyz for point_id in ids])


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("cameras.txt", lambda text: text.replace(b"80 78", b"80,0 78"), r"cameras\.txt, line 1, cannot be"),
        ("cameras.txt", lambda text: text.replace(b" 37", b""), r"cameras\.txt, line 1"),
        ("cameras.txt", lambda text: text.replace(b"PINHOLE", b"PINHOLLE"), r"cameras\.txt, line 1"),
        ("cameras.txt", lambda text: b"\n\n" + text[:9], r"cameras\.txt, line 3"),
        ("images.txt", lambda text: text.replace(b" 1 002.png", b" one 002.png"), r"images\.txt, line 5"),
        ("images.txt", lambda text: b"1 2 3\n" + text, r"images\.txt, line 1"),
        ("points3D.txt", lambda text: text.replace(b"3 1.0", b"3 x"), r"points3D\.txt, line 3"),
        ("points3D.txt", lambda text: text + b"9 1 2 3\n", r"points3D\.txt, line 9"),
        ("points3D.txt", lambda text: 400 * b"9" + text, r"points3D\.txt, line 1"),
        ("cameras.txt", lambda text: b"2" + text[1:], "has camera 1, which the model lacks"),
        ("cameras.txt", lambda text: text.replace(b"80 78", b".83 1.1"), "a focal length of 0.1 to 50 sides"),
        ("images.txt", lambda text: b"", "0 of 0 views of"),
    ],
)
def test_unreadable_lines_are_named(file, change, message, tmp_path, imported):
    folder = write(tmp_path / "in")
    edit(folder, file, change)
    with pytest.raises(HilsplatError, match=message):
        imported(folder)


@pytest.mark.parametrize("change", [b"0 0 0 0", b"nan 0 0 1", b"0.5 0.5 0.5 0.9"])
def test_one_quaternion_that_is_not_a_rotation_leaves_out_its_view(change, tmp_path):
    folder = write(tmp_path)

    def changed(text):
        lines = text.split(b"\n")
        cells = lines[4].split(b" ")
        lines[4] = b" ".join([cells[0], change, *cells[5:]])
        return b"\n".join(lines)

    edit(folder, "images.txt", changed)
    source = read_source(find_known_poses(folder))
    assert [view.name for view in source.views] == [f"{number:03d}.png" for number in (0, 1, 3, 4, 5)]
    assert "a quaternion of length 1" in source.left_out["002.png"]


@pytest.mark.parametrize(
    ("models", "chosen"),
    [
        ({"sparse/0": 3, "sparse/1": 6}, "sparse/1"),
        ({"sparse/0": 4, "sparse/1": 3, "sparse/2": 5}, "sparse/2"),
        ({"sparse/0": 6, "sparse/1": 6}, "sparse/0"),
        ({"sparse": 6, "sparse/0": 3}, "sparse"),
        ({"sparse/model": 6}, "sparse/model"),
        ({".": 6}, "."),
        ({"sparse/0": 6, ".": 3}, "sparse/0"),
    ],
)
@pytest.mark.parametrize("form", ["text", "binary"])
def test_the_model_with_the_most_images_is_taken_and_others_are_named(models, chosen, form, tmp_path):
    for model, count in models.items():
        write(tmp_path, model=model, count=count)
        if form == "binary":
            rewrite_as_binary(tmp_path / model)
    known = find_known_poses(tmp_path)
    assert known.files == (tmp_path / chosen,)
    assert chosen == "." or find_known_poses(tmp_path, tmp_path / "sparse").files == known.files
    source = read_source(known)
    assert len(source.views) == max(models.values())
    assert {note.partition(" also has poses")[0] for note in source.notes} == {
        str(tmp_path / model) for model in models if model != chosen
    }


def test_other_kinds_of_poses_in_the_folder_are_named(tmp_path):
    folder = write(tmp_path)
    (folder / "transforms.json").write_text("{}")
    np.save(folder / "poses_bounds.npy", np.zeros((6, 17)))
    notes = " ".join(read_source(find_known_poses(folder)).notes)
    assert "transforms.json also has poses" in notes and "poses_bounds.npy also has poses" in notes


@pytest.mark.parametrize(
    ("size", "is_noted"),
    [
        ((960, 720), False),
        ((480, 360), False),  # a scaled copy
        ((641, 481), False),
        ((1921, 1440), False),  # rounded
        ((720, 960), False),  # turned
        ((900, 676), True),  # undistorted by COLMAP, with a pincushion lens
        ((961, 720), True),  # with a weak barrel lens
        ((480, 363), True),  # stretched
    ],
)
def test_images_of_nearly_the_camera_s_size_or_stretched_are_noted(size, is_noted, tmp_path):
    world.save(tmp_path / "images", {"000": np.zeros((720, 960, 3), np.uint8)})
    lens = f"PINHOLE {size[0]} {size[0]} {size[0] / 2} {size[1] / 2}"
    world.write_colmap(tmp_path / "sparse/0", lens, size, {"000.png": POSES[0]}, POINTS)
    notes = read_source(find_known_poses(tmp_path)).notes
    assert len(notes) == is_noted
    assert all(note.startswith("1 images, such as 000.png (") for note in notes)
    assert all("are they the images that the poses were computed from?" in note for note in notes)


def test_a_model_without_points_or_without_their_file_has_none(tmp_path):
    folder = write(tmp_path / "in")
    world.write_colmap(folder / "sparse/0", LENS, (WIDTH, HEIGHT), {"000.png": POSES[0]}, [])
    assert read_source(find_known_poses(folder)).points is None
    (folder / "sparse/0/points3D.txt").unlink()
    assert read_source(find_known_poses(folder)).points is None


@pytest.mark.parametrize("is_alone", [True, False])
def test_points_in_a_ply_beside_the_model_are_read_if_it_has_no_others(is_alone, tmp_path):
    folder = write(tmp_path)
    cloud = np.zeros(
        1, [(name, "f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    )
    PlyData([PlyElement.describe(cloud, "vertex")]).write(folder / "sparse/0/points3D.ply")
    if is_alone:
        (folder / "sparse/0/points3D.txt").unlink()
    assert len(read_source(find_known_poses(folder)).points[0]) == (1 if is_alone else len(POINTS))
    assert (folder / "sparse/0/points3D.ply" in photo_files(folder)) == is_alone


def test_colours_from_0_to_1_become_bytes(tmp_path):
    folder = write(tmp_path)
    points = [(0, 0, 0, 0.4, 1, 0)]
    world.write_colmap(folder / "sparse/0", LENS, (WIDTH, HEIGHT), {"000.png": POSES[0]}, points)
    assert read_source(find_known_poses(folder)).points[1].tolist() == [[102, 255, 0]]


def test_rigs_whose_cameras_share_file_names_keep_every_view(tmp_path, imported):
    """COLMAP's rigs: rig0/0000.png, rig1/0000.png, ..."""
    views, *_ = imported(write(tmp_path / "in", "rig{}/0000.png"))
    world.require_right(views, {f"rig{number}_0000.png": pose for number, pose in enumerate(POSES)}, 45)


RIG = {f"cam{1 + number // 3}/{number % 3}.png": number for number in range(6)}
FLAT = {f"{number}.png": number for number in range(6)}
MAPS = {f"depth {number}": f"scan/depth/{number}.png" for number in range(6)}


@pytest.mark.parametrize(
    ("names", "moved", "missing"),
    [
        # The picture of the same name in another camera's folder has no pose, or one of its own.
        ([*RIG][1:], {"cam2/0.png": "images/cam1/0.png", "cam1/0.png": None}, {"cam2/0.png"}),
        ([*RIG], {"cam2/0.png": None}, {"cam2/0.png"}),
        ([*RIG], dict.fromkeys([*RIG][3:]), {*[*RIG][3:]}),
        ([*RIG][3:], dict.fromkeys([*RIG][3:]), {*[*RIG][3:]}),
        # The same names in another form, with other folders above, or without any.
        ([*RIG], {"cam2/0.png": "images/CAM2/0.PNG"}, set()),
        ([*RIG], {name: f"photos/rig/{name}" for name in RIG}, set()),
        ([*RIG][3:], {name: f"images/{name[5:]}" for name in [*RIG][3:]} | {"cam1/0.png": None}, set()),
        # The `convert.py` of 3DGS keeps distorted photographs in `input/`.
        ([*FLAT], {"2.png": "input/2.png"}, {"2.png"}),
        ([*FLAT], {"2.png": "images/2.JPEG", "3.png": "images/3.PNG"}, set()),
        ([*FLAT], {name: f"input/{name}" for name in FLAT}, set()),
        ([*FLAT], {name: f"DCIM/10{name[0]}/{name}" for name in FLAT}, set()),
        # Maps beside the photographs are not meant.
        ([*FLAT], {name: f"scan/color/{name}" for name in FLAT} | MAPS, set()),
    ],
)
def test_a_missing_picture_is_not_replaced_by_one_in_another_folder(names, moved, missing, tmp_path):
    """`moved` maps pictures to other files than `images/<name>`, or to None if they are deleted."""
    pictures = FLAT if names[-1] in FLAT else RIG
    files = {name: moved.get(name, f"images/{name}") for name in pictures}
    shown = {file: PICTURES[pictures[name]] for name, file in files.items() if file}
    maps = {file: PICTURES[0] for name, file in moved.items() if name in MAPS}
    world.save(tmp_path, shown | maps, suffix="")
    poses = dict(zip(names, POSES, strict=False))
    world.write_colmap(tmp_path / "sparse/0", LENS, (WIDTH, HEIGHT), poses, POINTS)
    views = {view.name: view.image for view in read_source(find_known_poses(tmp_path)).views}
    expected = {name: None if name in missing else tmp_path / files[name] for name in poses}
    assert views == expected


def test_the_test_views_that_3dgs_lists_are_held_out(tmp_path, imported):
    folder = write(tmp_path / "in")
    listed = folder / "sparse/0/test.txt"
    listed.write_text("\ufeff004.png\r\nimages\\001.JPG\r\n009.png\r\n\r\n", encoding="utf-8")
    *_, split, report = imported(folder)
    assert [view for view, part in split.items() if part == "test"] == ["001.png", "004.png"]
    assert report["warnings"] == ["1 names in test.txt belong to no view"]
    assert listed in photo_files(folder)
    listed.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(HilsplatError, match=r"test\.txt cannot be read(.|\n)*the name of a test view"):
        imported(folder)
