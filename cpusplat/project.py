"""Projection of Gaussians into a view, and its gradient, each in one pass over the Gaussians.

Conventions are gsplat's (docs/rasteriser.md): the 3D covariance is mapped by the perspective Jacobian at the
centre (EWA), with the ray clamped to 30 % beyond the image border; 0.3 px^2 are added to the diagonal; colour
is max(0, 0.5 + spherical harmonics) in the direction from the camera to the mean.

Projected Gaussians are stored for the blending loops, which use exponents of base 2:
log2 alpha = peak - (a dx^2 + b dx dy + c dy^2), where (dx, dy) = mean - pixel centre.
"""

import math

import numpy as np

from cpusplat.compiled import compiled
from cpusplat.lanes import (
    WIDTH,
    aligned,
    exp2_negative,
    keep_ge,
    keep_gt,
    lanes,
    larger,
    load,
    narrow,
    prefetch,
    root,
    smaller,
    store,
    transpose,
    wide,
)

NEAR, FAR = 0.01, 1e10  # default range of depths (scene units) that are drawn (gsplat: 0.01 and 1e10)
LOW_PASS_PX2 = 0.3  # default variance added to the projected covariance, px^2 (3DGS, gsplat: 0.3)
MIN_ALPHA = 1.0 / 255.0  # smaller alphas are not drawn (3DGS, gsplat: 1 / 255)
MAX_LOG_SCALE = np.float32(20.0)
"""Scales are clipped at exp(20), 5e8 scene units; clipped scales get no gradient. A Gaussian that wide covers
any view evenly along that axis; `_exp` is limited to exp(22).
The limit is float32, because a float64 limit would make the scales float64 and change their last bits."""
_LEAST_LOG = np.float32(-60.0)
LOG2_E, LN_2 = 1.4426950408889634, 0.6931471805599453
LOG2_MIN_ALPHA = math.log2(MIN_ALPHA)
_LOG2_1P = tuple(
    np.polynomial.Chebyshev.interpolate(lambda e: np.log1p(e) / (e * LN_2), 9, domain=[0, 1])
    .convert(kind=np.polynomial.Polynomial)
    .coef.astype(np.float32)
)
"""Polynomial for log2(1 + e) / e on [0, 1], constant first."""

GEOMETRY = 16
"""Columns of a projected Gaussian, one cache line: mean x, mean y, a, b, c, log2 of the peak alpha, depth,
whether it is drawn, colour (3), spare (5)."""
MOMENTS = 6
"""Leading columns of gradient slots and sums: v, v dx, v dy, v dx^2, v dx dy, v dy^2; v = alpha dL/dalpha."""

LANES = WIDTH
SH_COLUMN = 16
ROW = 96
"""Columns of 16 Gaussians that are projected together: mean, log scales, quaternion, logit; harmonics from
16; geometry from 64; sums from 80."""

_C0 = 0.28209479177387814
_C1 = 0.4886025119029199
_C20, _C22, _C24 = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
_C30, _C31, _C32 = 0.5900435899266435, 2.890611442640554, 0.4570457994644658
_C33, _C35 = 0.3731763325901154, 1.445305721320277


def pack_camera(
    viewmat: np.ndarray,
    K: np.ndarray,
    size_hw: tuple[int, int],
    near: float = NEAR,
    far: float = FAR,
    low_pass_px2: float = LOW_PASS_PX2,
) -> np.ndarray:
    """Return a camera as one row of float64.

    In order: rotation (9), translation (3), fx, fy, cx, cy, centre (3), ray limits (4), height, width, near,
    far, low-pass variance.

    Ray limits are the range of x/z and y/z to which the Jacobian's ray is clamped: the image widened
    by 0.3 of its half field of view on each side (gsplat).
    """
    height, width = size_hw
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.3 * 0.5 * width / fx, 0.3 * 0.5 * height / fy
    limits_x = -cx / fx - margin_x, (width - cx) / fx + margin_x
    limits_y = -cy / fy - margin_y, (height - cy) / fy + margin_y
    row = (*rotation.ravel(), *translation, fx, fy, cx, cy, *(-rotation.T @ translation))
    return np.array((*row, *limits_x, *limits_y, height, width, near, far, low_pass_px2), dtype=np.float64)


