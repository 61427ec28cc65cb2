"""Extraction of photographs from videos: the sharpest frame of each section of the camera path."""

import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.stream import Disposition
from av.video.stream import VideoStream
from jaxtyping import Int64, UInt8
from packaging.version import Version
from PIL import Image

from hilsplat.base.artifacts import write_json
from hilsplat.base.errors import SceneError, foreign
from hilsplat.base.lineage import sha256_of_file
from hilsplat.base.progress import track
from hilsplat.photos.video_colours import rgb_pixels

logger = logging.getLogger(__name__)

CANDIDATES_PER_FRAME = 4
"""Number of candidate frames per requested frame. The camera path is measured on the candidates."""

MIN_STEP = 0.01
"""Displacement between two frames, as a share of the diagonal, below which they count as the same. For
a phone's 70-degree view, it is about 0.7 degrees. The noise of a static camera is below 0.001."""

GREY_SIDE_PX = 480
SHARPNESS_SIDE_PX = 960
"""Longer side of the grey copies: `GREY_SIDE_PX` for motion, `SHARPNESS_SIDE_PX` for sharpness."""

MAX_FRAME_PX = 8192 * 4352
LIMIT = {"max_pixels": str(MAX_FRAME_PX)}
"""Maximum size of a frame, as in level 6.2 of H.265 (8K); decoders keep up to 16 frames in memory."""

OPTIONS = {"format_whitelist": "mov,matroska,avi", "protocol_whitelist": "file", "enable_drefs": "0"}
"""FFmpeg's options that keep a video from naming other files to read: demuxers of `VIDEO_SUFFIXES` only,
without playlists; no network; no tracks in external files."""

METADATA: dict[str, Any] = {"metadata_errors": "replace"} if Version(av.__version__).major < 19 else {}
"""What lets titles be in another encoding than UTF-8; newer releases of PyAV need nothing."""

JPEG_QUALITY = 95
USUAL_RATE = 30.0  # assumed frames per second for files without a frame rate or timestamps

NUM_CORNERS = 300
PYRAMID_LEVELS = 4
LOST = 0.25  # displacement, as a share of the diagonal, assumed if too few corners can be tracked
MIN_FOLLOWED = 20  # minimum number of corners tracked forwards and backwards for a valid measurement


@dataclass(frozen=True)
class Frame:
    """A video frame that may become a photograph.

    `number` is its index among the intact frames of its video. `grey` is a small copy, not rotated upright.
    """

    video: int
    number: int
    time_s: float
    sharpness: float
    grey: UInt8[np.ndarray, "h w"]


@dataclass
class Decoding:
    """Decoding statistics: duration in the file's metadata, time of the last intact frame, counts, notes."""

    stated_s: float | None = None
    decoded_s: float = 0.0
    num_frames: int = 0
    num_damaged: int = 0
    notes: list[str] = field(default_factory=list)


