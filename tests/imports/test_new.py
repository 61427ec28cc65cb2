"""`hilsplat new` says what it will use, what it leaves out and why, before anything runs."""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData
from typer.testing import CliRunner

from hilsplat.base.errors import SceneError
from hilsplat.base.images import read_image
from hilsplat.cli.main import app
from hilsplat.embed.clip import ClipModel
from hilsplat.embed.langsplat_files import read_view
from hilsplat.scene.layouts import photo_folder
from hilsplat.scene.sheet import read_sheet
from hilsplat.settings import ClipSettings
from hilsplat.splat.ply import save_ply
from hilsplat.workflow.new_scene import add_scene
from tests.conftest import PROJECT
from tests.imports import analytic_world as world
from tests.unit.round_gaussians import round_gaussians

WIDTH, HEIGHT = 64, 48
POSES = world.cameras(6)
PICTURES = {
    f"{row:03d}": world.picture(world.pinhole(60, 60, 32, 24), WIDTH, HEIGHT, p)
    for row, p in enumerate(POSES)
}
POINTS = [(0.1 * row, 0, 0, 1, 2, 3) for row in range(7)]


def photographs(folder, count=6):
    world.save(folder, dict(list(PICTURES.items())[:count]), ".jpg", quality=95)
    return folder


def model(folder, place="sparse/0", count=6):
    images = {f"{name}.jpg": pose for name, pose in zip(list(PICTURES)[:count], POSES, strict=False)}
    world.write_colmap(folder / place, "PINHOLE 60 60 32 24", (WIDTH, HEIGHT), images, POINTS)


def gaussians(path, count):
    path.parent.mkdir(parents=True, exist_ok=True)
    save_ply(path, round_gaussians(np.ones((count, 3))))


def without_some(path, bad):
    """Spoil Gaussians: positions that are not numbers."""
    ply = PlyData.read(path, mmap=False)
    ply["vertex"].data["x"][:bad] = np.nan
    ply.write(path)


def langsplat_files(folder, name, size_hw=(HEIGHT, WIDTH)):
    """Write LangSplat's maps and vectors of an image: one mask, which covers the image at every level."""
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / f"{name}_s.npy", np.zeros((4, *size_hw), np.float32))
    np.save(folder / f"{name}_f.npy", np.ones((1, 8), np.float32))


def thing(text, **keys):
    """Return an object of a label file: a square of 20 px."""
    number = 1 + len(text) % 2
    square = [[10, 10], [30, 10], [30, 30], [10, 30]]
    return {"category": text, "id": number, "level": 1, "segmentation": square, **keys}


def label_file(path, objects, width=WIDTH, height=HEIGHT):
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps({"info": {"width": width, "height": height}, "objects": objects}))


def new(folder, project, *options):
    project.mkdir(exist_ok=True)
    words = ["new", "desk", str(folder), "--sheet", str(project / "config/scenes.tsv"), *options]
    return CliRunner().invoke(app, words)


