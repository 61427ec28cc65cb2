"""Creation of a scene from images with known poses."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from hilsplat.base.errors import ImageError, shorten_list
from hilsplat.base.files import is_outside
from hilsplat.base.images import (
    image_size_hw,
    num_readers,
    opened_image,
    orientation,
    read_image,
    require_usable_size,
    resize_to_fit,
    write_png,
)
from hilsplat.base.processes import in_order, in_own_process
from hilsplat.base.progress import track
from hilsplat.scene.assemble import Posed, PosedView, few_points_doubt, photo_of, split_views, undistort
from hilsplat.scene.cameras import Photo
from hilsplat.scene.colmap import Points, pycolmap, sparse_points
from hilsplat.scene.features import find_matches, incremental_options
from hilsplat.scene.importers.known_views import ASPECT_TOLERANCE, KnownView, Source
from hilsplat.scene.importers.reading import read_source
from hilsplat.scene.layouts import KnownPoses
from hilsplat.scene.view_names import view_names
from hilsplat.settings import PosesSettings

CHECKED_VIEWS, CHECKED_POINTS, MIN_INSIDE = 8, 100_000, 100
"""Numbers of images and points that are compared, and of points that must be inside the images."""

MAX_MISFIT = 0.75
"""Median difference between the colours of points and pixels, relative to that of other points' colours.
Measured: 0.08 to 0.43 with right poses; 0.80 or more in other axes, or with inverted poses."""


def import_poses(
    known: KnownPoses, work: Path, name: str, settings: PosesSettings, seed: int, threads: int
) -> Posed:
    """Read a folder with known poses.

    Images are matched to poses by name; the report lists poses without an image and images without a pose.
    Pixels are used as stored, because COLMAP ignores the EXIF orientation. The source's axes are kept.
    """
    source, min_share = read_source(known), settings.min_registered_share
    source.require_most(min_share, known.files[0])
    total = len(source.views) + len(source.left_out)
    with_image = {view.image: view for view in source.views if view.image is not None}
    posed: list[tuple[KnownView, PosedView]] = []
    turned: list[str] = []  # images used as stored against their EXIF orientation

    def imported(pair: tuple[KnownView, str]) -> tuple[PosedView, bool] | ImageError:
        try:
            distorted, as_stored = _with_pixels(*pair, work / "images", settings.max_side_px)
            return undistort(distorted, work / "pinhole", settings.max_side_px), as_stored
        except ImageError as error:
            return error

    pairs = [*zip(with_image.values(), view_names([*with_image]), strict=True)]
    reads = in_order(imported, pairs, num_readers(with_image, threads))
    for (view, _), read in zip(pairs, track(reads, "images read", len(pairs)), strict=True):
        if isinstance(read, ImageError):
            source.drop(view, read)
            continue
        posed.append((view, read[0]))
        turned += [view.name] * read[1]
    source.require_most(min_share, known.files[0], images=True)
    missing = source.without_image
    views = [view for _, view in posed]
    points = source.points or triangulate(views, work, settings, seed, threads)
    points_per_view = round(len(points[0]) / len(views), 1)
    if source.points is not None:
        source.notes += misfit_notes([view for view, _ in posed], points, "points")
    else:
        source.notes += few_points_doubt(points_per_view)
    warnings = [*source.notes, *(f"left out: {reason}" for reason in source.left_out.values())]
    if turned:
        warnings.append(
            f"{len(turned)} images, such as {turned[0]}, are used as stored, as COLMAP does, although EXIF "
            "turns or mirrors them: poses, labels and maps of the upright images don't fit"
        )
    if missing:
        named = shorten_list(missing, 20)
        warnings.append(f"{len(missing)} of {total} posed views have no image file: {named}")
    if source.unposed:
        warnings.append(f"{len(source.unposed)} images have no pose and are skipped")
    origin = ", ".join(
        path.relative_to(known.root).as_posix() if known.root in path.parents else path.name
        for path in known.files
    )
    observed = [view.report for view in source.views if view.report.get("observations")]
    num_observations = sum(entry["observations"] for entry in observed)
    total_px = sum(entry["observations"] * entry["reprojection_error_px"] for entry in observed)
    report = {
        "scene": name,
        "poses": f"imported from {origin}",
        "seed": seed,
        "images": total + len(source.unposed),
        "registered": len(views),
        "models": [len(views)],
        "points": len(points[0]),
        "points_from": "source" if source.points is not None else "triangulated from the known poses",
        "points_per_view": points_per_view,
        "mean_reprojection_error_px": round(total_px / num_observations, 4) if num_observations else None,
        "warnings": warnings,
        "views": _view_entries(posed, source, missing),
    }
    names = [view.view for view in views]
    train = {path.stem for path in (known.root / "images_train").glob("*")}  # of Gaussian Grouping's data
    held_out = [view.is_test or (bool(train) and Path(view.name).stem not in train) for view, _ in posed]
    if any(held_out) or source.has_split:
        split = {view: "test" if is_test else "train" for view, is_test in zip(names, held_out, strict=True)}
    else:
        split = split_views(names, settings.test_every)
    return views, points, split, report


def _view_entries(
    posed: Sequence[tuple[KnownView, PosedView]], source: Source, missing: list[str]
) -> dict[str, dict[str, Any]]:
    """Return the report on each view and each image without a view; `missing` views have no image."""
    entries: dict[str, dict[str, Any]] = {}
    for described, view in posed:
        name = Path(described.name).name if is_outside(described.name) else described.name
        entries[view.view] = {"file": name, "registered": True, **described.report}
    reasons = source.left_out | dict.fromkeys(missing, "its image file is missing")
    reasons |= dict.fromkeys(source.unposed, "the source has no pose for it")
    for file, reason in reasons.items():
        entries.setdefault(file, {"file": file, "registered": False, "why_not": reason})
    return entries


def _with_pixels(view: KnownView, view_name: str, folder: Path, max_side_px: int) -> tuple[PosedView, bool]:
    """Read an image in the orientation of its camera, write the work image, and adapt the camera to it.

    Also return whether the image is used as stored, against its EXIF orientation.
    """
    folder.mkdir(parents=True, exist_ok=True)
    camera, cropped, as_stored = fitted_camera(view, max_side_px)
    pixels = _pixels_of(view, camera, as_stored=as_stored)
    if not as_stored:  # otherwise, programs that label photographs turn them
        view.report["photo_hw_px"] = list(pixels.shape[:2] if cropped is None else cropped.size_hw)
    pixels = resize_to_fit(pixels, max_side_px)
    camera.rescale(pixels.shape[1], pixels.shape[0])
    write_png(folder / view_name, pixels)
    return PosedView(view_name, folder / view_name, camera, view.cam_from_source, cropped), as_stored


def _pixels_of(view: KnownView, camera: pycolmap.Camera, *, as_stored: bool) -> UInt8[np.ndarray, "H W 3"]:
    """Read the pixels of a camera from `fitted_camera`: the image without its border."""
    assert view.image is not None  # the caller leaves out views without one
    pixels = read_image(view.image, as_stored=as_stored)
    border_px = (pixels.shape[1] - camera.width) // 2
    inside = pixels[border_px:, border_px:][: camera.height, : camera.width]
    return np.ascontiguousarray(inside)


def misfit_notes(views: Sequence[KnownView], points: Points, what: str) -> list[str]:
    """Return a note if points don't match the images, so that the coordinates or axes of either are wrong.

    The colours of points are compared with the pixels at their projections, and these with the colours of
    other points. If all points have one colour, they only need to be inside the images.
    """
    xyz, rgb = (column[:: 1 + len(column) // CHECKED_POINTS] for column in points)
    usable = [view for view in views if view.image is not None]
    rows = np.linspace(0, len(usable) - 1, min(CHECKED_VIEWS, len(usable))).astype(int)
    if len(xyz) < MIN_INSIDE or not usable:
        return []
    pairs = [_colours_in(usable[row], xyz, rgb.astype(np.float32)) for row in rows]
    pixels, colours = map(np.concatenate, zip(*pairs, strict=True))
    others = np.roll(colours, len(colours) // 2, axis=0)
    problem = f"only {len(pixels)} of {len(xyz)} are inside {len(rows)} images"
    if len(pixels) >= MIN_INSIDE:
        misfit, other = (np.median(np.abs(pixels - expected).mean(axis=1)) for expected in (colours, others))
        if misfit < MAX_MISFIT * other or not np.ptp(rgb, axis=0).any():
            return []
        problem = "their colours are not those of their pixels"
    question = f"Are poses and {what} in the same coordinates, and the colours those of the photographs?"
    return [f"the {what} don't match the images: {problem}. {question}"]


def _colours_in(
    view: KnownView, xyz: Float64[np.ndarray, "P 3"], rgb: Float32[np.ndarray, "P 3"]
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    """Return the pixels at the points that are inside an image, and the points' colours."""
    try:
        camera, _, as_stored = fitted_camera(view)
        image = _pixels_of(view, camera, as_stored=as_stored).astype(np.float32)
    except ImageError:  # its import reports it
        return rgb[:0], rgb[:0]
    seen = xyz @ view.cam_from_source[:3, :3].T + view.cam_from_source[:3, 3]
    is_ahead = seen[:, 2] > 0
    xy = np.floor(camera.img_from_cam(seen[is_ahead]))
    is_inside = (xy >= 0).all(axis=1) & (xy < (camera.width, camera.height)).all(axis=1)
    columns, rows = xy[is_inside].astype(np.int64).T
    return image[rows, columns], rgb[is_ahead][is_inside]


