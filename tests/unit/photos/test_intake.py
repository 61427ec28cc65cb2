"""Videos, archives and folders become a folder of photographs and a row of the sheet."""

import json
import stat
import zipfile

import pytest

from hilsplat.base.errors import SceneError
from hilsplat.photos import intake
from hilsplat.photos.add import add_scene
from hilsplat.photos.intake import prepared_photographs
from hilsplat.scene.sheet import read_sheet
from tests.unit.photos.test_video import pan, write_video
from tests.unit.scene.test_poses import write_noise


def zipped(path, entries):
    """A zip archive of (name or ZipInfo, bytes)."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, content in entries:
            opened.writestr(name, content)
    return path


def photo_entries(folder, prefix=""):
    return [(f"{prefix}{path.name}", path.read_bytes()) for path in sorted(folder.iterdir())]


def sources(sheet):
    return {row.scene: row.source for row in read_sheet(sheet)}


@pytest.fixture
def sheet(tmp_path):
    (tmp_path / "project/config").mkdir(parents=True)
    return tmp_path / "project/config/scenes.tsv"


def test_a_video_becomes_photographs_in_the_project(tmp_path, sheet):
    video = write_video(tmp_path / "walk.MP4", pan([0] + [6] * 40))
    report = add_scene(sheet, "desk", video, frames=12)
    assert (report.num_readable, report.sizes) == (12, {(240, 320): 12})
    assert sources(sheet) == {"desk": "photos/desk"}
    folder = tmp_path / "project/photos/desk"
    assert sorted(path.name for path in folder.glob("[!.]*"))[:2] == ["0001.jpg", "0002.jpg"]
    assert json.loads((folder / "origin.json").read_text())["settings"]["frames"] == 12
    assert "12 frames of walk.MP4 are in" in str(report)
    with pytest.raises(SceneError, match="photos/desk is already in"):
        add_scene(sheet, "desk", video)
    assert len(list(folder.glob("*.jpg"))) == 12


def test_a_folder_of_videos_is_one_capture(tmp_path, sheet):
    (tmp_path / "clips").mkdir()
    for number, left in enumerate((0, 300)):
        write_video(tmp_path / "clips" / f"{number}.mp4", pan([left] + [6] * 20))
    assert add_scene(sheet, "desk", tmp_path / "clips", frames=10).num_readable == 10


def test_a_static_video_is_refused_and_leaves_no_files(tmp_path, sheet):
    video = write_video(tmp_path / "still.mp4", pan([0] * 20))
    with pytest.raises(SceneError, match=r"too few photographs(.|\n)*1 different(.|\n)*film longer"):
        add_scene(sheet, "desk", video)
    assert not sheet.exists()
    assert not (tmp_path / "project/photos/desk").exists()


def test_an_existing_folder_is_kept(tmp_path, sheet):
    mine = tmp_path / "project/photos/desk"
    write_noise(mine, 1)
    with pytest.raises(SceneError, match=r"photos/desk already exists"):
        add_scene(sheet, "desk", write_video(tmp_path / "walk.mp4", pan([0] + [6] * 20)))
    assert len(list(mine.iterdir())) == 1


def test_a_command_that_was_killed_after_it_unpacked_resumes(tmp_path, sheet):
    made, video = tmp_path / "project/photos/desk", write_video(tmp_path / "walk.mp4", pan([0] + [6] * 20))
    with prepared_photographs(video, made, 10):
        before = sorted(path.stat().st_mtime_ns for path in made.glob("*.*"))
    report = add_scene(sheet, "desk", video, frames=10)  # the same again: no frame is taken twice
    assert report.num_readable == 10 and "already exists, from the same files" in str(report)
    assert sorted(path.stat().st_mtime_ns for path in made.glob("*.*")) == before


def test_videos_of_live_photos_are_ignored_and_reported(tmp_path, sheet):
    import pillow_heif

    pillow_heif.register_heif_opener()
    folder = write_noise(tmp_path / "phone", 4, suffix=".HEIC")
    (folder / "0.MOV").write_bytes(b"never opened")
    report = add_scene(sheet, "desk", folder)
    assert report.num_readable == 4
    assert "1 videos beside the photographs (Live Photos) are not used" in str(report)
    assert not (tmp_path / "project/photos").exists()  # a folder stays where it is


def test_other_files_are_refused(tmp_path, sheet):
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(SceneError, match=r"notes\.txt is a file of an unknown kind(.|\n)*a \.zip"):
        add_scene(sheet, "desk", tmp_path / "notes.txt")


def test_a_zip_is_unpacked_and_its_only_folder_unwrapped(tmp_path, sheet):
    photos = write_noise(tmp_path / "source", 4, suffix=".jpg")
    entries = photo_entries(photos, "Trip 1/best/")
    junk = [("__MACOSX/Trip 1/._0.jpg", b"x"), ("Trip 1/.DS_Store", b"x"), ("Trip 1/run.sh", b"rm -rf")]
    report = add_scene(sheet, "desk", zipped(tmp_path / "trip.ZIP", entries + junk))
    assert report.num_readable == 4
    assert sources(sheet) == {"desk": "photos/desk/Trip 1/best"}
    unpacked = tmp_path / "project/photos/desk"
    files = {path.name: path.read_bytes() for path in unpacked.rglob("[!.]*") if path.is_file()}
    assert files == {path.name: path.read_bytes() for path in photos.iterdir()}


def link(name):
    entry = zipfile.ZipInfo(name)
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    return entry


OUTSIDE = [(name, "leads out") for name in ("../evil.jpg", "a/../../evil.jpg", "/evil.jpg", "..\\evil.jpg")]


@pytest.mark.parametrize(
    ("entry", "problem"), [*OUTSIDE, (link("evil.jpg"), "is a link"), ("0.jpg", "is there twice")]
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_archives_that_could_write_elsewhere_are_refused(tmp_path, sheet, entry, problem):
    entries = photo_entries(write_noise(tmp_path / "source", 4, suffix=".jpg"))
    bad = zipped(tmp_path / "bad.zip", [*entries, (entry, b"x")])
    with pytest.raises(SceneError, match=rf"bad\.zip: entry '.*(evil|0)\.jpg' {problem}"):
        add_scene(sheet, "desk", bad)
    assert not (tmp_path / "project/photos/desk").exists()
    assert not list(tmp_path.rglob("*evil*"))


def test_too_large_archives_are_refused(tmp_path, sheet, monkeypatch):
    entries = photo_entries(write_noise(tmp_path / "source", 4, suffix=".jpg"))
    good = zipped(tmp_path / "good.zip", entries)
    for limit, value, message in (("MAX_TOTAL_GIB", 1e-6, "GiB"), ("MAX_FILES", 3, r"3 files(.|\n)*4 files")):
        monkeypatch.setattr(intake, limit, value)
        with pytest.raises(SceneError, match=rf"too large(.|\n)*at most (.|\n)*{message}"):
            add_scene(sheet, "desk", good)


def test_an_archive_writes_at_most_the_declared_size(tmp_path):
    bomb = zipped(tmp_path / "bomb.zip", [("a.jpg", bytes(1_000_000))])
    content = bytearray(bomb.read_bytes())
    at = content.index(b"PK\x01\x02") + 24  # uncompressed size in the central directory
    content[at : at + 4] = (1000).to_bytes(4, "little")
    bomb.write_bytes(content)
    (tmp_path / "out").mkdir()
    with pytest.raises(SceneError, match=r"bomb\.zip cannot be unpacked"):
        intake.unpack_photographs(bomb, tmp_path / "out")
    assert (tmp_path / "out/a.jpg").stat().st_size <= 1000


def test_damaged_and_encrypted_archives_are_refused(tmp_path, sheet):
    entries = photo_entries(write_noise(tmp_path / "source", 4, suffix=".jpg"))
    whole = zipped(tmp_path / "a.zip", entries).read_bytes()
    (tmp_path / "half.zip").write_bytes(whole[: len(whole) // 2])
    hurt = bytearray(whole)
    hurt[200:300] = bytes(100)
    (tmp_path / "hurt.zip").write_bytes(hurt)
    for name in ("half.zip", "hurt.zip"):
        with pytest.raises(SceneError, match=rf"{name} cannot be unpacked"):
            add_scene(sheet, "desk", tmp_path / name)
    locked = bytearray(whole)
    at = locked.index(b"PK\x01\x02") + 8
    locked[at] |= 1
    (tmp_path / "locked.zip").write_bytes(locked)
    with pytest.raises(SceneError, match=r"locked\.zip: entry '0\.jpg' is encrypted"):
        add_scene(sheet, "desk", tmp_path / "locked.zip")
    assert not (tmp_path / "project/photos/desk").exists()
