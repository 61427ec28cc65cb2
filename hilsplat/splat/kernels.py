"""Compiled loops of the fit."""

import numpy as np

from cpusplat.compiled import compiled
from cpusplat.project import matrix_entries

NOISE_SHARPNESS = 100.0
"""Rate at which noise decreases with opacity (paper: k = 100): the noise factor at opacity 0.1 is e^-9.5."""

MIN_GATE = 1e-6  # Gaussians whose noise factor is smaller than this get no noise


@compiled(error_model="numpy")
def noise_rows(begin, end, means, log_scales, quats, logits, normal, dead_below, weight, extent):
    """Add weight x gate x covariance x normal, in units of the extent, to the means of rows begin..end.

    The gate is 1/2 at the opacity threshold of dead Gaussians, and 0 for opaque ones (paper, Eq. 8).
    """
    turn, local = np.empty((3, 3)), np.empty(3)
    for row in range(begin, end):
        opacity = 1.0 / (1.0 + np.exp(-np.float64(logits[row])))
        gate = 1.0 / (1.0 + np.exp(NOISE_SHARPNESS * (opacity - dead_below)))
        if gate < MIN_GATE:
            continue
        w, x = np.float64(quats[row, 0]), np.float64(quats[row, 1])
        y, z = np.float64(quats[row, 2]), np.float64(quats[row, 3])
        norm = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
        entries = matrix_entries(w * norm, x * norm, y * norm, z * norm)
        for axis in range(3):
            for k in range(3):
                turn[axis, k] = entries[3 * axis + k]
        for axis in range(3):
            along = 0.0
            for k in range(3):
                along += turn[k, axis] * normal[row, k]
            local[axis] = along * np.exp(2.0 * np.float64(log_scales[row, axis])) / (extent * extent)
        square = local[0] ** 2 + local[1] ** 2 + local[2] ** 2  # rotation preserves the length
        # without this limit, a Gaussian far wider than the scene would jump out of it
        factor = extent * weight * gate / max(weight * gate * np.sqrt(square), 1.0)
        for axis in range(3):
            step = turn[axis, 0] * local[0] + turn[axis, 1] * local[1] + turn[axis, 2] * local[2]
            means[row, axis] += factor * step
