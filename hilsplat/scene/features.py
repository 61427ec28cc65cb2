"""Features and verified matches of photographs: upright work images, initial cameras, SIFT, pairs."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from PIL import ExifTags

from hilsplat.base.errors import ImageError
from hilsplat.base.images import (
    exif_tags,
    num_readers,
    open_image,
    read_image,
    require_usable_size,
    resize_to_fit,
    write_png,
)
from hilsplat.base.processes import in_order
from hilsplat.base.progress import track
from hilsplat.scene.colmap import pycolmap
from hilsplat.scene.matching import match_pairs, read_features
from hilsplat.scene.pairing import appearance_vectors, groups_of, joining_pairs, likely_pairs
from hilsplat.scene.view_names import view_names
from hilsplat.settings import PosesSettings

logger = logging.getLogger(__name__)

LARGE_CAPTURE = 100
"""Number of views above which matcher "auto" tries likely pairs only, and mapping refines poses less."""

MIN_INLIERS = 12  # minimum number of verified matches per pair (COLMAP: 15)

PEAK_THRESHOLD = 0.02 / 3 / 2
"""SIFT contrast threshold; half of COLMAP's, because renders and indoor photographs have low contrast."""

MAX_TRIALS = 1000  # maximum RANSAC trials per pair (COLMAP: 10000); pairs without overlap use all of them

MIN_TRIALS = 30
"""Minimum RANSAC trials per pair of matcher "retrieval" (COLMAP: 100); most of its pairs overlap."""

WORK_COMPRESSION = 1
"""zlib compression level of work images, a third faster than level 6; COLMAP reads each image only once."""

PLANE_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""Millimetres per unit of the focal plane resolution, by EXIF unit code (default: inch)."""
DIAGONAL_35MM = 43.2666
"""Diagonal of a 35 mm frame in mm, the reference of the equivalent focal length in EXIF."""

Lens = tuple[list[str], str, list[float] | None]
"""Views that share a camera, the camera's COLMAP model, and its initial parameters (None: COLMAP guesses)."""


@dataclass(frozen=True)
class WorkImage:
    """Upright, downscaled PNG of a photograph (`source`) for structure from motion, named after the view.

    `focal_px` is the focal length from EXIF, in px of the copy, or None. `taken` is the time from EXIF, or ""
    (`exif_time`).
    """

    view: str
    source: Path
    size_hw: tuple[int, int]
    focal_px: float | None
    taken: str = ""


def exif_focal_px(path: Path, size_hw: tuple[int, int]) -> float | None:
    """Return the focal length from EXIF, in px of the image resized to `size_hw`, or None.

    It is computed from the 35 mm equivalent or else from the focal length and the focal plane resolution.
    """
    with open_image(path) as image:
        tags, size = exif_tags(image, ExifTags.IFD.Exif), image.size

    def number(tag: ExifTags.Base) -> float:
        try:
            value = float(tags.get(tag) or 0)
        except (TypeError, ValueError, ZeroDivisionError):
            return 0.0
        return value if np.isfinite(value) and value > 0 else 0.0

    focal_px = number(ExifTags.Base.FocalLengthIn35mmFilm) / DIAGONAL_35MM * float(np.hypot(*size_hw))
    unit_mm = PLANE_UNIT_MM.get(int(number(ExifTags.Base.FocalPlaneResolutionUnit)), 25.4)
    pixels_per_mm = number(ExifTags.Base.FocalPlaneXResolution) / unit_mm
    # The resolution refers to the image stored by the camera; programs that downscale it keep these tags.
    stored = (number(ExifTags.Base.ExifImageWidth), number(ExifTags.Base.ExifImageHeight))
    stored_px = max(stored) or max(size)
    focal_px = focal_px or number(ExifTags.Base.FocalLength) * pixels_per_mm * max(size_hw) / stored_px
    return focal_px if 0.1 < focal_px / max(size_hw) < 10 else None  # COLMAP registers no others


def exif_time(path: Path) -> str:
    """Return the time at which a photograph was taken, from EXIF ("2026:05:17 12:30:59.25"), or ""."""
    with open_image(path) as image:
        tags = exif_tags(image, ExifTags.IFD.Exif)
    parts = (tags.get(tag) for tag in (ExifTags.Base.DateTimeOriginal, ExifTags.Base.SubsecTimeOriginal))
    return ".".join(part.strip() for part in parts if isinstance(part, str))


def prepare_images(
    sources: Sequence[Path], folder: Path, max_side_px: int, min_share: float = 1.0, threads: int = 1
) -> tuple[list[WorkImage], dict[Path, str]]:
    """Write each photograph to `folder` as an upright PNG with a longer side of at most `max_side_px`.

    Return the copies, and why the other photographs cannot be used; raise ImageError if fewer than
    `min_share` can be used.
    """
    folder.mkdir(parents=True, exist_ok=True)

    def prepared(source: Path) -> WorkImage | str:
        try:
            pixels = read_image(source)
            require_usable_size(source, pixels.shape[:2], max_side_px)
        except ImageError as error:
            return str(error)
        pixels = resize_to_fit(pixels, max_side_px)
        size_hw = (pixels.shape[0], pixels.shape[1])
        write_png(folder / views[source], pixels, WORK_COMPRESSION)
        return WorkImage(views[source], source, size_hw, exif_focal_px(source, size_hw), exif_time(source))

    views = dict(zip(sources, view_names(sources), strict=True))
    reads = in_order(prepared, sources, num_readers(sources, threads))
    found = dict(zip(sources, track(reads, "photographs read", len(sources)), strict=True))
    images = [image for image in found.values() if isinstance(image, WorkImage)]
    damaged = {source: reason for source, reason in found.items() if isinstance(reason, str)}
    if len(images) < min_share * len(sources):
        raise ImageError(
            f"{len(damaged)} of {len(sources)} images in {sources[0].parent} cannot be used",
            found="\n            ".join(" ".join(reason.split()) for reason in damaged.values()),
            fix="remove them from the folder or replace them with intact copies",
        )
    return images, damaged