@compiled(inline="always")
def matrix_entries(w, x, y, z):
    """Return the nine entries of a unit quaternion's rotation matrix, row by row."""
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@compiled(inline="always")
def _sh_basis(x, y, z, degree, basis):
    """Store real spherical harmonics of unit directions up to `degree` (at most 3), as in 3DGS."""
    one = lanes(np.float32(1))
    store(basis, 0, _C0 * one)
    if degree >= 1:
        store(basis, 1 * LANES, -_C1 * y)
        store(basis, 2 * LANES, _C1 * z)
        store(basis, 3 * LANES, -_C1 * x)
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        store(basis, 4 * LANES, _C20 * x * y)
        store(basis, 5 * LANES, -_C20 * y * z)
        store(basis, 6 * LANES, _C22 * (2.0 * zz - xx - yy))
        store(basis, 7 * LANES, -_C20 * x * z)
        store(basis, 8 * LANES, _C24 * (xx - yy))
        if degree >= 3:
            store(basis, 9 * LANES, -_C30 * y * (3.0 * xx - yy))
            store(basis, 10 * LANES, _C31 * x * y * z)
            store(basis, 11 * LANES, -_C32 * y * (4.0 * zz - xx - yy))
            store(basis, 12 * LANES, _C33 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy))
            store(basis, 13 * LANES, -_C32 * x * (4.0 * zz - xx - yy))
            store(basis, 14 * LANES, _C35 * z * (xx - yy))
            store(basis, 15 * LANES, -_C30 * x * (xx - 3.0 * yy))


@compiled(inline="always")
def _sh_pull(x, y, z, degree, w):
    """Return the gradient of the sum of w[k] times `_sh_basis` with respect to independent x, y and z."""
    w1, w2, w3 = load(w, 1 * LANES), load(w, 2 * LANES), load(w, 3 * LANES)
    gx, gy, gz = -_C1 * w3, -_C1 * w1, _C1 * w2
    if degree >= 2:
        w4, w5, w6 = load(w, 4 * LANES), load(w, 5 * LANES), load(w, 6 * LANES)
        w7, w8 = load(w, 7 * LANES), load(w, 8 * LANES)
        gx = gx + _C20 * (y * w4 - z * w7) - 2.0 * _C22 * x * w6 + 2.0 * _C24 * x * w8
        gy = gy + _C20 * (x * w4 - z * w5) - 2.0 * _C22 * y * w6 - 2.0 * _C24 * y * w8
        gz = gz - _C20 * (y * w5 + x * w7) + 4.0 * _C22 * z * w6
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        w9, w10, w11 = load(w, 9 * LANES), load(w, 10 * LANES), load(w, 11 * LANES)
        w12, w13, w14 = load(w, 12 * LANES), load(w, 13 * LANES), load(w, 14 * LANES)
        w15 = load(w, 15 * LANES)
        across, along = 3.0 * _C30 * (xx - yy), 6.0 * _C30 * x * y
        gx = gx - along * w9 - across * w15 + _C31 * y * z * w10 + 2.0 * _C35 * x * z * w14
        gx = gx + _C32 * (2.0 * x * y * w11 - (4.0 * zz - 3.0 * xx - yy) * w13) - 6.0 * _C33 * x * z * w12
        gy = gy - across * w9 + along * w15 + _C31 * x * z * w10 - 2.0 * _C35 * y * z * w14
        gy = gy + _C32 * (2.0 * x * y * w13 - (4.0 * zz - xx - 3.0 * yy) * w11) - 6.0 * _C33 * y * z * w12
        gz = gz + _C31 * x * y * w10 + _C35 * (xx - yy) * w14 - 8.0 * _C32 * z * (y * w11 + x * w13)
        gz = gz + _C33 * (6.0 * zz - 3.0 * xx - 3.0 * yy) * w12
    return gx, gy, gz


@compiled(inline="always")
def _fetch(table, width, first):
    """Start loading 16 rows of a table into the cache, to be read or written there."""
    for k in range(width):
        prefetch(table, first * width + k * LANES)


@compiled(inline="always")
def _read(table, width, first, count, rows, columns):
    """Transpose harmonics of Gaussians first..first + count to columns of 16 lanes from SH_COLUMN.

    Lanes beyond `count` and columns beyond `width` contain arbitrary numbers.
    """
    blocks = (width + LANES - 1) // LANES
    if (first + LANES - 1) * width + blocks * LANES <= len(table):
        for block in range(blocks):
            at = first * width + block * LANES
            transpose(table, at, width, columns, (SH_COLUMN + block * LANES) * LANES, LANES)
    else:  # a vector load would read past the end of the table
        for k in range(count * width):
            rows[k] = table[first * width + k]
        for block in range(blocks):
            transpose(rows, block * LANES, width, columns, (SH_COLUMN + block * LANES) * LANES, LANES)


