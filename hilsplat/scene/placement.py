"""What was drawn on a photograph (labels, masks, maps), at the pixels of the view made from it."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Int64, Shaped

from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.scene.cameras import Camera, Photo

SHAPE_TOLERANCE = 0.01
"""Relative difference in aspect ratio, between a drawing and its picture, that is attributed to rounding."""

OUTSIDE = -1

ON_VIEW = {"drawn_on": "view"}
"""Key of files whose drawings are on the view. Their size can fit the photograph better once the lens has
been estimated again, because the view's size then changes by about a pixel."""

Placement = Callable[[Shaped[np.ndarray, "H W"]], Shaped[np.ndarray, "h w"]]


def is_on_view(content: Mapping[str, Any]) -> bool:
    """Return whether a file states that its drawings are on the view (`ON_VIEW`)."""
    return ON_VIEW.items() <= content.items()


def of_view(camera: Camera) -> Camera:
    """Return a view's camera without its photograph, for drawings that are on the view or a scaled copy."""
    return replace(camera, photo=None)


def placement(camera: Camera, drawn_hw: tuple[int, int], where: str) -> Placement | None:
    """Return a function that brings a drawing of this size from the photograph to the view.

    Each pixel takes the value at its centre's place in the photograph; a place outside it gives 0. Return
    None if the drawing has the view's size, or is a scaled copy of the view. A drawing whose shape fits view
    and photograph belongs to the closer of the two.

    Raises:
        MisalignedArtifactError: the shape fits neither.
    """
    if drawn_hw == camera.size_hw:
        return None
    pictures = {"undistorted": camera.size_hw}
    if camera.photo is not None:
        pictures["photograph"] = camera.photo.size_hw
    # In px of the drawing, which is compared at its own width.
    misfit = {
        name: abs(drawn_hw[0] - drawn_hw[1] * height / width) for name, (height, width) in pictures.items()
    }
    best = min(misfit, key=lambda name: (misfit[name], name == "undistorted"))
    if misfit[best] > max(1.0, SHAPE_TOLERANCE * drawn_hw[0]):
        sizes = [f"{width} x {height} px ({name})" for name, (height, width) in pictures.items()]
        raise MisalignedArtifactError(
            f"{where} does not match the size of its image",
            expected=f"{' or '.join(sizes)}, or a scaled copy",
            found=f"{drawn_hw[1]} x {drawn_hw[0]} px (width x height)",
            fix="use what was drawn on this image",
        )
    if best == "undistorted":
        return None
    assert camera.photo is not None
    pixels = _pixels_of_photo(camera.photo, tuple(camera.K.ravel().tolist()), camera.size_hw, drawn_hw)
    return lambda drawn: np.where(pixels == OUTSIDE, 0, drawn.ravel()[pixels]).astype(drawn.dtype)


def placed(drawn: Shaped[np.ndarray, "H W"], camera: Camera, where: str) -> Shaped[np.ndarray, "h w"]:
    """Bring a drawing from a view's photograph, or from a scaled copy of either, to the view's pixels.

    Each pixel takes the value at its centre. For errors, see `placement`.
    """
    if (place := placement(camera, drawn.shape, where)) is not None:
        return place(drawn)
    rows, columns = (
        ((np.arange(side) + 0.5) * old / side).astype(np.int64)
        for side, old in zip(camera.size_hw, drawn.shape, strict=True)
    )
    return drawn[rows[:, None], columns]


@lru_cache(maxsize=4)
def _pixels_of_photo(
    photo: Photo, K: tuple[float, ...], size_hw: tuple[int, int], drawn_hw: tuple[int, int]
) -> Int64[np.ndarray, "h w"]:
    """Return for each pixel of the view the pixel of the drawing (row * width + column), or `OUTSIDE`."""
    from hilsplat.scene.colmap import as_camera

    lens = as_camera(photo)
    columns, rows = np.meshgrid(np.arange(size_hw[1]) + 0.5, np.arange(size_hw[0]) + 0.5)
    seen = np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)], axis=1)
    xy = lens.img_from_cam(seen @ np.linalg.inv(np.reshape(K, (3, 3))).T)
    xy = np.floor(xy * (np.array(drawn_hw[::-1]) / photo.size_hw[::-1]))
    inside = (xy >= 0).all(axis=1) & (xy < drawn_hw[::-1]).all(axis=1)  # false for NaN
    pixels = np.full(len(xy), OUTSIDE, np.int64)
    pixels[inside] = (xy[inside] @ [1, drawn_hw[1]]).astype(np.int64)
    return pixels.reshape(size_hw)
