"""The scene sheet: errors name the cell and the fix; new scenes are appended."""

import json
import os
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.errors import ArtifactError, SceneError, SettingsError
from hilsplat.photos.check import inspect_photos
from hilsplat.scene.layouts import NO_POSES
from hilsplat.scene.sheet import choose_scenes, read_sheet
from hilsplat.workflow.new_scene import add_scene
from hilsplat.workflow.scene_data import SceneData
from tests.imports.test_new import PICTURES, gaussians, label_file, langsplat_files, model, photographs
from tests.unit.scene.test_poses import write_noise

COLUMNS = ("dataset", "scene", "group", "source", "unit", "gaussians", "features", "poses")
WORLD = ("world", "a", "ci", "world:tabletop:1", "metre")
DESK = ("photos", "desk", "photos", "desk", "arbitrary")


def write_sheet(folder, *rows, columns=COLUMNS[:5]):
    sheet = folder / "config" / "scenes.tsv"
    sheet.parent.mkdir(exist_ok=True)
    sheet.write_text("".join("\t".join(row) + "\n" for row in (columns, *rows)), encoding="utf-8")
    return sheet


def test_named_scenes_are_chosen_alone_and_from_any_group(tmp_path):
    places = ("a one benchmark", "a two benchmark", "a three development", "b two development")
    rows = read_sheet(
        write_sheet(tmp_path, *((*place.split(), "world:tabletop:201", "metre") for place in places))
    )

    def chosen(*only):
        return [row.name for row in choose_scenes(rows, ["benchmark"], only)]

    assert chosen() == ["a/one", "a/two"]
    assert chosen("two") == ["a/two"]  # in the groups
    assert chosen("b/two") == ["b/two"]
    assert chosen("three", "a/one") == ["a/one", "a/three"]
    assert chosen("a/*") == chosen("a") == ["a/one", "a/two"]  # in the groups
    assert chosen("b/*", "t[h]ree") == ["a/three", "b/two"]
    with pytest.raises(SceneError, match=r"no scene is named 'tow'(.|\n)*did you mean 'a/two'"):
        chosen("tow")


@pytest.mark.parametrize(
    ("column", "cell", "problem"),
    [
        ("scene", "", "it is empty"),
        ("scene", "a..b", r'it contains "\.\."'),
        ("scene", ".desk", "it begins with '.'"),
        ("scene", "tür{1}", "it contains '{', '}', 'ü'"),
        ("scene", "x" * 101, "longer than 100"),
        ("group", "benchmrk", r"'benchmrk' is unknown(.|\n)*did you mean 'benchmark'"),
        ("unit", "cm", "'cm' is unknown"),
        ("source", "world:tabletop", "does not name a generated scene"),
        ("source", "gone", "gone is missing"),
        ("source", "", "it is empty"),
        ("source", "phone", r"has no images(.|\n)*1 files \(\.dng"),
        ("gaussians", "gone.ply", "is missing"),
        ("gaussians", "desk", "is a folder"),
        ("gaussians", "notes.txt", "is not a PLY: it begins with b'hell'"),
        ("gaussians", "data:theirs.ply", "data_root, which is not set"),
        ("features", "desk", "contains no LangSplat masks"),
        ("poses", "gone", "gone is missing"),
    ],
)
def test_a_bad_cell_is_refused_with_line_and_column(tmp_path, column, cell, problem):
    write_noise(tmp_path / "desk", 3)
    (tmp_path / "phone").mkdir()
    (tmp_path / "phone/a.DNG").write_bytes(b"x")
    (tmp_path / "notes.txt").write_text("hello")
    cells = dict(zip(COLUMNS, (*DESK, "-", "-", "-"), strict=True)) | {column: cell}
    sheet = write_sheet(tmp_path, tuple(cells.values()), columns=COLUMNS)
    with pytest.raises(SceneError, match=rf"scenes\.tsv, line 2, column {column}: (.|\n)*{problem}"):
        read_sheet(sheet)
    if column == "scene":
        with pytest.raises(SceneError, match=problem):
            add_scene(sheet, cell, tmp_path)
    elif column in ("gaussians", "features", "poses") or cell in ("gone", "phone"):
        assert len(read_sheet(sheet, ("ci/other",))) == 1  # it is not run


