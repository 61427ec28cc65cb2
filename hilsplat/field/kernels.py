"""Compiled loops of the field: Adam, the shuffle of torch, one-pass sums and updates."""

from typing import no_type_check

import numpy as np

from cpusplat.compiled import compiled

BETA1, BETA2 = 0.9, 0.999  # decay rates of the moments, as in torch
MIN_MOMENT = np.float32(1e-36)  # smaller moments are set to 0


@compiled(error_model="numpy")
@no_type_check  # the shape checks of the test suite cannot be compiled
def adam_step(values, gradient, first, second, rate, scale, eps):
    """Take one step in place; `rate` is divided by 1 - beta1^t, and `scale` is 1 / sqrt(1 - beta2^t)."""
    for k in range(len(values)):
        g = gradient[k]
        m = np.float32(BETA1) * first[k] + np.float32(1 - BETA1) * g
        v = np.float32(BETA2) * second[k] + np.float32(1 - BETA2) * g * g
        # Processors are many times slower with subnormal numbers, which moments of unused units reach.
        first[k] = m if abs(m) > MIN_MOMENT else np.float32(0)
        second[k] = v if v > MIN_MOMENT else np.float32(0)
        values[k] -= rate * first[k] / (np.sqrt(second[k]) * scale + eps)


@compiled
def swap(order, drawn):
    """Swap each element with itself or a later element, chosen by random draws."""
    for at in range(len(drawn)):
        other = at + np.int64(drawn[at]) % (len(order) - at)
        order[at], order[other] = order[other], order[at]


# One-pass updates and sums over a whole field, without temporaries of that size. They are memory-bound: three
# levels of sixteen numbers for a million Gaussians take 192 MB, and NumPy reads and writes that much for each
# operator of an expression. Sums are computed in float64 in a fixed order.


@compiled
def channel_dots(a, b):
    """Sum the products of two fields (N, 3, D) over Gaussians, per level and channel."""
    out = np.zeros(a.shape[1:])
    for n in range(len(a)):
        for level in range(a.shape[1]):
            for c in range(a.shape[2]):
                out[level, c] += np.float64(a[n, level, c]) * np.float64(b[n, level, c])
    return out


@compiled
def scaled_squares(scale, a):
    """Return `channel_dots` of a field with itself times scale (N, 3)."""
    out = np.zeros(a.shape[1:])
    for n in range(len(a)):
        for level in range(a.shape[1]):
            for c in range(a.shape[2]):
                value = a[n, level, c]
                out[level, c] += np.float64(value) * np.float64(scale[n, level] * value)
    return out


@compiled
def add_scaled(factor, scale, a, out):
    """Add factor times scale (N, 3) times a field to `out`."""
    for n in range(len(a)):
        for level in range(a.shape[1]):
            weight = factor * scale[n, level]
            for c in range(a.shape[2]):
                out[n, level, c] += weight * a[n, level, c]


@compiled
def add_by_channel(factors, a, out):
    """Add a field times the factor (3, D) of each level and channel to `out`."""
    for n in range(len(a)):
        for level in range(a.shape[1]):
            for c in range(a.shape[2]):
                out[n, level, c] += factors[level, c] * a[n, level, c]


@compiled
def redirect(scale, residual, ratio, direction):
    """Update the conjugate direction: scale (N, 3) times residual plus ratio (3, D) times the last one."""
    for n in range(len(residual)):
        for level in range(residual.shape[1]):
            for c in range(residual.shape[2]):
                step = scale[n, level] * residual[n, level, c]
                direction[n, level, c] = step + ratio[level, c] * direction[n, level, c]


@compiled
def add_slope(factor, curved, right, scale, out):
    """Add a quadratic form's slope, factor * (curved - right), to `out`; multiply the sum by scale (N, 3)."""
    for n in range(len(out)):
        for level in range(out.shape[1]):
            for c in range(out.shape[2]):
                slope = factor * (curved[n, level, c] - right[n, level, c])
                out[n, level, c] = (out[n, level, c] + slope) * scale[n, level]


@compiled
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


@compiled
def flat_dot(a, b):
    s, t, u, v = 0.0, 0.0, 0.0, 0.0
    fours = len(a) // 4 * 4
    for i in range(0, fours, 4):
        s += np.float64(a[i]) * np.float64(b[i])
        t += np.float64(a[i + 1]) * np.float64(b[i + 1])
        u += np.float64(a[i + 2]) * np.float64(b[i + 2])
        v += np.float64(a[i + 3]) * np.float64(b[i + 3])
    for i in range(fours, len(a)):
        s += np.float64(a[i]) * np.float64(b[i])
    return (s + t) + (u + v)


@compiled
def add_multiple(factor, vector, out):
    """Add a multiple of a flat vector to `out`, in float32, without a temporary."""
    for i in range(len(out)):
        out[i] += factor * vector[i]
