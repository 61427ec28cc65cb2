"""Reading and writing of images: upright, sRGB, channel-last."""

import functools
import io
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageCms, ImageOps, PngImagePlugin

from hilsplat.base.artifacts import atomic_path
from hilsplat.base.errors import ImageError

logger = logging.getLogger(__name__)

FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP", "AVIF", "HEIF")
"""Pillow's names of the formats of `IMAGE_SUFFIXES` (JPEG includes phones' MPO). All other formats are
refused whatever the suffix: for EPS, Pillow starts Ghostscript, which runs the program in the file."""

MIN_SIDE_PX, MAX_ASPECT = 16, 20  # limits on photographs; all stages were run on 16 x 16 and 320 x 16 px

DAMAGE = (EOFError, MemoryError, OSError, SyntaxError, ValueError)
"""Errors that Pillow raises on damaged files."""


def open_image(file: Path | io.BytesIO, max_side_px: int = 2**16) -> Image.Image:
    """Open an image with Pillow, which reads HEIF (.heic) through pillow-heif.

    Size and EXIF data are read immediately; pixels are decoded on demand. A HEIF image is returned upright:
    its rotation is part of the format, and its EXIF orientation is reset.

    Raises:
        ImageError: the header specifies more pixels than a photograph can have, or sides above `max_side_px`.
        OSError: the file is missing or has none of the `FORMATS`.
    """
    import pillow_heif

    pillow_heif.register_heif_opener()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(file, formats=FORMATS)
        if max(image.size) > max_side_px:
            raise Image.DecompressionBombError(f"{image.width} x {image.height} px")
    except Image.DecompressionBombError as error:
        raise ImageError(
            f"image {file} is too large: {str(error).partition(',')[0]}",
            expected=f"at most {2 * (Image.MAX_IMAGE_PIXELS or 0) / 1e6:.0f} MP, {max_side_px} px per side",
            fix="shrink or remove it",
        ) from error
    return image


@contextmanager
def opened_image(path: Path, what: str = "image") -> Iterator[Image.Image]:
    """Open an image as `open_image` does; raise ImageError if opening or the block fails on its content."""
    try:
        with open_image(path) as image:
            yield image
    except DAMAGE as error:
        fix = "replace it with an intact copy"
        raise ImageError(f"{what} {path} cannot be read: {error}", fix=fix) from error


def read_image(file: Path | io.BytesIO, max_side_px: int = 2**16) -> UInt8[np.ndarray, "H W 3"]:
    """Read an image as upright sRGB.

    The EXIF orientation is applied. Colours with an embedded profile (Display P3 from phones, Adobe RGB) and
    CMYK are converted, alpha is dropped, grey is copied to all channels, and 16-bit values become 8-bit.

    Raises:
        ImageError: the file is missing, empty, truncated, too large (`open_image`) or not an image.
    """
    try:
        with open_image(file, max_side_px) as image:
            if (num_frames := _frames(image)) > 1:
                raise ValueError(f"it contains {num_frames} frames of the same size, like an animation")
            image.load()
            upright = ImageOps.exif_transpose(image)
            if upright.mode.startswith("I"):  # Pillow would clip values above 255
                values = np.asarray(upright).astype(np.int64)
                if values.min() < 0 or values.max() > np.iinfo(np.uint16).max:
                    raise ValueError(
                        f"its grey values, {values.min()} to {values.max()}, do not fit into 16 bits"
                    )
                upright = Image.fromarray(((values + 128) // 257).astype(np.uint8))  # 257: 65535 / 255
            if upright.mode == "F":
                raise ValueError("its pixels are floating-point numbers of unknown range")
            return np.asarray(_to_srgb(upright, file))
    except FileNotFoundError as error:
        raise ImageError(f"image {file} is missing") from error
    except DAMAGE as error:
        size = file.stat().st_size if isinstance(file, Path) and file.exists() else 0
        raise ImageError(
            f"image {file} cannot be read: {error}",
            found=f"a file of {size} bytes",
            fix="remove it from the folder, or replace it with an intact copy",
        ) from error


def require_usable_size(image: object, size_hw: tuple[int, ...], max_side_px: int = 2**16) -> None:
    """Raise ImageError if a photograph is too narrow for later stages, now or shrunk to `max_side_px`."""
    short, long = sorted(size_hw)
    if long > MAX_ASPECT * short or round(short * min(1, max_side_px / max(long, 1))) < MIN_SIDE_PX:
        raise ImageError(
            f"image {image} is too small or too narrow: {size_hw[1]} x {size_hw[0]} px (width x height)",
            expected=f"sides from {MIN_SIDE_PX} px, also at poses.max_side_px; aspect ratio to {MAX_ASPECT}",
            fix="remove it, or crop it and its poses",
        )


def _frames(image: Image.Image) -> int:
    """Return the number of animation frames, without previews and the additional pictures of phones."""
    num_frames = int(getattr(image, "n_frames", 1))
    if num_frames < 2 or image.format in ("MPO", "HEIF"):
        return 1
    size = image.size
    image.seek(1)
    same = image.size == size
    image.seek(0)
    return num_frames if same else 1


def _to_srgb(image: Image.Image, file: object) -> Image.Image:
    """Convert to sRGB with the embedded profile; if it is missing or damaged, assume sRGB pixels."""
    profile = image.info.get("icc_profile")
    if profile and image.mode in ("RGB", "RGBA", "CMYK"):
        colours = image.convert("RGB") if image.mode == "RGBA" else image
        try:
            converted = ImageCms.profileToProfile(
                colours, io.BytesIO(profile), _srgb_profile(), outputMode="RGB"
            )
        except ImageCms.PyCMSError as error:
            logger.warning("%s is read as sRGB, because its colour profile is damaged: %s", file, error)
        else:
            assert converted is not None  # only in-place conversion returns None
            return converted
    return image.convert("RGB")


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