@pytest.mark.parametrize("options", [(), ("--dry-run",)])
def test_every_part_is_counted_and_what_is_left_out_is_named(options, tmp_path):
    folder = photographs(tmp_path / "theirs/images").parent
    model(folder), model(folder, "sparse/1", 2)
    (folder / "images/004.jpg").unlink()
    gaussians(folder / "output/a/point_cloud/iteration_30000/point_cloud.ply", 11)
    gaussians(folder / "output/a/point_cloud/iteration_best/point_cloud.ply", 12)
    without_some(folder / "output/a/point_cloud/iteration_30000/point_cloud.ply", 2)
    for name in ("000", "001", "002"):
        langsplat_files(folder / "language_features", name)
    langsplat_files(folder / "language_features", "003", (HEIGHT, HEIGHT))
    for name in ("001", "002", "004"):
        label_file(folder / f"label/{name}.json", [thing("mug"), thing("cup", origin="proposed")])
    label_file(folder / "label/005.json", [thing("mug")])
    label_file(folder / "label/003.json", [thing("mug")], WIDTH, WIDTH)
    (folder / "label/000.json").write_text("{")
    (folder / "label/._001.json").write_bytes(b"of macOS")
    (folder / "output/a/chkpnt30000.pth").touch()
    result = new(folder, tmp_path / "project", *options)
    assert result.exit_code == 0, result.output
    for line in (
        f"poses: {folder}/sparse/0: 5 views with an image",
        "  left out: 1 views without an image: 004.jpg",
        "  points: 7",
        f"  {folder}/sparse/1 also has poses, which are not used",
        f"Gaussians: 9 from {folder}/output/a/point_cloud/iteration_30000/point_cloud.ply",
        "  left out: 2 of 11 Gaussians",
        "  not used: output/a/point_cloud/iteration_best/point_cloud.ply",
        f"features: {folder}/language_features: masks and vectors of 3 of 5 views",
        "003_s.npy does not match the size of its image",
        "005_s.npy is missing",
        f"labels: 3 regions in 3 photographs, used for evaluation: {folder}/label",
        "004.json: no view with an image and a pose has this name",
        "003.json does not match the size of its image",
        "001.json: ignored 1 unaccepted proposal(s)",
        "_f.npy does not match the CLIP model in models/clip-tiny",
        "skipped, because pickle files can run code: chkpnt30000.pth",
        "5 photographs in",
    ):
        assert line in result.output, result.output
    assert "000.json is not valid JSON" in result.output and "._001" not in result.output
    sheet = tmp_path / "project/config/scenes.tsv"
    assert sheet.exists() == (not options)
    for row in read_sheet(sheet) if not options else []:
        assert row.gaussians == folder / "output/a/point_cloud/iteration_30000/point_cloud.ply"
        assert (row.folder, row.features) == (folder, folder / "language_features")
    assert (tmp_path / "project/annotated/photos/desk/001.json").exists() == (not options)
    assert not (tmp_path / "project/annotated/photos/desk/000.json").exists()


def test_poses_that_the_run_would_refuse_are_refused(tmp_path):
    folder = photographs(tmp_path / "a/images", 4).parent
    model(folder)
    assert "2 of 6 views of" in str(new(folder, tmp_path / "p").exception)
    assert not (tmp_path / "p/config/scenes.tsv").exists()
    names = {f"{name}.jpg": pose for name, pose in zip(PICTURES, POSES, strict=True)}
    world.write_colmap(folder / "sparse/0", "OPENCV 60 60 32 24 -1.5 0 0 0", (WIDTH, HEIGHT), names, POINTS)
    assert "lens distortion of view 000.png cannot be undone" in str(new(folder, tmp_path / "p").exception)
    model(folder)
    Image.new("RGB", (HEIGHT, HEIGHT)).save(folder / "images/004.jpg")
    photographs(folder / "images", 3)
    error = str(new(folder, tmp_path / "p").exception)
    assert (
        "004.jpg does not match the size of its camera" in error and "005.jpg: its image is missing" in error
    )
    (tmp_path / "p/config").mkdir(exist_ok=True)
    (tmp_path / "p/config/config.yaml").write_text(
        "overrides: {photos: {poses: {min_registered_share: 0.6}}}"
    )
    assert "4 views with an image" in new(folder, tmp_path / "p").output


@pytest.mark.parametrize(
    ("files", "reason"),
    [
        ({"001": [thing("mug")], "0badcafe-001": [thing("cup")]}, "another file has the labels of 001.png"),
        ({"0badcafe-001": [thing("mug")], "zzz": [thing("cup")]}, "zzz.json: no view with an image"),
        ({"001": [thing("mug")], "002": [{"category": "mug"}]}, "segmentation is not a polygon"),
        ({"001": [thing("mug")], "002": [thing("mug", level=4)]}, "invalid level"),
        ({"001": [thing("mug")], "002": [thing("mug", segmentation=[[99, 9], [98, 9], [98, 8]])]}, "outside"),
    ],
)
def test_labels_that_evaluation_would_refuse_are_left_out_or_refused(files, reason, tmp_path):
    folder = photographs(tmp_path / "a")
    for name, objects in files.items():
        label_file(folder / f"label/{name}.json", objects)
    output = new(folder, tmp_path / "p").output
    assert "labels: 1 regions in 1 photographs" in output and reason in output, output
    assert [path.stem for path in (tmp_path / "p/annotated/photos/desk").iterdir()] == ["001"]


