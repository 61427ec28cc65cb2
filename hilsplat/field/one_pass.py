"""Updates and sums over a whole field in one pass, without temporaries of its size.

These passes are memory-bound: three levels of sixteen numbers for a million Gaussians are 192 MB, and a
NumPy expression reads and writes that much for each operator. Sums are taken in float64 in a fixed order.
"""

from typing import no_type_check

import numpy as np

from hilsplat.base.compiled import compiled


@compiled
@no_type_check  # the shape checks of the test-suite cannot be compiled
def channel_dots(a, b):
    """Sum the products of two fields (N, 3, D) over Gaussians, per level and channel."""
    out = np.zeros(a.shape[1:])
    for n in range(len(a)):
        for level in range(a.shape[1]):
            for c in range(a.shape[2]):
                out[level, c] += np.float64(a[n, level, c]) * np.float64(b[n, level, c])
    return out


@compiled
@no_type_check
def scaled_squares(scale, a):
    """Return `channel_dots` of a field and scale (N, 3) times the field."""
    out = np.zeros(a.shape[1:])
    for n in range(len(a)):
        for level in range(a.shape[1]):
            for c in range(a.shape[2]):
                value = a[n, level, c]
                out[level, c] += np.float64(value) * np.float64(scale[n, level] * value)
    return out


@compiled
@no_type_check
def add_scaled(factor, scale, a, out):
    """Add factor times scale (N, 3) times a field to `out`."""
    for n in range(len(a)):
        for level in range(a.shape[1]):
            weight = factor * scale[n, level]
            for c in range(a.shape[2]):
                out[n, level, c] += weight * a[n, level, c]


@compiled
@no_type_check
def add_by_channel(factors, a, out):
    """Add a field times the factor (3, D) of each level and channel to `out`."""
    for n in range(len(a)):
        for level in range(a.shape[1]):
            for c in range(a.shape[2]):
                out[n, level, c] += factors[level, c] * a[n, level, c]


@compiled
@no_type_check
def redirect(scale, residual, ratio, direction):
    """Compute the next conjugate direction: scale (N, 3) times residual plus ratio (3, D) times the last."""
    for n in range(len(residual)):
        for level in range(residual.shape[1]):
            for c in range(residual.shape[2]):
                step = scale[n, level] * residual[n, level, c]
                direction[n, level, c] = step + ratio[level, c] * direction[n, level, c]


@compiled
@no_type_check
def add_slope(factor, curved, right, scale, out):
    """Add the slope factor (curved - right) of a quadratic form to `out`, and multiply by scale (N, 3)."""
    for n in range(len(out)):
        for level in range(out.shape[1]):
            for c in range(out.shape[2]):
                slope = factor * (curved[n, level, c] - right[n, level, c])
                out[n, level, c] = (out[n, level, c] + slope) * scale[n, level]


@compiled
@no_type_check
def pull(mass, features, start):
    """Return the sum of mass (N, 3) times the squared distance between two fields."""
    total = 0.0
    for n in range(len(features)):
        for level in range(features.shape[1]):
            square = 0.0
            for c in range(features.shape[2]):
                apart = np.float64(features[n, level, c]) - np.float64(start[n, level, c])
                square += apart * apart
            total += mass[n, level] * square
    return total
