"""Scenes with labelled images, the output of every reader of an image-labelled data set.

Labels, images and poses are keyed by view name ("frame_00041.png", see `scene.view_names.view_name`), so that
a label matches its image and camera even if other views are missing.
"""

import logging
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Int

from hilsplat.base.errors import ImageError, SceneError, shorten_list
from hilsplat.base.files import list_images
from hilsplat.base.images import image_size_hw, read_mask
from hilsplat.base.levels import Level, composed, plain_text
from hilsplat.datasets.dataset import SceneReport
from hilsplat.scene.cameras import Camera
from hilsplat.scene.layouts import find_known_poses
from hilsplat.scene.placement import of_view, placement
from hilsplat.scene.view_names import view_name, view_names

if TYPE_CHECKING:  # imports pycolmap, which evaluation doesn't need
    from hilsplat.scene.importers.known_views import KnownView

logger = logging.getLogger(__name__)
ROUNDING_PX = 1.0  # rounding tolerance, px, for the height of a label scaled to the width of its image


@dataclass(frozen=True, eq=False)
class LabelledRegion:
    """A labelled region of one view, and the query text for it."""

    text: str  # the query, spelt as in the labels
    size_hw: tuple[int, int]  # of the label, px
    pixels: Callable[[], Bool[np.ndarray, "H W"]]  # reads the region whenever its mask is needed
    boxes_xyxy: Int[np.ndarray, "B 4"] | None = None  # annotated, borders included, px of the label
    level: Level | None = None  # None if the data set has no levels
    path: tuple[str, ...] = ()  # texts from the whole down to this region; its own text without levels
    # Like `pixels`, but all non-black pixels, as in some protocols; None if identical.
    any_grey: Callable[[], Bool[np.ndarray, "H W"]] | None = None
    on_view: bool = False  # drawn on the view, not on its photograph; if False, the size decides

    def mask(
        self, size_hw: tuple[int, int] | None = None, *, any_grey: bool = False
    ) -> Bool[np.ndarray, "H W"]:
        """Return the region's mask at the label's size, or resized by nearest neighbour.

        Each new pixel takes the value at its top-left corner (`cv2.INTER_NEAREST`), as in public evaluators.
        """
        mask = self.any_grey() if any_grey and self.any_grey else self.pixels()
        if size_hw is None or mask.shape == tuple(size_hw):
            return mask
        return cv2.resize(mask.astype(np.uint8), size_hw[::-1], interpolation=cv2.INTER_NEAREST).astype(bool)

    def on(self, camera: Camera, where: str) -> "LabelledRegion":
        """Return the region on a view if it was drawn on the view's photograph; else the same region.

        A box becomes the extent of its pixels in the view; a box outside the view is omitted. For errors, see
        `placement`.
        """
        place = placement(of_view(camera) if self.on_view else camera, self.size_hw, where)
        if place is None:
            return self
        boxes, grey = self.boxes_xyxy, self.any_grey
        if boxes is not None:
            # Row and column in the photograph, from 1, because pixels outside it are 0.
            rows, columns = map(place, np.indices(self.size_hw, np.uint16) + np.uint16(1))
            left, top, right, bottom = (boxes.T + 1)[:, :, None, None]
            inside = (rows >= top) & (rows <= bottom) & (columns >= left) & (columns <= right)
            boxes = np.concatenate([boxes[:0], *map(extent, inside)])
        placed = replace(self, size_hw=camera.size_hw, boxes_xyxy=boxes, pixels=lambda: place(self.pixels()))
        return placed if grey is None else replace(placed, any_grey=lambda: place(grey()))

    def boxes(self, size_hw: tuple[int, int] | None = None) -> Int[np.ndarray, "B 4"]:
        """Return the annotated boxes, borders included, or the region's extent if no box is annotated.

        For a different size, each side is scaled and rounded to the pixel that contains it. A region with
        neither pixels nor annotated boxes has no boxes.
        """
        boxes = self.boxes_xyxy
        if boxes is None:
            boxes = extent(self.pixels())
        if size_hw is None or tuple(size_hw) == self.size_hw:
            return boxes
        scale = np.array([size_hw[1] / self.size_hw[1], size_hw[0] / self.size_hw[0]] * 2)
        scaled = np.floor((boxes + 0.5) * scale).astype(np.int64)
        return np.clip(scaled, 0, np.array([size_hw[1], size_hw[0]] * 2) - 1)


