"""Occam's LGS: a Gaussian's code averages, over views, the mask vectors at its projected centre.

A view's weight is the Gaussian's visibility at that pixel, and hidden Gaussians are ignored
(insait-institute/OccamLGS, arXiv 2412.01807). `lifted` averages over all pixels that show a Gaussian: a
large Gaussian across a border gets one mask per view here, but a share of both masks in `lifted`.

Departs from the published code:
    - the scene's linear code replaces the 512 numbers and is averaged in the same way;
    - the weight of a Gaussian at its centre's pixel is divided by the pixel's alpha, and weights below
      `contributions.min_weight` count as invisible; the published kernel returns a different weight.
"""

import numpy as np
from jaxtyping import Float, Float32, Int64

from hilsplat.base.levels import LEVELS
from hilsplat.base.progress import track
from hilsplat.baselines import MethodSettings
from hilsplat.methods.method import MethodInputs
from hilsplat.scene.cameras import Camera


def centre_pixels(means: Float[np.ndarray, "N 3"], camera: Camera) -> Int64[np.ndarray, " N"]:
    """Return each centre's row-major pixel index; -1 if behind the camera or outside the image."""
    height, width = camera.size_hw
    in_camera = means @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    in_front = in_camera[:, 2] > 0
    projected = in_camera @ camera.K.T
    x, y = (np.floor(projected[:, axis] / np.where(in_front, projected[:, 2], 1)) for axis in (0, 1))
    inside = in_front & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    return np.where(inside, y * width + x, -1).astype(np.int64)


def fit(inputs: MethodInputs, settings: MethodSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Lift all levels; Gaussians whose centre is not inside a mask in any view get zeros."""
    contributions, latents, sums = inputs.contributions, inputs.latents, inputs.no_features()
    means = contributions.means().astype(np.float64)
    total = np.zeros(sums.shape[:2], np.float32)
    rows_of_views = contributions.rows_of_views()
    for view, rows in zip(track(list(contributions.views), "views"), rows_of_views, strict=True):
        pixel = centre_pixels(means, inputs.view_camera(view))
        gaussians = np.flatnonzero(pixel >= 0)
        if not len(gaussians):
            continue
        weights = np.asarray(inputs.view_weights(view)[pixel[gaussians], gaussians], np.float32).ravel()
        labels, codes = inputs.view_labels(view)[pixel], latents[rows]
        for level in LEVELS:
            label = labels[gaussians, level.index]
            painted = (label >= 0) & (weights > 0)
            weight = weights[painted]
            sums[gaussians[painted], level.index] += weight[:, None] * codes[label[painted]]
            total[gaussians[painted], level.index] += weight
    return np.where(total[..., None] > 0, sums / np.maximum(total, 1e-12)[..., None], np.float32(0))
