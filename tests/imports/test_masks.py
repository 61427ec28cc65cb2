"""Mask files of other programs: transparency, bit depth and palettes."""

import numpy as np
import pytest
from PIL import Image, ImageFilter

from hilsplat.base.errors import ArtifactError, ImageError
from hilsplat.datasets.labelled import read_mask_file
from hilsplat.evaluate.files_stage import read_view_masks

SIZE = HEIGHT, WIDTH = 30, 40
MASK = np.zeros(SIZE, bool)
MASK[5:20, 10:30] = True
FULL, NONE, IN = np.full(SIZE, 255, np.uint8), np.zeros(SIZE, np.uint8), MASK * np.uint8(255)
OTHER = np.zeros(SIZE, bool)
OTHER[22:28, 2:38] = True
CORNER = np.indices(SIZE).sum(axis=0) == 0
NOISE = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), np.uint8)


def coloured(mug: tuple[int, ...], bear: tuple[int, ...]) -> np.ndarray:
    return (MASK[..., None] * np.array(mug) + OTHER[..., None] * np.array(bear)).astype(np.uint8)


def palette(values: np.ndarray, *colours: tuple[int, int, int], alpha: bytes | None = None) -> Image.Image:
    image = Image.fromarray(values.astype(np.uint8), "P")
    image.putpalette([value for colour in colours for value in colour])
    if alpha is not None:
        image.info["transparency"] = alpha
    return image


FILES = {
    "grey": Image.fromarray(IN),
    "1 bit": Image.fromarray(MASK),
    "RGB": Image.fromarray(np.dstack([IN] * 3)),
    "RGBA, opaque": Image.fromarray(np.dstack([IN, IN, IN, FULL])),
    "white cut-out": Image.fromarray(np.dstack([FULL, FULL, FULL, IN])),
    "black cut-out": Image.fromarray(np.dstack([NONE, NONE, NONE, IN])),
    "photograph cut out": Image.fromarray(np.dstack([NOISE, IN])),
    "red overlay, half transparent": Image.fromarray(np.dstack([FULL, NONE, NONE, MASK * np.uint8(128)])),
    "faint overlay": Image.fromarray(np.dstack([FULL, NONE, NONE, MASK * np.uint8(60)])),
    "grey with alpha": Image.fromarray(np.dstack([FULL, IN]), "LA"),
    "grey with opaque alpha": Image.fromarray(np.dstack([IN, FULL]), "LA"),
    "16 bit": Image.fromarray(MASK * np.uint16(65535)),
    "16 bit, up to 255": Image.fromarray(MASK * np.uint16(255)),
    "palette of VOC": palette(MASK, (0, 0, 0), (128, 0, 0)),
    "palette of DAVIS, second object": palette(2 * MASK, (0, 0, 0), (128, 0, 0), (0, 128, 0)),
    "palette, black and white": palette(MASK, (0, 0, 0), (255, 255, 255)),
    "palette, white first": palette(~MASK, (255, 255, 255), (0, 0, 0)),
    "palette of VOC, grey car": palette(MASK, (0, 0, 0), (128, 128, 128)),
    "palette with opaque alpha": palette(MASK, (0, 0, 0), (128, 0, 0), alpha=b"\xff\xff"),
    "one class in red": Image.fromarray(np.dstack([MASK * np.uint8(250), MASK * np.uint8(50), NONE])),
    "one transparent pixel": Image.fromarray(np.dstack([IN, IN, IN, np.where(CORNER, 0, FULL)])),
    "palette with a transparent colour": palette(MASK, (9, 200, 9), (0, 0, 0), alpha=b"\x00\xff"),
}


@pytest.mark.parametrize("kind", FILES)
def test_the_foreground_of_mask_files(kind, tmp_path):
    (tmp_path / "000").mkdir()
    path = tmp_path / "000/cup.png"
    FILES[kind].save(path)
    np.testing.assert_array_equal(read_view_masks(tmp_path, "000.png")["", "cup"], MASK)
    np.testing.assert_array_equal(read_mask_file(path, 255), MASK)


@pytest.mark.parametrize(
    "image",
    [
        Image.fromarray(MASK.astype(np.uint8)),  # 0 and 1
        Image.fromarray(MASK * np.uint16(1)),
    ],
)
def test_masks_without_a_clear_foreground_are_refused(image, tmp_path):
    (tmp_path / "000").mkdir()
    image.save(tmp_path / "000/cup.png")
    with pytest.raises(ArtifactError, match="has non-zero values, but none is foreground"):
        read_view_masks(tmp_path, "000.png")


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (Image.fromarray(MASK.astype(np.uint8)), "has only the values 0 and 1"),
        (Image.fromarray(MASK * np.uint8(3)), "has only the values 0 and 3"),
        (
            palette(MASK + np.eye(*SIZE), (0, 0, 0), (128, 0, 0), (224, 224, 192)),
            "has 3 colours",
        ),  # VOC's border
        (palette(MASK + np.eye(*SIZE), (0, 0, 0), (128, 0, 0), (0, 0, 90)), "has 3 colours"),  # two objects
        *[
            (Image.fromarray(coloured(mug, bear)), "has 3 colours")
            for mug, bear in (
                ((250, 50, 83), (61, 245, 61)),  # CVAT
                ((0, 0, 255), (255, 255, 0)),
                ((255, 255, 255), (0, 200, 0)),
            )
        ],
        (palette(MASK + 2 * OTHER, (0, 0, 0), (200, 0, 0), (0, 255, 0), alpha=b"\xff" * 3), "has 3 colours"),
        (
            Image.fromarray(np.dstack([coloured((255, 0, 0), (0, 9, 255)), IN + OTHER * FULL])),
            "has 2 colours",
        ),
        (Image.fromarray(np.dstack([NOISE, np.where(CORNER, 0, FULL)])), r"has \d+ colours"),
        *[
            (Image.fromarray((MASK * mug + OTHER * bear).astype(depth)), f"has 3 grey values up to {mug}")
            for mug, bear, depth in ((170, 85, np.uint8), (200, 100, np.uint8), (2, 1, np.uint16))
        ],
    ],
)
def test_maps_of_classes_and_other_values_are_refused(image, reason, tmp_path):
    image.save(tmp_path / "cup.png")
    with pytest.raises(ImageError, match=rf"cup.png .*{reason}"):
        read_mask_file(tmp_path / "cup.png", 129)


@pytest.mark.parametrize("quality", [30, 75, 95])
@pytest.mark.parametrize("mode", ["L", "RGB"])
@pytest.mark.parametrize("radius", [0, 1])
def test_compressed_and_smooth_masks_are_read_by_brightness(mode, quality, radius, tmp_path):
    mask = Image.fromarray(IN).resize((320, 240), Image.Resampling.NEAREST)
    mask = mask.filter(ImageFilter.GaussianBlur(radius)).convert(mode)
    for path in (tmp_path / "cup.jpg", tmp_path / "cup.webp"):
        mask.save(path, quality=quality)
        expected = np.asarray(mask.convert("L")) > 128
        assert (read_mask_file(path, 129) ^ expected).sum() < 0.02 * expected.sum()
