"""Projection of Gaussians into a view, and its gradient: one pass each over the Gaussians.

Conventions are gsplat's: a pinhole camera whose top-left pixel has its centre at (0.5, 0.5); the
3D covariance is pushed through the perspective Jacobian at the centre (EWA), with the ray clamped
to 30 % beyond the image border; 0.3 px^2 are added to the diagonal; colour is
max(0, 0.5 + spherical harmonics) in the direction from the camera to the mean.

The projected Gaussian is stored for the blending loops, whose exponent is base 2:
log2 alpha = peak - (a dx^2 + b dx dy + c dy^2), where (dx, dy) = mean - pixel centre.
"""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Float

from hilsplat.base.compiled import compiled
from hilsplat.base.rotations import matrix_entries
from hilsplat.scene.cameras import Camera

NEAR = 0.01
"""Gaussians with a smaller depth are not drawn, scene units (gsplat: 0.01)."""
LOW_PASS_PX2 = 0.3
"""Added to the projected variance, px^2 (3DGS, gsplat: 0.3)."""
MIN_ALPHA = 1.0 / 255.0
"""A smaller alpha is not drawn (3DGS, gsplat: 1 / 255)."""
MAX_LOG_SCALE = np.float32(20.0)
"""Scales are cut at exp(20), 5e8 scene units, and get no gradient beyond. A Gaussian that wide covers any
view evenly along that axis; at exp(40) the columns of its pixel box would overflow 64-bit integers. float32
as the scales: with a float64 they would all be computed in float64, and change in their last bits."""
LOG2_E = 1.4426950408889634

GEOMETRY = 8
"""Columns of a projected Gaussian: mean x, mean y, a, b, c, log2 of the peak alpha, depth, spare."""
MOMENTS = 6
"""Leading columns of gradient slots and sums: v, v dx, v dy, v dx^2, v dx dy, v dy^2; v = alpha dL/dalpha."""

_C0 = 0.28209479177387814
_C1 = 0.4886025119029199
_C20, _C22, _C24 = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
_C30, _C31, _C32, _C33, _C35 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)


def pack_camera(camera: Camera) -> Float[np.ndarray, " 25"]:
    """A camera as one row.

    In order: rotation (9), translation (3), fx, fy, cx, cy, centre (3), ray limits (4), height, width.

    Ray limits are the range of x/z and y/z inside which the Jacobian is taken: the image widened
    by 0.3 of its half field of view on each side (gsplat).
    """
    height, width = camera.size_hw
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    margin_x, margin_y = 0.3 * 0.5 * width / fx, 0.3 * 0.5 * height / fy
    limits = (
        -cx / fx - margin_x,
        (width - cx) / fx + margin_x,
        -cy / fy - margin_y,
        (height - cy) / fy + margin_y,
    )
    row = (*camera.cam_from_world[:3, :3].ravel(), *camera.cam_from_world[:3, 3], fx, fy, cx, cy)
    return np.array((*row, *camera.centre, *limits, height, width), dtype=np.float64)


@compiled(inline="always")
@no_type_check
def _sh_basis(x, y, z, degree, basis):
    """Real spherical harmonics up to `degree` (at most 3) of a unit direction, 3DGS order and signs."""
    basis[0] = _C0
    if degree >= 1:
        basis[1] = -_C1 * y
        basis[2] = _C1 * z
        basis[3] = -_C1 * x
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis[4] = _C20 * x * y
        basis[5] = -_C20 * y * z
        basis[6] = _C22 * (2.0 * zz - xx - yy)
        basis[7] = -_C20 * x * z
        basis[8] = _C24 * (xx - yy)
        if degree >= 3:
            basis[9] = -_C30 * y * (3.0 * xx - yy)
            basis[10] = _C31 * x * y * z
            basis[11] = -_C32 * y * (4.0 * zz - xx - yy)
            basis[12] = _C33 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
            basis[13] = -_C32 * x * (4.0 * zz - xx - yy)
            basis[14] = _C35 * z * (xx - yy)
            basis[15] = -_C30 * x * (xx - 3.0 * yy)