@compiled(inline="always")
def _read_narrow(means, log_scales, quats, first, count, rows, columns):
    """Transpose means, log scales and quaternions together to the first ten columns (see `_read`)."""
    for lane in range(count):
        at, i = lane * LANES, first + lane
        for k in range(3):
            rows[at + k] = means[3 * i + k]
            rows[at + 3 + k] = log_scales[3 * i + k]
        for k in range(4):
            rows[at + 6 + k] = quats[4 * i + k]
    transpose(rows, 0, LANES, columns, 0, LANES)


@compiled(inline="always")
def _write_narrow(columns, rows, grads, first, count):
    """Transpose the first 13 columns back to rows of the narrow gradients (see `project_backward`)."""
    transpose(columns, 0, LANES, rows, 0, LANES)
    for lane in range(count):
        at, i = lane * LANES, first + lane
        for k in range(3):
            grads[0][3 * i + k] = rows[at + k]
            grads[1][3 * i + k] = rows[at + 3 + k]
        for k in range(4):
            grads[2][4 * i + k] = rows[at + 6 + k]
        grads[4][i] = rows[at + 10]
        grads[5][2 * i], grads[5][2 * i + 1] = rows[at + 11], rows[at + 12]


@compiled(inline="always")
def _write(columns, width, rows, table, first, count, last):
    """Transpose columns of harmonics back to rows of a table, for rows below `last` (see `_read`).

    The last block of a row overlaps the next row, whose first block is written after it.
    """
    blocks = (width + LANES - 1) // LANES
    if (first + LANES - 1) * width + blocks * LANES <= last * width:
        for block in range(blocks - 1, -1, -1):
            at = first * width + block * LANES
            transpose(columns, (SH_COLUMN + block * LANES) * LANES, LANES, table, at, width)
    else:
        for block in range(blocks - 1, -1, -1):
            transpose(columns, (SH_COLUMN + block * LANES) * LANES, LANES, rows, block * LANES, width)
        for k in range(count * width):
            table[first * width + k] = rows[k]


@compiled(inline="always")
def _exp(value):
    """Return exp of lanes clipped to [-60, MAX_LOG_SCALE]; exp(-60) is negligible next to the low pass."""
    exponent = wide(smaller(larger(value, lanes(_LEAST_LOG)), lanes(MAX_LOG_SCALE))) * LOG2_E - 32.0
    near = narrow(exponent)
    return wide(exp2_negative(near)) * (1.0 + (exponent - wide(near)) * LN_2) * 2.0**32


@compiled(inline="always")
def _log2_sigmoid(logit):
    """Return log2 of 1 / (1 + exp(-logit)) of float32 lanes, with an absolute error below 1e-6."""
    zero = lanes(np.float32(0))
    e = narrow(_exp(smaller(logit, zero - logit)))
    series = lanes(_LOG2_1P[-1])
    for k in range(len(_LOG2_1P) - 2, -1, -1):
        series = series * e + lanes(_LOG2_1P[k])
    return smaller(logit, zero) * LOG2_E - series * e


@compiled(inline="always")
def _wide_column(columns, k):
    return wide(load(columns, k * LANES))


@compiled(inline="always")
def _place(columns, camera):
    """Return means in camera space, and unit quaternions and directions, each with its inverse length."""
    mx, my, mz = _wide_column(columns, 0), _wide_column(columns, 1), _wide_column(columns, 2)
    x = camera[0] * mx + camera[1] * my + camera[2] * mz + camera[9]
    y = camera[3] * mx + camera[4] * my + camera[5] * mz + camera[10]
    z = camera[6] * mx + camera[7] * my + camera[8] * mz + camera[11]
    w, i = _wide_column(columns, 6), _wide_column(columns, 7)
    j, k = _wide_column(columns, 8), _wide_column(columns, 9)
    norm = 1.0 / root(w * w + i * i + j * j + k * k)
    dx, dy, dz = mx - camera[16], my - camera[17], mz - camera[18]
    distance = 1.0 / root(dx * dx + dy * dy + dz * dz)
    direction = dx * distance, dy * distance, dz * distance
    return (x, y, z), (w * norm, i * norm, j * norm, k * norm), norm, direction, distance


