"""One function reads pictures: orientation, colour profile, bit depth, CMYK and alpha, with poses or not."""

import io
import struct

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from hilsplat.base.errors import ImageError
from hilsplat.base.images import image_size_hw, read_image, read_mask
from tests.conftest import PROJECT
from tests.imports import analytic_world as world
from tests.unit.base.test_image_formats import red_and_green_swapped

WIDTH, HEIGHT = 96, 72
POSES = world.cameras(4)
PICTURES = [world.picture(world.pinhole(80, 80, 48, 36), WIDTH, HEIGHT, pose) for pose in POSES]


def exif(orientation):
    tags = Image.Exif()
    tags[0x0112] = orientation
    return tags.tobytes()


def grey16(pixels):
    return (pixels.mean(axis=2) * 257).astype(np.uint16)


def half_transparent(pixels):
    return np.dstack([pixels, np.full(pixels.shape[:2], 128, np.uint8)])


def grey(pixels):
    return np.repeat(pixels[..., None], 3, axis=2)


def swapped(pixels):
    return pixels[..., [1, 0, 2]]


FORMS = {  # suffix, what is stored, how it is saved, and what it must become (more: `test_image_formats.py`)
    "16-bit grey": (".png", grey16, {}, lambda px: grey((grey16(px) / 257).round().astype(np.uint8))),
    "profile and alpha": (".png", half_transparent, {"icc_profile": red_and_green_swapped()}, swapped),
    "grey with a profile of colours": (
        ".png",
        lambda px: px[..., 0],
        {"icc_profile": red_and_green_swapped()},
        lambda px: grey(px[..., 0]),
    ),
    "TIFF": (".tif", lambda px: px, {}, lambda px: px),
    "lossless WebP": (".webp", lambda px: px, {"lossless": True}, lambda px: px),
}


@pytest.mark.parametrize("form", FORMS)
def test_turned_photographs_with_known_poses_have_the_pixels_of_the_others(form, tmp_path, imported):
    """COLMAP ignores EXIF, so the camera is that of the stored pixels."""
    suffix, stored, options, expected = FORMS[form]
    folder = tmp_path / "in/images"
    folder.mkdir(parents=True)
    for number, (pixels, turn) in enumerate(zip(PICTURES, (1, 6, 3, 8), strict=True)):
        Image.fromarray(stored(pixels)).save(folder / f"{number}{suffix}", exif=exif(turn), **options)
    images = {f"{number}{suffix}": pose for number, pose in enumerate(POSES)}
    world.write_colmap(tmp_path / "in/sparse/0", "PINHOLE 80 80 48 36", (WIDTH, HEIGHT), images)
    views, *_ = imported(tmp_path / "in")
    for view, pixels in zip(views, PICTURES, strict=True):
        found = np.asarray(Image.open(view.image))
        assert found.shape == pixels.shape and np.abs(found.astype(int) - expected(pixels)).max() <= 1


@pytest.mark.parametrize("turn", range(1, 9))
def test_square_photographs_with_known_poses_stay_as_stored(turn, tmp_path, imported):
    pixels = PICTURES[0][:, :HEIGHT]
    (tmp_path / "in/images").mkdir(parents=True)
    Image.fromarray(pixels).save(tmp_path / "in/images/a.png", exif=exif(turn))
    world.write_colmap(tmp_path / "in/sparse/0", "PINHOLE 80 80 36 36", (HEIGHT, HEIGHT), {"a.png": POSES[0]})
    (view,), _, _, report = imported(tmp_path / "in")
    np.testing.assert_array_equal(np.asarray(Image.open(view.image)), pixels)
    assert ["are used as stored" in warning for warning in report["warnings"]] == [True] * (turn > 1)


@pytest.mark.parametrize("turn", range(1, 9))
def test_poses_of_upright_pictures_get_upright_pictures(turn, tmp_path, imported):
    """Other programs turn photographs before they compute poses; then the shape decides."""
    upright = PICTURES[0]
    turned = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}[turn]  # the opposite turn
    raw = io.BytesIO()
    Image.fromarray(upright).save(raw, "PNG", exif=exif(turned))
    stored = read_image(io.BytesIO(raw.getvalue()))
    (tmp_path / "in/images").mkdir(parents=True)
    Image.fromarray(stored).save(tmp_path / "in/images/a.png", exif=exif(turn))
    np.testing.assert_array_equal(read_image(tmp_path / "in/images/a.png"), upright)
    if turn > 4:  # width and height are exchanged
        world.write_colmap(
            tmp_path / "in/sparse/0", "PINHOLE 80 80 48 36", (WIDTH, HEIGHT), {"a.png": POSES[0]}
        )
        (view,), _, _, report = imported(tmp_path / "in")
        np.testing.assert_array_equal(np.asarray(Image.open(view.image)), upright)
        assert not report["warnings"]


def tiff(*entries, data=b""):
    """EXIF with one directory; entries are (tag, type, count, value of 4 bytes, or None for `data`)."""
    start = 8 + 2 + 12 * len(entries) + 4
    rows = b"".join(
        struct.pack("<HHI", *entry[:3]) + (struct.pack("<I", start) if entry[3] is None else entry[3])
        for entry in sorted(entries)
    )
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + rows + struct.pack("<I", 0) + data