def lenses_of(images: Sequence[WorkImage], camera_model: str, single_camera: str) -> list[Lens]:
    """Group views by lens: by size and EXIF focal length ("auto"), by size ("yes"), or singly ("no")."""
    groups: dict[object, list[WorkImage]] = {}
    for image in images:
        key = {"yes": image.size_hw, "no": image.view}.get(single_camera, (image.size_hw, image.focal_px))
        groups.setdefault(key, []).append(image)
    lenses: list[Lens] = []
    for group in groups.values():
        (height, width), focal = group[0].size_hw, group[0].focal_px
        name, params = camera_model.upper(), None
        if focal is not None:
            params = pycolmap.Camera.create_from_model_name(1, name, focal, width, height).params.tolist()
        lenses.append(([image.view for image in group], name, params))
    return lenses


def find_matches(
    database: Path,
    folder: Path,
    lenses: Sequence[Lens],
    taken: Mapping[str, str],
    settings: PosesSettings,
    seed: int,
    threads: int,
) -> str:
    """Add images to a new database, extract features and match them; return the matcher that was used.

    Features are extracted on the CPU; the result does not depend on `threads`. `taken` orders views in time
    (`WorkImage.taken`); views at the same time, or without one, are in name order. Call this in a separate
    process: if the database cannot be written, COLMAP throws an exception in a C++ thread.
    """
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    pycolmap.Database.open(database).close()  # creates the file
    # Import first: extraction would add images as its threads finish, so results would depend on timing.
    names: list[str] = []
    for lens_views, camera_model, params in lenses:
        numbers = ", ".join(map(repr, params or ()))
        reader = pycolmap.ImageReaderOptions(camera_model=camera_model, camera_params=numbers)
        pycolmap.import_images(database, folder, pycolmap.CameraMode.SINGLE, lens_views, reader)
        names += lens_views
    size = settings.max_side_px
    options = pycolmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False, max_image_size=size)
    options.sift.max_num_features = settings.max_features
    options.sift.peak_threshold = PEAK_THRESHOLD
    pycolmap.extract_features(database, folder, names, extraction_options=options, device=pycolmap.Device.cpu)
    verification = pycolmap.TwoViewGeometryOptions(min_num_inliers=MIN_INLIERS)
    verification.ransac.random_seed = seed
    verification.ransac.num_threads = 1
    verification.ransac.max_num_trials = MAX_TRIALS
    verification.compute_relative_pose = settings.mapper == "global"
    matcher = settings.matcher
    if matcher == "auto":
        matcher = "exhaustive" if len(names) <= LARGE_CAPTURE else "retrieval"
    names.sort()  # in the order of `read_features`
    with pycolmap.Database.open(database) as opened:
        views = read_features(opened)
        if matcher == "exhaustive":
            match_pairs(opened, views, list(combinations(range(len(views)), 2)), verification, threads)
            return matcher
        verification.ransac.min_num_trials = MIN_TRIALS
        vectors = appearance_vectors([view.descriptors for view in views], seed)
        likeness = vectors @ vectors.T
        in_time = sorted(range(len(names)), key=lambda row: taken.get(names[row], ""))
        pairs = likely_pairs(likeness, in_time)
        verified = match_pairs(opened, views, sorted(pairs), verification, threads)
        more = joining_pairs(likeness, pairs, verified)
        match_pairs(opened, views, sorted(more), verification, threads)
    return matcher


def incremental_options(seed: int) -> pycolmap.IncrementalPipelineOptions:
    """Return the options of COLMAP's incremental mapper and triangulator: one thread and fixed seeds."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.min_num_matches = MIN_INLIERS
    return options


def count_matches(database: Path) -> tuple[dict[str, dict[str, int]], dict[str, dict[str, int]]]:
    """Count the verified matches of each pair of views, and each view's features and matches for the report.

    Two views count as matched if they have at least `MIN_INLIERS` verified matches. Groups are the connected
    components of matched views, numbered from 1, the largest first.
    """
    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        features = {name: opened.num_keypoints_for_image(number) for number, name in names.items()}
        pair_ids, inliers = opened.read_two_view_geometry_num_inliers()
    shared: dict[str, dict[str, int]] = {name: {} for name in sorted(names.values())}
    row_of = {name: row for row, name in enumerate(shared)}
    verified = []
    for pair_id, count in zip(pair_ids, inliers, strict=True):
        one, other = (names[image_id] for image_id in pycolmap.pair_id_to_image_pair(pair_id))
        shared[one][other] = shared[other][one] = int(count)
        if count >= MIN_INLIERS:
            verified.append((row_of[one], row_of[other]))
    groups = groups_of(len(shared), verified)
    counts = {}
    for name, group in zip(shared, groups, strict=True):
        pairs = [count for count in shared[name].values() if count >= MIN_INLIERS]
        counts[name] = {
            "features": features[name],
            "group": int(group) + 1,
            "matched_views": len(pairs),
            "best_pair_matches": max(pairs, default=0),
        }
    return shared, counts
