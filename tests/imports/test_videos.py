"""Videos as cameras and programs write them: pixels that are not square, several streams, pixel formats."""

import json
from fractions import Fraction

import av
import numpy as np
import pytest
from av.stream import Disposition
from PIL import Image

from hilsplat.base.errors import SceneError
from hilsplat.photos.video import extract_frames
from tests.imports import analytic_world as world
from tests.unit.photos.test_intake import write_video

HEIGHT = 96


def picture(size, turn=0.0):
    """A smooth picture of (height, width), a function of the position relative to the sides only."""
    y, x = ((np.arange(n) + 0.5) / n for n in size)
    x, y = np.meshgrid(x, y)
    waves = (7 * x + 2 * y, 5 * y - 3 * x + turn, 6 * x * y + 1)
    return np.stack([127 + 90 * np.sin(wave) for wave in waves], -1).round().astype(np.uint8)


def write(path, *streams):
    """Write streams of equal pictures: dicts of size (height, width) and options."""
    same = {"rate": 10, "options": {"crf": "8", "preset": "ultrafast"}, "turn": 0, "frames": 6}
    forms = (same | form for form in streams)
    return write_video(
        path, *(f | {"pictures": [picture(f["size"], f["turn"])] * f["frames"]} for f in forms)
    )


def extracted(path, count=2):
    """The first extracted picture, and the notes."""
    folder = path.parent / "frames"
    folder.mkdir()
    notes = extract_frames([path], folder, count)
    assert json.loads((folder / "origin.json").read_text())["frames"]
    return np.asarray(Image.open(folder / "0001.jpg")), notes


@pytest.mark.parametrize("suffix", ["mp4", "mov", "mkv"])
@pytest.mark.parametrize(
    ("width", "aspect", "shown", "rotation", "turns"),
    [
        (144, (4, 3), 192, 0, 0),
        (144, (16, 15), 154, 90, 1),
        (128, (3, 4), 96, -90, 3),
        (128, (1, 1), 128, 180, 2),
        (64, (2, 1), 128, 90, 1),
    ],
)
def test_frames_are_stretched_to_square_pixels(tmp_path, suffix, rotation, turns, width, aspect, shown):
    stream = {"size": (HEIGHT, width), "aspect": Fraction(*aspect), "rotation": rotation}
    found, notes = extracted(write(tmp_path / f"a.{suffix}", stream))
    assert world.psnr(found, np.rot90(picture((HEIGHT, shown)), turns)) > 38  # lossy: x264, 4:2:0 and JPEG
    assert notes == [] or "too similar" in notes[0]


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_titles_in_another_encoding_do_not_matter(tmp_path, suffix):
    path = write(tmp_path / f"a.{suffix}", {"size": (HEIGHT, 128), "title": "Vidéo"})
    assert path.read_bytes().count("é".encode()) == 1
    path.write_bytes(path.read_bytes().replace("é".encode(), b"\xe9!"))
    assert world.psnr(extracted(path)[0], picture((HEIGHT, 128))) > 38


@pytest.mark.parametrize("aspect", [Fraction(40, 1), Fraction(1, 40)])
def test_impossible_pixels_are_refused(tmp_path, aspect):
    path = write(tmp_path / "a.mkv", {"size": (HEIGHT, 128), "aspect": aspect})
    with pytest.raises(SceneError, match=r"a\.mkv is too large(.|\n)*aspect"):
        extract_frames([path], tmp_path, 2)


MAIN = {"size": (HEIGHT, 128), "turn": 1.5}
SMALL = {"size": (48, 64)}
COVER = {"size": (300, 300), "codec": "mjpeg", "format": "yuvj420p", "options": {}, "frames": 1}
THUMBNAILS = {"size": (120, 160), "codec": "mjpeg", "format": "yuvj420p", "options": {}}
ATTACHED = {**COVER, "disposition": Disposition.attached_pic}
STREAMS = {
    "cover art": (ATTACHED, MAIN),
    "cover art without its flag": (COVER, MAIN),
    "a small stream first": (SMALL, MAIN),
    "a small default stream": (
        {**SMALL, "disposition": Disposition.default},
        {**MAIN, "disposition": Disposition(0)},
    ),
    "a small stream last": (MAIN, SMALL),
    "thumbnails of a larger size": (THUMBNAILS, MAIN),
    "both": (ATTACHED, SMALL, MAIN),
}


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
@pytest.mark.parametrize("case", STREAMS)
def test_the_best_stream_is_used_and_others_are_reported(tmp_path, case, suffix):
    found, notes = extracted(write(tmp_path / f"a.{suffix}", *STREAMS[case]))
    assert world.psnr(found, picture(MAIN["size"], MAIN["turn"])) > 35
    assert world.psnr(found, picture(MAIN["size"])) < 20  # the others' picture
    assert f"a.{suffix}: video stream" in notes[0] and "128 x 96 px" in notes[0]
    assert notes[0].endswith(f"of {len(STREAMS[case])}")


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_video_that_ends_before_another_stream_is_complete(tmp_path, suffix):
    _, notes = extracted(write(tmp_path / f"a.{suffix}", MAIN, {**SMALL, "frames": 60}))
    assert not any("ends after" in note for note in notes)