@pytest.mark.parametrize("lens", [None, "PINHOLE 60 60 32 24", "SIMPLE_RADIAL 60 32 24 0.3"])
def test_labels_of_another_shape_are_left_out(lens, tmp_path):
    folder = labelled(tmp_path / "a", v000="mug")
    if lens is not None:
        poses = {f"{name}.jpg": pose for name, pose in zip(PICTURES, POSES, strict=True)}
        world.write_colmap(folder / "sparse/0", lens, (WIDTH, HEIGHT), poses, POINTS)
    sizes = (2 * WIDTH, 2 * HEIGHT), (HEIGHT, WIDTH), (WIDTH, 36), (1000, 710), (WIDTH, HEIGHT)
    for number, size in enumerate(sizes, 1):
        label_file(folder / f"label/00{number}.json", [thing("mug")], *size)
    output = new(folder, tmp_path / "p", "--dry-run").output
    count = 4 if lens is None else 3  # undistorted views without known poses may have the last shape
    assert f"labels: {count} regions in {count} photographs" in output, output
    assert ("refuses it unless the undistorted view has its shape" in output) == (lens is None)
    for name in ("002", "003"):
        assert f"{name}.json does not match the size of its" in output


@pytest.mark.parametrize(("turn", "is_right"), [(0, True), (1, False)])
def test_vectors_are_compared_with_those_of_the_clip_model(turn, is_right, tmp_path):
    folder = photographs(tmp_path / "a")
    model = ClipModel.load(PROJECT / "models/clip-tiny")
    maps = np.full((4, HEIGHT, WIDTH), -1, np.float32)
    maps[1:, :24, :32] = 0
    for path in folder.glob("*.jpg"):
        langsplat_files(folder / "language_features", path.stem)
        np.save(folder / f"language_features/{path.stem}_s.npy", maps)
        masks, _ = read_view(folder / "language_features", path.stem)
        vector = model.embed_masks(read_image(path), masks, ClipSettings(crop="langsplat"))[:1]
        np.save(folder / f"language_features/{path.stem}_f.npy", np.roll(vector.astype(np.float32), turn))
    output = new(folder, tmp_path / "p", "--dry-run").output
    assert "masks and vectors of 6 of 6 views" in output
    assert ("were not computed by the CLIP model" in output) == (not is_right), output


@pytest.mark.parametrize("kind", ["zip", "r3d"])
def test_a_dry_run_of_an_archive_leaves_nothing(kind, tmp_path):
    archive_with(tmp_path, "{}", kind)
    result = new(tmp_path / f"a.{kind}", tmp_path / "project", "--dry-run")
    assert "6 photographs in" in result.output and "nothing was added" in result.output
    assert not list((tmp_path / "project").rglob("*"))


@pytest.mark.parametrize(
    "folders",  # the first is meant
    [
        (".",),
        ("Images",),
        ("input",),
        ("images", "input"),
        ("images", "images_2", "images_4"),
        ("images_2", "images_4", "images_8"),
        ("DCIM/100APPLE",),
        ("photos", "output/renders", ".thumbnails"),
        ("photos", "masks"),
        ("rgb", "depth", "confidence"),
        ("scan/color", "scan/label-filt", "scan/masks_2"),
    ],
)
def test_photographs_are_found_where_people_have_them(folders, tmp_path, monkeypatch):
    for folder in folders:
        photographs(tmp_path / folder)
    assert photo_folder(tmp_path) == tmp_path / folders[0]
    monkeypatch.chdir(tmp_path)
    assert photo_folder(Path()) == Path(folders[0])


def test_with_known_poses_the_images_that_have_one_are_reported(tmp_path):
    model(tmp_path)
    photographs(tmp_path / "images")
    for place, count in ((".", 4), ("images/more", 3)):
        photographs(tmp_path / place, count)
    world.save(tmp_path / "images", {"900": np.zeros((HEIGHT, WIDTH), np.uint8)})
    report = str(add_scene(tmp_path / "p/scenes.tsv", "a", tmp_path))
    assert f"6 photographs in {tmp_path}/images\n" in report
    assert "  left out: 1 images without a pose\n" in report


