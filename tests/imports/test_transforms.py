"""Every key of transforms.json that changes a picture's meaning is applied, refused, or reported."""

import functools
import json

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from hilsplat.base.errors import HilsplatError, SceneError
from hilsplat.scene.importers.ply_file import read_ply_points
from hilsplat.scene.importers.reading import read_source
from hilsplat.scene.layouts import find_known_poses
from tests.imports import analytic_world as world

WIDTH, HEIGHT, FX, FY, CX, CY = 112, 84, 95.0, 91.0, 58.0, 40.0
NUMBERS = {"w": WIDTH, "h": HEIGHT, "fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY}
POSES = dict(zip("abcdef", world.cameras(6), strict=True))
SQUARE = world.pinhole(FX, FX, WIDTH / 2, HEIGHT / 2)
PLAIN = world.pinhole(FX, FY, CX, CY)


@functools.cache
def shot(rays, letter):
    """A picture of one of the world's cameras; most tests need the same."""
    return world.picture(rays, WIDTH, HEIGHT, POSES[letter])


def write(folder, rays, head, letters="abcdef", frame=lambda name: {}, name="images/{}.png", stem="{}"):
    """Write pictures of cameras, and transforms.json with the given keys, per file and per frame."""
    world.save(folder / "images", {stem.format(letter): shot(rays, letter) for letter in letters})
    named = {name.format(letter): POSES[letter] for letter in letters}
    world.write_transforms(folder / "transforms.json", {"ply_file_path": "points.ply", **head}, named, frame)
    points = np.zeros(3, [(axis, "f4") for axis in "xyz"])
    PlyData([PlyElement.describe(points, "vertex")]).write(folder / "points.ply")
    return folder


def right(letters):
    return {f"{letter}.png": POSES[letter] for letter in letters}


def angle(side, focal):
    return 2 * np.arctan(side / 2 / focal)


def bent(**coefficients):
    return world.bent(world.brown(**coefficients), FX, FY, CX, CY)


def fisheye(**coefficients):
    return world.fisheye(FX, FY, CX, CY, **coefficients)


LENS = {key: value for key, value in NUMBERS.items() if key not in ("w", "h")}
SIZE = {"w": WIDTH, "h": HEIGHT}
BENT = {"k1": 0.1, "k2": -0.02, "p1": 2e-3, "p2": -1e-3}
ROUND = {"k1": 0.03, "k2": -0.01, "k3": 2e-3, "k4": -1e-3}
FORMS = {  # the lens, the keys that describe it, and the least PSNR
    "focal lengths in px": (PLAIN, NUMBERS, 45),
    "no size": (PLAIN, LENS, 45),
    "sizes as floats": (PLAIN, {"w": float(WIDTH), "h": float(HEIGHT), **LENS}, 45),
    "lens of a larger image": (SQUARE, {"width": 2 * WIDTH, "height": 2 * HEIGHT, "fl_x": 2 * FX}, 45),
    "only fl_x": (SQUARE, {**SIZE, "fl_x": FX}, 45),
    "only fl_y": (SQUARE, {**SIZE, "fl_y": FX}, 45),
    "camera_angle_x": (SQUARE, {**SIZE, "camera_angle_x": angle(WIDTH, FX)}, 45),
    "camera_angle_y": (SQUARE, {**SIZE, "camera_angle_y": angle(HEIGHT, FX)}, 45),
    "both angles": (
        world.pinhole(FX, FY, WIDTH / 2, HEIGHT / 2),
        {"camera_angle_x": angle(WIDTH, FX), "camera_angle_y": angle(HEIGHT, FY)},
        45,
    ),
    "x_fov": (SQUARE, {**SIZE, "x_fov": np.degrees(angle(WIDTH, FX))}, 45),
    "y_fov": (SQUARE, {**SIZE, "y_fov": np.degrees(angle(HEIGHT, FX))}, 45),
    "null values": (PLAIN, {**NUMBERS, "k1": None, "camera_angle_x": None, "is_fisheye": None}, 45),
    "null centre and model": (
        world.pinhole(FX, FY, WIDTH / 2, HEIGHT / 2),
        {**NUMBERS, "cx": None, "cy": None, "camera_model": None},
        45,
    ),
    "ordinary axes": (PLAIN, {**NUMBERS, "from_na": False}, 45),
    "zero distortion": (PLAIN, {**NUMBERS, "camera_model": "OPENCV", "k1": 0, "p2": 0.0}, 45),
    "PINHOLE in small letters": (PLAIN, {**NUMBERS, "camera_model": "pinhole"}, 45),
    "false flags": (PLAIN, {**NUMBERS, "is_fisheye": False, "ortho": False, "k5": 0}, 45),
    "no rolling shutter": (PLAIN, {**NUMBERS, "rolling_shutter": [0, 0, 0, 0]}, 45),
    "OPENCV": (bent(**BENT), {**NUMBERS, "camera_model": "OPENCV", **BENT}, 28),
    "SIMPLE_RADIAL": (bent(k1=0.15), {**NUMBERS, "camera_model": "SIMPLE_RADIAL", "k1": 0.15}, 28),
    "k3": (bent(k1=0.05, k3=0.2), {**NUMBERS, "k1": 0.05, "k3": 0.2}, 28),
    "OPENCV_FISHEYE": (fisheye(**ROUND), {**NUMBERS, "camera_model": "OPENCV_FISHEYE", **ROUND}, 28),
    "OPENCV_FISHEYE without coefficients": (fisheye(), {**LENS, "camera_model": "OPENCV_FISHEYE"}, 28),
    "is_fisheye": (fisheye(k1=0.03), {**LENS, "is_fisheye": True, "k1": 0.03, "k2": 0, "p1": 0}, 28),
    "is_fisheye without coefficients": (fisheye(), {**LENS, "is_fisheye": True}, 28),
}


@pytest.mark.parametrize("form", FORMS)
def test_lenses_are_read_right(form, tmp_path, imported):
    rays, head, least_psnr_db = FORMS[form]
    views, _, _, report = imported(write(tmp_path / "in", rays, head, "b"))
    world.require_right(views, right("b"), least_psnr_db)
    assert not report["warnings"]


def test_lenses_of_frames_replace_those_of_the_file(tmp_path, imported):
    """The file's focal length doesn't count if a frame states its own, with whatever key."""
    focal = {"a": 120.0, "b": 90.0, "c": 160.0}
    keys = {
        "images/a.png": {},
        "images/b.png": {"camera_angle_x": angle(WIDTH, focal["b"])},
        "images/c.png": {"x_fov": np.degrees(angle(WIDTH, focal["c"]))},
    }
    folder = write(tmp_path / "in", SQUARE, {**SIZE, "fl_x": 120.0, "fl_y": 120.0}, "abc", keys.get)
    for letter in "abc":
        lens = world.pinhole(*[focal[letter]] * 2, WIDTH / 2, HEIGHT / 2)
        world.save(folder / "images", {letter: shot(lens, letter)})
    views, *_ = imported(folder)
    world.require_right(views, right("abc"), 45)


@pytest.mark.parametrize(
    "head",
    [
        {"camera_model": "EQUIRECTANGULAR"},
        {"camera_model": "ORTHOPHOTO"},
        {"camera_model": "FISHEYE624", "distortion_params": [0.1] * 12},
        {"distortion": [0.1, 0, 0, 0]},
        {"ortho": True},
        {"k4": 0.01},
        {"k6": 0.01},
        {"is_fisheye": True, "p1": 0.01},
        {"rolling_shutter": [0, 0, 0, 1]},
        {"shift_x": 0.1},
        {"ftheta_p0": 0.5},
        {"latlong": 1},
        {"from_na": True},  # NeuS2: camera axes of OpenCV
        {"normal_mts_args": {"spp": 4}},  # Mitsuba's camera axes, in instant-ngp
        {"fl_x": "wide"},
        {"fl_x": None, "fl_y": None},
        {"fl_x": -120},
        {"w": 0},
        {"w": "144 px"},
    ],
    ids=str,
)
def test_what_cannot_be_applied_is_refused(head, tmp_path, imported):
    folder = write(tmp_path / "in", PLAIN, {**NUMBERS, **head}, "a")
    with pytest.raises(HilsplatError):
        imported(folder)


@pytest.mark.parametrize(
    ("head", "message"),
    [
        ({**SIZE, "camera_angle_x": 40.0}, "camera_angle_x is 40, not an angle in radians"),  # tan(20) > 0
        ({**SIZE, "y_fov": 400.0}, "y_fov is 400, not an angle in degrees"),
        ({**SIZE, "x_fov": 0.9}, "a focal length of 0.1 to 50 sides"),  # radians
        ({**NUMBERS, "fl_x": FX / WIDTH, "fl_y": FY / HEIGHT}, "a focal length of 0.1 to 50 sides"),
        ({**LENS, "cx": 4 * CX, "cy": 4 * CY}, "cx and cy of view .* another size of the image"),  # images_4
        ({**NUMBERS, "cx": 0.75 * WIDTH, "cy": 0.75 * HEIGHT}, "another size of the image"),  # 1080p for 720p
    ],
)
def test_numbers_of_another_unit_or_size_are_refused(head, message, tmp_path, imported):
    with pytest.raises(HilsplatError, match=message):
        imported(write(tmp_path / "in", PLAIN, head, "a"))


def test_crops_off_the_middle_are_imported_with_a_note(tmp_path, imported):
    rays = world.pinhole(FX, FY, 0.26 * WIDTH, 0.7 * HEIGHT)
    folder = write(tmp_path / "in", rays, {**NUMBERS, "cx": 0.26 * WIDTH, "cy": 0.7 * HEIGHT})
    views, _, _, report = imported(folder)
    world.require_right(views, right("abcdef"), 45)
    (note,) = report["warnings"]
    assert note.startswith("cx or cy of images/a.png and 5 others is more than 10% of a side off the middle")


def test_unknown_keys_and_contradictions_are_reported_once(tmp_path):
    head = {**NUMBERS, "exposure": 3, "aabb_scale": 16, "camera_angle_x": 0.2}
    folder = write(tmp_path, PLAIN, head, frame=lambda name: {"mask_path": f"masks/{name}"})
    notes = read_source(find_known_poses(folder)).notes
    unknown, contradiction = notes
    assert unknown == "keys of transforms.json that are not used: exposure, mask_path"
    assert contradiction == "camera_angle_x contradicts fl_x, which is used"


NAMES = [f"images/{letter}.png" for letter in POSES]


@pytest.mark.parametrize(
    ("lists", "held_out"),
    [
        ({"test_filenames": NAMES[1:3]}, "bc"),
        ({"val_filenames": NAMES[1:3]}, "bc"),
        ({"train_filenames": NAMES[2:], "test_filenames": NAMES[:2], "val_filenames": NAMES[:2]}, "ab"),
        ({"train_filenames": NAMES[:4]}, "ef"),
        ({"train_filenames": NAMES[:4], "test_filenames": NAMES[4:5]}, "ef"),  # f is in no list of training
        ({"test_filenames": ["IMAGES\\B.PNG", "./images/c"]}, "bc"),
        ({"test_filenames": []}, ""),
        ({}, ""),
    ],
)
def test_the_split_of_the_source_is_kept(lists, held_out, tmp_path):
    source = read_source(find_known_poses(write(tmp_path, PLAIN, {**NUMBERS, **lists})))
    assert "".join(view.name[7] for view in source.views if view.is_test) == held_out


def test_a_split_without_training_views_is_refused(tmp_path):
    folder = write(tmp_path, PLAIN, {**NUMBERS, "test_filenames": NAMES})
    with pytest.raises(SceneError, match=r"transforms\.json holds out all 6 views"):
        read_source(find_known_poses(folder))


def test_the_test_frames_of_scannetpp_are_held_out(tmp_path, imported):
    """They are a second list of frames, not names."""
    folder = write(tmp_path / "in", PLAIN, NUMBERS)
    changed(
        folder, lambda content: content.update(test_frames=[content["frames"].pop(row) for row in (4, 1)])
    )
    views, _, split, _ = imported(folder)
    world.require_right(views, right("abcdef"), 45)
    assert sorted(view for view, part in split.items() if part == "test") == ["b.png", "e.png"]
    changed(folder, lambda content: content.update(test_frames=["images/b.png"]))
    with pytest.raises(SceneError, match="`test_frames` is missing, or is not a list of objects"):
        read_source(find_known_poses(folder))


@pytest.mark.parametrize(
    "name",
    [
        *("./images/{}.png", "images/{}", "{}.png", "images\\{}.png", "IMAGES/{}.PNG", ".\\images\\{}"),
        *(
            "https://x.org/images/{}.png?v=1",
            "/data/x/{}.png",
            "C:\\scans\\desk\\{}.jpg",
            "../images/{}.png",
            "colmap/images/{}.jpg",
        ),
    ],
)
def test_names_of_images_are_matched(name, tmp_path, imported):
    folder = write(tmp_path / "in", PLAIN, NUMBERS, "ab", name=name)
    if name == "images/{}":  # PNG is meant, as in Blender
        world.save(folder / "images", {"a": np.zeros((HEIGHT, WIDTH), np.uint8)}, suffix=".jpg")
    views, *_ = imported(folder)
    world.require_right(views, right("ab"), 45)


@pytest.mark.parametrize(("stem", "name"), [("\u00e4{}", "a\u0308{}"), ("a\u0308{}", "\u00e4{}")])
def test_names_in_another_unicode_form_are_matched(stem, name, tmp_path):
    folder = write(tmp_path, PLAIN, NUMBERS, "ab", name=f"images/{name}.png", stem=stem)
    assert all(view.image is not None for view in read_source(find_known_poses(folder)).views)


@pytest.mark.parametrize("maps", ["masks", "masks_4", "Depth", "normals", "segmentations", "exports/a"])
def test_a_map_does_not_replace_a_missing_image(maps, tmp_path):
    folder = write(tmp_path, PLAIN, NUMBERS)
    world.save(folder / maps, {letter: np.zeros((HEIGHT, WIDTH), np.uint8) for letter in POSES})
    (folder / "images/c.png").unlink()
    images = {view.name: view.image for view in read_source(find_known_poses(folder)).views}
    assert images == {name: folder / name if name != "images/c.png" else None for name in NAMES}
    path = folder / maps / "c.png"
    named = changed(folder, lambda content: content["frames"][2].update(file_path=f"{maps}/c.png"))
    assert path in [view.image for view in read_source(find_known_poses(named)).views]


@pytest.mark.parametrize("kind", ["transforms", "llff"])
def test_without_the_photographs_their_largest_copies_are_used(kind, tmp_path, imported):
    folder = write(tmp_path / "in", SQUARE, {**SIZE, "fl_x": FX})
    if kind == "llff":
        rows = [[*pose[:3, [1, 0, 2, 3]].T, [HEIGHT, WIDTH, FX]] for pose in POSES.values()]
        rows = np.array(rows) * np.array([1, 1, -1, 1, 1])[:, None]
        rows = rows.transpose(0, 2, 1).reshape(6, 15)
        np.save(folder / "poses_bounds.npy", np.column_stack([rows, np.ones((6, 2))]))
        (folder / "transforms.json").unlink()
    (folder / "images").rename(folder / "images_4")
    for copy, factor in (("images_2", 2), ("images_8", 4)):
        lens = world.pinhole(*[FX / factor] * 2, WIDTH / 2 / factor, HEIGHT / 2 / factor)
        size = WIDTH // factor, HEIGHT // factor
        world.save(folder / copy, {name: world.picture(lens, *size, pose) for name, pose in POSES.items()})
    views, _, _, report = imported(folder)
    assert {(view.camera.width, view.camera.height) for view in views} == {(WIDTH // 2, HEIGHT // 2)}
    world.require_right(views, right("abcdef"), 40)
    assert any(f"the images in {folder}/images_2, which are smaller" in note for note in report["warnings"])


def posed(matrix):
    return lambda frame: frame.update(transform_matrix=matrix.tolist())


def at(x):
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def changed(folder, change):
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (posed(np.ones((2, 2))), "the pose is not a rotation"),
        (posed(np.diag([1.0, 1, -1, 1])), "the pose is not a rotation"),
        (posed(np.diag([1.01, 1, 1, 1])), "the pose is not a rotation"),
        (lambda frame: frame.update(transform_matrix=None), "the pose is not a rotation"),
        (lambda frame: frame["transform_matrix"][0].__setitem__(3, None), "the pose is not a rotation"),
        (lambda frame: frame["transform_matrix"][0].__setitem__(3, 1e12), "coordinates up to 1e"),
        (lambda frame: frame.pop("transform_matrix"), "'transform_matrix' is missing"),
        (lambda frame: frame.update(file_path=3), "file_path is not a text"),
        (lambda frame: frame.update(fl_x=-3), "lens of view"),
        (lambda frame: frame.update(fl_x=0), "has no focal length"),
        (lambda frame: frame.update(w=10, cx=5), "does not match the size of its camera"),
    ],
)
def test_one_frame_that_cannot_be_used_is_left_out_with_the_reason(change, reason, tmp_path, imported):
    folder = changed(write(tmp_path / "in", PLAIN, NUMBERS), lambda content: change(content["frames"][2]))
    views, _, _, report = imported(folder)
    assert [view.view for view in views] == [*right("abdef")]
    (lost,) = [entry for entry in report["views"].values() if not entry["registered"]]
    assert reason in lost["why_not"] and any(reason in warning for warning in report["warnings"])
    changed(folder, lambda content: [change(content["frames"][row]) for row in (0, 1)])
    with pytest.raises(HilsplatError, match=reason):
        imported(folder)


def test_one_damaged_image_is_left_out_even_if_it_states_the_size(tmp_path, imported):
    folder = write(tmp_path / "in", PLAIN, LENS)
    (folder / "images/c.png").write_bytes(b"no picture")
    views, _, _, report = imported(folder)
    assert [view.view for view in views] == [*right("abdef")]
    assert "c.png cannot be read" in " ".join(report["warnings"])


@pytest.mark.parametrize("name", ["../secret", "images/../../secret", "/etc/secret"])
@pytest.mark.parametrize("key", ["file_path", "ply_file_path"])
def test_files_outside_the_folder_are_refused(name, key, tmp_path):
    def change(content):
        (content["frames"][1] if key == "file_path" else content)[key] = name

    folder = changed(write(tmp_path, PLAIN, NUMBERS, "ab"), change)
    with pytest.raises(SceneError, match=f"a file outside it: {name}"):
        read_source(find_known_poses(folder))


def test_views_that_all_have_one_pose_are_refused(tmp_path):
    folder = write(tmp_path, PLAIN, NUMBERS)
    changed(folder, lambda content: [posed(np.eye(4))(frame) for frame in content["frames"]])
    with pytest.raises(SceneError, match="same pose"):
        read_source(find_known_poses(folder))
    # Cameras that only move, in coordinates of a map.
    changed(folder, lambda content: [posed(at(4e6 + row))(content["frames"][row]) for row in range(6)])
    assert len(read_source(find_known_poses(folder)).views) == 6


def test_two_frames_with_one_image_are_both_left_out(tmp_path):
    folder = changed(
        write(tmp_path, PLAIN, NUMBERS), lambda content: content["frames"][0].update(file_path="./images/b")
    )
    source = read_source(find_known_poses(folder))
    assert [view.name for view in source.views] == NAMES[2:]
    assert set(source.left_out) == {"./images/b", "images/b.png"}


@pytest.mark.parametrize("name", ["other/b.png", "b.jpg", "x/images/b", "images/sub/b"])
def test_the_image_of_a_frame_is_not_that_of_a_frame_without_one(name, tmp_path):
    folder = write(tmp_path, PLAIN, NUMBERS)
    (folder / "images/a.png").unlink()
    changed(folder, lambda content: content["frames"][0].update(file_path=name))
    images = {view.name: view.image for view in read_source(find_known_poses(folder)).views}
    assert images == {name: None} | {other: folder / other for other in NAMES[1:]}


@pytest.mark.parametrize("splits", [("train",), ("train", "test")])
def test_a_missing_picture_of_blender_is_not_replaced_by_one_of_another_set(splits, tmp_path):
    """Both sets have pictures a, b, ...; one picture for training is missing, then all of them."""
    for split in ("train", "test"):
        world.save(tmp_path / split, {letter: shot(SQUARE, letter) for letter in POSES})
        if split in splits:
            poses = {f"./{split}/{letter}": POSES[letter] for letter in POSES}
            world.write_transforms(tmp_path / f"transforms_{split}.json", {"camera_angle_x": 1.0}, poses)
    for letters in ("c", "abdef"):
        for letter in letters:
            (tmp_path / f"train/{letter}.png").unlink()
        images = {view.name: view.image for view in read_source(find_known_poses(tmp_path)).views}
        paths = {name: tmp_path / f"{name}.png" for name in images}
        assert images == {name: path if path.is_file() else None for name, path in paths.items()}
        assert len(images) == 6 * len(splits)


def cloud(folder, colours, kind, names=("red", "green", "blue"), xyz=((0, 1, 2), (3, 4, 5)), text=False):
    table = np.zeros(len(xyz), [(axis, "f8") for axis in "xyz"] + [(name, kind) for name in names])
    for axis, column in zip("xyz", np.array(xyz).T, strict=True):
        table[axis] = column
    for name, column in zip(names, np.array(colours).T, strict=True):
        table[name] = column
    PlyData([PlyElement.describe(table, "vertex")], text=text).write(folder / "cloud.ply")
    return folder / "cloud.ply"


@pytest.mark.parametrize(
    ("colours", "kind", "expected"),
    [
        ([[0, 102, 255], [1, 2, 3]], "u1", [[0, 102, 255], [1, 2, 3]]),
        ([[0, 0.4, 1], [0.1, 0.2, 0.31]], "f4", [[0, 102, 255], [26, 51, 79]]),
        ([[0, 0.4, 1], [0.1, 0.2, np.nan]], "f8", [[0, 102, 255], [26, 51, 128]]),
        ([[0, 0.4, 1.001], [0.1, 0.2, 0.31]], "f4", [[0, 102, 255], [26, 51, 79]]),
        ([[0, 102, 255], [1, 2, 3]], "f4", [[0, 102, 255], [1, 2, 3]]),
        ([[0, 26214, 65535], [257, 514, 771]], "u2", [[0, 102, 255], [1, 2, 3]]),
        ([[0, 102, 255], [1, 2, 3]], "u2", [[0, 102, 255], [1, 2, 3]]),
        ([[0, 102, 255], [1, 2, 3]], "i4", [[0, 102, 255], [1, 2, 3]]),
    ],
)
@pytest.mark.parametrize(
    "names", [("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue")]
)
def test_colours_of_points_become_bytes(colours, kind, expected, names, tmp_path):
    xyz, rgb = read_ply_points(cloud(tmp_path, colours, kind, names))
    assert rgb.tolist() == expected and xyz.tolist() == [[0, 1, 2], [3, 4, 5]]


def test_points_that_are_not_finite_are_dropped_with_a_note(tmp_path):
    folder = write(tmp_path, PLAIN, {**NUMBERS, "ply_file_path": "cloud.ply"})
    cloud(folder, [[1, 2, 3]] * 4, "u1", xyz=((0, 1, 2), (np.nan, 0, 0), (0, np.inf, 0), (3, 4, 5)))
    source = read_source(find_known_poses(folder))
    assert source.points[0].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert source.notes == ["2 of 4 points are not finite and are left out"]


@pytest.mark.parametrize(
    "content", [None, b"", b"ply\nformat ascii 1.0\n", b"ply\r\nelement vertex 1e9\n", b"\0" * 99]
)
def test_missing_and_damaged_points_are_refused_by_name(content, tmp_path):
    folder = write(tmp_path, PLAIN, NUMBERS, "ab")
    (folder / "points.ply").unlink()
    if content is not None:
        (folder / "points.ply").write_bytes(content)
    with pytest.raises(SceneError, match=r"points\.ply, with the points, cannot be read"):
        read_source(find_known_poses(folder))


def test_a_header_without_an_end_is_not_searched_for_it(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"ply\ncomment " + bytes(2**21))
    with pytest.raises(SceneError, match="not a PLY file with a header of at most 1048576 bytes"):
        read_ply_points(tmp_path / "a.ply")


def test_blender_s_second_file_is_the_test_set_and_the_third_replaces_it(tmp_path, imported):
    for split, letters in (("train", "abcd"), ("val", "e"), ("test", "f")):
        write(tmp_path / "in", SQUARE, {"camera_angle_x": angle(WIDTH, FX)}, letters)
        (tmp_path / "in/transforms.json").rename(tmp_path / f"in/transforms_{split}.json")
    for letter in "fe":
        _, _, split, _ = imported(tmp_path / "in")
        assert [view for view, part in split.items() if part == "test"] == [f"{letter}.png"]
        (tmp_path / "in/transforms_test.json").unlink(missing_ok=True)


@pytest.mark.parametrize("letters", ["abcdef", "bd"])
def test_views_of_the_first_file_that_the_test_file_repeats_are_training_views(letters, tmp_path, imported):
    """3DGS requires a test file, so people copy the one for training."""
    for split, listed in (("train", "abcdef"), ("test", letters)):
        write(tmp_path / "in", SQUARE, {"camera_angle_x": angle(WIDTH, FX)}, listed)
        (tmp_path / "in/transforms.json").rename(tmp_path / f"in/transforms_{split}.json")
    views, _, split, report = imported(tmp_path / "in")
    world.require_right(views, right("abcdef"), 45)
    assert set(split.values()) == {"train"}
    assert report["warnings"] == [f"{len(letters)} of the views listed are repetitions, which are dropped"]