def fitted_camera(view: KnownView, max_side_px: int = 2**16) -> tuple[pycolmap.Camera, Photo | None, bool]:
    """Return the camera of a view's image without its border, from the header of the image.

    The image is used as stored if both of its orientations have the camera's shape. Also return the
    photograph if it has a border, and whether the EXIF orientation is ignored.

    Raises:
        ImageError: the image is unreadable or too small, or doesn't have the camera's shape.
    """
    assert view.image is not None
    with opened_image(view.image) as image:
        is_turned = orientation(image) > 1
    for as_stored in (True, False) if is_turned else (False,):
        height, width = image_size_hw(view.image, upright=not as_stored)
        ratio = (width / height) / (view.camera.width / view.camera.height)
        if abs(ratio - 1) <= ASPECT_TOLERANCE:
            break
    else:
        raise ImageError(
            f"image {view.image} does not match the size of its camera",
            expected=f"{view.camera.width} x {view.camera.height} px (width x height), or a scaled copy",
            found=f"{width} x {height} px",
            fix="use the images that the poses were computed from",
        )
    camera = pycolmap.Camera(view.camera.todict())
    camera.rescale(width, height)
    photo, border_px = photo_of(camera), math.ceil(view.border_px * width / view.camera.width)
    camera.width -= 2 * border_px
    camera.height -= 2 * border_px
    camera.principal_point_x -= border_px
    camera.principal_point_y -= border_px
    require_usable_size(view.image, (camera.height, camera.width), max_side_px)
    return camera, photo if border_px else None, as_stored


def triangulate(
    views: Sequence[PosedView], work: Path, settings: PosesSettings, seed: int, threads: int
) -> Points:
    """Match features of pinhole views, and triangulate sparse points from their known poses."""
    if len(views) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8)
    folder, database = views[0].image.parent, work / "triangulation.db"
    lenses = [([view.view], view.camera.model_name, view.camera.params.tolist()) for view in views]
    in_own_process(find_matches, database, folder, lenses, {}, settings, seed, threads)
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        for view in views:
            entry = opened.read_image_with_name(view.view)
            assert entry is not None  # imported above
            model.add_camera_with_trivial_rig(opened.read_camera(entry.camera_id))
            image = pycolmap.Image(name=view.view, camera_id=entry.camera_id, image_id=entry.image_id)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_source[:3]))
    target = work / "triangulated"
    target.mkdir()
    model = pycolmap.triangulate_points(model, database, folder, target, options=incremental_options(seed))
    return sparse_points(model)