def extent(mask: Bool[np.ndarray, "H W"]) -> Int[np.ndarray, "B 4"]:
    """Return the box of a mask, xyxy with borders included; no box if the mask is empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    boxes = [[columns[0], rows[0], columns[-1], rows[-1]]] if len(rows) else []
    return np.array(boxes, np.int64).reshape(-1, 4)


@dataclass(frozen=True, eq=False)
class LabelledScene:
    """One scene of an image-labelled data set."""

    dataset: str
    scene: str
    images: Mapping[str, Path]  # all images of the scene, by view
    poses: Path | None  # folder in which `find_known_poses` finds poses, if any
    views: Mapping[str, tuple[LabelledRegion, ...]]  # by view, in label order
    warnings: tuple[str, ...] = ()  # a sentence for each item that was reinterpreted or is doubtful
    # Minimum share of labelled views with a pose. Scores of published data sets need all of them.
    min_posed: float = 1.0

    def __post_init__(self) -> None:
        """Add a warning for each text that resembles another one."""
        first: dict[str, str] = {}
        for text in self.prompts:
            if (other := first.setdefault(plain_text(text), text)) != text:
                twins = f"{other!r} and {text!r} differ only in case or spaces, but are scored separately"
                object.__setattr__(self, "warnings", (*self.warnings, twins))

    @property
    def prompts(self) -> tuple[str, ...]:
        """Texts of the scene, sorted (capitals first)."""
        return tuple(sorted({region.text for regions in self.views.values() for region in regions}))

    @property
    def num_pairs(self) -> int:
        return sum(len({region.text for region in regions}) for regions in self.views.values())

    def image_hw(self, view: str) -> tuple[int, int] | None:
        """Return the size of a view's image in the data set; None if the data set has no image of it."""
        return image_size_hw(self.images[view]) if view in self.images else None

    def check_posed(self, names: Collection[str]) -> list[str]:
        """Return the labelled views that have a pose; log the others.

        Raises:
            SceneError: the share of views that have one is below `min_posed`.
        """
        posed = [view for view in self.views if view in names]
        missing = [view for view in self.views if view not in names]
        lacking = f"labelled views of {self.dataset}/{self.scene} have no pose: {', '.join(missing)}"
        if len(posed) < self.min_posed * len(self.views):
            raise SceneError(
                lacking,
                expected=f"a pose for {self.min_posed:.0%} of the {len(self.views)} labelled views",
                found=f"{len(names)} posed views: {shorten_list(sorted(names), 5)}",
                fix="use the poses included in the data set, or register these images",
            )
        if missing:
            logger.warning("%s; they are not scored", lacking)
        return posed

    def report(self) -> SceneReport:
        """Read every mask and the poses of the scene, and report what was found."""
        warnings = list(self.warnings)
        empty = [
            f"{view}: {region.text}"
            for view, regions in self.views.items()
            for region in regions
            if not region.mask().any()
        ]
        if empty:
            warnings.append(f"regions without pixels: {'; '.join(empty)}")
        facts: dict[str, object] = {
            "images": len(self.images),
            "labelled views": len(self.views),
            "regions": sum(map(len, self.views.values())),
            "(view, text) pairs": self.num_pairs,
            "texts": len(self.prompts),
        }
        if self.poses is None:
            warnings.append("the data set has no poses for this scene; they will be computed from the images")
        else:
            posed = posed_images(self.poses, self.dataset)
            facts["posed views"] = len(posed)
            self.check_posed(posed)
        return SceneReport(facts, tuple(warnings))


def images_by_view(folder: Path) -> dict[str, Path]:
    """Return a folder's images by view, sorted by stem; raise SceneError if it has none or a stem repeats."""
    files = sorted(list_images(folder) if folder.is_dir() else [], key=lambda path: path.stem)
    if not files:
        raise SceneError(
            f"{folder} {'has no images' if folder.is_dir() else 'is missing'}",
            expected="the scene's images (.jpg or .png)",
            fix="unpack the whole archive again",
        )
    return dict(zip(view_names(files), files, strict=True))


