"""Sparse points of views with known poses: triangulated, or random if triangulation fails."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from hilsplat.base.processes import in_own_process
from hilsplat.scene.assemble import PosedView
from hilsplat.scene.colmap import pycolmap
from hilsplat.scene.features import (
    features_and_matches,
    incremental_options,
)
from hilsplat.scene.model import sparse_points
from hilsplat.settings import PosesSettings

MIN_TRIANGULATED = 100
"""Number of triangulated points below which random points in front of the cameras are used instead."""

NUM_RANDOM_POINTS = 20_000


def triangulate(
    views: Sequence[PosedView], work: Path, settings: PosesSettings, seed: int, threads: int
) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
    """Triangulate sparse points of pinhole views at their known poses, after feature matching."""
    if len(views) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8)
    folder, database = views[0].image.parent, work / "triangulation.db"
    pycolmap.Database.open(database).close()
    for view in views:
        options = pycolmap.ImageReaderOptions()
        options.camera_model = view.camera.model_name
        options.camera_params = ", ".join(repr(float(value)) for value in view.camera.params)
        pycolmap.import_images(database, folder, pycolmap.CameraMode.PER_IMAGE, [view.view], options)
    names = [view.view for view in views]
    in_own_process(features_and_matches, database, folder, names, settings, seed, threads)
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


def random_points(
    views: Sequence[PosedView], seed: int
) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
    """Sample random grey points in front of the cameras, to start a fit if triangulation gives too few.

    Each is on the ray of a random pixel of a random view, at a depth between 0.3 and 2 times the distance
    from the camera to the point nearest to all optical axes.
    """
    generator = np.random.default_rng(seed)
    centres = np.stack([view.centre for view in views])
    looks = np.stack([view.cam_from_source[2, :3] for view in views])
    # Least squares for the point nearest to all axes, with a weak prior at one camera spread ahead.
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()) or 1.0
    across = np.eye(3)[None] - looks[:, :, None] * looks[:, None, :]
    prior = 1e-3
    ahead = (centres + spread * looks).mean(axis=0)
    focus = np.linalg.solve(
        across.mean(axis=0) + prior * np.eye(3),
        np.einsum("vij,vj->i", across, centres) / len(views) + prior * ahead,
    )
    rows = generator.integers(len(views), size=NUM_RANDOM_POINTS)
    depth = np.maximum(np.linalg.norm(centres - focus, axis=1), 1e-3 * spread)[rows]
    depth = depth * generator.uniform(0.3, 2.0, NUM_RANDOM_POINTS)
    xyz = np.empty((NUM_RANDOM_POINTS, 3))
    for row, view in enumerate(views):
        chosen = rows == row
        pixels = generator.random((int(chosen.sum()), 2)) * [view.camera.width, view.camera.height]
        K = view.camera.calibration_matrix()
        rays = np.concatenate([(pixels - K[:2, 2]) / np.diag(K)[:2], np.ones((len(pixels), 1))], axis=1)
        xyz[chosen] = centres[row] + (rays * depth[chosen, None]) @ view.cam_from_source[:3, :3]
    return xyz, np.full(xyz.shape, 128, dtype=np.uint8)