@pytest.mark.parametrize(
    ("rows", "columns", "message"),
    [
        ((WORLD, ("world", "A", *WORLD[2:])), COLUMNS[:5], "line 3, .*world/A is listed twice.*line 2"),
        ((), (*COLUMNS[:4], "units"), "line 1.*missing: 'unit'; unknown: 'units'"),
        ((WORLD[:4],), COLUMNS[:5], "wrong number of columns"),
    ],
)
def test_repeated_names_and_wrong_columns_are_refused(tmp_path, rows, columns, message):
    with pytest.raises(SceneError, match=f"(?s){message}"):
        read_sheet(write_sheet(tmp_path, *rows, columns=columns))


def test_comments_are_skipped_optional_columns_may_be_missing_and_paths_start_at_the_project(tmp_path):
    write_noise(tmp_path / "desk", 3)
    (tmp_path / "theirs.ply").write_bytes(b"ply\nformat ...")
    cells = [("theirs.ply", "-"), ("-", ""), ("", ""), ()]
    rows = [("photos", f"desk{row}", *DESK[2:], *more) for row, more in enumerate(cells)]
    world, *found = read_sheet(write_sheet(tmp_path, ("# a comment",), WORLD, *rows, columns=COLUMNS[:7]))
    assert (world.name, world.generated, world.folder) == ("world/a", ("world", "tabletop", 1), None)
    assert {row.folder for row in found} == {tmp_path / "desk"}
    assert [row.gaussians for row in found] == [tmp_path / "theirs.ply", None, None, None]
    assert {row.features for row in found} == {None}


