"""Images of every kind become upright sRGB of 8 bits."""

import io
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pillow_heif
import pytest
from PIL import Image, ImageCms, TiffImagePlugin
from PIL.PngImagePlugin import PngInfo

from hilsplat.base.errors import ImageError
from hilsplat.base.files import list_images
from hilsplat.base.images import image_size_hw, read_image

pillow_heif.register_heif_opener()  # for writing; reading registers it itself

SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
GREY = np.array([[0, 128, 255], [10, 20, 30]], np.uint8)


def saved(tmp_path: Path, image: Image.Image, suffix: str, **options: object) -> Path:
    path = tmp_path / f"image{suffix}"
    image.save(path, **options)
    return path


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGB", "RGBA", "1"])
def test_grey_alpha_and_palettes_become_rgb(tmp_path, mode):
    values = (GREY > 100).astype(np.uint8) * 255 if mode == "1" else GREY
    image = Image.fromarray(values).convert(mode)
    if mode == "RGBA":
        image.putalpha(0)  # transparent pixels keep their colour
    found = read_image(saved(tmp_path, image, ".png"))
    np.testing.assert_array_equal(found, np.repeat(values[..., None], 3, axis=2))


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bits_are_scaled_and_not_clipped(tmp_path, suffix):
    deep = np.array([[0, 257, 32896, 65535, 128, 129]], np.uint16)
    found = read_image(saved(tmp_path, Image.fromarray(deep), suffix))
    # 257 steps are one; 128 is nearer to 0 and 129 nearer to 1
    assert found[0, :, 0].tolist() == [0, 1, 128, 255, 0, 1]
    assert (found[..., 0] == found[..., 2]).all()


def test_sixteen_bit_colour_is_read(tmp_path):
    deep = np.zeros((2, 3, 3), np.uint16)
    deep[..., 2] = 40000  # cv2 writes blue, green, red
    cv2.imwrite(str(tmp_path / "deep.png"), deep)
    found = read_image(tmp_path / "deep.png")
    assert found[0, 0].tolist() == [pytest.approx(40000 / 257, abs=1), 0, 0]


def test_cmyk_photographs_are_converted(tmp_path):
    white, cyan = (0, 0, 0, 0), (255, 0, 0, 0)
    image = Image.new("CMYK", (32, 16), white)
    image.paste(cyan, (16, 0, 32, 16))
    found = read_image(saved(tmp_path, image, ".jpg", quality=95)).astype(int)
    assert np.abs(found[8, 4] - [255, 255, 255]).max() < 12
    assert np.abs(found[8, 28] - [0, 255, 255]).max() < 12


def red_and_green_swapped() -> bytes:
    """sRGB's profile with its red and green primaries exchanged."""
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    return profile.replace(b"rXYZ", b"kept").replace(b"gXYZ", b"rXYZ").replace(b"kept", b"gXYZ")


@pytest.mark.parametrize(
    ("suffix", "options"),
    [(".png", {}), (".tif", {}), (".jpg", {"quality": 100, "subsampling": 0}), (".heic", {"quality": 100})],
)
def test_colours_of_an_embedded_profile_become_srgb(tmp_path, suffix, options):
    red = Image.new("RGB", (16, 16), (250, 10, 40))
    found = read_image(saved(tmp_path, red, suffix, icc_profile=red_and_green_swapped(), **options))
    np.testing.assert_allclose(found[8, 8], (10, 250, 40), atol=6)


def test_a_damaged_profile_leaves_the_pixels_as_they_are_and_is_reported(tmp_path, caplog):
    path = saved(tmp_path, Image.new("RGB", (4, 4), (250, 10, 40)), ".png", icc_profile=b"no profile")
    assert (read_image(path) == (250, 10, 40)).all()
    assert f"{path} is read as sRGB" in caplog.text


def test_pixels_of_unknown_range_are_refused(tmp_path):
    path = saved(tmp_path, Image.fromarray(np.ones((2, 2), np.float32)), ".tif")
    with pytest.raises(ImageError, match=r"image.tif cannot be read(.|\n)*floating-point"):
        read_image(path)
    path = saved(tmp_path, Image.fromarray(np.full((2, 2), 70000, np.int32)), ".tif")
    with pytest.raises(ImageError, match=r"70000, do not fit into 16 bits"):
        read_image(path)