@compiled(inline="always")
def _axis(camera, scale, i, j, k):
    """Return an axis (i, j, k) of Gaussians in camera space, times the scale along that axis."""
    return (
        (camera[0] * i + camera[1] * j + camera[2] * k) * scale,
        (camera[3] * i + camera[4] * j + camera[5] * k) * scale,
        (camera[6] * i + camera[7] * j + camera[8] * k) * scale,
    )


@compiled(inline="always")
def _clamped(value, low, high):
    return smaller(larger(value, value * 0.0 + low), value * 0.0 + high)


@compiled
def project(begin, end, means, log_scales, quats, opacity_logits, sh, degree, camera, geometry, box, colours):
    """Project groups begin..end of 16 Gaussians into a view.

    Writes for each Gaussian: geometry (see GEOMETRY); box, the first and last pixel column and the first and
    last pixel row where alpha can reach MIN_ALPHA (last < first: not drawn); colours.

    Returns:
        number of Gaussians with a non-finite number or a zero quaternion.
    """
    height, width = int(camera[23]), int(camera[24])
    near, far, low_pass = camera[25], camera[26], camera[27]
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    rows, columns, basis = aligned(LANES * ROW), aligned(LANES * ROW), aligned(16 * LANES)
    rows[:] = 0.0
    projected, zero = np.empty(7 * LANES), lanes(np.float32(0))
    tables = means.reshape(-1), log_scales.reshape(-1), quats.reshape(-1), sh.reshape(-1)
    flat_geometry = geometry.reshape(-1)
    numbers, broken = 3 * sh.shape[1], 0
    for group in range(begin, end):
        first = group * LANES
        count = min(LANES, len(means) - first)
        _read_narrow(tables[0], tables[1], tables[2], first, count, rows, columns)
        for lane in range(count):
            columns[10 * LANES + lane] = opacity_logits[first + lane]
        _read(tables[3], numbers, first, count, rows, columns)
        finite = zero  # becomes NaN if a parameter is not finite
        for k in range(SH_COLUMN + numbers):
            if k < 11 or k >= SH_COLUMN:
                finite = finite + load(columns, k * LANES) * zero
        (x, y, z), (qw, qx, qy, qz), norm, towards, _ = _place(columns, camera)
        store(projected, 0, z)
        # also NaN if the quaternion has zero length
        store(projected, LANES, norm * 0.0 + wide(finite))
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = matrix_entries(qw, qx, qy, qz)
        inverse_z = 1.0 / z
        ray_x = _clamped(x * inverse_z, camera[19], camera[20])
        ray_y = _clamped(y * inverse_z, camera[21], camera[22])
        jx, jy = fx * inverse_z, fy * inverse_z
        one = _axis(camera, _exp(load(columns, 3 * LANES)), r00, r10, r20)
        two = _axis(camera, _exp(load(columns, 4 * LANES)), r01, r11, r21)
        three = _axis(camera, _exp(load(columns, 5 * LANES)), r02, r12, r22)
        u1, u2, u3 = one[0] - ray_x * one[2], two[0] - ray_x * two[2], three[0] - ray_x * three[2]
        v1, v2, v3 = one[1] - ray_y * one[2], two[1] - ray_y * two[2], three[1] - ray_y * three[2]
        xx = jx * jx * (u1 * u1 + u2 * u2 + u3 * u3) + low_pass
        xy = jx * jy * (u1 * v1 + u2 * v2 + u3 * v3)
        yy = jy * jy * (v1 * v1 + v2 * v2 + v3 * v3) + low_pass
        determinant = xx * yy - xy * xy
        inverse = 1.0 / determinant
        px, py = jx * x + cx, jy * y + cy
        top = _log2_sigmoid(load(columns, 10 * LANES))
        # the level set alpha = MIN_ALPHA has half-widths sqrt(q cov), slightly enlarged against rounding
        q = 2.0 * LN_2 * (wide(top) - LOG2_MIN_ALPHA)
        store(projected, 2 * LANES, determinant)
        store(projected, 3 * LANES, px)
        store(projected, 4 * LANES, py)
        store(projected, 5 * LANES, root(q * xx) + 1e-2)
        store(projected, 6 * LANES, root(q * yy) + 1e-2)
        store(columns, 0, narrow(px))
        store(columns, 1 * LANES, narrow(py))
        store(columns, 2 * LANES, narrow(0.5 * LOG2_E * yy * inverse))
        store(columns, 3 * LANES, narrow(-LOG2_E * xy * inverse))
        store(columns, 4 * LANES, narrow(0.5 * LOG2_E * xx * inverse))
        store(columns, 5 * LANES, top)
        store(columns, 6 * LANES, narrow(z))
        _sh_basis(narrow(towards[0]), narrow(towards[1]), narrow(towards[2]), degree, basis)
        red, green, blue = zero + 0.5, zero + 0.5, zero + 0.5
        for k in range((degree + 1) * (degree + 1)):
            coefficient, at = load(basis, k * LANES), (SH_COLUMN + 3 * k) * LANES
            red = red + coefficient * load(columns, at)
            green = green + coefficient * load(columns, at + LANES)
            blue = blue + coefficient * load(columns, at + 2 * LANES)
        store(columns, 8 * LANES, larger(red, zero))
        store(columns, 9 * LANES, larger(green, zero))
        store(columns, 10 * LANES, larger(blue, zero))
        store(columns, 7 * LANES, zero)
        transpose(columns, 0, LANES, flat_geometry, first * GEOMETRY, GEOMETRY)
        for lane in range(count):
            i = first + lane
            box[i, 0], box[i, 1], box[i, 2], box[i, 3] = 0, -1, 0, -1
            if projected[LANES + lane] != 0.0:  # includes NaN
                broken += 1
                continue
            if not (near < projected[lane] < far and 0.0 < projected[2 * LANES + lane] < np.inf):
                continue
            x, y = projected[3 * LANES + lane], projected[4 * LANES + lane]
            half_x, half_y = projected[5 * LANES + lane], projected[6 * LANES + lane]
            # also false if the peak is below MIN_ALPHA, where the half-widths are NaN
            if not (x + half_x > 0.0 and x - half_x < width and y + half_y > 0.0 and y - half_y < height):
                continue
            # clipped first, because huge numbers would overflow as integers
            first_x = math.ceil(max(x - half_x - 0.5, 0.0))
            last_x = math.floor(min(x + half_x - 0.5, width - 1.0))
            first_y = math.ceil(max(y - half_y - 0.5, 0.0))
            last_y = math.floor(min(y + half_y - 0.5, height - 1.0))
            if last_x < first_x or last_y < first_y:
                continue
            box[i, 0], box[i, 1], box[i, 2], box[i, 3] = first_x, last_x, first_y, last_y
            geometry[i, 7] = 1.0
            for k in range(3):
                colours[i, k] = geometry[i, 8 + k]
    return broken