def mask_region(
    path: Path,
    foreground: int,
    image_hw: tuple[int, int],
    warnings: list[str],
    share: float = 0.0,
    min_grey: int | None = None,
) -> LabelledRegion:
    """Return the region in a grey mask file, which is named after the query; report resizing in `warnings`.

    Args:
        foreground: lowest grey value of the region.
        share: as in `check_label_size`.
        min_grey: lowest grey value of the region under protocols that use `any_grey`, if different.
    """
    size_hw = image_size_hw(path)
    warnings += check_label_size(f"mask {path}", size_hw, image_hw, share)
    any_grey = None if min_grey is None else partial(read_mask_file, path, min_grey)
    pixels = partial(read_mask_file, path, foreground)
    text = composed(path.stem)
    return LabelledRegion(text, size_hw, pixels, path=(text,), any_grey=any_grey)


def read_mask_file(path: Path, minimum: int) -> Bool[np.ndarray, "H W"]:
    """Return which values of a mask file are at least `minimum`.

    Raises:
        ImageError: it cannot be read, or has only 0 and one value below `minimum`.
    """
    values = read_mask(path)
    if 0 < values.max() < minimum and len(np.unique(values)) <= 2:
        expected, fix = "0 and 255", "write the region as white on black"
        problem = f"mask {path} has only the values 0 and {values.max()}"
        raise ImageError(problem, expected=expected, fix=fix)
    return values >= minimum


def check_label_size(
    where: str, label_hw: tuple[int, int], image_hw: tuple[int, int], share: float = 0.0
) -> list[str]:
    """Compare a label's size with its image's; if they differ, return a warning that starts with `where`.

    `share` is the tolerated relative difference in height after scaling to the same width; rounding
    differences are always tolerated.

    Raises:
        SceneError: the label and its image have different aspect ratios.
    """
    if label_hw == image_hw:
        return []
    scale = image_hw[1] / label_hw[1]
    if abs(image_hw[0] - label_hw[0] * scale) > max(ROUNDING_PX, ROUNDING_PX * scale, share * image_hw[0]):
        raise SceneError(
            f"{where} does not match the size of its image",
            expected=f"{image_hw[1]} x {image_hw[0]} px (width x height), or a scaled copy",
            found=f"{label_hw[1]} x {label_hw[0]} px",
            fix="use the images that the labels were drawn on (undistorted, from the same release)",
        )
    return [
        f"{where} is {label_hw[1]} x {label_hw[0]} px, but its image is {image_hw[1]} x {image_hw[0]} px; "
        "resized by nearest neighbour"
    ]


def require_images(labelled: Iterable[str], images: Mapping[str, Path]) -> None:
    """Raise SceneError if a labelled view has no image."""
    orphans = sorted(set(labelled) - set(images))
    if orphans:
        raise SceneError(
            f"labelled views have no image: {', '.join(orphans)}",
            expected=f"images with these names in {next(iter(images.values())).parent}",
            found=f"{len(images)} images, {next(iter(images))} to {list(images)[-1]}",
            fix="unpack the images again; other releases number them differently",
        )


def posed_images(folder: Path, dataset: str) -> dict[str, "KnownView"]:
    """Return the posed views of a scene folder by view name, sorted by stem.

    Raises:
        SceneError: the folder has no poses, they cannot be read, or the lenses have distortion, which
            would misalign labels drawn on undistorted images.
    """
    from hilsplat.scene.colmap import is_pinhole
    from hilsplat.scene.importers.reading import read_source

    known = find_known_poses(folder)
    if known is None:
        raise SceneError(
            f"{folder} has no poses",
            expected="a COLMAP model in sparse/0/",
            fix=f"unpack the whole archive of {dataset} again",
        )
    source = read_source(known)
    source.require_most(1.0, known.files[0])
    bent = sorted({view.camera.model_name for view in source.views if not is_pinhole(view.camera)})
    if bent:
        raise SceneError(
            f"the cameras in {known.files[0]} have lens distortion",
            expected="PINHOLE or SIMPLE_PINHOLE, as for undistorted images",
            found=", ".join(bent),
            fix="use the COLMAP model of the undistorted images, or undistort images and labels",
        )
    by_stem = {Path(view.name).stem: view for view in source.views}
    return {view_name(stem): by_stem[stem] for stem in sorted(by_stem)}