def test_a_stray_picture_beside_a_folder_of_photographs_is_not_the_set(tmp_path):
    photographs(tmp_path / "images")
    photographs(tmp_path, 1)
    report = add_scene(tmp_path / "p/scenes.tsv", "a", tmp_path)
    assert report.num_readable == 6 and report.folder == tmp_path / "images"
    (tmp_path / "images").rename(tmp_path / "scan")
    assert add_scene(tmp_path / "p/scenes.tsv", "b", tmp_path).folder == tmp_path / "scan"


@pytest.mark.parametrize("places", [["monday", "tuesday"], ["DCIM/100APPLE", "DCIM/101APPLE"]])
def test_several_folders_of_photographs_are_listed(places, tmp_path):
    for place in places:
        photographs(tmp_path / "photos" / place, 4)
    with pytest.raises(SceneError, match=r"0 distinct readable(.|\n)*4 images in(.|\n)*4 images in"):
        add_scene(tmp_path / "scenes.tsv", "a", tmp_path / "photos")


def test_poses_in_a_single_folder_below_are_found(tmp_path):
    photographs(tmp_path / "desk/desk/images")
    model(tmp_path / "desk/desk")
    (tmp_path / "desk/__MACOSX").mkdir()
    (tmp_path / "desk/README.md").write_text("# Desk")
    report = add_scene(tmp_path / "p/config/scenes.tsv", "a", tmp_path / "desk")
    assert "6 views with an image" in str(report)
    (row,) = read_sheet(tmp_path / "p/config/scenes.tsv")
    assert row.folder == tmp_path / "desk/desk"


def test_some_photographs_that_cannot_be_read_are_left_out(tmp_path):
    folder = photographs(tmp_path / "a")
    Image.new("1", (20_000, 10_000)).save(folder / "large.png")  # 200 megapixels
    (folder / "text.png").write_bytes(b"no picture")
    report = str(add_scene(tmp_path / "scenes.tsv", "a", folder))
    assert "6 photographs in" in report and "2  cannot be read and are left out" in report
    assert "large.png: " in report and "text.png: " in report
    for row in range(3):
        (folder / f"bad{row}.png").write_bytes(b"")
    with pytest.raises(SceneError, match=r"5 of 11 photographs in .* cannot be read"):
        add_scene(tmp_path / "scenes.tsv", "b", folder)


def archive_with(folder, name, suffix="zip"):
    photographs(folder / "a")
    with zipfile.ZipFile(folder / f"a.{suffix}", "w") as archive:
        for path in (folder / "a").iterdir():
            archive.write(path, name.format(path.name))


@pytest.mark.parametrize("name", ["photos\\{}", "a\\b\\{}"])
def test_archives_made_on_windows_are_unpacked(name, tmp_path):
    archive_with(tmp_path, name)
    assert add_scene(tmp_path / "p/scenes.tsv", "a", tmp_path / "a.zip").num_readable == 6


def test_names_in_archives_of_macos_are_utf_8_without_its_flag(tmp_path):
    archive_with(tmp_path, "K\u00fcche {}")
    content = (tmp_path / "a.zip").read_bytes()
    for start in (b"PK\3\4\x14\0\0", b"PK\1\2\x14\3\x14\0\0"):
        assert content.count(start + b"\x08") == 6
        content = content.replace(start + b"\x08", start + b"\0")
    (tmp_path / "a.zip").write_bytes(content)
    add_scene(tmp_path / "p/scenes.tsv", "a", tmp_path / "a.zip")
    names = {path.name for path in (tmp_path / "p/photos/a").glob("*.jpg")}
    assert len(names) == 6 and all(name.startswith("K\u00fcche 0") for name in names)


def test_other_programs_gaussians_without_poses_are_named_but_not_used(tmp_path):
    folder = photographs(tmp_path / "a")
    gaussians(folder / "point_cloud.ply", 3)
    report = str(add_scene(tmp_path / "scenes.tsv", "a", folder))
    assert "Gaussians: not used, because they need the poses they were made with" in report
    (row,) = read_sheet(tmp_path / "scenes.tsv")
    assert row.gaussians is None


