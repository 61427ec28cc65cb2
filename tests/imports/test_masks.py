"""Mask files of other programs: transparency, bit depth and palettes."""

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.errors import ArtifactError, ImageError
from hilsplat.datasets.labelled import read_mask_file
from hilsplat.evaluate.files_stage import read_view_masks

SIZE = HEIGHT, WIDTH = 30, 40
MASK = np.zeros(SIZE, bool)
MASK[5:20, 10:30] = True
FULL, NONE, IN = np.full(SIZE, 255, np.uint8), np.zeros(SIZE, np.uint8), MASK * np.uint8(255)
NOISE = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), np.uint8)


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
        (Image.fromarray(np.dstack([IN, NONE, NONE])), "has only the values 0 and 76"),  # red
        (
            palette(MASK + np.eye(*SIZE), (0, 0, 0), (128, 0, 0), (224, 224, 192)),
            "has 3 colours",
        ),  # VOC's border
        (palette(MASK + np.eye(*SIZE), (0, 0, 0), (128, 0, 0), (0, 0, 90)), "has 3 colours"),  # two objects
    ],
)
def test_maps_of_classes_and_other_values_are_refused(image, reason, tmp_path):
    image.save(tmp_path / "cup.png")
    with pytest.raises(ImageError, match=rf"cup.png .*{reason}"):
        read_mask_file(tmp_path / "cup.png", 129)
