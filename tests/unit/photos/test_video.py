"""Photographs from videos are sharp, distinct, upright, in sRGB, and the same bytes each time."""

import json
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from hilsplat.base.errors import SceneError
from hilsplat.photos.video import MIN_STEP, displacement, extract_frames
from hilsplat.photos.video_colours import _pq_light, rgb_pixels, srgb_from_hdr


def wall(width=900, height=240):
    """A textured wall to pan over: smooth noise, so that it survives coding."""
    noise = np.random.default_rng(3).integers(0, 256, (height // 6, width // 6, 3), dtype=np.uint8)
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


def pan(steps, size=(320, 240)):
    """Pictures of a camera that moves over the wall by these steps, px."""
    left = np.cumsum(steps).astype(int)
    return [wall()[: size[1], x : x + size[0]].copy() for x in left]


def write_video(path, pictures, codec="libx264", times=None, rotation=None, **options):
    """Encode pictures, at 30 per second or at given times in milliseconds."""
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream(codec, rate=30)
        height, width = pictures[0].shape[:2]
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        if codec == "libx264":
            stream.options = {"crf": "12", "g": "15", "preset": "ultrafast"}
        if rotation is not None:
            stream.set_display_rotation(rotation)
        if times is not None:
            stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for number, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, "rgb24")
            if times is not None:
                frame.pts, frame.time_base = times[number], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def extracted(videos, tmp_path, count, name="frames"):
    folder = tmp_path / name
    folder.mkdir()
    notes = extract_frames(videos, folder, count)
    origin = json.loads((folder / "origin.json").read_text())
    assert sorted(origin["frames"]) == sorted(path.name for path in folder.glob("*.jpg"))
    return folder, notes, origin


def test_the_sharpest_frame_of_each_section_is_taken(tmp_path):
    pictures = pan([0] + [4] * 59)
    sharp = range(3, 60, 6)
    blurred = [p if n in sharp else cv2.GaussianBlur(p, (0, 0), 2.5) for n, p in enumerate(pictures)]
    video = write_video(tmp_path / "a.mp4", blurred)
    _, notes, origin = extracted([video], tmp_path, 10)
    times = [frame["seconds"] for frame in origin["frames"].values()]
    assert [round(time * 30) for time in times] == list(sharp)
    assert notes == []


def test_a_resting_camera_gives_one_frame_despite_jitter(tmp_path):
    tremble = [200, *[1, -1] * 40]  # a path of 80 px, at most one of them from the start
    video = write_video(tmp_path / "a.mp4", pan(tremble))
    _, notes, origin = extracted([video], tmp_path, 20)
    assert len(origin["frames"]) == 1
    assert notes == ["1 frames instead of 20: the others differ too little from these"]


def test_frames_are_spread_over_the_path_rather_than_time(tmp_path):
    rest_then_move = [0] * 60 + [5] * 60
    video = write_video(tmp_path / "a.mp4", pan(rest_then_move))
    _, _, origin = extracted([video], tmp_path, 10)
    times = [frame["seconds"] for frame in origin["frames"].values()]
    assert len(times) == 10
    assert sum(time >= 2 for time in times) >= 9  # the camera rests for the first two of four seconds


@pytest.mark.parametrize(("rotation", "turns"), [(90, 1), (-90, -1), (180, 2)])
def test_the_display_matrix_turns_frames_upright(tmp_path, rotation, turns):
    video = write_video(tmp_path / "a.mov", pan([0] + [6] * 12), rotation=rotation)
    folder, _, origin = extracted([video], tmp_path, 3)
    first = round(origin["frames"]["0001.jpg"]["seconds"] * 30)
    expected = np.rot90(pan([0] + [6] * 12)[first], turns)  # anticlockwise
    found = np.asarray(Image.open(folder / "0001.jpg")).astype(int)
    assert found.shape == expected.shape
    assert np.abs(found - expected).mean() < 12


def test_times_are_those_of_the_stream_rather_than_its_rate(tmp_path):
    times = [0, 200, 400, 1500, 1700, 3000, 3400, 4000]
    video = write_video(tmp_path / "a.mkv", pan([0] + [20] * 7), times=times)
    _, _, origin = extracted([video], tmp_path, 8)
    assert [round(frame["seconds"] * 1000) for frame in origin["frames"].values()] == times
    assert origin["videos"][0]["seconds"] == 4.0


@pytest.mark.parametrize(("suffix", "codec"), [(".webm", "libvpx"), (".avi", "mpeg4"), (".mkv", "libx264")])
def test_other_containers_are_read(tmp_path, suffix, codec):
    video = write_video(tmp_path / f"a{suffix}", pan([0] + [6] * 20), codec)
    assert len(extracted([video], tmp_path, 5)[2]["frames"]) == 5


def test_a_recording_without_a_duration_is_read_twice_to_the_same_bytes(tmp_path):
    video = write_video(tmp_path / "a.mkv", pan([0] + [4] * 60), live="1")
    with av.open(str(video)) as container:
        assert container.duration is None
    first, notes, origin = extracted([video], tmp_path, 6, "one")
    assert (len(origin["frames"]), notes) == (6, [])
    second, _, _ = extracted([video], tmp_path, 6, "two")
    for path in first.iterdir():
        assert path.read_bytes() == (second / path.name).read_bytes()


def test_several_videos_share_the_frames_by_path_length(tmp_path):
    long = write_video(tmp_path / "long.mp4", pan([0] + [6] * 40))
    short = write_video(tmp_path / "short.mp4", pan([400] + [6] * 10))
    _, _, origin = extracted([long, short], tmp_path, 10)
    sources = [frame["video"] for frame in origin["frames"].values()]
    num_long = sources.count("long.mp4")
    assert sources == ["long.mp4"] * num_long + ["short.mp4"] * (10 - num_long)
    assert num_long in (7, 8)
    assert [video["file"] for video in origin["videos"]] == ["long.mp4", "short.mp4"]


def test_the_intact_part_of_a_truncated_video_is_used_and_reported(tmp_path):
    whole = write_video(tmp_path / "a.mp4", pan([0] + [4] * 119), movflags="faststart")
    content = whole.read_bytes()
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(content[: len(content) // 2])
    _, notes, origin = extracted([cut], tmp_path, 8)
    assert 1 < origin["videos"][0]["seconds"] < 3
    assert any(note.startswith("cut.mp4 ends after") and "of 4.0 s" in note for note in notes)
    assert len(origin["frames"]) == 8


def test_damaged_packets_are_left_out_and_counted(tmp_path):
    whole = write_video(tmp_path / "a.mp4", pan([0] + [4] * 60))
    content = bytearray(whole.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 3000] = bytes(3000)
    (tmp_path / "hurt.mp4").write_bytes(content)
    _, notes, origin = extracted([tmp_path / "hurt.mp4"], tmp_path, 8)
    damaged, sound = origin["videos"][0]["damaged"], origin["videos"][0]["frames"]
    assert 0 < damaged < 5
    assert sound == 61 - damaged
    assert notes[0] == f"hurt.mp4: {damaged} damaged packets or frames were left out"


def test_unreadable_videos_are_refused(tmp_path):
    content = write_video(tmp_path / "a.mp4", pan([0] + [4] * 30)).read_bytes()
    (tmp_path / "cut.mp4").write_bytes(content[: len(content) // 2])  # without the index, which is at the end
    (tmp_path / "text.mov").write_text("no video" * 100)
    (tmp_path / "empty.webm").touch()
    for name in ("cut.mp4", "text.mov", "empty.webm", "gone.mp4"):
        with pytest.raises(SceneError, match=rf"{name} cannot be read(.|\n)*fix"):
            extract_frames([tmp_path / name], tmp_path, 5)
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((2, 1024), np.float32), "fltp", "stereo")
        frame.rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(SceneError, match=r"sound\.mp4 has no video stream\n.*audio"):
        extract_frames([tmp_path / "sound.mp4"], tmp_path, 5)


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
    """BT.601's pure red, (81, 90, 240), is read by BT.601 below 720 lines and by BT.709 from there on."""
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
