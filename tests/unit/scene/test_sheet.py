"""The scene sheet refuses what would fail later, and says where and how to fix it."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.errors import SceneError
from hilsplat.photos.add import add_scene, inspect_photos
from hilsplat.scene.layouts import NO_POSES
from hilsplat.scene.sheet import choose_scenes, read_sheet
from hilsplat.workflow.scene_data import SceneData

HEADER = "dataset\tscene\tgroup\tsource\tunit\n"


def write_sheet(folder, *rows, header=HEADER):
    sheet = folder / "config" / "scenes.tsv"
    sheet.parent.mkdir(exist_ok=True)
    sheet.write_text(header + "".join("\t".join(row) + "\n" for row in rows), encoding="utf-8")
    return sheet


def write_photos(folder, count, size=(40, 30), seed=0):
    folder.mkdir(parents=True, exist_ok=True)
    generator = np.random.default_rng(seed)
    for number in range(count):
        pixels = generator.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"photo_{number}.jpg")
    return folder


def test_rows_are_read_in_order_and_comments_are_skipped(tmp_path):
    write_photos(tmp_path / "desk", 3)
    sheet = write_sheet(
        tmp_path,
        ("# a comment",),
        ("world", "tabletop-201", "benchmark", "world:tabletop:201", "metre"),
        ("photos", "desk", "photos", "desk", "arbitrary"),
    )
    first, second = read_sheet(sheet)
    assert (first.name, first.world, first.folder) == ("world/tabletop-201", ("tabletop", 201), None)
    assert (second.name, second.world, second.folder) == ("photos/desk", None, tmp_path / "desk")


def test_named_scenes_are_chosen_alone_and_from_any_group(tmp_path):
    sheet = write_sheet(
        tmp_path,
        ("a", "one", "benchmark", "world:tabletop:201", "metre"),
        ("a", "two", "benchmark", "world:tabletop:202", "metre"),
        ("a", "three", "development", "world:tabletop:101", "metre"),
        ("b", "two", "development", "world:tabletop:102", "metre"),
    )
    rows = read_sheet(sheet)

    def chosen(*only):
        return [row.name for row in choose_scenes(rows, ["benchmark"], only)]

    assert chosen() == ["a/one", "a/two"]
    assert chosen("two") == ["a/two"]  # of the groups, as they have one
    assert chosen("b/two") == ["b/two"]
    assert chosen("three", "a/one") == ["a/one", "a/three"]
    with pytest.raises(SceneError, match=r"only names 'tow'(.|\n)*a/one, a/two"):
        chosen("tow")


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("", "it is empty"),
        ("a b", "it contains ' '"),
        ("a/b", "it contains '/'"),
        ("..", r'it contains "\.\."'),
        ("a..b", r'it contains "\.\."'),
        ("-desk", "it begins with '-'"),
        (".desk", "it begins with '.'"),
        ("tür", "it contains 'ü'"),
        ("desk{1}", "it contains '{', '}'"),
        ("x" * 101, "longer than 100"),
    ],
)
def test_bad_scene_names_are_refused_with_line_and_column(tmp_path, name, problem):
    sheet = write_sheet(tmp_path, ("world", name, "ci", "world:tabletop:1", "metre"))
    with pytest.raises(SceneError, match=rf"scenes\.tsv, line 2, column scene: (.|\n)*{problem}"):
        read_sheet(sheet)
    with pytest.raises(SceneError, match=problem):
        add_scene(sheet, name, tmp_path)


def test_names_that_differ_only_in_case_count_as_duplicates(tmp_path):
    rows = [("world", name, "ci", "world:tabletop:1", "metre") for name in ("desk", "Desk")]
    with pytest.raises(SceneError, match=r"line 3, column scene: world/Desk is listed twice(.|\n)*line 2"):
        read_sheet(write_sheet(tmp_path, *rows))


def test_missing_and_misspelt_columns_are_named(tmp_path):
    with pytest.raises(SceneError, match=r"line 1(.|\n)*missing: 'unit'; unknown: 'units'"):
        read_sheet(write_sheet(tmp_path, header="dataset\tscene\tgroup\tsource\tunits\n"))
    with pytest.raises(SceneError, match="wrong number of columns"):
        read_sheet(write_sheet(tmp_path, ("world", "a", "ci", "world:tabletop:1")))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (("world", "a", "paper", "world:tabletop:1", "metre"), "column group: 'paper' is unknown"),
        (("world", "a", "ci", "world:tabletop:1", "cm"), "column unit: 'cm' is unknown"),
        (("world", "a", "ci", "world:tabletop", "metre"), "is not the name of a synthetic world"),
        (("photos", "a", "photos", "gone", "arbitrary"), "gone is missing"),
        (("photos", "a", "photos", "", "arbitrary"), "column source: it is empty"),
    ],
)
def test_bad_cells_are_named(tmp_path, row, message):
    with pytest.raises(SceneError, match=message):
        read_sheet(write_sheet(tmp_path, row))


def test_a_folder_of_unread_photographs_says_what_it_holds(tmp_path):
    (tmp_path / "phone").mkdir()
    (tmp_path / "phone" / "a.DNG").write_bytes(b"x")
    row = ("photos", "a", "photos", "phone", "arbitrary")
    with pytest.raises(SceneError, match=r"has no images(.|\n)*1 files \.dng"):
        read_sheet(write_sheet(tmp_path, row))
    assert len(read_sheet(write_sheet(tmp_path, row), checked_groups=())) == 1


def langsplat_scene(folder: Path) -> Path:
    """Photographs, and beside them what COLMAP, 3DGS and LangSplat write."""
    write_photos(folder / "images", 3)
    for path in (
        "sparse/0/cameras.bin",
        "sparse/0/images.bin",
        "sparse/0/points3D.bin",
        "output/a/point_cloud/iteration_7000/point_cloud.ply",
        "output/a/point_cloud/iteration_30000/point_cloud.ply",
        "output/a/chkpnt30000.pth",
        "language_features/000_s.npy",
        "label/photo_0.json",
    ):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(b"ply\n")
    return folder


def test_what_3dgs_and_langsplat_left_is_found_named_and_recorded(tmp_path):
    folder = langsplat_scene(tmp_path / "theirs")
    sheet = write_sheet(tmp_path, ("world", "a", "ci", "world:tabletop:1", "metre"))
    report = str(add_scene(sheet, "desk", folder))
    assert "iteration_30000/point_cloud.ply" in report and "language_features" in report
    assert "not read, because a pickle can run code: chkpnt30000.pth" in report
    assert "labels of 1 photographs" in report
    assert (tmp_path / "annotated/photos/desk/photo_0.json").is_file()
    old, new = read_sheet(sheet)
    assert (old.gaussians, old.features) == (None, None)
    assert new.features == folder / "language_features"
    assert new.gaussians == folder / "output/a/point_cloud/iteration_30000/point_cloud.ply"


def test_what_was_found_can_be_left_out_or_replaced(tmp_path):
    folder = langsplat_scene(tmp_path / "theirs")
    other = tmp_path / "other.ply"
    other.write_bytes(b"ply\n")
    sheet = write_sheet(tmp_path)
    nothing = Path("none")
    add_scene(sheet, "plain", folder, gaussians=nothing, features=nothing, labels=nothing)
    assert not (tmp_path / "annotated").exists()
    add_scene(sheet, "mixed", folder, gaussians=other, features=Path("none"))
    plain, mixed = read_sheet(sheet)
    assert (plain.gaussians, plain.features) == (None, None)
    assert (mixed.gaussians, mixed.features) == (other, None)
    assert (plain.poses, mixed.poses) == (None, None)
    with pytest.raises(SceneError, match="holds no label file"):
        add_scene(sheet, "lost", folder, labels=tmp_path / "config")
    with pytest.raises(SceneError, match="--features gone is missing"):
        add_scene(sheet, "lost", folder, features=Path("gone"))


def test_poses_can_be_ignored_or_named_and_are_recorded(tmp_path):
    folder, other = langsplat_scene(tmp_path / "theirs"), langsplat_scene(tmp_path / "other")
    sheet = write_sheet(tmp_path)
    assert "poses: structure from motion" in str(add_scene(sheet, "own", folder, poses=Path("none")))
    report = str(add_scene(sheet, "named", folder, poses=other / "sparse/0"))
    assert f"poses: {other / 'sparse/0'}" in report
    own, named = read_sheet(sheet)
    assert (own.poses, own.gaussians) == (NO_POSES, None)  # Gaussians are in the coordinates of those poses
    assert named.poses == other / "sparse/0" and named.gaussians is not None
    shutil.rmtree(other)
    with pytest.raises(SceneError, match=r"line 3, column poses: .*sparse/0 is missing"):
        read_sheet(sheet)


def test_nerfstudios_export_is_found_with_the_record_of_its_coordinates(tmp_path):
    folder = tmp_path / "theirs"
    write_photos(folder / "images", 3)
    for path in ("exports/splat/splat.ply", *(f"outputs/desk/splatfacto/2026-0{n}-01/x" for n in (2, 1))):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(b"ply\n")
    (folder / "transforms.json").write_text("{}")
    for run in (folder / "outputs/desk/splatfacto").iterdir():
        (run / "dataparser_transforms.json").write_text("{}")
    sheet = write_sheet(tmp_path)
    report = str(add_scene(sheet, "desk", folder))
    latest = folder / "outputs/desk/splatfacto/2026-02-01/dataparser_transforms.json"
    assert f"nerfstudio's, by {latest}" in report
    (row,) = read_sheet(sheet)
    data = SceneData([row], "", str)
    assert data.existing_gaussians(row) == [str(row.gaussians), str(latest), str(folder / "transforms.json")]
    assert f"--dataparser {latest}" in data.existing_gaussians_option(row)


def test_gaussians_without_known_poses_are_not_taken(tmp_path):
    folder = langsplat_scene(tmp_path / "theirs")
    shutil.rmtree(folder / "sparse")
    sheet = write_sheet(tmp_path)
    add_scene(sheet, "desk", folder)
    (row,) = read_sheet(sheet)
    assert row.gaussians is None


def test_optional_columns_may_be_missing_at_the_end_of_a_row(tmp_path):
    header = "dataset\tscene\tgroup\tsource\tunit\tgaussians\tfeatures\n"
    sheet = write_sheet(tmp_path, ("world", "a", "ci", "world:tabletop:1", "metre"), header=header)
    (row,) = read_sheet(sheet)
    assert (row.gaussians, row.features) == (None, None)


def test_inspection_finds_damaged_turned_and_copied_photographs(tmp_path):
    folder = write_photos(tmp_path / "images", 3)
    upright = Image.open(folder / "photo_0.jpg")
    exif = Image.Exif()
    exif[0x0112] = 6  # a quarter turn: 40 x 30 is shown as 30 x 40
    upright.save(folder / "turned.jpg", exif=exif)
    (folder / "copy.jpg").write_bytes((folder / "photo_1.jpg").read_bytes())
    (folder / "empty.jpg").touch()
    whole = (folder / "photo_2.jpg").read_bytes()
    (folder / "truncated.jpg").write_bytes(whole[: len(whole) // 2])
    (folder / "text.png").write_text("no image")
    (folder / "raw.nef").write_bytes(b"x")

    report = inspect_photos(tmp_path)  # the folder above images/ works too
    assert report.folder == folder
    assert report.sizes == {(30, 40): 4, (40, 30): 1}  # height, width
    assert (report.num_readable, report.num_distinct, report.num_rotated) == (5, 4, 1)
    assert report.duplicates == (("copy.jpg", "photo_1.jpg"),)
    assert [name for name, _ in report.unreadable] == ["empty.jpg", "text.png", "truncated.jpg"]
    assert dict(report.unreadable)["empty.jpg"] == "the file is empty"
    assert "truncated" in dict(report.unreadable)["truncated.jpg"]
    assert report.passed_over == {".nef": 1}
    assert "5 photographs in" in str(report) and "4  of 40 x 30 px" in str(report)


def test_adding_a_scene_appends_one_row_with_a_relative_source(tmp_path):
    sheet = write_sheet(tmp_path, ("world", "a", "ci", "world:tabletop:1", "metre"))
    before = sheet.read_text().rstrip("\n")
    sheet.write_text(before)  # an editor may have dropped the last newline
    report = add_scene(sheet, "desk", write_photos(tmp_path / "desk photos", 3))
    assert report.num_readable == 3
    assert sheet.read_text() == before + "\nphotos\tdesk\tphotos\tdesk photos\tarbitrary\n"
    assert [row.name for row in read_sheet(sheet)] == ["world/a", "photos/desk"]
    with pytest.raises(SceneError, match="photos/desk is already in"):
        add_scene(sheet, "Desk", tmp_path / "desk photos")


def test_adding_too_few_or_damaged_photographs_leaves_the_sheet_alone(tmp_path):
    sheet = tmp_path / "scenes.tsv"
    folder = write_photos(tmp_path / "desk", 2)
    (folder / "copy.jpg").write_bytes((folder / "photo_1.jpg").read_bytes())
    with pytest.raises(SceneError, match=r"too few photographs(.|\n)*2 different"):
        add_scene(sheet, "desk", folder)
    (folder / "empty.jpg").touch()
    with pytest.raises(SceneError, match=r"empty\.jpg: the file is empty"):
        add_scene(sheet, "desk", folder)
    with pytest.raises(SceneError, match=r"gone is missing(.|\n)*a folder of photographs, a video, or a zip"):
        add_scene(sheet, "desk", tmp_path / "gone")
    assert not sheet.exists()


def test_photographs_that_differ_only_in_suffix_are_refused(tmp_path):
    folder = write_photos(tmp_path / "desk", 3)
    Image.open(folder / "photo_0.jpg").save(folder / "photo_0.png")
    with pytest.raises(SceneError, match=r"same view(.|\n)*photo_0\.jpg, photo_0\.png"):
        inspect_photos(folder)


def test_data_sources_are_below_the_data_root(tmp_path):
    row = ("lerf", "figurines", "lerf", "data:lerf_ovs/figurines", "arbitrary")
    sheet = write_sheet(tmp_path, row)
    assert read_sheet(sheet)[0].folder is None
    found = read_sheet(sheet, data_root=str(tmp_path / "data"))  # the workflow deals with missing ones
    assert found[0].folder == tmp_path / "data/lerf_ovs/figurines"


def test_a_group_that_is_not_run_is_not_checked(tmp_path):
    row = ("photos", "lost", "photos", "nowhere", "arbitrary")
    assert len(read_sheet(write_sheet(tmp_path, row), checked_groups=("ci",))) == 1


WITH_GAUSSIANS = HEADER.replace("\n", "\tgaussians\n")


def test_a_ready_made_ply_is_found_from_the_project_folder(tmp_path):
    write_photos(tmp_path / "desk", 3)
    (tmp_path / "theirs.ply").write_bytes(b"ply\nformat ...")
    rows = [
        ("photos", "desk", "photos", "desk", "arbitrary", "theirs.ply"),
        ("photos", "fitted", "photos", "desk", "arbitrary", "-"),
        ("photos", "too", "photos", "desk", "arbitrary", ""),
    ]
    existing, fitted, too = read_sheet(write_sheet(tmp_path, *rows, header=WITH_GAUSSIANS))
    assert existing.gaussians == tmp_path / "theirs.ply"
    assert fitted.gaussians is None
    assert too.gaussians is None


@pytest.mark.parametrize(
    ("cell", "problem"),
    [
        ("gone.ply", "is missing"),
        ("desk", "is a folder"),
        ("notes.txt", "is not a PLY: it begins with b'hell'"),
        ("data:theirs.ply", "data_root, which is not set"),
    ],
)
def test_a_ply_that_cannot_be_read_stops_its_group_only(tmp_path, cell, problem):
    write_photos(tmp_path / "desk", 3)
    (tmp_path / "notes.txt").write_text("hello")
    row = ("photos", "desk", "photos", "desk", "arbitrary", cell)
    sheet = write_sheet(tmp_path, row, header=WITH_GAUSSIANS)
    with pytest.raises(SceneError, match=rf"line 2, column gaussians: (.|\n)*{problem}"):
        read_sheet(sheet)
    read_sheet(sheet, checked_groups=("ci",))


def test_a_ply_below_the_data_root_is_found(tmp_path):
    write_photos(tmp_path / "data" / "desk", 3)
    (tmp_path / "data" / "theirs.ply").write_bytes(b"ply\n")
    row = ("lerf", "desk", "lerf", "data:desk", "arbitrary", "data:theirs.ply")
    sheet = write_sheet(tmp_path, row, header=WITH_GAUSSIANS)
    assert read_sheet(sheet, data_root="data")[0].gaussians == tmp_path / "data" / "theirs.ply"
    assert read_sheet(sheet)[0].gaussians is None  # nor has the scene a folder: it is skipped


def test_a_new_scene_in_a_sheet_with_that_column_is_fitted(tmp_path):
    write_photos(tmp_path / "desk", 3)
    sheet = write_sheet(tmp_path, header=WITH_GAUSSIANS)
    add_scene(sheet, "desk", tmp_path / "desk")
    assert sheet.read_text().splitlines()[1] == "photos\tdesk\tphotos\tdesk\tarbitrary\t-"
    assert read_sheet(sheet)[0].gaussians is None