@compiled(inline="always")
@no_type_check
def _sh_slope(x, y, z, degree, slope):
    """Derivatives of `_sh_basis` with respect to x, y, z as if independent: slope[k] = (d/dx, d/dy, d/dz)."""
    slope[:, :] = 0.0
    if degree >= 1:
        slope[1, 1] = -_C1
        slope[2, 2] = _C1
        slope[3, 0] = -_C1
    if degree >= 2:
        slope[4, 0], slope[4, 1] = _C20 * y, _C20 * x
        slope[5, 1], slope[5, 2] = -_C20 * z, -_C20 * y
        slope[6, 0], slope[6, 1], slope[6, 2] = -2.0 * _C22 * x, -2.0 * _C22 * y, 4.0 * _C22 * z
        slope[7, 0], slope[7, 2] = -_C20 * z, -_C20 * x
        slope[8, 0], slope[8, 1] = 2.0 * _C24 * x, -2.0 * _C24 * y
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        slope[9, 0], slope[9, 1] = -6.0 * _C30 * x * y, -_C30 * (3.0 * xx - 3.0 * yy)
        slope[10, 0], slope[10, 1], slope[10, 2] = _C31 * y * z, _C31 * x * z, _C31 * x * y
        slope[11, 0], slope[11, 1] = 2.0 * _C32 * x * y, -_C32 * (4.0 * zz - xx - 3.0 * yy)
        slope[11, 2] = -8.0 * _C32 * y * z
        slope[12, 0], slope[12, 1] = -6.0 * _C33 * x * z, -6.0 * _C33 * y * z
        slope[12, 2] = _C33 * (6.0 * zz - 3.0 * xx - 3.0 * yy)
        slope[13, 0], slope[13, 1] = -_C32 * (4.0 * zz - 3.0 * xx - yy), 2.0 * _C32 * x * y
        slope[13, 2] = -8.0 * _C32 * x * z
        slope[14, 0], slope[14, 1], slope[14, 2] = 2.0 * _C35 * x * z, -2.0 * _C35 * y * z, _C35 * (xx - yy)
        slope[15, 0], slope[15, 1] = -_C30 * (3.0 * xx - 3.0 * yy), 6.0 * _C30 * x * y


@compiled(inline="always")
@no_type_check
def _cam_from_gaussian(camera, quats, scales, i, axes, factor):
    """Rotation of Gaussian i into the camera (axes) and the same with columns scaled (factor)."""
    w, x, y, z = float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3])
    norm = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * norm, x * norm, y * norm, z * norm
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = matrix_entries(w, x, y, z)
    for row in range(3):
        a, b, c = camera[3 * row], camera[3 * row + 1], camera[3 * row + 2]
        axes[row, 0] = a * r00 + b * r10 + c * r20
        axes[row, 1] = a * r01 + b * r11 + c * r21
        axes[row, 2] = a * r02 + b * r12 + c * r22
        for k in range(3):
            factor[row, k] = axes[row, k] * scales[k]
    return w, x, y, z, norm