def test_equal_streams_are_ranked_by_the_container(tmp_path):
    first, second = ({**MAIN, "turn": turn} for turn in (0.0, 1.5))
    streams = [{**first, "disposition": Disposition(0)}, {**second, "disposition": Disposition.default}]
    found, _ = extracted(write(tmp_path / "a.mkv", *streams))
    assert world.psnr(found, picture(MAIN["size"], 1.5)) > 35


def test_a_video_of_motion_jpeg_is_read(tmp_path):
    found, notes = extracted(write(tmp_path / "a.avi", {**THUMBNAILS, "options": {"qscale": "1"}}))
    assert world.psnr(found, picture(THUMBNAILS["size"])) > 30
    assert not any("stream" in note for note in notes)


def test_a_file_with_only_a_cover_is_refused(tmp_path):
    with av.open(str(tmp_path / "song.mp4"), "w") as container:
        sound = container.add_stream("aac", rate=44100)
        cover = container.add_stream("mjpeg", rate=1)
        cover.height, cover.width, cover.pix_fmt = 64, 64, "yuvj420p"
        cover.disposition = Disposition.attached_pic
        frame = av.AudioFrame.from_ndarray(np.zeros((2, 1024), np.float32), "fltp", "stereo")
        frame.rate = 44100
        container.mux([*sound.encode(frame), *sound.encode()])
        image = av.VideoFrame.from_ndarray(picture((64, 64)), "rgb24").reformat(format="yuvj420p")
        container.mux([*cover.encode(image), *cover.encode()])
    with pytest.raises(SceneError, match=r"song\.mp4 has no video stream(.|\n)*cover art"):
        extract_frames([tmp_path / "song.mp4"], tmp_path, 2)


def test_interlaced_video_is_reported(tmp_path):
    options = {"crf": "8", "x264-params": "interlaced=1:tff=1"}
    _, notes = extracted(write(tmp_path / "a.mp4", {**MAIN, "options": options}))
    assert notes[0].startswith("a.mp4: it is interlaced")


@pytest.mark.parametrize(
    ("codec", "form", "suffix"),
    [
        ("ffv1", "yuv420p10le", "mkv"),
        ("prores_ks", "yuv422p10le", "mov"),
        ("prores_ks", "yuva444p10le", "mov"),
        ("ffv1", "yuva420p", "mkv"),
        ("qtrle", "argb", "mov"),
        ("png", "rgb24", "mov"),
        ("libvpx-vp9", "yuv420p", "webm"),
    ],
)
def test_pixel_formats_keep_their_colours(tmp_path, codec, form, suffix):
    stream = {"size": (HEIGHT, 128), "codec": codec, "format": form, "options": {}}
    found, _ = extracted(write(tmp_path / f"a.{suffix}", stream))
    assert world.psnr(found, picture((HEIGHT, 128))) > 35


@pytest.mark.parametrize(
    ("suffix", "start_ms"), [("mp4", -650), ("mp4", 0), ("mp4", 500_000), ("mkv", 0), ("mkv", 500_000)]
)
def test_times_start_at_the_first_frame_that_is_shown(tmp_path, suffix, start_ms):
    """MP4 gets an edit list that hides frames before 0, as phones write for trimmed videos."""
    times = [0, 200, 650, 2000]
    # pictures without a common corner, so that each is selected
    pictures = list(np.random.default_rng(2).integers(0, 256, (len(times), HEIGHT, 128, 3), np.uint8))
    stream = {"pictures": pictures, "times": [start_ms + time_ms for time_ms in times]}
    path = write_video(tmp_path / f"a.{suffix}", stream)
    times = times if start_ms >= 0 else [0, 1350]
    notes = extract_frames([path], tmp_path, len(times))
    assert notes == []
    frames = json.loads((tmp_path / "origin.json").read_text())["frames"].values()
    assert [round(1000 * frame["seconds"]) for frame in frames] == times