def extract_frames(videos: Sequence[Path], folder: Path, count: int) -> list[str]:
    """Write selected frames of videos, and `origin.json`, to a folder; return notes.

    The camera path through all videos, measured by the displacement of image corners, is divided into `count`
    sections of equal length, and the sharpest frame of each is selected. A camera at rest yields one frame; a
    short path yields fewer than `count`. Frames are stretched to square pixels, rotated upright according to
    the stream's display matrix, and stored as 0001.jpg, 0002.jpg, ... at full size and quality 95. The same
    videos produce the same bytes.

    A video is decoded twice, once to select and once to write frames, so that only small copies are kept
    in memory.

    Raises:
        SceneError: a video cannot be read or has no intact frame.
    """
    notes: list[str] = []
    candidates: list[Frame] = []
    for position, video in enumerate(videos):
        decoding = Decoding()
        with foreign(f"video {video}", fix="convert it to H.264 in an .mp4"):
            candidates += _candidates(video, position, CANDIDATES_PER_FRAME * count, decoding)
        if not decoding.num_frames:
            raise SceneError(
                f"no frame of video {video} can be decoded",
                found=f"{decoding.num_damaged} damaged packets, {video.stat().st_size} bytes",
                fix="play it to see whether it is intact; copy it again, or convert it to H.264 in an .mp4",
            )
        notes += [f"{video.name}: {note}" for note in decoding.notes]
        if decoding.num_damaged:
            notes.append(f"{video.name}: {decoding.num_damaged} damaged packets or frames were skipped")
        if decoding.stated_s is not None and decoding.decoded_s < 0.9 * decoding.stated_s - 1:
            notes.append(
                f"{video.name} ends after {decoding.decoded_s:.1f} of {decoding.stated_s:.1f} s: only this "
                "part is used; copy the file again if you need the rest"
            )
    frames = {f"{row:04d}.jpg": frame for row, frame in enumerate(choose_frames(candidates, count), start=1)}
    if len(frames) < count:
        notes.append(f"{len(frames)} of {count} requested frames selected: the others are too similar")
    for position, video in enumerate(videos):
        names = {frame.number: name for name, frame in frames.items() if frame.video == position}
        _write_frames(video, names, folder)
    origin = {
        "videos": [{"file": video.name, "sha256": sha256_of_file(video)} for video in videos],
        "settings": {"frames": count, "min_step": MIN_STEP, "jpeg_quality": JPEG_QUALITY},
        "frames": {
            name: {
                "video": videos[frame.video].name,
                "seconds": round(frame.time_s, 3),
                "sharpness": round(frame.sharpness, 2),
            }
            for name, frame in frames.items()
        },
    }
    write_json(folder / "origin.json", origin)
    return notes


