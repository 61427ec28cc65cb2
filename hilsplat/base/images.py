"""Reading and writing of images: upright, sRGB, channel-last."""

import functools
import io
import logging
import math
import re
import threading
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, UInt8
from PIL import ExifTags, Image, ImageCms, PngImagePlugin

from hilsplat.base.atomic import atomic_path
from hilsplat.base.errors import ImageError, foreign
from hilsplat.base.files import stats_of

logger = logging.getLogger(__name__)

FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP", "AVIF", "HEIF")
"""Pillow's names of the formats of `IMAGE_SUFFIXES` (JPEG includes phones' MPO). All other formats are
refused whatever the suffix: for EPS, Pillow starts Ghostscript, which runs the program in the file."""

UPRIGHT = dict(zip(range(2, 9), (Image.Transpose(move) for move in (0, 3, 1, 5, 4, 6, 2)), strict=True))
"""How to turn a picture upright, by EXIF orientation."""

PROFILE_MODES = {b"RGB ": "RGB", b"GRAY": "L", b"CMYK": "CMYK"}
"""Pillow's mode of a colour profile, by the colour space in its header."""

HDR = re.compile(rb"colrnclx..\0[\x10\x12]|cICP.[\x10\x12]", re.DOTALL)
"""The box of AVIF, and the chunk of PNG, that state a transfer function of HDR."""

MAX_PX = 2 * (Image.MAX_IMAGE_PIXELS or 0)  # Pillow refuses more in a file's first picture

MAX_READERS, READ_PX = 4, 100_000_000
"""Maximum number of threads that read photographs at once, and of pixels that they may hold together."""

MIN_SIDE_PX, MAX_ASPECT = 16, 20  # limits on photographs; all stages were run on 16 x 16 and 320 x 16 px

SLIVER = 0.01
"""Share of transparent pixels up to which a mask counts as opaque, such as one with rounded corners."""

MAX_CLASSES = 20  # maximum number of values in a map of classes; compressed or smooth masks have more

GREY_NOISE = 16
"""Difference between the channels up to which a mask's pixel counts as grey, as after lossy compression."""

_FILTERS = threading.RLock()  # warning filters are those of all threads


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Ignore what Pillow warns about, such as large images and odd EXIF tags."""
    with _FILTERS, warnings.catch_warnings(action="ignore"):
        yield


def open_image(file: Path | io.BytesIO, max_side_px: int = 2**16) -> Image.Image:
    """Open an image with Pillow, which reads HEIF (.heic) through pillow-heif.

    Size and EXIF data are read immediately; pixels are decoded on demand. A HEIF image is returned upright:
    its rotation is part of the format, and its EXIF orientation is reset.

    Raises:
        ImageError: the header specifies more pixels than a photograph can have, or sides above `max_side_px`.
        OSError: the file is missing or has none of the `FORMATS`.
    """
    formats: tuple[str, ...] = FORMATS
    if _head(file, 8)[4:] == b"ftyp":  # the file is made of ISO's boxes, as HEIF and AVIF are
        import pillow_heif  # 30 MB of libraries, which other formats don't need

        pillow_heif.register_heif_opener()
    else:
        formats = tuple(name for name in FORMATS if name != "HEIF")
    try:
        with _without_warnings():
            image = Image.open(file, formats=formats)
            if image.format == "TIFF":
                image.filename = ""  # else Pillow 13 maps the file into memory, and scrambles turned pictures
                with suppress(EOFError):
                    while image.tell() < 4 and image.tag_v2.get(ExifTags.Base.NewSubfileType) == 1:  # type: ignore
                        image.seek(image.tell() + 1)  # a reduced copy may come first
        if max(image.size) > max_side_px or math.prod(image.size) > MAX_PX:
            raise Image.DecompressionBombError(f"{image.width} x {image.height} px")
    except Image.DecompressionBombError as error:
        raise ImageError(
            f"image {file} is too large: {str(error).partition(',')[0]}",
            expected=f"at most {MAX_PX / 1e6:.0f} MP, {max_side_px} px per side",
            fix="shrink or remove it",
        ) from error
    return image


def _head(file: Path | io.BytesIO, count: int) -> bytes:
    """Return the first bytes of a file."""
    if isinstance(file, io.BytesIO):
        return bytes(file.getbuffer()[:count])
    with file.open("rb") as stream:
        return stream.read(count)


@contextmanager
def opened_image(path: Path, what: str = "image") -> Iterator[Image.Image]:
    """Open an image as `open_image` does; raise ImageError if opening or the block fails on its content."""
    fix = "replace it with an intact copy"
    with foreign(f"{what} {path}", ImageError, fix=fix), open_image(path) as image:
        yield image


def image_size_hw(path: Path, *, upright: bool = False) -> tuple[int, int]:
    """Read an image's height and width, as stored or upright, from its header; ImageError if unreadable."""
    with opened_image(path) as image:
        # Pillow states the upright size of a TIFF.
        is_other = orientation(image) > 4 and upright != (image.format == "TIFF")
        return (image.width, image.height) if is_other else (image.height, image.width)