@compiled(inline="always")
def _where_equal(left, right, value):
    return keep_ge(left, right, keep_ge(right, left, value))


@compiled(inline="always")
def _axis_backward(camera, scale, i, j, k, shared):
    """Backpropagate through a column of cov = U U' + low pass, U = J factor, factor = cam_R rot scales.

    dU = 2 dcov U, dJ = dU factor', dfactor = J' dU.

    Returns:
        dL/d(log scale), dL/d(three entries of rot), and dL/dJ (entries 00, 02, 11, 12).
    """
    jx, jy, ray_x, ray_y, cov_xx, cov_xy, cov_yy = shared
    f0, f1, f2 = _axis(camera, scale, i, j, k)
    u, v = jx * (f0 - ray_x * f2), jy * (f1 - ray_y * f2)
    du, dv = 2.0 * (cov_xx * u + cov_xy * v), 2.0 * (cov_xy * u + cov_yy * v)
    g0, g1 = jx * du, jy * dv
    g2 = 0.0 - (ray_x * g0 + ray_y * g1)
    rotation = (
        (camera[0] * g0 + camera[3] * g1 + camera[6] * g2) * scale,
        (camera[1] * g0 + camera[4] * g1 + camera[7] * g2) * scale,
        (camera[2] * g0 + camera[5] * g1 + camera[8] * g2) * scale,
    )
    return g0 * f0 + g1 * f1 + g2 * f2, rotation, (du * f0, du * f2, dv * f1, dv * f2)