TURN = (0x0112, 3, 1, struct.pack("<HH", 6, 0))
ODD_EXIF = {
    "signed rational with denominator 0": tiff(TURN, (0x011A, 10, 1, None), data=struct.pack("<ii", -1, 0)),
    "float that is not a number": tiff(TURN, (0x011A, 11, 1, struct.pack("<f", np.nan))),
    "negative altitude": tiff(TURN, (0x0006, 10, 1, None), data=struct.pack("<ii", -12, 1)),
    "number that doesn't fit its type": tiff(TURN, (0x0128, 4, 1, struct.pack("<I", 70000))),
    "signed number in an unsigned tag": tiff(TURN, (0x0106, 8, 1, struct.pack("<hh", -1, 0))),
    "two resolutions": tiff(TURN, (0x011A, 5, 2, None), data=struct.pack("<4I", 72, 1, 72, 1)),
    "doubled header": b"Exif\0\0" + tiff(TURN),
    "maker as a number": tiff(TURN, (0x010F, 3, 1, struct.pack("<HH", 7, 0))),
    "unknown type": tiff(TURN, (0x9999, 77, 1, struct.pack("<I", 1))),
    "directory that contains itself": tiff(TURN, (0x8769, 4, 1, struct.pack("<I", 8))),
    "directory outside the file": tiff(TURN, (0x8769, 4, 1, struct.pack("<I", 10**6))),
    "GPS directory as text": tiff(TURN, (0x8825, 2, 4, b"abc\0")),
    "text outside the file": tiff(TURN, (0x010E, 2, 10**6, struct.pack("<I", 10**6))),
}


@pytest.mark.parametrize("form", ODD_EXIF)
def test_odd_exif_turns_the_picture_by_its_orientation_alone(form, tmp_path, recwarn):
    raw = io.BytesIO()
    Image.fromarray(PICTURES[0]).save(raw, "JPEG", quality=95)
    tags = ODD_EXIF[form]
    app1 = b"\xff\xe1" + struct.pack(">H", len(tags) + 8) + b"Exif\0\0" + tags
    path = tmp_path / "a.jpg"
    path.write_bytes(raw.getvalue()[:2] + app1 + raw.getvalue()[2:])
    decoded = np.asarray(Image.open(io.BytesIO(raw.getvalue())))
    np.testing.assert_array_equal(read_image(path), np.rot90(decoded, -1))
    assert not list(recwarn)


@pytest.mark.parametrize("value", [0, 9, 255, -1])
def test_unknown_orientations_do_not_turn(value, tmp_path):
    tags = tiff((0x0112, 8, 1, struct.pack("<hh", value, 0)))
    Image.fromarray(PICTURES[0]).save(tmp_path / "a.png", exif=b"Exif\0\0" + tags)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), PICTURES[0])


@pytest.mark.parametrize(
    ("chunks", "exponent"),
    [
        ({b"gAMA": 100_000}, 1.0),  # linear light
        ({b"gAMA": 55_556}, 100_000 / 55_556),  # 1.8, as on old Macs
        ({b"gAMA": 45_455}, None),  # sRGB's own
        ({b"sRGB": 0, b"gAMA": 100_000}, None),
    ],
)
def test_gamma_of_png_is_applied_unless_it_is_that_of_srgb(chunks, exponent, tmp_path):
    stored, info = np.arange(256, dtype=np.uint8).reshape(16, 16), PngInfo()
    for name, value in chunks.items():
        info.add(name, struct.pack(">I" if name == b"gAMA" else ">B", value))
    Image.fromarray(stored).save(tmp_path / "a.png", pnginfo=info)
    light = (stored / 255) ** (exponent or 1)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)  # IEC 61966-2-1
    expected = stored if exponent is None else np.rint(255 * srgb).astype(np.uint8)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), grey(expected))


@pytest.mark.parametrize("turn", [1, 6])
def test_sizes_in_headers_are_those_of_the_pixels_as_stored_and_upright(turn, tmp_path):
    for suffix in (".jpg", ".png", ".tif", ".webp"):
        path = tmp_path / f"a{suffix}"
        Image.fromarray(PICTURES[0]).save(path, exif=exif(turn))
        for upright in (False, True):
            assert image_size_hw(path, upright=upright) == read_image(path, as_stored=not upright).shape[:2]


def test_pictures_are_opened_in_one_place():
    """Another `Image.open(...).convert(...)` would lack orientation, profile and depth."""
    package = PROJECT / "hilsplat"
    words = ('.convert("', "Image.open(", "cv2.imread", "exif_transpose", "imageio")
    places = {
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        if any(word in path.read_text() for word in words)
    }
    assert places == {"base/images.py"}


def test_masks_are_read_as_stored(tmp_path):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[10:20, 5:50] = 255
    Image.fromarray(mask).save(tmp_path / "a.png", exif=exif(6))
    np.testing.assert_array_equal(read_mask(tmp_path / "a.png"), mask)


def test_masks_may_have_any_type_of_numbers_but_neither_negative_numbers_nor_fractions(tmp_path):
    mask = np.zeros((HEIGHT, WIDTH), np.float32)
    for value in (255, -1, 0.9, np.nan):
        mask[10:20, 5:50] = value
        for kind in (np.int32, np.float32) if value in (255, -1) else (np.float32,):
            Image.fromarray(mask.astype(kind)).save(tmp_path / "a.tif")
            if value == 255:
                np.testing.assert_array_equal(read_mask(tmp_path / "a.tif"), mask)
            else:
                with pytest.raises(ImageError, match="fractions" if value != -1 else "-1 to 0, do not fit"):
                    read_mask(tmp_path / "a.tif")