def gradient() -> Image.Image:
    """40 x 24 px, red to the right and green downwards: every quarter turn differs."""
    y, x = np.mgrid[:24, :40]
    return Image.fromarray(np.stack([x * 6, y * 10, 0 * x], axis=-1).astype(np.uint8))


@pytest.mark.parametrize(
    "suffix", [".heic", ".HEIF", ".hif", ".avif", ".webp", ".TIF", ".JPG", ".jfif", ".bmp"]
)
def test_phone_and_web_formats_are_listed_and_read(tmp_path, suffix):
    path = saved(tmp_path, gradient(), suffix, quality=95)
    assert list_images(tmp_path) == [path]
    assert np.abs(read_image(path).astype(int) - np.asarray(gradient())).mean() < 4


@pytest.mark.parametrize(
    ("transfer", "profile", "is_read"),
    [(13, b"", True), (1, b"", True), (16, b"", False), (18, b"", False), (16, SRGB, True)],
)
@pytest.mark.parametrize("suffix", [".hif", ".avif", ".png"])
def test_hdr_pictures_are_refused_and_not_shown_dull(transfer, profile, is_read, suffix, tmp_path):
    path, info = tmp_path / f"a{suffix}", {"icc_profile": profile} if profile else {}
    if suffix == ".hif":
        file = pillow_heif.from_pillow(gradient())
        file.info.update(info)
        file.save(path, quality=-1, color_primaries=1, transfer_characteristics=transfer)
    elif suffix == ".avif":
        gradient().save(path, **info)
        srgb, stated = (b"colrnclx\0\1\0" + bytes([code]) for code in (13, transfer))
        content = path.read_bytes()
        path.write_bytes(content.replace(srgb, stated) if srgb in content else content)
    else:
        chunk = PngInfo()
        chunk.add(b"cICP", bytes([9, transfer, 0, 1]))
        gradient().save(path, pnginfo=chunk, **info)
    with nullcontext() if is_read else pytest.raises(ImageError, match="its colours are HDR"):
        assert read_image(path).shape == (24, 40, 3)


@pytest.mark.parametrize("kinds", [(1, 0), (1, 1, 0), (0, 1), (1,)])
def test_a_reduced_copy_in_a_tiff_is_not_the_photograph(kinds, tmp_path):
    pages = [gradient() if kind == 0 else gradient().resize((20, 12 + row)) for row, kind in enumerate(kinds)]
    stream = io.BytesIO()
    with TiffImagePlugin.AppendingTiffWriter(stream, new=True) as writer:
        for page, kind in zip(pages, kinds, strict=True):
            page.save(writer, "TIFF", tiffinfo={254: kind})
            writer.newFrame()
    (tmp_path / "a.tif").write_bytes(stream.getvalue())
    expected = np.asarray(pages[kinds.index(0) if 0 in kinds else 0])
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), expected)
    assert image_size_hw(tmp_path / "a.tif") == expected.shape[:2]


def test_a_large_page_after_a_reduced_copy_is_not_read(tmp_path):
    stream = io.BytesIO()
    with TiffImagePlugin.AppendingTiffWriter(stream, new=True) as writer:
        for page, kind in ((gradient(), 1), (Image.new("1", (20_000, 10_000)), 0)):
            page.save(writer, "TIFF", tiffinfo={254: kind}, compression="tiff_deflate")
            writer.newFrame()
    (tmp_path / "a.tif").write_bytes(stream.getvalue())
    with pytest.raises(ImageError, match=r"a\.tif is too large: 20000 x 10000 px"):
        read_image(tmp_path / "a.tif")


def test_reading_heif_needs_no_preparation(tmp_path, project):
    path = saved(tmp_path, gradient(), ".heic")
    read = f"from pathlib import Path; import hilsplat.base.images as i; i.read_image(Path({str(path)!r}))"
    subprocess.run([sys.executable, "-c", read], check=True, cwd=project)


@pytest.mark.parametrize("suffix", [".heic", ".avif"])
def test_exif_orientation_turns_the_picture_upright(tmp_path, suffix):
    exif = Image.Exif()
    exif[0x0112] = 6  # shown a quarter turn clockwise
    path = saved(tmp_path, gradient(), suffix, quality=95, exif=exif.tobytes())  # HEIF: as `irot`
    expected = np.rot90(np.asarray(gradient()), -1)
    found = read_image(path).astype(int)
    assert found.shape == expected.shape
    assert np.abs(found - expected).mean() < 4