@compiled
@no_type_check
def project(begin, end, means, log_scales, quats, opacity_logits, sh, degree, camera, geometry, box, colours):
    """Project Gaussians begin..end into a view.

    Fills, per Gaussian: geometry (see GEOMETRY), box = first and last pixel column, first and last
    pixel row where alpha can reach MIN_ALPHA (last < first: not drawn), colours.

    Returns:
        number of Gaussians with a number that is not finite or a zero quaternion.
    """
    height, width = int(camera[23]), int(camera[24])
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    axes, factor = np.empty((3, 3)), np.empty((3, 3))
    scales, basis = np.empty(3), np.empty(16)
    bases = (degree + 1) * (degree + 1)
    broken = 0
    for i in range(begin, end):
        box[i, 0], box[i, 1], box[i, 2], box[i, 3] = 0, -1, 0, -1
        total = float(opacity_logits[i])
        for k in range(3):
            total += float(means[i, k]) + float(log_scales[i, k])
        length = 0.0
        for k in range(4):
            length += float(quats[i, k]) * float(quats[i, k])
        for k in range(sh.shape[1]):
            total += float(sh[i, k, 0]) + float(sh[i, k, 1]) + float(sh[i, k, 2])
        if not (abs(total) < np.inf and 0.0 < length < np.inf):
            broken += 1
            continue
        mx, my, mz = float(means[i, 0]), float(means[i, 1]), float(means[i, 2])
        x = camera[0] * mx + camera[1] * my + camera[2] * mz + camera[9]
        y = camera[3] * mx + camera[4] * my + camera[5] * mz + camera[10]
        z = camera[6] * mx + camera[7] * my + camera[8] * mz + camera[11]
        if z <= NEAR:
            continue
        opacity = 1.0 / (1.0 + math.exp(-float(opacity_logits[i])))
        if opacity < MIN_ALPHA:
            continue
        for k in range(3):
            scales[k] = math.exp(min(float(log_scales[i, k]), MAX_LOG_SCALE))
        _cam_from_gaussian(camera, quats, scales, i, axes, factor)
        inverse_z = 1.0 / z
        ray_x = min(max(x * inverse_z, camera[19]), camera[20])
        ray_y = min(max(y * inverse_z, camera[21]), camera[22])
        jx, jy = fx * inverse_z, fy * inverse_z
        xx, xy, yy = LOW_PASS_PX2, 0.0, LOW_PASS_PX2
        for k in range(3):
            u = jx * (factor[0, k] - ray_x * factor[2, k])
            v = jy * (factor[1, k] - ray_y * factor[2, k])
            xx += u * u
            xy += u * v
            yy += v * v
        determinant = xx * yy - xy * xy
        if not 0.0 < determinant < np.inf:
            continue
        inverse = 1.0 / determinant
        px, py = fx * x * inverse_z + cx, fy * y * inverse_z + cy
        # The level set alpha = MIN_ALPHA has half-widths sqrt(q cov); slightly more for rounding.
        q = 2.0 * math.log(opacity / MIN_ALPHA)
        half_x, half_y = math.sqrt(q * xx) + 1e-2, math.sqrt(q * yy) + 1e-2
        if not (px + half_x > 0.0 and px - half_x < width and py + half_y > 0.0 and py - half_y < height):
            continue
        first_x, last_x = max(math.ceil(px - half_x - 0.5), 0), min(math.floor(px + half_x - 0.5), width - 1)
        first_y, last_y = max(math.ceil(py - half_y - 0.5), 0), min(math.floor(py + half_y - 0.5), height - 1)
        if last_x < first_x or last_y < first_y:
            continue
        box[i, 0], box[i, 1], box[i, 2], box[i, 3] = first_x, last_x, first_y, last_y
        geometry[i, 0], geometry[i, 1] = px, py
        geometry[i, 2] = 0.5 * LOG2_E * yy * inverse
        geometry[i, 3] = -LOG2_E * xy * inverse
        geometry[i, 4] = 0.5 * LOG2_E * xx * inverse
        geometry[i, 5] = math.log2(opacity)
        geometry[i, 6] = z
        dx, dy, dz = mx - camera[16], my - camera[17], mz - camera[18]
        distance = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
        _sh_basis(dx * distance, dy * distance, dz * distance, degree, basis)
        red, green, blue = 0.5, 0.5, 0.5
        for k in range(bases):
            red += basis[k] * sh[i, k, 0]
            green += basis[k] * sh[i, k, 1]
            blue += basis[k] * sh[i, k, 2]
        colours[i, 0], colours[i, 1], colours[i, 2] = max(red, 0.0), max(green, 0.0), max(blue, 0.0)
    return broken