@contextmanager
def _opened(video: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Open the best video stream of a file; cover art and other attached pictures are never opened."""
    expected = "an intact .mp4, .mov, .mkv, .webm or .avi; a truncated .mp4 or .mov lacks its index"
    fix = "copy it again from the camera, or convert it to H.264 in an .mp4"
    with foreign(f"video {video}", expected=expected, fix=fix):
        container = av.open(f"file:{video}", options=OPTIONS | LIMIT, **METADATA)
    with container:
        picture = Disposition.attached_pic | Disposition.timed_thumbnails | Disposition.still_image
        decodable = [s for s in container.streams.video if s.codec_context and not s.disposition & picture]
        if not decodable:
            raise SceneError(
                f"{video} has no video stream",
                found=", ".join(stream.type for stream in container.streams) or "no stream",
                fix="pass a file that contains video, not only cover art, in a codec that FFmpeg decodes",
            )

        def rank(stream: VideoStream) -> tuple[bool, bool, int, bool]:
            # Thumbnails have one frame or these codecs. FFmpeg's choice may only reflect the streams' order.
            is_film = stream.codec_context.name not in ("mjpeg", "png")
            is_best = stream == container.streams.best("video")
            return stream.frames != 1, is_film, stream.width * stream.height, is_best

        stream = max(decodable, key=rank)
        aspect = float(stream.sample_aspect_ratio or 1)
        if not 0.1 < aspect < 10 or stream.width * stream.height * max(aspect, 1) > MAX_FRAME_PX:
            expected = "frames of at most 8192 x 4352 px"
            found = f"{stream.width} x {stream.height} px with a pixel aspect ratio of {aspect:.3g}"
            raise SceneError(f"video {video} is too large", expected=expected, found=found, fix="rescale it")
        stream.codec_context.options = LIMIT  # frames may be larger than the header states
        stream.thread_type = "AUTO"
        yield container, stream


def _decoded(
    container: InputContainer, stream: VideoStream, decoding: Decoding
) -> Iterator[tuple[av.VideoFrame, float]]:
    """Yield the intact frames of a video with their times in seconds, in presentation order.

    Damaged packets are counted and skipped; a truncated file yields its intact part.
    """
    rate = float(stream.average_rate or USUAL_RATE)
    start: float | None = None
    packets = container.demux(stream)
    while True:
        try:
            frames = next(packets).decode()
        except (av.error.EOFError, StopIteration):
            return
        except av.error.FFmpegError as error:
            logger.debug("%s", error)
            decoding.num_damaged += 1
            continue
        for frame in frames:
            if not isinstance(frame, av.VideoFrame) or frame.is_corrupt:
                decoding.num_damaged += 1
                continue
            time_s = frame.time if frame.time is not None else decoding.num_frames / rate
            start = time_s if start is None else start
            decoding.decoded_s = max(decoding.decoded_s, time_s - start)
            decoding.num_frames += 1
            yield frame, time_s - start


def _candidates(video: Path, position: int, max_spans: int, decoding: Decoding) -> list[Frame]:
    """Divide a video into at most `max_spans` equal time spans; return the sharpest frame of each.

    The stated duration may be wrong, or missing, as in browser recordings. If this leads to too many spans,
    they are merged in pairs, keeping the sharper frame.
    """
    best: dict[int, Frame] = {}
    with _opened(video) as (container, stream):
        if (num_streams := len(container.streams.video)) > 1:
            used = f"{stream.index} ({stream.width} x {stream.height} px)"
            decoding.notes.append(f"video stream {used} is used, the best of {num_streams}")
        tag = re.fullmatch(r"(\d+):(\d\d):(\d\d[.\d]*)", stream.metadata.get("DURATION", ""))
        if tag is not None:  # Matroska; the container's duration is that of the longest stream
            decoding.stated_s = 3600 * int(tag[1]) + 60 * int(tag[2]) + float(tag[3])
        elif stream.duration is not None and stream.time_base is not None:
            decoding.stated_s = float(stream.duration * stream.time_base)
        elif container.duration is not None:
            decoding.stated_s = container.duration / av.time_base
        expected = round((decoding.stated_s or 0.0) * float(stream.average_rate or USUAL_RATE)) or None
        decoded = track(_decoded(container, stream, decoding), f"frames of {video.name}", expected)
        for number, (frame, time_s) in enumerate(decoded):
            if number == 0:
                stated_s, before_s = decoding.stated_s or 0.0, frame.time or 0.0
                # Matroska's duration includes the time before the first frame.
                if "matroska" in container.format.name and 0 < before_s < stated_s:
                    decoding.stated_s = stated_s = stated_s - before_s
                span_s = max(stated_s / max_spans, 1e-3)
                if frame.interlaced_frame:
                    decoding.notes.append("it is interlaced: deinterlace it first if edges are combed")
            row = int(time_s / span_s)
            score = sharpness(_grey(frame, SHARPNESS_SIDE_PX))
            if row in best and best[row].sharpness >= score:
                continue
            best[row] = Frame(position, number, time_s, score, _grey(frame, GREY_SIDE_PX))
            while len(best) > max_spans:
                span_s *= 2
                by_sharpness = sorted(best.items(), key=lambda item: (item[1].sharpness, -item[1].number))
                best = {row // 2: candidate for row, candidate in by_sharpness}  # the sharper one is kept
    return sorted(best.values(), key=lambda candidate: candidate.number)


def _grey(frame: av.VideoFrame, side_px: int) -> UInt8[np.ndarray, "h w"]:
    scale = min(1.0, side_px / max(frame.width, frame.height))
    size = {"width": max(2, round(frame.width * scale)), "height": max(2, round(frame.height * scale))}
    return frame.reformat(**size, format="gray", interpolation="AREA", threads=1).to_ndarray()


def _write_frames(video: Path, name_of_frame: dict[int, str], folder: Path) -> None:
    """Write the selected frames of a video upright, at full size."""
    missing = dict(name_of_frame)
    with _opened(video) as (container, stream):
        for number, (frame, _) in enumerate(_decoded(container, stream, Decoding())):
            if number in missing:
                # The display matrix rotates anticlockwise; only quarter turns are applied.
                square = rgb_pixels(frame, round(frame.width * (stream.sample_aspect_ratio or 1)))
                pixels = np.ascontiguousarray(np.rot90(square, round(frame.rotation / 90) % 4))
                Image.fromarray(pixels).save(folder / missing.pop(number), quality=JPEG_QUALITY)
            if not missing:
                break
    if missing:
        raise SceneError(
            f"video {video} decoded differently the second time: {len(missing)} frames are missing",
            fix="check that no program is writing to the file, and try again",
        )


def choose_frames(candidates: Sequence[Frame], count: int) -> list[Frame]:
    """Select the sharpest candidate of each of at most `count` equal sections of the camera path.

    Of two selected frames less than `MIN_STEP` apart, only the sharper one is kept. This also removes
    frames due to hand jitter, which lengthens the path although the camera stays in place.
    """
    frames: list[Frame] = []
    section_of = _sections([_step(a, b) for a, b in pairwise(candidates)], count)
    for _, group in groupby(zip(section_of.tolist(), candidates, strict=True), key=lambda item: item[0]):
        best = max((frame for _, frame in group), key=lambda frame: frame.sharpness)
        if not frames or _step(frames[-1], best) >= MIN_STEP:
            frames.append(best)
        elif best.sharpness > frames[-1].sharpness:
            frames[-1] = best
    return frames


def _sections(steps: Sequence[float], count: int) -> Int64[np.ndarray, " N"]:
    """Return the section number of each candidate, given the steps between candidates.

    Sections are as short as possible, but at least `MIN_STEP` long, and there are at most `count`. A step
    longer than a section cannot be divided, so it counts as one section.
    """

    def sections(length: float) -> Int64[np.ndarray, " N"]:
        path = np.concatenate([[0.0], np.cumsum(np.minimum(steps, length))])
        return np.floor(path / length + 1e-9).astype(np.int64)

    short, long = MIN_STEP, max(sum(steps), MIN_STEP) * 1.01
    if sections(short)[-1] < count:
        return sections(short)
    for _ in range(40):
        middle = (short + long) / 2
        short, long = (short, middle) if sections(middle)[-1] < count else (middle, long)
    return sections(long)


def _step(one: Frame, other: Frame) -> float:
    """Return the displacement between two frames (share of the diagonal); across videos, `MIN_STEP`."""
    if one.video != other.video or one.grey.shape != other.grey.shape:
        return MIN_STEP
    return displacement(one.grey, other.grey)


def sharpness(grey: UInt8[np.ndarray, "h w"]) -> float:
    """Compute the variance of the Laplacian (Pech-Pacheco et al. 2000), which is large for sharp edges.

    Values are comparable only between pictures of the same place, because they depend on the content.
    """
    return float(cv2.Laplacian(grey, cv2.CV_32F, ksize=3).var())


def displacement(one: UInt8[np.ndarray, "h w"], other: UInt8[np.ndarray, "h w"]) -> float:
    """Return the upper quartile of corner displacements between two pictures, as a share of the diagonal.

    Corners are tracked forwards and backwards with pyramidal Lucas-Kanade. Those that return a pixel or more
    from their start are ignored. Unlike the median, the upper quartile captures an object on a turntable in
    front of a static background. Return 0 if there are too few corners, and `LOST` if too few can be tracked.
    """
    corners = cv2.goodFeaturesToTrack(one, NUM_CORNERS, qualityLevel=0.01, minDistance=7)
    if corners is None or len(corners) < MIN_FOLLOWED:
        return 0.0
    there, is_tracked = _followed(one, other, corners)
    back, is_returned = _followed(other, one, there)
    sound = is_tracked & is_returned & (np.linalg.norm(back - corners, axis=2).ravel() < 1)
    if sound.sum() < MIN_FOLLOWED:
        return LOST
    moved = np.linalg.norm((there - corners)[sound].reshape(-1, 2), axis=1)
    return float(np.percentile(moved, 75) / np.hypot(*one.shape))


def _followed(
    one: UInt8[np.ndarray, "h w"], other: UInt8[np.ndarray, "h w"], corners: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of corners in the other picture, (n, 1, 2), and whether each was found, (n)."""
    start = np.zeros_like(corners)
    there, status, _ = cv2.calcOpticalFlowPyrLK(one, other, corners, start, maxLevel=PYRAMID_LEVELS)
    return np.asarray(there), np.asarray(status).ravel() > 0
