"""Videos, archives and folders become photographs; video frames are sharp, distinct, upright and in sRGB."""

import json
import re
import stat
import zipfile
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from hilsplat.base.errors import SceneError
from hilsplat.photos import intake
from hilsplat.photos.video import MIN_STEP, displacement, extract_frames
from hilsplat.photos.video_colours import _pq_light, rgb_pixels, srgb_from_hdr
from hilsplat.scene.sheet import read_sheet
from hilsplat.workflow.new_scene import add_scene
from tests.unit.scene.test_poses import write_noise


def wall(width=900, height=240):
    """A textured wall to pan over: smooth noise, so that it survives coding."""
    noise = np.random.default_rng(3).integers(0, 256, (height // 6, width // 6, 3), dtype=np.uint8)
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


def pan(steps, size=(320, 240)):
    """Pictures of a camera that pans over the wall by these steps, px."""
    left = np.cumsum(steps).astype(int)
    return [wall()[: size[1], x : x + size[0]].copy() for x in left]


def write_video(path, *streams, **options):
    """Encode streams: lists of pictures, or dicts of such a list, their times in ms, and options."""
    forms = [form if isinstance(form, dict) else {"pictures": form} for form in streams]
    with av.open(str(path), "w", options=options) as container:
        opened = []
        for form in forms:
            stream = container.add_stream(form.get("codec", "libx264"), rate=form.get("rate", 30))
            stream.height, stream.width = form["pictures"][0].shape[:2]
            stream.pix_fmt = form.get("format", "yuv420p")
            stream.options = form.get("options", {"crf": "12", "g": "15", "preset": "ultrafast"})
            if "aspect" in form:
                stream.codec_context.sample_aspect_ratio = form["aspect"]
            if "title" in form:
                container.metadata["title"] = form["title"]
            if "rotation" in form:
                stream.set_display_rotation(form["rotation"])
            if "disposition" in form:
                stream.disposition = form["disposition"]
            if "times" in form:
                stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
            opened.append(stream)
        for form, stream in zip(forms, opened, strict=True):
            for number, pixels in enumerate(form["pictures"]):
                frame = av.VideoFrame.from_ndarray(pixels, "rgb24").reformat(format=stream.pix_fmt)
                if "times" in form:
                    frame.pts, frame.time_base = form["times"][number], Fraction(1, 1000)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    return path


def extracted(videos, tmp_path, count, name="frames"):
    folder = tmp_path / name
    folder.mkdir()
    notes = extract_frames(videos, folder, count)
    origin = json.loads((folder / "origin.json").read_text())
    assert sorted(origin["frames"]) == sorted(path.name for path in folder.glob("*.jpg"))
    return folder, notes, [frame["seconds"] for frame in origin["frames"].values()]


def test_the_sharpest_frame_of_each_section_is_selected(tmp_path):
    pictures = pan([0] + [4] * 59)
    sharp = range(3, 60, 6)
    blurred = [p if n in sharp else cv2.GaussianBlur(p, (0, 0), 2.5) for n, p in enumerate(pictures)]
    video = write_video(tmp_path / "a.mp4", blurred)
    _, notes, times = extracted([video], tmp_path, 10)
    assert [round(time * 30) for time in times] == list(sharp)
    assert notes == []


def test_a_resting_camera_gives_one_frame_despite_jitter(tmp_path):
    tremble = [200, *[1, -1] * 40]  # a path of 80 px, never more than one px from the start
    video = write_video(tmp_path / "a.mp4", pan(tremble))
    _, notes, times = extracted([video], tmp_path, 20)
    assert len(times) == 1
    assert notes == ["1 of 20 requested frames selected: the others are too similar"]


def test_frames_are_spread_over_the_path_rather_than_time(tmp_path):
    rest_then_move = [0] * 60 + [5] * 60
    video = write_video(tmp_path / "a.mp4", pan(rest_then_move))
    _, _, times = extracted([video], tmp_path, 10)
    assert len(times) == 10
    assert sum(time >= 2 for time in times) >= 9  # the camera rests for the first two of four seconds


def test_a_recording_without_a_duration_is_read_twice_to_the_same_bytes(tmp_path):
    video = write_video(tmp_path / "a.mkv", pan([0] + [4] * 60), live="1")
    with av.open(str(video)) as container:
        assert container.duration is None
    first, notes, times = extracted([video], tmp_path, 6, "one")
    assert (len(times), notes) == (6, [])
    second, _, _ = extracted([video], tmp_path, 6, "two")
    for path in first.iterdir():
        assert path.read_bytes() == (second / path.name).read_bytes()


def test_the_intact_part_of_a_truncated_video_is_used_and_reported(tmp_path):
    whole = write_video(tmp_path / "a.mp4", pan([0] + [4] * 119), movflags="faststart")
    content = whole.read_bytes()
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(content[: len(content) // 2])
    _, notes, times = extracted([cut], tmp_path, 8)
    assert 1 < max(times) < 3
    assert any(note.startswith("cut.mp4 ends after") and "of 4.0 s" in note for note in notes)
    assert len(times) == 8


def test_damaged_packets_are_left_out_and_counted(tmp_path):
    whole = write_video(tmp_path / "a.mp4", pan([0] + [4] * 60))
    content = bytearray(whole.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 3000] = bytes(3000)
    (tmp_path / "hurt.mp4").write_bytes(content)
    _, notes, times = extracted([tmp_path / "hurt.mp4"], tmp_path, 8)
    assert re.fullmatch("hurt.mp4: [1-4] damaged packets or frames were skipped", notes[0])
    assert len(times) == 8


def test_unreadable_videos_are_refused(tmp_path):
    content = write_video(tmp_path / "a.mp4", pan([0] + [4] * 30)).read_bytes()
    (tmp_path / "cut.mp4").write_bytes(content[: len(content) // 2])  # without the index, which is at the end
    (tmp_path / "text.mov").write_text("no video" * 100)
    (tmp_path / "empty.webm").touch()
    for name in ("cut.mp4", "text.mov", "empty.webm", "gone.mp4"):
        with pytest.raises(SceneError, match=rf"{name} cannot be read(.|\n)*fix"):
            extract_frames([tmp_path / name], tmp_path, 5)


def test_hdr_white_is_compressed_and_darker_light_is_kept():
    """BT.2408: white is 203 nits, 58 % of PQ and 75 % of HLG. Compressed, 1 becomes 0.6 + 0.4 / 2 = 0.8,
    which sRGB encodes as 1.055 * 0.8 ** (1 / 2.4) - 0.055 = 0.906, or 231. A third of white in PQ stays a
    third: sRGB 0.612, or 156."""
    white_pq = int(np.searchsorted(_pq_light(), 1.0))
    assert white_pq / 65535 == pytest.approx(0.58, abs=0.005)
    for signal, is_hlg in ((white_pq, False), (round(0.75 * 65535), True)):
        found = srgb_from_hdr(np.full((2, 2, 3), signal, np.uint16), is_hlg=is_hlg)
        assert np.abs(found.astype(int) - 231).max() <= 1
    assert srgb_from_hdr(np.zeros((1, 1, 3), np.uint16), is_hlg=True).max() == 0
    assert srgb_from_hdr(np.full((1, 1, 3), 65535, np.uint16), is_hlg=False).min() >= 250
    third = int(np.searchsorted(_pq_light(), 1 / 3))
    assert srgb_from_hdr(np.full((1, 1, 3), third, np.uint16), is_hlg=False)[0, 0].tolist() == [156] * 3


def test_ten_bit_hlg_video_is_mapped_to_srgb(tmp_path):
    """A grey of 75 % HLG, in limited range 64 + 0.75 * 876 = 721 of 1023."""
    hlg = {"color_trc": 18, "color_primaries": 9, "colorspace": 9, "color_range": 1}
    frame = av.VideoFrame(64, 48, "yuv420p10le")
    for plane, code in zip(frame.planes, (721, 512, 512), strict=True):
        plane.update(np.full(plane.buffer_size // 2, code, np.uint16).tobytes())
    with av.open(str(tmp_path / "hdr.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p10le"
        for name, value in hlg.items():
            setattr(stream.codec_context, name, value)
            setattr(frame, name, value)
        container.mux([*stream.encode(frame), *stream.encode()])
    folder, _, _ = extracted([tmp_path / "hdr.mkv"], tmp_path, 3)
    assert np.abs(np.asarray(Image.open(folder / "0001.jpg")).astype(int) - 231).max() <= 2


@pytest.mark.parametrize(("size", "expected"), [((64, 48), (254, 0, 0)), ((1280, 720), (255, 24, 0))])
def test_the_matrix_of_an_untagged_stream_follows_its_size(size, expected):
    """BT.601's pure red, (81, 90, 240), is read as BT.601 below 720 lines, otherwise as BT.709."""
    frame = av.VideoFrame(*size, "yuv420p")
    for plane, code in zip(frame.planes, (81, 90, 240), strict=True):
        plane.update(bytes([code]) * plane.buffer_size)
    assert np.abs(rgb_pixels(frame)[0, 0].astype(int) - expected).max() <= 2


def test_displacement_is_the_shift_over_the_diagonal():
    one, other = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pan([0, 20]))
    assert displacement(one, other) == pytest.approx(20 / 400, rel=0.02)  # 320 x 240 has a diagonal of 400
    assert displacement(one, one) < MIN_STEP / 100
    assert displacement(np.zeros((240, 320), np.uint8), np.zeros((240, 320), np.uint8)) == 0
    assert displacement(one, np.zeros((240, 320), np.uint8)) == 0.25  # no corner could be tracked


def zipped(path, entries):
    """A zip archive of (name or ZipInfo, bytes)."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, content in entries:
            opened.writestr(name, content)
    return path


@pytest.fixture
def photos_in_zip(tmp_path):
    """Names and bytes of four photographs."""
    folder = write_noise(tmp_path / "source", 4, suffix=".jpg")
    return [(path.name, path.read_bytes()) for path in sorted(folder.iterdir())]


def sources(sheet):
    return {row.scene: row.source for row in read_sheet(sheet)}


@pytest.fixture
def sheet(tmp_path):
    (tmp_path / "project/config").mkdir(parents=True)
    return tmp_path / "project/config/scenes.tsv"


def test_a_folder_of_videos_is_one_capture_and_a_static_one_leaves_no_files(tmp_path, sheet):
    (tmp_path / "DCIM/clips").mkdir(parents=True)
    for number, left in enumerate((0, 300)):
        write_video(tmp_path / "DCIM/clips" / f"{number}.mp4", pan([left] + [6] * 20))
    report = add_scene(sheet, "desk", tmp_path / "DCIM", frames=10)
    again = str(add_scene(sheet.with_name("b.tsv"), "desk", tmp_path / "DCIM/clips", frames=10, dry_run=True))
    assert "10 frames of 0.mp4, 1.mp4 extracted to" in again
    assert report.sizes == {(240, 320): 10}
    assert "10 frames of 0.mp4, 1.mp4 extracted to" in str(report)
    origin = json.loads((tmp_path / "project/photos/desk/origin.json").read_text())
    assert [frame["video"] for frame in origin["frames"].values()] == ["0.mp4"] * 5 + ["1.mp4"] * 5
    video = write_video(tmp_path / "still.mp4", pan([0] * 20))
    with pytest.raises(SceneError, match=r"too few photographs(.|\n)*1 distinct(.|\n)*a longer video"):
        add_scene(sheet, "still", video)
    assert sources(sheet) == {"desk": "photos/desk"}
    assert not (tmp_path / "project/photos/still").exists()


def test_an_existing_folder_is_kept_and_other_files_are_refused(tmp_path, sheet):
    mine, archive = tmp_path / "project/photos/desk", zipped(tmp_path / "a.zip", [("photos.zip", b"PK")])
    write_noise(mine, 1)
    with pytest.raises(SceneError, match=r"photos/desk already exists"):
        add_scene(sheet, "desk", archive)
    assert len(list(mine.iterdir())) == 1
    with pytest.raises(SceneError, match=r"a\.zip contains no photographs(.|\n)*1 files \(\.zip\)"):
        add_scene(sheet, "room", archive)
    for name, fix in (
        ("notes.txt", "pass the folder"),
        ("a.tar.gz", "unpack"),
        ("a.spz", "--gaussians with a 3DGS"),
    ):
        (tmp_path / name).write_text("x")
        with pytest.raises(
            SceneError, match=rf"{name} has an unsupported file type(.|\n)*a \.zip(.|\n)*{fix}"
        ):
            add_scene(sheet, "desk", tmp_path / name)


def test_a_command_that_was_killed_after_it_unpacked_resumes(tmp_path, sheet):
    made, video = tmp_path / "project/photos/desk", write_video(tmp_path / "walk.mp4", pan([0] + [6] * 20))
    with intake.prepared_photographs(video, made, 10):
        before = sorted(path.stat().st_mtime_ns for path in made.glob("*.*"))
    report = add_scene(sheet, "desk", video, frames=10)  # no frame is extracted again
    assert report.num_readable == 10 and "already exists and was made from the same files" in str(report)
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


def test_a_zip_is_unpacked_and_its_only_folder_unwrapped(tmp_path, photos_in_zip, sheet):
    entries = [(f"Trip 1/best/{name}", content) for name, content in photos_in_zip]
    junk = [("__MACOSX/Trip 1/._0.jpg", b"x"), ("Trip 1/.DS_Store", b"x"), ("Trip 1/run.sh", b"rm -rf")]
    report = add_scene(sheet, "desk", zipped(tmp_path / "trip.ZIP", entries + junk))
    assert report.num_readable == 4
    assert sources(sheet) == {"desk": "photos/desk/Trip 1/best"}
    unpacked = tmp_path / "project/photos/desk"
    files = {path.name: path.read_bytes() for path in unpacked.rglob("[!.]*") if path.is_file()}
    assert files == dict(photos_in_zip)


@pytest.mark.parametrize("dry_run", [True, False])
def test_of_an_archive_with_two_albums_one_must_be_unpacked(tmp_path, photos_in_zip, sheet, dry_run):
    entries = [(f"{album}/{name}", content) for album in "ab" for name, content in photos_in_zip]
    archive = zipped(tmp_path / "albums.zip", entries)
    with pytest.raises(
        SceneError, match=r"4 images in \S+/a/, (.|\n)*removed again(.|\n)*unpack albums\.zip"
    ):
        add_scene(sheet, "desk", archive, dry_run=dry_run)
    assert not (tmp_path / "project/photos").exists() or not list((tmp_path / "project/photos").iterdir())


def link(name):
    entry = zipfile.ZipInfo(name)
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    return entry


NAMES = (
    "../evil.jpg",
    "a/../../evil.jpg",
    "/evil.jpg",
    "..\\evil.jpg",
    "C:\\a\\evil.jpg",
    "\\\\host\\a\\evil.jpg",
)
OUTSIDE = [(name, "would be unpacked outside") for name in NAMES]


@pytest.mark.parametrize(
    ("entry", "problem"), [*OUTSIDE, (link("evil.jpg"), "is a link"), ("0.jpg", "occurs twice")]
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_archives_that_could_write_elsewhere_are_refused(tmp_path, photos_in_zip, sheet, entry, problem):
    bad = zipped(tmp_path / "bad.zip", [*photos_in_zip, (entry, b"x")])
    with pytest.raises(SceneError, match=rf"bad\.zip: entry '.*(evil|0)\.jpg' {problem}"):
        add_scene(sheet, "desk", bad)
    assert not (tmp_path / "project/photos/desk").exists()
    assert not list(tmp_path.rglob("*evil*"))


def test_too_large_archives_are_refused(tmp_path, photos_in_zip, sheet, monkeypatch):
    good = zipped(tmp_path / "good.zip", photos_in_zip)
    for limit, value, message in (("MAX_TOTAL_GIB", 1e-6, "GiB"), ("MAX_FILES", 3, r"3 files(.|\n)*4 files")):
        monkeypatch.setattr(intake, limit, value)
        with pytest.raises(SceneError, match=rf"too large(.|\n)*at most (.|\n)*{message}"):
            add_scene(sheet, "desk", good)


def test_damaged_and_encrypted_archives_are_refused(tmp_path, photos_in_zip, sheet):
    whole = zipped(tmp_path / "a.zip", photos_in_zip).read_bytes()
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


def test_a_failing_command_keeps_the_folder_of_an_earlier_one(tmp_path, photos_in_zip, sheet):
    archive, folder = zipped(tmp_path / "desk.zip", photos_in_zip), tmp_path / "project/photos/desk"
    add_scene(sheet, "desk", archive)
    (folder / "mine.txt").write_text("mine")
    sheet.unlink()  # for example because the user starts a new sheet
    before = sorted(folder.rglob("*"))
    (tmp_path / "labels").mkdir()
    with pytest.raises(SceneError, match=r"--labels .* contains no label file"):
        add_scene(sheet, "desk", archive, labels=tmp_path / "labels")
    assert sorted(folder.rglob("*")) == before


def test_an_interrupted_command_leaves_nothing_of_its_own(tmp_path, photos_in_zip, sheet, monkeypatch):
    folder = tmp_path / "project/photos/desk"

    def interrupt(*_):
        (folder / "mine.txt").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr("hilsplat.workflow.new_scene.inspect_photos", interrupt)
    with pytest.raises(KeyboardInterrupt):
        add_scene(sheet, "desk", zipped(tmp_path / "desk.zip", photos_in_zip))
    assert [path.name for path in folder.rglob("*")] == ["mine.txt"]


def test_a_linked_sheet_is_changed_where_it_is(tmp_path, photos_in_zip, sheet):
    archive, shared = zipped(tmp_path / "desk.zip", photos_in_zip), sheet.with_name("shared.tsv")
    add_scene(sheet, "desk", archive)
    sheet.rename(shared)
    sheet.symlink_to("shared.tsv")
    add_scene(sheet, "room", archive)
    assert sheet.is_symlink()
    assert [row.scene for row in read_sheet(shared)] == ["desk", "room"]
