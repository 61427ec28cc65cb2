"""Posed views of a folder in any supported format."""

from collections import Counter

import numpy as np

from hilsplat.base.errors import SceneError
from hilsplat.scene.importers.known_views import Source, read_colmap, read_llff
from hilsplat.scene.importers.phones import read_polycam, read_record3d
from hilsplat.scene.importers.transforms import read_transforms
from hilsplat.scene.layouts import KnownPoses

READERS = {
    "colmap": read_colmap,
    "transforms": read_transforms,
    "polycam": read_polycam,
    "record3d": read_record3d,
    "llff": read_llff,
}


def read_source(known: KnownPoses) -> Source:
    """Read the posed views of a folder in any supported format, with points if available.

    Views that cannot be used are left out, with the reason. Views are matched to images by name; points that
    are not finite are dropped.

    Raises:
        SceneError: a file cannot be used, or at least three views all have one pose.
    """
    source = READERS[known.kind](known)
    poses = np.array([view.cam_from_source for view in source.views])
    if len(poses) > 2 and np.allclose(poses, poses[0]):
        raise SceneError(
            f"all {len(poses)} views of {known.files[0]} have the same pose", fix="export it again"
        )
    num_views = Counter(view.image for view in source.views)
    for view in [view for view in source.views if view.image is not None and num_views[view.image] > 1]:
        source.views.remove(view)
        source.leave_out(view.name, f"view {view.name}: other views have the same image {view.image}")
    source.notes += [f"{other} also has poses, which are not used" for other in known.others]
    if source.points is not None:
        xyz, rgb = source.points
        is_finite = np.isfinite(xyz).all(axis=1)
        if num_lost := int((~is_finite).sum()):
            source.notes.append(f"{num_lost} of {len(xyz)} points are not finite and are left out")
        # Without points, they are triangulated.
        source.points = (xyz[is_finite], rgb[is_finite]) if is_finite.any() else None
    return source
