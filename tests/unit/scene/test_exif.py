"""The focal length in EXIF is read from every format and scaled to the picture's size."""

import pillow_heif
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from hilsplat.scene.features import exif_focal_px, prepare_images

SIZE = (400, 300)  # diagonal 500 px


def photograph(path, size=SIZE, orientation=None, **tags):
    """A photograph with EXIF tags: focal_35, focal, resolution (px per unit), unit, stored (width, px)."""
    numbers = {"focal_35": 0xA405, "focal": 0x920A, "resolution": 0xA20E, "unit": 0xA210, "stored": 0xA002}
    exif = Image.Exif()
    if orientation:
        exif[0x0112] = orientation
    ifd = exif.get_ifd(0x8769)
    for name, value in tags.items():
        ifd[numbers[name]] = value
    pillow_heif.register_heif_opener()
    Image.new("RGB", size, (90, 120, 30)).save(path, exif=exif.tobytes())
    return path


@pytest.mark.parametrize("suffix", [".jpg", ".heic", ".avif", ".webp", ".png", ".tif"])
def test_the_35_mm_equivalent_is_read_from_every_format(tmp_path, suffix):
    path = photograph(tmp_path / f"a{suffix}", focal_35=26)
    # 26 mm on a diagonal of 43.27 mm are 26 / 43.27 of the picture's diagonal
    assert exif_focal_px(path, (300, 400)) == pytest.approx(500 * 26 / 43.2666)


def test_it_is_scaled_with_a_picture_that_is_shrunk_and_rotated(tmp_path):
    path = photograph(tmp_path / "a.heic", size=(800, 600), orientation=6, focal_35=26)
    (image,) = prepare_images([path], tmp_path / "work", max_side_px=400)
    assert image.size_hw == (400, 300)
    assert image.focal_px == pytest.approx(500 * 26 / 43.2666)


@pytest.mark.parametrize(("unit", "resolution"), [(2, 2540.0), (3, 1000.0), (4, 100.0), (None, 2540.0)])
def test_without_it_focal_length_and_sensor_resolution_are_used(tmp_path, unit, resolution):
    """100 px per mm: a lens of 5 mm is 500 px, in half the picture 250, in a tenth-size copy 50."""
    tags = {"focal": IFDRational(5), "resolution": IFDRational(int(resolution))} | (
        {"unit": unit} if unit else {}
    )
    path = photograph(tmp_path / "a.jpg", stored=400, **tags)
    assert exif_focal_px(path, (300, 400)) == pytest.approx(500)
    assert exif_focal_px(path, (150, 200)) == pytest.approx(250)
    shrunk = photograph(tmp_path / "a.jpg", stored=4000, **tags)
    assert exif_focal_px(shrunk, (300, 400)) == pytest.approx(50)


@pytest.mark.parametrize(
    "tags", [{}, {"focal": IFDRational(5)}, {"focal_35": 0}, {"focal": IFDRational(1, 0)}]
)
def test_without_usable_tags_there_is_none(tmp_path, tags):
    assert exif_focal_px(photograph(tmp_path / "a.jpg", **tags), (300, 400)) is None