def num_readers(photos: Iterable[Path], threads: int) -> int:
    """Return the number of threads that may read photographs at once, by the pixels of the largest file."""
    sizes = {path: stat.st_size for path, stat in stats_of(photos).items()}
    pixels = 1
    with suppress(ImageError, OSError, ValueError):  # reading it reports the problem; there may be no file
        pixels = math.prod(image_size_hw(max(sizes, key=sizes.__getitem__)))
    return max(1, min(threads, MAX_READERS, READ_PX // pixels))


def exif_tags(image: Image.Image, ifd: ExifTags.IFD | None = None) -> Mapping[int, Any]:
    """Return an image's EXIF tags, those of its main directory or of `ifd`; skip damaged ones."""
    values = {}
    with _without_warnings(), suppress(Exception):  # Pillow raises anything
        exif = image.getexif()
        tags: Mapping[int, Any] = exif if ifd is None else exif.get_ifd(ifd)
        for tag in tags:
            with suppress(Exception):
                values[tag] = tags[tag]
    return values


def orientation(image: Image.Image) -> int:
    """Return the EXIF orientation, 1 to 8; 1 if there is none."""
    value = exif_tags(image).get(ExifTags.Base.Orientation)
    return value if isinstance(value, int) and value in UPRIGHT else 1


def read_image(
    file: Path | io.BytesIO, max_side_px: int = 2**16, *, as_stored: bool = False
) -> UInt8[np.ndarray, "H W 3"]:
    """Read an image as sRGB, upright or, for poses computed without EXIF, as stored.

    Upright, the EXIF orientation is applied. Colours with an embedded profile (Display P3 from phones, Adobe
    RGB) and CMYK are converted, alpha is dropped, grey is copied to all channels, and 16-bit values become
    8-bit.

    Raises:
        ImageError: the file is missing, empty, truncated, too large (`open_image`) or not an image.
    """
    fix = "remove it from the folder, or replace it with an intact copy"
    with foreign(f"image {file}", ImageError, fix=fix), open_image(file, max_side_px) as image:
        if _is_animation(image):
            raise ValueError("it contains several frames of the same size, like an animation")
        if _is_hdr(image, file):
            raise ValueError("its colours are HDR (PQ or HLG); export it as JPEG")
        turn = orientation(image) if image.format == "TIFF" else 0  # read first: Pillow turns it upright
        image.load()  # raises only the first time, so nothing may have loaded it before
        turn = turn or orientation(image)
        if image.format == "TIFF":
            turn = {6: 8, 8: 6}.get(turn, turn) if as_stored else 1
        elif as_stored:
            turn = 1
        pixels = image if turn == 1 else image.transpose(UPRIGHT[turn])
        if image.mode.startswith("I"):
            pixels = Image.fromarray(_eight_bits(np.asarray(pixels)))
        if image.mode == "F":
            raise ValueError("its pixels are floating-point numbers of unknown range")
        return np.asarray(_to_srgb(pixels, image.info, file))


def _eight_bits(values: np.ndarray) -> UInt8[np.ndarray, "H W"]:
    """Convert 16-bit grey values, which Pillow would clip at 255."""
    values = values.astype(np.int64)
    if values.min() < 0 or values.max() > np.iinfo(np.uint16).max:
        raise ValueError(f"its grey values, {values.min()} to {values.max()}, do not fit into 16 bits")
    return ((values + 128) // 257).astype(np.uint8)  # 257: 65535 / 255


def read_mask(path: Path) -> UInt8[np.ndarray, "H W"]:
    """Read the grey values of a mask, 0 to 255, as stored.

    They are the alpha channel, scaled to 255, if it is 0 on more than `SLIVER` of the pixels (cut-outs,
    brushes) or nothing else varies; else the colours as grey. A single colour on black is 255; grey counts
    as a colour only in a palette. 16-bit values above 255 become 8-bit.

    Raises:
        ImageError: the file is missing or not an image, or has several classes, as colours or as ids.
    """
    with opened_image(path, "mask") as image:
        if image.mode.startswith(("I", "F")):
            values = np.asarray(image)
            if (values != np.rint(values)).any():
                raise ValueError("its grey values are fractions of unknown range")
            is_byte = values.min() >= 0 and values.max() <= 255
            grey = values.astype(np.uint8) if is_byte else _eight_bits(values)
        elif image.mode in ("1", "L") and not image.has_transparency_data:
            grey = np.asarray(image.convert("L"))
        else:
            rgba = np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB").convert("RGBA"))
            colours, alpha = rgba[..., :3], rgba[..., 3]
            is_plain, is_clear = (colours == colours[0, 0]).all(), (alpha == 0).mean()
            if SLIVER < is_clear < 1 or (is_plain and alpha.min() < max(alpha.max(), 1)):
                if 1 < (num_colours := _num_colours(colours[alpha == alpha.max()])) <= MAX_CLASSES:
                    raise _several_classes(path, f"{num_colours} colours")
                return (alpha.astype(np.float64) * 255 / max(alpha.max(), 1) + 0.5).astype(np.uint8)
            has_colour = (np.ptp(colours, axis=2) > GREY_NOISE).any()
            if has_colour or image.mode == "P":
                is_other = colours.any(axis=2)
                if not is_other.all() and _num_colours(colours[is_other]) == 1:
                    return np.where(is_other, 255, 0).astype(np.uint8)
                if has_colour:
                    raise _several_classes(path, f"{_num_colours(colours)} colours")
            grey = np.asarray(Image.fromarray(colours).convert("L"))
    if 2 < len(values := np.unique(grey)) <= MAX_CLASSES and values[-1] < 255:
        raise _several_classes(path, f"{len(values)} grey values up to {values[-1]}")
    return grey


def _num_colours(colours: UInt8[np.ndarray, "*N 3"]) -> int:
    return len(np.unique(colours @ np.array([65536, 256, 1])))


def _several_classes(path: Path, found: str) -> ImageError:
    """Return the error about a mask that would be thresholded by the brightness of its classes."""
    fix = "write one file per class, white on black"
    return ImageError(f"mask {path} has {found}, such as one for each class", expected="one class", fix=fix)


def require_usable_size(image: object, size_hw: tuple[int, ...], max_side_px: int = 2**16) -> None:
    """Raise ImageError if a photograph is too narrow for later stages, now or shrunk to `max_side_px`."""
    short, long = sorted(size_hw)
    if long > MAX_ASPECT * short or round(short * min(1, max_side_px / max(long, 1))) < MIN_SIDE_PX:
        raise ImageError(
            f"image {image} is too small or too narrow: {size_hw[1]} x {size_hw[0]} px (width x height)",
            expected=f"sides from {MIN_SIDE_PX} px, also at poses.max_side_px; aspect ratio to {MAX_ASPECT}",
            fix="remove it, or crop it and its poses",
        )


def _is_animation(image: Image.Image) -> bool:
    """Return whether a file has a second frame that is no preview and no additional picture of a phone."""
    size, number = image.size, image.tell()
    if image.format in ("MPO", "HEIF"):
        return False
    with suppress(EOFError):  # Pillow counts the frames of a TIFF in quadratic time
        image.seek(number + 1)
        same = image.size == size
        image.seek(number)
        return same
    return False


def _is_hdr(image: Image.Image, file: Path | io.BytesIO) -> bool:
    """Return whether an image without a profile has a transfer function of HDR (16: PQ, 18: HLG; H.273)."""
    if image.info.get("icc_profile"):
        return False
    if image.format in ("AVIF", "PNG"):
        return HDR.search(_head(file, 2**20).partition(b"IDAT")[0]) is not None
    return (image.info.get("nclx_profile") or {}).get("transfer_characteristics") in (16, 18)


def _to_srgb(image: Image.Image, info: Mapping[Any, Any], file: object) -> Image.Image:
    """Convert to sRGB with the embedded profile, or else PNG's gamma; without valid ones, assume sRGB."""
    profile = info.get("icc_profile")
    base = {"RGBA": "RGB", "P": "RGB", "LA": "L", "1": "L"}.get(image.mode, image.mode)
    if profile and PROFILE_MODES.get(profile[16:20], base) == base:  # grey images may carry a profile of RGB
        colours = image if base == image.mode else image.convert(base)
        try:
            converted = ImageCms.profileToProfile(
                colours, io.BytesIO(profile), _srgb_profile(), outputMode="RGB"
            )
        except ImageCms.PyCMSError as error:
            logger.warning("%s is read as sRGB, because its colour profile is damaged: %s", file, error)
        else:
            assert converted is not None  # only in-place conversion returns None
            return converted
    colours = image if image.mode == "RGB" else image.convert("RGB")  # which would copy it
    gamma = info.get("gamma", 1 / 2.2)
    if profile or "srgb" in info or abs(gamma - 1 / 2.2) < 0.01:  # 1 / 2.2 is nearly sRGB
        return colours
    return colours.point(srgb_codes(np.linspace(0, 1, 256) ** (1 / gamma)).tolist() * 3)


def srgb_codes(light: Float64[np.ndarray, " N"]) -> UInt8[np.ndarray, " N"]:
    """Return the 8-bit sRGB values of linear light in [0, 1] (IEC 61966-2-1)."""
    return to_uint8(np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055))


@functools.cache
def _srgb_profile() -> ImageCms.ImageCmsProfile:
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))