def test_data_sources_are_below_the_data_root(tmp_path, monkeypatch):
    """A relative data root starts from the working folder, as it does where the workflow looks for scenes."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    (tmp_path / "data/theirs.ply").write_bytes(b"ply\n")
    row = ("lerf", "figurines", "lerf", "data:lerf_ovs/figurines", "arbitrary", "data:theirs.ply")
    (tmp_path / "installed").mkdir()
    sheet = write_sheet(tmp_path / "installed", row, columns=COLUMNS[:6])
    (found,) = read_sheet(sheet)  # the workflow skips it
    assert (found.folder, found.gaussians) == (None, None)
    (found,) = read_sheet(sheet, data_root="data")  # the workflow deals with missing ones
    assert found.folder == tmp_path / "data/lerf_ovs/figurines"
    assert found.gaussians == tmp_path / "data/theirs.ply"


# ---- new scenes -----------------------------------------------------------------------------------


def write_features(folder: Path, names: Iterable[str] = "012") -> None:
    for name in names:
        langsplat_files(folder, name)


def langsplat_scene(folder: Path) -> Path:
    """Photographs, and beside them what COLMAP, 3DGS and LangSplat write."""
    photographs(folder / "images")
    model(folder)
    for steps in (7000, 30000):
        gaussians(folder / f"output/a/point_cloud/iteration_{steps}/point_cloud.ply", 1)
    (folder / "output/a/chkpnt30000.pth").touch()
    write_features(folder / "language_features", PICTURES)
    label_file(folder / "label/000.json", [])
    return folder


@pytest.mark.parametrize("parent", ["", "output/"])
@pytest.mark.parametrize(
    ("written", "expected", "shared"),
    [
        ({"case": 30000}, "case", False),  # LangSplat's process.sh
        ({"case": 30000, "case_1": 30000, "case_2": 30000, "case_3": 30000}, "case", False),
        ({"case_1": 30000, "case_2": 30000, "case_3": 30000}, "case_1", True),
        ({"case": 7000, "case_1": 30000, "case_2": 30000, "case_3": 30000}, "case_1", True),
        ({"room_1": 7000, "room_2": 30000}, "room_2", False),  # other models with such names
    ],
)
def test_gaussians_written_by_langsplat_s_script_are_found(tmp_path, parent, written, expected, shared):
    folder = langsplat_scene(tmp_path / "theirs")
    shutil.rmtree(folder / "output")
    for case, steps in written.items():
        gaussians(folder / f"{parent}{case}/point_cloud/iteration_{steps}/point_cloud.ply", 1)
    sheet = write_sheet(tmp_path)
    report = str(add_scene(sheet, "desk", folder))
    (row,) = read_sheet(sheet)
    steps = written[expected]
    assert row.gaussians == folder / f"{parent}{expected}/point_cloud/iteration_{steps}/point_cloud.ply"
    assert ("three levels of LangSplat share their geometry" in report) == shared


def test_found_files_can_be_ignored_or_replaced(tmp_path):
    folder, none = langsplat_scene(tmp_path / "theirs"), Path("none")
    gaussians(tmp_path / "other.ply", 1)
    sheet = write_sheet(tmp_path)
    add_scene(sheet, "plain", folder, gaussians=none, features=none, labels=none)
    assert not (tmp_path / "annotated").exists()
    add_scene(sheet, "mixed", folder, gaussians=tmp_path / "other.ply", features=none)
    plain, mixed = read_sheet(sheet)
    assert (plain.gaussians, plain.features, plain.poses) == (None, None, None)
    assert (mixed.gaussians, mixed.features, mixed.poses) == (tmp_path / "other.ply", None, None)
    with pytest.raises(SceneError, match="--features gone is missing"):
        add_scene(sheet, "lost", folder, features=Path("gone"))


def test_poses_can_be_ignored_or_named_and_gaussians_need_known_poses(tmp_path):
    folder, other = langsplat_scene(tmp_path / "theirs"), langsplat_scene(tmp_path / "other")
    sheet = write_sheet(tmp_path)
    assert "poses: structure from motion" in str(add_scene(sheet, "own", folder, poses=Path("none")))
    report = str(add_scene(sheet, "named", folder, poses=other / "sparse/0"))
    assert f"poses: {other / 'sparse/0'}" in report
    shutil.rmtree(folder / "sparse")
    add_scene(sheet, "unposed", folder)
    own, named, unposed = read_sheet(sheet)
    assert (own.poses, own.gaussians) == (NO_POSES, None)  # Gaussians are in the coordinates of those poses
    assert named.poses == other / "sparse/0" and named.gaussians is not None
    assert (unposed.poses, unposed.gaussians) == (None, None)


def test_nerfstudios_export_is_found_with_the_record_of_its_coordinates(tmp_path):
    folder = tmp_path / "theirs"
    write_noise(folder / "images", 3)
    runs = [f"outputs/desk/splatfacto/2026-0{month}-01/dataparser_transforms.json" for month in (2, 1)]
    gaussians(folder / "exports/splat/splat.ply", 1)
    for run in runs:
        (folder / run).parent.mkdir(parents=True)
        (folder / run).write_text(json.dumps({"transform": np.eye(4).tolist(), "scale": 1}))
    frames = [{"file_path": "images/0.png", "transform_matrix": np.eye(4).tolist()}]
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 50, "frames": frames}))
    sheet = write_sheet(tmp_path)
    report = str(add_scene(sheet, "desk", folder))
    latest = folder / runs[0]
    assert f"nerfstudio's, from {latest}" in report
    (row,) = read_sheet(sheet)
    data = SceneData([row], "", str)
    assert data.gaussians_files(row) == [str(row.gaussians), str(latest), str(folder / "transforms.json")]
    assert data.gaussians("dataparser")(row) == [str(latest)]


def test_inspection_finds_damaged_turned_and_copied_photographs(tmp_path):
    folder = write_noise(tmp_path / "images", 3, (30, 40), ".jpg")
    exif = Image.Exif()
    exif[0x0112] = 6  # a quarter turn: 40 x 30 is shown as 30 x 40
    Image.open(folder / "0.jpg").save(folder / "turned.jpg", exif=exif)
    shutil.copy(folder / "1.jpg", folder / "copy.jpg")
    (folder / "empty.jpg").touch()
    whole = (folder / "2.jpg").read_bytes()
    (folder / "truncated.jpg").write_bytes(whole[: len(whole) // 2])
    (folder / "text.png").write_text("no image")
    for name in ("raw.nef", "raw.RW2"):
        (folder / name).write_bytes(b"x")

    report = inspect_photos(tmp_path)  # the folder above images/ works too
    assert report.folder == folder
    assert report.sizes == {(30, 40): 4, (40, 30): 1}  # height, width
    assert (report.num_readable, report.num_rotated) == (5, 1)
    assert report.duplicates == (("1.jpg", "copy.jpg"),)
    unreadable = dict(report.unreadable)
    assert list(unreadable) == ["empty.jpg", "text.png", "truncated.jpg"]
    assert unreadable["empty.jpg"] == "cannot identify image file 'empty.jpg' (0 bytes)"
    assert "truncated" in unreadable["truncated.jpg"]
    assert report.passed_over == {".nef": 1, ".rw2": 1}
    assert "5 photographs in" in str(report) and "4  of 40 x 30 px" in str(report)
    assert "1  are copies of others and are left out: 1.jpg = copy.jpg" in str(report)
    assert "1  are copies of others: 1.jpg" in str(replace(report, have_poses=True))  # all are used
    many = str(replace(report, duplicates=(("a.jpg", "b.jpg", "c.jpg"),) * 8))
    assert "16  are copies of others" in many and many.count("a.jpg = b.jpg = c.jpg") == 5


@pytest.mark.parametrize(("columns", "more"), [(5, ""), (6, "\t-")])
def test_adding_a_scene_appends_one_row_with_a_relative_source(tmp_path, columns, more):
    sheet = write_sheet(tmp_path, WORLD, columns=COLUMNS[:columns])
    before = sheet.read_text().rstrip("\n")
    sheet.write_text(before)  # an editor may have dropped the last newline
    report = add_scene(sheet, "desk", write_noise(tmp_path / "desk photos", 3))
    assert report.num_readable == 3
    assert sheet.read_text() == f"{before}\nphotos\tdesk\tphotos\tdesk photos\tarbitrary{more}\n"
    assert [row.name for row in read_sheet(sheet)] == ["world/a", "photos/desk"]
    with pytest.raises(SceneError, match="photos/desk is already in"):
        add_scene(sheet, "Desk", tmp_path / "desk photos")


@pytest.mark.parametrize("name", [" desk", "~desk", "data:desk", "world:desk", "world:tabletop:1", "-"])
def test_the_added_row_names_the_given_folders(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    folder, sheet = write_noise(tmp_path / name, 3), write_sheet(tmp_path, WORLD)
    write_features(tmp_path / "masks" / name)
    add_scene(sheet, "first", Path(name), features=Path("masks", name))
    add_scene(sheet, "second", folder)
    _, *rows = read_sheet(sheet)
    assert [(row.folder, row.features) for row in rows] == [
        (folder, tmp_path / "masks" / name),
        (folder, None),
    ]


@pytest.mark.parametrize("path", ["desk ", "desk\t2", "desk\x1b[2J", "desk\r"])
def test_a_path_that_the_sheet_cannot_hold_is_refused(tmp_path, path):
    """The reader strips cells: the photographs of the folder "desk" would be used for "desk "."""
    write_noise(tmp_path / "desk", 3)
    write_features(tmp_path / path)
    sheet = write_sheet(tmp_path, WORLD)
    before = sheet.read_bytes()
    for photos, features in ((write_noise(tmp_path / path, 3), None), (tmp_path / "desk", tmp_path / path)):
        with pytest.raises(SceneError, match="cannot be written to the scene sheet"):
            add_scene(sheet, "new", photos, features=features)
    assert sheet.read_bytes() == before


@pytest.mark.parametrize("dry_run", [True, False])
def test_files_that_a_run_would_refuse_are_refused_before(tmp_path, dry_run):
    sheet = write_sheet(tmp_path, WORLD)
    before = sheet.read_bytes()
    with pytest.raises(SettingsError, match=r"photos/new: its name contains braces"):
        add_scene(sheet, "new", write_noise(tmp_path / "desk {1}", 3), dry_run=dry_run)
    folder = write_noise(tmp_path / "desk", 3)
    os.utime(folder / "1.png", (2**32, 2**32))
    with pytest.raises(ArtifactError, match=r"1\.png has a modification time in the future"):
        add_scene(sheet, "new", folder, dry_run=dry_run)
    assert sheet.read_bytes() == before


def test_labels_of_the_future_are_copied_with_the_present_time(tmp_path):
    folder, sheet = photographs(tmp_path / "desk"), write_sheet(tmp_path)
    label_file(folder / "label/000.json", [{"category": "mug", "segmentation": [[1, 1], [9, 1], [9, 9]]}])
    os.utime(folder / "label/000.json", (2**32, 2**32))
    add_scene(sheet, "desk", folder)
    copy = tmp_path / "annotated/photos/desk/000.json"
    assert copy.stat().st_mtime < 2**32
    os.utime(copy, (2**32, 2**32))
    (row,) = read_sheet(sheet)
    with pytest.raises(ArtifactError, match=r"000\.json has a modification time in the future"):
        SceneData([row], str(tmp_path), str).require_usable_files(row)


def test_photographs_that_are_not_used_are_counted_by_folder(tmp_path):
    folder, sheet = write_noise(tmp_path / "desk", 4), write_sheet(tmp_path)
    write_noise(folder / "burst", 3), write_noise(folder / "masks", 4)
    for number in range(2):
        (folder / f".IMG_{number}.HEIC.icloud").write_bytes(b"bplist00")
    report = str(add_scene(sheet, "desk", folder))
    assert f"  not used: 3 images in {folder}/burst/; to use them, move them to {folder}\n" in report
    assert "  left out: 2 photographs that iCloud has not downloaded" in report
    for path in folder.glob("[!.]*"):
        path.unlink() if path.is_file() else shutil.rmtree(path)
    with pytest.raises(SceneError, match=r"too few photographs(.|\n)*2 photographs that iCloud has not"):
        add_scene(sheet, "later", folder)


def test_new_columns_are_added_to_the_header_and_not_to_a_comment(tmp_path):
    header = "\t".join(COLUMNS[:5])
    sheet, folder = write_sheet(tmp_path), write_noise(tmp_path / "desk", 3)
    write_features(folder / "masks")
    sheet.write_text(f"# columns: {header}\n{header}\n")
    add_scene(sheet, "desk", folder, features=folder / "masks")
    assert sheet.read_text().splitlines()[:2] == [f"# columns: {header}", f"{header}\tfeatures"]
    assert [row.features for row in read_sheet(sheet)] == [folder / "masks"]


def test_adding_unusable_photographs_leaves_the_sheet_alone(tmp_path):
    sheet, folder = tmp_path / "scenes.tsv", write_noise(tmp_path / "desk", 2)
    shutil.copy(folder / "1.png", folder / "copy.png")
    with pytest.raises(SceneError, match=r"too few photographs(.|\n)*2 distinct"):
        add_scene(sheet, "desk", folder)
    (folder / "empty.jpg").touch()
    with pytest.raises(SceneError, match=r"empty\.jpg: cannot identify image file 'empty\.jpg' \(0 bytes\)"):
        add_scene(sheet, "desk", folder)
    with pytest.raises(SceneError, match=r"gone is missing(.|\n)*a folder of photographs, a video, or a zip"):
        add_scene(sheet, "desk", tmp_path / "gone")
    Image.open(folder / "0.png").save(folder / "0.jpg")
    with pytest.raises(SceneError, match=r"same view(.|\n)*0\.jpg, .*0\.png"):
        add_scene(sheet, "desk", folder)
    assert not sheet.exists()