@compiled
def project_backward(begin, end, num_bases, tables, degree, camera, geometry, sums, grads):
    """Compute gradients of groups begin..end of 16 Gaussians from rows of `sums`: moments and dL/dcolours.

    Args:
        num_bases: number of harmonics per Gaussian and channel.
        tables: flat means, log scales, quaternions and harmonics.
        grads: flat outputs: gradients of the tables in the same order, of the opacity logits, and of the
            projected means (px). They are overwritten, with zeros for Gaussians that are not drawn.
    """
    fx, fy = camera[12], camera[13]
    rows, columns = aligned(LANES * ROW), aligned(LANES * ROW)
    basis, pulls = aligned(16 * LANES), aligned(16 * LANES)
    rows[:] = 0.0
    zero, numbers, bases = lanes(np.float32(0)), 3 * num_bases, (degree + 1) * (degree + 1)
    flat_geometry, flat_sums, num_gaussians = geometry.reshape(-1), sums.reshape(-1), len(tables[0]) // 3
    last = min(end * LANES, num_gaussians)
    for group in range(begin, end):
        first = group * LANES
        count = min(LANES, num_gaussians - first)
        _read_narrow(tables[0], tables[1], tables[2], first, count, rows, columns)
        _fetch(tables[3], numbers, first + LANES)
        _fetch(grads[3], numbers, first + LANES)
        _fetch(flat_geometry, GEOMETRY, first + LANES)
        _fetch(flat_sums, sums.shape[1], first + LANES)
        _read(tables[3], numbers, first, count, rows, columns)
        transpose(flat_geometry, first * GEOMETRY, GEOMETRY, columns, 64 * LANES, LANES)
        transpose(flat_sums, first * sums.shape[1], sums.shape[1], columns, 80 * LANES, LANES)
        drawn = load(columns, 71 * LANES)
        (x, y, z), (qw, qx, qy, qz), norm, (vx, vy, vz), inverse = _place(columns, camera)

        # log alpha = ln opacity - (A dx^2 + 2 B dx dy + C dy^2) / 2, conic (A, B, C) = inverse covariance
        conic_a = 2.0 / LOG2_E * _wide_column(columns, 66)
        conic_b = 1.0 / LOG2_E * _wide_column(columns, 67)
        conic_c = 2.0 / LOG2_E * _wide_column(columns, 68)
        s, sx, sy = load(columns, 80 * LANES), _wide_column(columns, 81), _wide_column(columns, 82)
        opacity = exp2_negative(load(columns, 69 * LANES))
        gpx, gpy = 0.0 - (conic_a * sx + conic_b * sy), 0.0 - (conic_b * sx + conic_c * sy)
        # dL/d conic as a symmetric matrix (p, q; q, r); dL/d cov = -conic (p, q; q, r) conic
        p, q = -0.5 * _wide_column(columns, 83), -0.5 * _wide_column(columns, 84)
        r = -0.5 * _wide_column(columns, 85)
        m00, m01 = conic_a * p + conic_b * q, conic_a * q + conic_b * r
        m10, m11 = conic_b * p + conic_c * q, conic_b * q + conic_c * r
        cov_xx = 0.0 - (m00 * conic_a + m01 * conic_b)
        cov_xy = 0.0 - (m00 * conic_b + m01 * conic_c)
        cov_yy = 0.0 - (m10 * conic_b + m11 * conic_c)

        r00, r01, r02, r10, r11, r12, r20, r21, r22 = matrix_entries(qw, qx, qy, qz)
        inverse_z = 1.0 / z
        free_x, free_y = x * inverse_z, y * inverse_z
        ray_x = _clamped(free_x, camera[19], camera[20])
        ray_y = _clamped(free_y, camera[21], camera[22])
        jx, jy = fx * inverse_z, fy * inverse_z
        shared = (jx, jy, ray_x, ray_y, cov_xx, cov_xy, cov_yy)
        size_1, size_2 = load(columns, 3 * LANES), load(columns, 4 * LANES)
        size_3 = load(columns, 5 * LANES)
        along_1, (d00, d10, d20), to_j1 = _axis_backward(camera, _exp(size_1), r00, r10, r20, shared)
        along_2, (d01, d11, d21), to_j2 = _axis_backward(camera, _exp(size_2), r01, r11, r21, shared)
        along_3, (d02, d12, d22), to_j3 = _axis_backward(camera, _exp(size_3), r02, r12, r22, shared)
        most = lanes(MAX_LOG_SCALE)
        store(columns, 3 * LANES, keep_ge(most, size_1, narrow(along_1)))
        store(columns, 4 * LANES, keep_ge(most, size_2, narrow(along_2)))
        store(columns, 5 * LANES, keep_ge(most, size_3, narrow(along_3)))
        j00, j02 = to_j1[0] + to_j2[0] + to_j3[0], to_j1[1] + to_j2[1] + to_j3[1]
        j11, j12 = to_j1[2] + to_j2[2] + to_j3[2], to_j1[3] + to_j2[3] + to_j3[3]
        gx, gy = gpx * jx, gpy * jy
        # J = (fx/z, 0, -fx/z ray_x; 0, fy/z, -fy/z ray_y); the ray is constant where it is clamped
        gz = (gx * x + gy * y + (j00 - j02 * ray_x) * jx + (j11 - j12 * ray_y) * jy) * inverse_z
        by_ray_x = _where_equal(free_x, ray_x, j02 * jx * inverse_z)
        by_ray_y = _where_equal(free_y, ray_y, j12 * jy * inverse_z)
        gx, gy = gx - by_ray_x, gy - by_ray_y
        gz = ray_x * by_ray_x + ray_y * by_ray_y - gz
        wx = camera[0] * gx + camera[3] * gy + camera[6] * gz
        wy = camera[1] * gx + camera[4] * gy + camera[7] * gz
        wz = camera[2] * gx + camera[5] * gy + camera[8] * gz

        dw = 2.0 * (qx * (d21 - d12) + qy * (d02 - d20) + qz * (d10 - d01))
        dx = 2.0 * (qy * (d01 + d10) + qz * (d02 + d20) + qw * (d21 - d12) - 2.0 * qx * (d11 + d22))
        dy = 2.0 * (qx * (d01 + d10) + qz * (d12 + d21) + qw * (d02 - d20) - 2.0 * qy * (d00 + d22))
        dz = 2.0 * (qx * (d02 + d20) + qy * (d12 + d21) + qw * (d10 - d01) - 2.0 * qz * (d00 + d11))
        along = qw * dw + qx * dx + qy * dy + qz * dz
        store(columns, 6 * LANES, narrow((dw - along * qw) * norm))
        store(columns, 7 * LANES, narrow((dx - along * qx) * norm))
        store(columns, 8 * LANES, narrow((dy - along * qy) * norm))
        store(columns, 9 * LANES, narrow((dz - along * qz) * norm))
        store(columns, 10 * LANES, s * (1.0 - opacity))
        store(columns, 11 * LANES, narrow(gpx))
        store(columns, 12 * LANES, narrow(gpy))

        # a colour channel that is clamped at 0 passes no gradient
        red = keep_gt(load(columns, 72 * LANES), zero, load(columns, 86 * LANES))
        green = keep_gt(load(columns, 73 * LANES), zero, load(columns, 87 * LANES))
        blue = keep_gt(load(columns, 74 * LANES), zero, load(columns, 88 * LANES))
        ux, uy, uz = narrow(vx), narrow(vy), narrow(vz)
        _sh_basis(ux, uy, uz, degree, basis)
        for k in range(bases):
            coefficient, at = load(basis, k * LANES), (SH_COLUMN + 3 * k) * LANES
            pull = red * load(columns, at) + green * load(columns, at + LANES)
            store(pulls, k * LANES, pull + blue * load(columns, at + 2 * LANES))
            store(columns, at, coefficient * red)
            store(columns, at + LANES, coefficient * green)
            store(columns, at + 2 * LANES, coefficient * blue)
        for k in range(SH_COLUMN + 3 * bases, SH_COLUMN + numbers):
            store(columns, k * LANES, zero)
        if degree > 0:
            hx, hy, hz = _sh_pull(ux, uy, uz, degree, pulls)
            along = hx * ux + hy * uy + hz * uz
            wx = wx + wide(hx - along * ux) * inverse
            wy = wy + wide(hy - along * uy) * inverse
            wz = wz + wide(hz - along * uz) * inverse
        store(columns, 0, narrow(wx))
        store(columns, 1 * LANES, narrow(wy))
        store(columns, 2 * LANES, narrow(wz))
        for k in range(SH_COLUMN + numbers):
            store(columns, k * LANES, keep_gt(drawn, zero, load(columns, k * LANES)))
        _write_narrow(columns, rows, grads, first, count)
        _write(columns, numbers, rows, grads[3], first, count, last)
