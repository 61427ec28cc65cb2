"""Posed views of a folder in any supported format."""

from contextlib import suppress

import numpy as np

from hilsplat.base.errors import ImageError, SceneError
from hilsplat.base.files import list_images
from hilsplat.base.images import image_size_hw
from hilsplat.scene.importers.known_views import KnownView, Source, check_centres, read_colmap, read_llff
from hilsplat.scene.importers.phones import read_polycam, read_record3d
from hilsplat.scene.importers.transforms import read_transforms
from hilsplat.scene.layouts import SCALED, KnownPoses

READERS = {
    "colmap": read_colmap,
    "transforms": read_transforms,
    "polycam": read_polycam,
    "record3d": read_record3d,
    "llff": read_llff,
}

NEARLY = 0.1
"""Relative difference from the camera's size up to which an image is no scaled copy made on purpose."""


def read_source(known: KnownPoses) -> Source:
    """Read the posed views of a folder in any supported format, with points if available.

    Views that cannot be used are left out, with the reason. Views are matched to images by name; a view that
    several files list is used once, as the first describes it. Points that are not finite are dropped.

    Raises:
        SceneError: a file cannot be used, all views are held out, or at least three all have one pose.
    """
    source = READERS[known.kind](known)
    poses = np.array([view.cam_from_source for view in source.views])
    if len(poses) > 2 and (poses == poses[0]).all():
        problem = f"all {len(poses)} views of {known.files[0]} have the same pose"
        raise SceneError(problem, fix="export it again")
    used = {view.image for view in source.views}
    _keep_one_view_per_image(source)
    if source.views and all(view.is_test for view in source.views):
        problem = f"{known.files[0]} holds out all {len(source.views)} views for tests"
        raise SceneError(problem, fix="list fewer views for tests, because others are needed for training")
    if known.kind == "colmap" and (beside := known.root / "images").is_dir():
        others = [path.name for path in list_images(beside) if path not in used]
        source.unposed = [name for name in others if name not in source.left_out]
    source.notes += check_centres({view.name: view.lens for view in source.views if view.image is not None})
    source.notes += _size_notes(source)
    for folder in sorted({view.image.parent for view in source.views if view.image is not None}):
        inside = f"/{folder.relative_to(known.root).as_posix()}/"
        if SCALED.search(inside) and not any(folder.name in view.name for view in source.views):
            source.notes.append(f"the images in {folder}, which are smaller copies, are used")
    source.notes += [f"{other} also has poses, which are not used" for other in known.others]
    if source.points is not None:
        xyz, rgb = source.points
        is_finite = np.isfinite(xyz).all(axis=1)
        if num_lost := int((~is_finite).sum()):
            source.notes.append(f"{num_lost} of {len(xyz)} points are not finite and are left out")
        # Without points, they are triangulated.
        source.points = (xyz[is_finite], rgb[is_finite]) if is_finite.any() else None
    return source


def _size_notes(source: Source) -> list[str]:
    """Return a note if images may not be those of the poses: nearly of the camera's size, or stretched.

    Undistortion changes the size by a few percent, and may leave the shape within `ASPECT_TOLERANCE`.
    """
    noted = []
    for view in source.views:
        if view.image is None:
            continue
        with suppress(ImageError):  # its import gives the reason
            image = np.sort(image_size_hw(view.image))  # EXIF may turn it
            camera = np.sort(view.lens[1])
            factors = image / camera
            is_stretched = abs(factors[0] / factors[1] - 1) > (1 / np.minimum(image, camera)).sum()
            if (factors != 1).any() and (is_stretched or (np.abs(factors - 1) < NEARLY).all()):
                noted.append(f"{view.name} ({factors[0]:.3f} and {factors[1]:.3f} times)")
    if not noted:
        return []
    why = "other sizes than their cameras: are they the images that the poses were computed from?"
    return [f"{len(noted)} images, such as {noted[0]}, have {why}"]


def _keep_one_view_per_image(source: Source) -> None:
    """Drop repetitions of a view, and leave out different views of the same image."""
    views: dict[object, list[KnownView]] = {}
    for view in source.views:
        views.setdefault(view.image or id(view), []).append(view)
    num_repeated = len(source.views) - len(views)
    source.views = []
    for first, *others in views.values():
        poses = [other.cam_from_source for other in others if other.camera == first.camera]
        if len(poses) == len(others) and all(np.array_equal(pose, first.cam_from_source) for pose in poses):
            source.views.append(first)
            continue
        num_repeated -= len(others)
        for view in (first, *others):
            source.leave_out(view.name, f"view {view.name}: other views have the same image {view.image}")
    if num_repeated:
        source.notes.append(f"{num_repeated} of the views listed are repetitions, which are dropped")
