"""Report on a set of photographs, before it is processed: what can be read, and which problems are likely.

Thresholds were chosen on three sets of real photographs that all register, on blurred, darkened and
over-exposed copies of them, and on pictures from a camera that only rotates (values: docs/scene.md).
"""

import os
import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from hilsplat.base.errors import ImageError, first_line, shorten_list
from hilsplat.base.files import list_files, list_images
from hilsplat.base.images import (
    num_readers,
    opened_image,
    orientation,
    read_image,
    require_usable_size,
    resize_to_fit,
)
from hilsplat.base.lineage import copies_of
from hilsplat.base.processes import in_order, num_cores
from hilsplat.base.progress import track
from hilsplat.scene.features import exif_focal_px
from hilsplat.scene.layouts import photo_folder
from hilsplat.scene.view_names import view_names

OTHER_PHOTO_SUFFIXES = frozenset(
    {".dng", ".nef", ".nrw", ".cr2", ".cr3", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw", ".gpr"}
    | {".insp", ".jp2", ".exr", ".hdr", ".psd", ".gif", ".jxl"}
)
"""Suffixes of unsupported photograph formats. Such files are counted and reported as skipped."""

FEW_PHOTOS = 10  # with fewer photographs, large parts of a scene usually appear in at most one photograph

CHECK_SIDE_PX = 800
FEATURE_SIDE_PX = 640
"""Longer side of the grey copies: `CHECK_SIDE_PX` for blur and exposure, `FEATURE_SIDE_PX` for motion."""

BLURRED = 0.55
"""Blur above which a photograph is reported. Measured: 0.16 to 0.40 for photographs, up to 0.50 for
video frames, and 0.58 to 0.77 for photographs blurred by a Gaussian of 4 px (at 800 px)."""

REBLUR_PX = 11

DARK_LEVEL = 64
"""A photograph is too dark if 95 % of its pixels are below this level. A lit object on black is not."""

WHITE_LEVEL = 250
WHITE_SHARE = 0.5  # a photograph is over-exposed if more than this share of its pixels is white

FAULTS = (
    "blurred: omit them, or retake them with more light, a steady hand and correct focus",
    "too dark: retake them with more light",
    "more than half white: retake them with less exposure, unless the background is white",
    "exactly twice as wide as high: cut 360-degree panoramas into views of about 90 degrees",
)
"""Faults of a photograph, and what to do."""

OF_OTHERS = re.compile(r"(\.(jpe?g|png|tiff?|heic))?([._-](mask|depth|normal|edited))?$", re.IGNORECASE)
"""What masks, maps and edited copies have behind the name of their photograph."""

SAME_PLACE = 0.01
"""Displacement of matches (90th percentile), as a share of the diagonal, below which two pictures count as
the same. The median would be too small: around a centred object, half of the matches may barely move."""

MAX_PAIRS = 60  # maximum number of evenly spaced neighbouring pairs to match (5 s at 80 ms per photograph)

NUM_FEATURES = 1000
RATIO = 0.8
MIN_MATCHES = 40  # minimum number of verified matches required to measure the motion between two photographs

MATCH_ERROR_PX = 1.5
TURN_ERROR_PX = 3.0
TURN_SHARE = 0.85
"""A pair counts as rotated if a rotation explains at least this share of its verified matches. Measured: 0.96
to 1 for rotating cameras, and 0.07 to 0.27 (median of a set) and at most 0.87 for moving cameras."""

MIN_TURN_PAIRS = 3
FOCALS = (0.6, 0.75, 0.9, 1.1, 1.35, 1.7, 2.2, 3.0)
"""Focal lengths to try, as multiples of the picture's longer side."""

MAX_NAMED = 5  # maximum number of photographs or sizes that a doubt names

Features = tuple[Float32[np.ndarray, "_ 2"], Float32[np.ndarray, "_ 128"], tuple[int, int]]
"""SIFT positions in px, RootSIFT descriptors, and height and width of the picture that has them."""


@dataclass(frozen=True)
class PhotoReport:
    """Report on a folder of photographs.

    Attributes:
        sizes: number of readable photographs per upright size (height, width), px.
        unreadable: (file name, reason) of each image that cannot be read.
        num_rotated: number of photographs that are rotated according to their EXIF orientation.
        duplicates: groups of file names with identical bytes. Without known poses, the first is used.
        passed_over: number of skipped files in unsupported photograph formats, by suffix.
        doubts: likely problems and what to do about them (`check`).
        notes: how the folder was made (`intake`), and what else in it is used or left out (`findings`).
        columns: paths of these other parts for the scene sheet, by column.
        have_poses: whether the poses are known.
    """

    folder: Path
    sizes: dict[tuple[int, int], int]
    unreadable: tuple[tuple[str, str], ...]
    num_rotated: int
    duplicates: tuple[tuple[str, ...], ...]
    passed_over: dict[str, int]
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    columns: dict[str, Path] = field(default_factory=dict)
    have_poses: bool = False

    @property
    def num_readable(self) -> int:
        """Number of readable photographs, including identical copies."""
        return sum(self.sizes.values())

    def __str__(self) -> str:
        lines = [*self.notes, f"{self.num_readable} photographs in {self.folder}"]
        for (height, width), count in sorted(self.sizes.items(), key=lambda item: (-item[1], item[0])):
            lines.append(f"  {count:>5}  of {width} x {height} px (width x height)")
        if self.num_rotated:
            lines.append(f"  {self.num_rotated:>5}  rotated upright according to their EXIF orientation")
        if copies := sum(len(names) - 1 for names in self.duplicates):
            equal = shorten_list([" = ".join(names) for names in self.duplicates], 5)
            fate = "" if self.have_poses else " and are left out"
            lines.append(f"  {copies:>5}  are copies of others{fate}: {equal}")
        for suffix, count in sorted(self.passed_over.items()):
            lines.append(f"  {count:>5}  {suffix} files skipped: convert them to JPEG or PNG to use them")
        if self.unreadable:
            lines.append(f"  {len(self.unreadable):>5}  cannot be read and are left out:")
            lines += [f"           {name}: {reason}" for name, reason in self.unreadable]
        lines += [f"  warning: {doubt}" for doubt in self.doubts]
        return "\n".join(lines)


def inspect_photos(folder: Path, posed: Sequence[Path] = ()) -> PhotoReport:
    """Decode the `posed` images or, if no poses are known, all photographs in a folder (`photo_folder`).

    Report their contents and likely problems.

    Raises:
        SceneError: a photograph has an unusable name, or two photographs differ only in their suffix.
    """
    photos = [*posed] or list_images(photo_folder(folder))
    folder = Path(os.path.commonpath([path.parent for path in photos])) if photos else photo_folder(folder)
    view_names(photos)
    unreadable: list[tuple[str, str]] = []
    num_rotated = 0
    checked: list[CheckedPhoto] = []
    matched, have_poses = matched_rows(len(photos)), bool(posed)

    def inspected(row: int) -> tuple[CheckedPhoto, bool] | str:
        """Return a photograph and whether it is turned, or why it cannot be read."""
        path = photos[row]
        name = path.relative_to(folder).as_posix()
        try:
            pixels = read_image(path)
            require_usable_size(path, pixels.shape[:2])
        except ImageError as error:
            reason = first_line(error.__cause__ or error).replace(str(path), name)
            return reason + (f" ({path.stat().st_size} bytes)" if path.exists() else "")
        focal_px = exif_focal_px(path, (pixels.shape[0], pixels.shape[1]))
        with opened_image(path) as image:
            is_turned = orientation(image) > 1
        is_matched = row in matched and not have_poses
        return checked_photo(name, pixels, focal_px, is_matched=is_matched), is_turned

    reads = in_order(inspected, range(len(photos)), num_readers(photos, num_cores()))
    for path, found in zip(photos, track(reads, "photographs checked", len(photos)), strict=True):
        if isinstance(found, str):
            unreadable.append((path.relative_to(folder).as_posix(), found))
            continue
        photo, is_turned = found
        num_rotated += is_turned
        checked.append(photo)
    copies = {path.relative_to(folder).as_posix(): original for path, original in copies_of(photos).items()}
    distinct = [photo for photo in checked if photo.name not in copies]
    same: dict[Path, list[str]] = defaultdict(list)
    for name in (photo.name for photo in checked if photo.name in copies):
        same[copies[name]].append(name)
    return PhotoReport(
        folder=folder,
        sizes=Counter(photo.size_hw for photo in checked),
        unreadable=tuple(unreadable),
        num_rotated=num_rotated,
        duplicates=tuple((first.relative_to(folder).as_posix(), *names) for first, names in same.items()),
        passed_over=Counter(path.suffix.lower() for path in list_files(folder, OTHER_PHOTO_SUFFIXES)),
        doubts=tuple(photo_doubts(distinct, have_poses=have_poses)),
        have_poses=have_poses,
    )


@dataclass(frozen=True, eq=False)
class CheckedPhoto:
    """Properties of a photograph that the checks use.

    `focal_px` is the focal length from EXIF, in px at full size, or None. `faults` are some of `FAULTS`.
    `features` are those of an upright copy, or None if the photograph isn't matched with its neighbours.
    """

    name: str
    size_hw: tuple[int, int]
    focal_px: float | None
    faults: tuple[str, ...]
    features: Features | None


def checked_photo(
    name: str, pixels: UInt8[np.ndarray, "H W 3"], focal_px: float | None, *, is_matched: bool
) -> CheckedPhoto:
    """Measure a photograph; only if it `is_matched`, its features are computed and kept."""
    grey = cv2.cvtColor(resize_to_fit(pixels, CHECK_SIDE_PX), cv2.COLOR_RGB2GRAY)
    is_dark, is_white = np.percentile(grey, 95) < DARK_LEVEL, (grey >= WHITE_LEVEL).mean() > WHITE_SHARE
    height, width = pixels.shape[:2]
    observed = (blur(grey) > BLURRED, is_dark, is_white, width == 2 * height)
    faults = tuple(fault for fault, is_found in zip(FAULTS, observed, strict=True) if is_found)
    features = _features(resize_to_fit(grey, FEATURE_SIDE_PX)) if is_matched else None
    return CheckedPhoto(name, (height, width), focal_px, faults, features)


def matched_rows(number: int) -> set[int]:
    """Return the rows of at most `MAX_PAIRS` evenly spaced pairs of neighbours among photographs."""
    first = np.linspace(0, max(number - 2, 0), min(max(number - 1, 0), MAX_PAIRS)).round().astype(int)
    return {*first.tolist(), *(first + 1).tolist()}


def photo_doubts(photos: Sequence[CheckedPhoto], *, have_poses: bool) -> list[str]:
    """Return one message per likely problem, with advice on how to fix it.

    Photographs must be sorted by name, which is assumed to be the capture order. If their poses are known,
    the lens and the motion are not checked.
    """
    doubts = []
    if len(photos) < FEW_PHOTOS:
        doubts.append(f"only {len(photos)} photographs: take 20 or more, less than 10 degrees apart")
    by_stem = {photo.name.rpartition(".")[0]: photo.name for photo in photos}
    if copies := [by_stem[s] for s in by_stem if s != (plain := OF_OTHERS.sub("", s)) and plain in by_stem]:
        doubts.append(f"{_listed(copies, photos)} named like masks or copies of others: move them elsewhere")
    for fault in FAULTS:
        if names := [photo.name for photo in photos if fault in photo.faults]:
            doubts.append(f"{_listed(names, photos)} {fault}")
    if not have_poses:
        doubts += _lens_doubts(photos) + _motion_doubts(photos)
    return doubts


def _lens_doubts(photos: Sequence[CheckedPhoto]) -> list[str]:
    sizes = sorted({tuple(sorted(photo.size_hw, reverse=True)) for photo in photos}, reverse=True)
    if len(sizes) > 1:
        listed = ", ".join(f"{long} x {short}" for long, short in sizes[:MAX_NAMED])
        return [
            f"the photographs have {len(sizes)} sizes ({listed}), and each size needs a separate lens "
            "model, which is hard to estimate from few photographs: use one camera, and don't crop"
        ]
    focals = sorted(photo.focal_px for photo in photos if photo.focal_px is not None)
    if focals and focals[-1] > 1.1 * focals[0]:
        return [
            f"the focal lengths range from {focals[0]:.0f} to {focals[-1]:.0f} px (zoom or several lenses): "
            "use one lens, and don't zoom"
        ]
    return []


def _motion_doubts(photos: Sequence[CheckedPhoto]) -> list[str]:
    """Return problems with the camera's motion, measured by matching neighbouring photographs."""
    same, turned, moved = [], 0, 0
    for one, other in pairwise(photos):
        if one.features is None or other.features is None:
            continue
        if (motion := pair_motion(one.features, other.features)) is None:
            continue
        displacement, turn_share = motion
        if displacement < SAME_PLACE:
            same.append(other.name)
        elif turn_share >= TURN_SHARE:
            turned += 1
        else:
            moved += 1
    doubts = []
    if same:
        doubts.append(
            f"{_listed(same, photos)} nearly identical to the previous one: omit them, because they "
            "take time to process and add nothing"
        )
    if turned >= MIN_TURN_PAIRS and turned > 2 * moved:
        doubts.append(
            f"the camera seems to turn in place: rotation alone explains {turned} of the {turned + moved} "
            "pairs of neighbours that could be compared. To measure depth, walk around the scene, or step "
            "sideways between photographs"
        )
    return doubts


def _listed(names: Sequence[str], photos: Sequence[CheckedPhoto]) -> str:
    """Format a list, such as "3 of 40 photographs (a.jpg, b.jpg, c.jpg) are"."""
    verb = "is" if len(names) == 1 else "are"
    return f"{len(names)} of {len(photos)} photographs ({shorten_list(names, MAX_NAMED)}) {verb}"


def blur(grey: UInt8[np.ndarray, "h w"]) -> float:
    """Return the blur of a picture, 0 to 1: the share of its gradient magnitude that a second blur preserves.

    Crete et al., "The blur effect" (2007), with an 11 px box. The result is the larger of the values along x
    and y. Unlike the Laplacian's variance, it depends little on the content. A flat picture has blur 1.
    """
    values = grey.astype(np.float32)
    shares = []
    for axis, box in ((1, (REBLUR_PX, 1)), (0, (1, REBLUR_PX))):
        steps = np.abs(np.diff(values, axis=axis))
        lost = np.maximum(steps - np.abs(np.diff(cv2.blur(values, box), axis=axis)), 0)
        total = float(steps.sum(dtype=np.float64))
        shares.append(1 - float(lost.sum(dtype=np.float64)) / total if total else 1.0)
    return max(shares)


def _features(grey: UInt8[np.ndarray, "h w"]) -> Features:
    points, descriptors = cv2.SIFT.create(NUM_FEATURES).detectAndCompute(grey, None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), grey.shape
    xy = np.array([point.pt for point in points], dtype=np.float32)
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    return xy, descriptors, grey.shape


def pair_motion(one: Features, other: Features) -> tuple[float, float] | None:
    """Measure the motion between two pictures, or return None if too few matches fit an epipolar geometry.

    Return the displacement of the verified matches (90th percentile, as a share of the diagonal) and the
    share of these matches explained by a rotation of the camera about its centre. The rotation (three
    parameters) is fitted with the best of several focal lengths. A homography is not used, because it also
    fits a camera that moves in front of a wall or a carpet (measured: up to 0.97 of the matches).
    """
    if min(len(one[0]), len(other[0])) < MIN_MATCHES:
        return None
    nearest: dict[int, cv2.DMatch] = {}
    for first, second in cv2.BFMatcher().knnMatch(one[1], other[1], k=2):
        if first.distance < RATIO * second.distance:
            rival = nearest.get(first.trainIdx)
            if rival is None or first.distance < rival.distance:
                nearest[first.trainIdx] = first
    if len(nearest) < MIN_MATCHES:
        return None
    matches = list(nearest.values())
    a, b = one[0][[match.queryIdx for match in matches]], other[0][[match.trainIdx for match in matches]]
    try:
        _, inliers = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, MATCH_ERROR_PX, 0.999, 2000)
    except cv2.error:  # OpenCV 5.0 fails an assertion if it finds no model
        return None
    if inliers is None or inliers.sum() < MIN_MATCHES:
        return None
    a, b = a[inliers.ravel() > 0].astype(np.float64), b[inliers.ravel() > 0].astype(np.float64)
    size_hw = one[2]
    displacement = float(np.percentile(np.linalg.norm(b - a, axis=1), 90) / np.hypot(*size_hw))
    return displacement, max(_turn_share(a, b, size_hw, focal * max(size_hw)) for focal in FOCALS)


def _turn_share(
    a: Float64[np.ndarray, "n 2"], b: Float64[np.ndarray, "n 2"], size_hw: tuple[int, int], focal_px: float
) -> float:
    """Return the share of matches that the best rotation explains (Kabsch, refitted to the better half)."""
    centre = np.array([size_hw[1] / 2, size_hw[0] / 2])

    def rays(xy: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
        directions = np.column_stack([(xy - centre) / focal_px, np.ones(len(xy))])
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)

    from_a, from_b = rays(a), rays(b)
    used = np.ones(len(a), dtype=bool)
    for _ in range(5):
        u, _, vt = np.linalg.svd(from_b[used].T @ from_a[used])
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        turned = from_a @ rotation.T
        error_px = np.linalg.norm(turned[:, :2] / turned[:, 2:] * focal_px + centre - b, axis=1)
        used = error_px <= max(TURN_ERROR_PX, float(np.median(error_px)))
    return float((error_px < TURN_ERROR_PX).mean())