def test_unknown_coordinates_of_a_nerfstudio_export_are_stated(tmp_path):
    folder, ply = photographs(tmp_path / "a/images").parent, tmp_path / "a/exports/splat/desk.ply"
    model(folder)
    gaussians(ply, 3)
    comment = b"\ncomment Generated by Nerstudio 1.1.5\nelement"
    ply.write_bytes(ply.read_bytes().replace(b"\nelement", comment, 1))
    result = new(folder, tmp_path / "p", "--gaussians", str(ply), "--dry-run")
    assert f"Gaussians: 3 from {ply}\n  coordinates: unknown" in result.output


def test_poses_and_gaussians_that_are_not_used_are_named_with_what_to_do(tmp_path):
    folder = photographs(tmp_path / "a")
    for name in ("cameras.xml", "photos.out", "scene.spz", "points.ply", "transforms_old.json", "ckpt.pt"):
        (folder / name).write_bytes(b"ply\n")
    model(folder, "colmap/sparse/0")
    model(folder, "dslr/colmap")
    gaussians(folder / "results/ply/Scan.ply", 3)
    lines = new(folder, tmp_path / "p", "--dry-run").output.splitlines()
    found = f"{folder}/colmap/sparse/0, {folder}/dslr/colmap, {folder}/transforms_old.json"
    ply = f"{folder}/results/ply/Scan.ply"
    assert lines[:6] == [
        "poses: structure from motion",
        f"  not used: {found}; to use these poses, pass --poses",
        f"  not used: {folder}/cameras.xml, {folder}/photos.out; "
        "for poses, export a COLMAP model or transforms.json",
        f"  not used: {ply}; to use Gaussians in the coordinates of the poses, pass --gaussians",
        f"  not used: {folder}/scene.spz; for Gaussians, export an uncompressed 3DGS PLY",
        "skipped, because pickle files can run code: ckpt.pt",
    ]


def test_the_next_commands_name_the_setting_of_another_sheet(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    photographs(tmp_path / "a")
    for sheet, setting in (
        ("config/scenes.tsv", ""),
        ("my.tsv", ", with `scenes: my.tsv` in config/config.yaml"),
    ):
        printed = CliRunner().invoke(app, ["new", "desk", "a", "--sheet", sheet]).output
        assert f"added photos/desk to {sheet}. Next{setting}:\n  hilsplat run desk\n" in printed


def labelled(folder, **labels):
    """Write photographs, and a label file for each name of a view."""
    photographs(folder)
    (folder / "label").mkdir()
    for view, label in labels.items():
        label_file(folder / f"label/{view[1:]}.json", [thing(label)])
    return folder


def test_labels_of_an_earlier_scene_are_never_used_unnoticed(tmp_path):
    first, second = labelled(tmp_path / "a", v000="mug"), labelled(tmp_path / "b", v000="train")
    bare = photographs(tmp_path / "c")
    project, annotated = tmp_path / "p", tmp_path / "p/annotated/photos/desk"
    sheet = project / "config/scenes.tsv"
    annotated.mkdir(parents=True)  # empty

    def remove_row():
        sheet.write_text("".join(line for line in sheet.open() if "\tdesk\t" not in line))

    for _ in range(2):
        assert f"used for evaluation: {first}/label" in new(first, project).output
        assert "mug" in (annotated / "000.json").read_text()
        remove_row()
    before = sheet.read_bytes()
    for options in ((), ("--dry-run",), ("--labels", str(second / "label"))):
        result = new(second, project, *options)
        assert "differ from the labels to be used" in str(result.exception)
        assert sheet.read_bytes() == before
    for folder, options in ((bare, ()), (second, ("--labels", "none"))):
        printed = new(folder, project, *options).output
        assert f"labels: 1 files of an earlier scene, used for evaluation: {annotated}" in printed
        assert "mug" in (annotated / "000.json").read_text()
        remove_row()
    (annotated / "000.json").rename(annotated / "notes.txt")
    assert "differ from the labels to be used" in str(new(second, project).exception)
    (annotated / "notes.txt").unlink()
    assert f"used for evaluation: {second}/label" in new(second, project).output
    assert "train" in (annotated / "000.json").read_text()
