"""Solid textures: colour as a compiled function of position.

All textures are computed from hashes of lattice cells, without image files or texture coordinates. A surface
point has the same colour in all views, as structure from motion and 3D Gaussians require.
"""

import math

import numpy as np

from cpusplat.compiled import compiled

# Hash increments of a lattice cell per step in x, y, z and salt.
_X, _Y = np.uint32(0x27D4EB2D), np.uint32(0x165667B1)
_Z, _SALT = np.uint32(0x1B873593), np.uint32(0x2545F491)


@compiled(forceinline=True)
def _mixed(h):
    """Map a key to a number in [0, 1) by a chain of 32-bit integer mixing steps."""
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D))
    h = np.uint32((h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39))
    return np.uint32(h ^ (h >> np.uint32(15))) / 4294967296.0


@compiled(forceinline=True)
def _key(i, j, k, salt):
    """Return the hash key of a lattice cell."""
    return np.uint32(np.uint32(i) * _X + np.uint32(j) * _Y + np.uint32(k) * _Z + np.uint32(salt) * _SALT)


@compiled
def hash01(x: int, y: int, z: int, salt: int) -> float:
    """Return a lattice cell's hash, in [0, 1)."""
    return _mixed(_key(x, y, z, salt))


@compiled(forceinline=True)  # a loop that calls a function is not vectorised
def value_noise(x: float, y: float, z: float, salt: int) -> float:
    """Return smoothly interpolated lattice noise in [0, 1)."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = x - i, y - j, z - k
    u, v, w = u * u * (3 - 2 * u), v * v * (3 - 2 * v), w * w * (3 - 2 * w)
    h = _key(np.int32(i), np.int32(j), np.int32(k), salt)
    a = _mixed(h) * (1 - u) + _mixed(np.uint32(h + _X)) * u
    b = _mixed(np.uint32(h + _Y)) * (1 - u) + _mixed(np.uint32(h + _X + _Y)) * u
    c = _mixed(np.uint32(h + _Z)) * (1 - u) + _mixed(np.uint32(h + _X + _Z)) * u
    d = _mixed(np.uint32(h + _Y + _Z)) * (1 - u) + _mixed(np.uint32(h + _X + _Y + _Z)) * u
    return (a * (1 - v) + b * v) * (1 - w) + (c * (1 - v) + d * v) * w


@compiled
def fractal_noise(x: float, y: float, z: float, octaves: int, salt: int) -> float:
    """Return a sum of `value_noise` octaves in [0, 1), each with half the previous size and amplitude."""
    total, amplitude, reach = 0.0, 0.5, 0.0
    for octave in range(octaves):
        total += amplitude * value_noise(x, y, z, salt + octave)
        reach += amplitude
        amplitude *= 0.5
        x, y, z = 2.03 * x, 2.03 * y, 2.03 * z
    return total / reach


@compiled
def cell_noise(x: float, y: float, z: float, salt: int) -> tuple[float, float, float]:
    """Find the two nearest of many random points, one per cell (Worley noise).

    Returns:
        Distances to these two points, in cells, and the nearest point's random number in [0, 1).
    """
    i0, j0, k0 = math.floor(x), math.floor(y), math.floor(z)
    nearest, second, identity = 9.0, 9.0, 0.0
    for i in range(i0 - 1, i0 + 2):
        for j in range(j0 - 1, j0 + 2):
            for k in range(k0 - 1, k0 + 2):
                dx = i + hash01(i, j, k, salt) - x
                dy = j + hash01(i, j, k, salt + 1) - y
                dz = k + hash01(i, j, k, salt + 2) - z
                distance = dx * dx + dy * dy + dz * dz
                if distance < nearest:
                    second, nearest = nearest, distance
                    identity = hash01(i, j, k, salt + 3)
                elif distance < second:
                    second = distance
    return math.sqrt(nearest), math.sqrt(second), identity


@compiled
def step_between(value: float, low: float, high: float) -> float:
    """Return 0 below `low`, 1 above `high`, and a smooth transition in between."""
    t = min(1.0, max(0.0, (value - low) / (high - low)))
    return t * t * (3 - 2 * t)


@compiled
def pattern(kind: int, x: float, y: float, z: float) -> tuple[float, float]:
    """Evaluate a texture at a point given in pattern cells.

    Args:
        kind: index into `paints.KINDS`.
        x: first coordinate, in pattern cells (y and z correspondingly).

    Returns:
        Share of the second colour in [0, 1], and a brightness factor.
    """
    if kind == 1:  # stripes, slightly wavy
        bend = 0.35 * value_noise(0.5 * x, 0.5 * y, 0.5 * z, 11)
        wave = math.sin(2 * math.pi * (0.75 * z + 0.2 * x + 0.2 * y + bend))
        return step_between(wave, 0.15, 0.45), 0.92 + 0.16 * value_noise(3 * x, 3 * y, 3 * z, 12)
    if kind == 2:  # checks
        cell = math.floor(0.62 * x) + math.floor(0.62 * y) + math.floor(0.62 * z)
        return float(cell & 1), 0.92 + 0.16 * value_noise(3 * x, 3 * y, 3 * z, 21)
    if kind == 3:  # spots
        nearest, _, identity = cell_noise(0.7 * x, 0.7 * y, 0.7 * z, 31)
        share = 1 - step_between(nearest, 0.22 + 0.14 * identity, 0.27 + 0.14 * identity)
        return share, 0.92 + 0.16 * value_noise(3 * x, 3 * y, 3 * z, 35)
    if kind == 4:  # wood: rings around a tilted axis, and fine fibres along the axis
        rx = x + 0.9 * value_noise(0.4 * x, 0.4 * y, 0.12 * z, 41)
        ry = y + 0.25 * z
        bend = value_noise(0.6 * x, 0.6 * y, 0.2 * z, 42)
        rings = math.sin(2.2 * math.sqrt(rx * rx + ry * ry) + 2.5 * bend)
        fibre = value_noise(6 * x, 6 * y, 0.7 * z, 43)
        return 0.55 * step_between(rings, -0.7, 0.9) + 0.4 * fibre, 0.9 + 0.2 * fibre
    if kind == 5:  # stone: clouds and thin veins
        clouds = fractal_noise(x, y, z, 4, 51)
        vein = abs(fractal_noise(0.7 * x, 0.7 * y, 0.7 * z, 3, 57) - 0.5)
        return step_between(clouds, 0.3, 0.7), 1.08 - 0.35 * (1 - step_between(vein, 0.0, 0.035))
    if kind == 6:  # collage of patches
        nearest, second, identity = cell_noise(0.55 * x, 0.55 * y, 0.55 * z, 61)
        seam = step_between(second - nearest, 0.02, 0.07)
        return identity, (0.7 + 0.3 * seam) * (0.8 + 0.45 * math.fabs(math.sin(37.0 * identity)))
    if kind == 7:  # weave
        warp, weft = math.sin(math.pi * (x + 0.4 * y)), math.sin(math.pi * (z - 0.4 * y))
        cloud = fractal_noise(0.3 * x, 0.3 * y, 0.3 * z, 3, 71)
        return step_between(warp * weft, -0.5, 0.5), 0.88 + 0.2 * cloud
    if kind == 8:  # brushed metal: streaks around z
        streak = value_noise(0.8 * x, 0.8 * y, 11 * z, 81)
        cloud = fractal_noise(0.9 * x, 0.9 * y, 0.9 * z, 3, 83)
        return 0.5 * streak + 0.35 * cloud, 0.85 + 0.3 * streak
    if kind == 9:  # brick: courses along z, joints along x + y, so that every upright face shows joints
        course = math.floor(0.9 * z)
        along = 0.36 * (x + y) + 0.5 * (course & 1)
        brick = math.floor(along)
        across = min(0.9 * z - course, course + 1 - 0.9 * z)
        joint = min(min(along - brick, brick + 1 - along) / 0.36, across / 0.9)
        tone = hash01(brick, course, 0, 91)
        return 1 - step_between(joint, 0.05, 0.1), 0.78 + 0.4 * tone
    if kind == 11:  # floor tiles: squares in x and y, which upright faces show as stripes
        column, row = math.floor(0.4 * x), math.floor(0.4 * y)
        joint = min(min(0.4 * x - column, column + 1 - 0.4 * x), min(0.4 * y - row, row + 1 - 0.4 * y))
        tone = hash01(column, row, 0, 111)
        cloud = fractal_noise(0.8 * x, 0.8 * y, 0.8 * z, 3, 113)
        return 1 - step_between(joint, 0.03, 0.06), 0.74 + 0.3 * tone + 0.24 * cloud
    if kind == 10:  # fur: short strokes
        stroke = fractal_noise(2.4 * x + 1.2 * z, 2.4 * y, 0.9 * z, 3, 101)
        cloud = fractal_noise(0.4 * x, 0.4 * y, 0.4 * z, 2, 105)
        return step_between(0.65 * stroke + 0.35 * cloud, 0.3, 0.7), 0.85 + 0.3 * stroke
    mottle = step_between(fractal_noise(x, y, z, 4, 1), 0.3, 0.72)
    return mottle, 0.95 + 0.1 * value_noise(4 * x, 4 * y, 4 * z, 7)


@compiled(error_model="numpy")  # loops that may raise an exception are not vectorised
def grains(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Compute `fractal_noise(16 x, 16 y, 16 z, 4, 201)` for many points, vectorised but bit-identical.

    Grain sizes range from 0.06 to 0.008 scene units; the finest grain is about one pixel of a 256 px view.
    """
    out = np.zeros(len(x))
    amplitude, reach, size = 0.5, 0.0, 16.0
    a, b, c = size * x, size * y, size * z
    for salt in range(201, 205):
        for n in range(len(out)):
            out[n] += amplitude * value_noise(a[n], b[n], c[n], salt)
        reach += amplitude
        amplitude *= 0.5
        a, b, c = 2.03 * a, 2.03 * b, 2.03 * c
    return out / reach


@compiled
def albedo(material: np.ndarray, x: float, y: float, z: float, grain: float) -> tuple[float, float, float]:
    """Return the linear-light colour of a surface point.

    Args:
        material: parameters from `Paint.row`.
        x: first object coordinate plus the material's offset, scene units (y and z correspondingly).
        grain: value of `grains` at the point.
    """
    scale = material[7]
    share, brightness = pattern(int(material[0]), scale * x, scale * y, scale * z)
    brightness *= 1.0 + 4.5 * material[10] * (grain - 0.5)
    red = (material[1] * (1 - share) + material[4] * share) * brightness
    green = (material[2] * (1 - share) + material[5] * share) * brightness
    blue = (material[3] * (1 - share) + material[6] * share) * brightness
    return min(red, 1.0), min(green, 1.0), min(blue, 1.0)