@compiled
@no_type_check
def project_backward(
    begin,
    end,
    means,
    log_scales,
    quats,
    sh,
    degree,
    camera,
    geometry,
    box,
    colours,
    sums,
    grad_means,
    grad_log_scales,
    grad_quats,
    grad_opacity_logits,
    grad_sh,
    grad_means_px,
):
    """Gradients of Gaussians begin..end from their moments and dL/dcolours (rows of `sums`).

    The outputs are overwritten; Gaussians that are not drawn get zeros. `grad_means_px` is dL/d(projected
    mean), per pixel.
    """
    fx, fy = camera[12], camera[13]
    axes, factor, grad_factor = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    scales, basis, slope = np.empty(3), np.empty(16), np.empty((16, 3))
    rotation_grad, jacobian = np.empty((3, 3)), np.empty((2, 3))
    bases = (degree + 1) * (degree + 1)
    for i in range(begin, end):
        if box[i, 1] < box[i, 0]:
            for k in range(3):
                grad_means[i, k] = grad_log_scales[i, k] = 0.0
            for k in range(4):
                grad_quats[i, k] = 0.0
            grad_opacity_logits[i] = grad_means_px[i, 0] = grad_means_px[i, 1] = 0.0
            for k in range(grad_sh.shape[1]):
                grad_sh[i, k, 0] = grad_sh[i, k, 1] = grad_sh[i, k, 2] = 0.0
            continue

        # log alpha = ln opacity - (A dx^2 + 2 B dx dy + C dy^2) / 2, conic (A, B, C) = inverse covariance
        conic_a = 2.0 / LOG2_E * geometry[i, 2]
        conic_b = geometry[i, 3] / LOG2_E
        conic_c = 2.0 / LOG2_E * geometry[i, 4]
        opacity = 2.0 ** float(geometry[i, 5])
        grad_opacity_logits[i] = sums[i, 0] * (1.0 - opacity)
        gpx = -(conic_a * sums[i, 1] + conic_b * sums[i, 2])
        gpy = -(conic_b * sums[i, 1] + conic_c * sums[i, 2])
        grad_means_px[i, 0], grad_means_px[i, 1] = gpx, gpy
        # dL/d conic as a symmetric matrix (p, q; q, r); dL/d cov = -conic (p, q; q, r) conic
        p, q, r = -0.5 * sums[i, 3], -0.5 * sums[i, 4], -0.5 * sums[i, 5]
        m00, m01 = conic_a * p + conic_b * q, conic_a * q + conic_b * r
        m10, m11 = conic_b * p + conic_c * q, conic_b * q + conic_c * r
        cov_xx = -(m00 * conic_a + m01 * conic_b)
        cov_xy = -(m00 * conic_b + m01 * conic_c)
        cov_yy = -(m10 * conic_b + m11 * conic_c)

        mx, my, mz = float(means[i, 0]), float(means[i, 1]), float(means[i, 2])
        x = camera[0] * mx + camera[1] * my + camera[2] * mz + camera[9]
        y = camera[3] * mx + camera[4] * my + camera[5] * mz + camera[10]
        z = camera[6] * mx + camera[7] * my + camera[8] * mz + camera[11]
        for k in range(3):
            scales[k] = math.exp(min(float(log_scales[i, k]), MAX_LOG_SCALE))
        qw, qx, qy, qz, norm = _cam_from_gaussian(camera, quats, scales, i, axes, factor)
        inverse_z = 1.0 / z
        ray_x, ray_y = x * inverse_z, y * inverse_z
        inside_x = camera[19] <= ray_x <= camera[20]
        inside_y = camera[21] <= ray_y <= camera[22]
        ray_x = min(max(ray_x, camera[19]), camera[20])
        ray_y = min(max(ray_y, camera[21]), camera[22])
        jx, jy = fx * inverse_z, fy * inverse_z
        jacobian[0, 0], jacobian[0, 1], jacobian[0, 2] = jx, 0.0, -jx * ray_x
        jacobian[1, 0], jacobian[1, 1], jacobian[1, 2] = 0.0, jy, -jy * ray_y
        # cov = U U' + low pass, U = J factor (2 x 3): dU = 2 dcov U, dJ = dU factor', dfactor = J' dU
        j00, j02, j11, j12 = 0.0, 0.0, 0.0, 0.0
        for k in range(3):
            u = jx * (factor[0, k] - ray_x * factor[2, k])
            v = jy * (factor[1, k] - ray_y * factor[2, k])
            du = 2.0 * (cov_xx * u + cov_xy * v)
            dv = 2.0 * (cov_xy * u + cov_yy * v)
            j00 += du * factor[0, k]
            j02 += du * factor[2, k]
            j11 += dv * factor[1, k]
            j12 += dv * factor[2, k]
            along = 0.0
            for row in range(3):
                grad_factor[row, k] = jacobian[0, row] * du + jacobian[1, row] * dv
                along += grad_factor[row, k] * factor[row, k]
            grad_log_scales[i, k] = along if log_scales[i, k] <= MAX_LOG_SCALE else 0.0
        gx, gy = gpx * jx, gpy * jy
        gz = -(gpx * jx * x + gpy * jy * y) * inverse_z
        # J = (fx/z, 0, -fx/z ray_x; 0, fy/z, -fy/z ray_y); the ray is constant where it is clamped
        gz += -(j00 - j02 * ray_x) * jx * inverse_z - (j11 - j12 * ray_y) * jy * inverse_z
        if inside_x:
            gx += -j02 * jx * inverse_z
            gz += j02 * jx * ray_x * inverse_z
        if inside_y:
            gy += -j12 * jy * inverse_z
            gz += j12 * jy * ray_y * inverse_z
        wx = camera[0] * gx + camera[3] * gy + camera[6] * gz
        wy = camera[1] * gx + camera[4] * gy + camera[7] * gz
        wz = camera[2] * gx + camera[5] * gy + camera[8] * gz

        # rotation: factor = cam_R rot diag(scales)
        for row in range(3):
            for k in range(3):
                rotation_grad[row, k] = scales[k] * (
                    camera[row] * grad_factor[0, k]
                    + camera[3 + row] * grad_factor[1, k]
                    + camera[6 + row] * grad_factor[2, k]
                )
        d = rotation_grad
        dw = 2.0 * (qx * (d[2, 1] - d[1, 2]) + qy * (d[0, 2] - d[2, 0]) + qz * (d[1, 0] - d[0, 1]))
        dx = 2.0 * (
            -2.0 * qx * (d[1, 1] + d[2, 2])
            + qy * (d[0, 1] + d[1, 0])
            + qz * (d[0, 2] + d[2, 0])
            + qw * (d[2, 1] - d[1, 2])
        )
        dy = 2.0 * (
            qx * (d[0, 1] + d[1, 0])
            - 2.0 * qy * (d[0, 0] + d[2, 2])
            + qz * (d[1, 2] + d[2, 1])
            + qw * (d[0, 2] - d[2, 0])
        )
        dz = 2.0 * (
            qx * (d[0, 2] + d[2, 0])
            + qy * (d[1, 2] + d[2, 1])
            - 2.0 * qz * (d[0, 0] + d[1, 1])
            + qw * (d[1, 0] - d[0, 1])
        )
        along = qw * dw + qx * dx + qy * dy + qz * dz
        grad_quats[i, 0] = (dw - along * qw) * norm
        grad_quats[i, 1] = (dx - along * qx) * norm
        grad_quats[i, 2] = (dy - along * qy) * norm
        grad_quats[i, 3] = (dz - along * qz) * norm

        # colour; a channel that is clamped at 0 passes no gradient
        vx, vy, vz = mx - camera[16], my - camera[17], mz - camera[18]
        inverse = 1.0 / math.sqrt(vx * vx + vy * vy + vz * vz)
        vx, vy, vz = vx * inverse, vy * inverse, vz * inverse
        _sh_basis(vx, vy, vz, degree, basis)
        red = sums[i, MOMENTS] if colours[i, 0] > 0.0 else 0.0
        green = sums[i, MOMENTS + 1] if colours[i, 1] > 0.0 else 0.0
        blue = sums[i, MOMENTS + 2] if colours[i, 2] > 0.0 else 0.0
        for k in range(bases):
            grad_sh[i, k, 0] = basis[k] * red
            grad_sh[i, k, 1] = basis[k] * green
            grad_sh[i, k, 2] = basis[k] * blue
        for k in range(bases, grad_sh.shape[1]):
            grad_sh[i, k, 0] = grad_sh[i, k, 1] = grad_sh[i, k, 2] = 0.0
        if degree > 0:
            _sh_slope(vx, vy, vz, degree, slope)
            hx, hy, hz = 0.0, 0.0, 0.0
            for k in range(1, bases):
                weight = red * sh[i, k, 0] + green * sh[i, k, 1] + blue * sh[i, k, 2]
                hx += weight * slope[k, 0]
                hy += weight * slope[k, 1]
                hz += weight * slope[k, 2]
            along = hx * vx + hy * vy + hz * vz
            wx += (hx - along * vx) * inverse
            wy += (hy - along * vy) * inverse
            wz += (hz - along * vz) * inverse
        grad_means[i, 0], grad_means[i, 1], grad_means[i, 2] = wx, wy, wz