def write_png(
    path: Path, pixels: np.ndarray, compression: int = 6, text: Mapping[str, str] | None = None
) -> None:
    """Write an image (H W 3, or grey H W, which may be 16-bit) as PNG atomically, with `text` as metadata."""
    metadata = PngImagePlugin.PngInfo()
    for key, value in (text or {}).items():
        metadata.add_text(key, value)
    with atomic_path(path) as temporary:
        Image.fromarray(np.ascontiguousarray(pixels)).save(
            temporary, format="PNG", compress_level=compression, pnginfo=metadata
        )


WEBP = {"quality": 70, "method": 4}
"""Options of Pillow for pictures of reports: about a tenth of the size of a PNG."""


def write_webp(path: Path, pixels: UInt8[np.ndarray, "H W 3"]) -> None:
    """Write an image as lossy WebP atomically."""
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="WEBP", **WEBP)


def to_float(pixels: UInt8[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Convert uint8 to float32 in [0, 1]."""
    return pixels.astype(np.float32) / np.float32(255)


def to_uint8(values: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Convert floats to uint8: clip them to [0, 1], scale them to 255, and round."""
    return (np.clip(values, 0, 1) * 255 + 0.5).astype(np.uint8)


def resize_to_fit(pixels: UInt8[np.ndarray, "H W *C"], max_side_px: int) -> UInt8[np.ndarray, "h w *C"]:
    """Shrink an image so that its longer side is at most `max_side_px` (area filter); never enlarge it."""
    import cv2

    height, width = pixels.shape[:2]
    scale = max_side_px / max(height, width)
    if scale >= 1:
        return pixels
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
