"""Photometric loss of a rendered view (L1 and D-SSIM) and its gradient, in one pass; PSNR and SSIM.

SSIM is computed as in 3DGS: an 11x11 Gaussian window of sigma 1.5 px, applied as two 11-tap passes to each
channel, with zeros beyond the border and the constants 0.01^2 and 0.03^2 for values in [0, 1].
"""

import numpy as np

from cpusplat.compiled import compiled
from cpusplat.lanes import lanes, load, reciprocal, store
from cpusplat.threads import over_ranges

RADIUS = 5
SIGMA_PX = 1.5
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
TAPS = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA_PX) ** 2)
TAPS = (TAPS / TAPS.sum()).astype(np.float32)
_LANES = 16
_SIDE = 16  # zero columns left and right of a padded row; at least 3 channels x RADIUS
_ZERO, _TWO = np.float32(0.0), np.float32(2.0)


@compiled(inline="always")
def _blurred(source, at, step):
    """Return the window's weighted sum along an axis, centred at an index of a flat array."""
    total = lanes(_ZERO)
    for k in range(2 * RADIUS + 1):
        total = total + lanes(TAPS[k]) * load(source, at + (k - RADIUS) * step)
    return total


@compiled
def _ssim_rows(begin, end, num, stride, image, target, slopes, ssim_sums, l1_sums):
    """Compute SSIM and L1 sums of padded rows begin..end and, in `slopes`, SSIM's derivatives.

    `slopes` (3 padded maps, flat) receives dSSIM/dE[x] (directly and through the variances), dSSIM/dE[x^2]
    and dSSIM/dE[x y] of every pixel's window. If `slopes` is empty, no derivatives are computed.
    """
    groups = (num + _LANES - 1) // _LANES
    row_length = groups * _LANES + 2 * _SIDE
    moments = np.zeros(5 * row_length, np.float32)
    out = np.empty(4 * _LANES, np.float32)
    zero, two = lanes(_ZERO), lanes(_TWO)
    c1, c2 = lanes(C1), lanes(C2)
    map_size = len(slopes) // 3
    for y in range(begin, end):
        for group in range(groups):
            at = _SIDE + group * _LANES
            x_sum, t_sum, xx_sum, tt_sum, xt_sum = zero, zero, zero, zero, zero
            for k in range(2 * RADIUS + 1):
                tap = lanes(TAPS[k])
                x, t = load(image, (y + k) * stride + at), load(target, (y + k) * stride + at)
                tap_x, tap_t = tap * x, tap * t
                x_sum = x_sum + tap_x
                t_sum = t_sum + tap_t
                xx_sum = xx_sum + tap_x * x
                tt_sum = tt_sum + tap_t * t
                xt_sum = xt_sum + tap_x * t
            store(moments, at, x_sum)
            store(moments, row_length + at, t_sum)
            store(moments, 2 * row_length + at, xx_sum)
            store(moments, 3 * row_length + at, tt_sum)
            store(moments, 4 * row_length + at, xt_sum)
        total, total_l1 = 0.0, 0.0
        for group in range(groups):
            at = _SIDE + group * _LANES
            x_mean, t_mean = _blurred(moments, at, 3), _blurred(moments, row_length + at, 3)
            xx, tt = _blurred(moments, 2 * row_length + at, 3), _blurred(moments, 3 * row_length + at, 3)
            xt = _blurred(moments, 4 * row_length + at, 3)
            product = x_mean * t_mean
            squares = x_mean * x_mean + t_mean * t_mean
            a1 = two * product + c1
            a2 = two * (xt - product) + c2
            b1 = squares + c1
            b2 = xx + tt - squares + c2
            scale = reciprocal(b1 * b2)
            value = a1 * a2 * scale
            store(out, 0, value)
            if map_size > 0:
                # value = a1 a2 / (b1 b2); a2 and b2 also depend on the means
                by_xx = zero - value * b1 * scale
                by_xt = two * a1 * scale
                by_mean = two * (t_mean * (a2 - a1) * scale - x_mean * value * (b2 - b1) * scale)
                store(out, _LANES, by_mean)
                store(out, 2 * _LANES, by_xx)
                store(out, 3 * _LANES, by_xt)
            for lane in range(min(_LANES, num - group * _LANES)):
                spot = (y + RADIUS) * stride + at + lane
                total += out[lane]
                total_l1 += abs(image[spot] - target[spot])
                if map_size > 0:
                    slopes[spot] = out[_LANES + lane]
                    slopes[map_size + spot] = out[2 * _LANES + lane]
                    slopes[2 * map_size + spot] = out[3 * _LANES + lane]
        ssim_sums[y] = total
        l1_sums[y] = total_l1


@compiled
def _gradient_rows(begin, end, num, stride, image, target, slopes, l1_weight, ssim_weight, gradient):
    """Compute dL/dimage of rows begin..end from the slopes of all windows and the sign of the error."""
    groups = (num + _LANES - 1) // _LANES
    row_length = groups * _LANES + 2 * _SIDE
    rows = np.zeros(3 * row_length, np.float32)
    out = np.empty(_LANES, np.float32)
    two = lanes(_TWO)
    map_size = len(slopes) // 3
    for y in range(begin, end):
        for group in range(groups):
            at = _SIDE + group * _LANES
            spot = (y + RADIUS) * stride + at
            for k in range(3):
                store(rows, k * row_length + at, _blurred(slopes, k * map_size + spot, stride))
        for group in range(groups):
            at = _SIDE + group * _LANES
            a, b = _blurred(rows, at, 3), _blurred(rows, row_length + at, 3)
            c = _blurred(rows, 2 * row_length + at, 3)
            spot = (y + RADIUS) * stride + at
            store(out, 0, a + two * load(image, spot) * b + load(target, spot) * c)
            for lane in range(min(_LANES, num - group * _LANES)):
                difference = image[spot + lane] - target[spot + lane]
                sign = l1_weight if difference > _ZERO else (-l1_weight if difference < _ZERO else _ZERO)
                gradient[y, group * _LANES + lane] = sign - ssim_weight * out[lane]


def _require_alike(image: np.ndarray, target: np.ndarray) -> None:
    """Raise ValueError unless both are images of one size; the loops do not check bounds."""
    are_images = all(
        array.ndim == 3 and array.shape[2] == 3 and array.dtype.kind == "f" for array in (image, target)
    )
    if not are_images or image.shape != target.shape or not image.size:
        found = " and ".join(f"{array.dtype} {list(array.shape)}" for array in (image, target))
        raise ValueError(f"expected two float images [H, W, 3] of one size, in [0, 1]; found {found}")


def _padded(image: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the image padded with zeros, as a flat array, and the padded length of a row."""
    height, width, _ = image.shape
    stride = -(-3 * width // _LANES) * _LANES + 2 * _SIDE
    out = np.zeros((height + 2 * RADIUS, stride), np.float32)
    out[RADIUS : RADIUS + height, _SIDE : _SIDE + 3 * width] = image.reshape(height, 3 * width)
    return out.reshape(-1), stride


def photometric_loss(
    image: np.ndarray, target: np.ndarray, *, ssim_weight: float, threads: int = 1
) -> tuple[float, np.ndarray]:
    """Return L = (1 - w) mean |image - target| + w (1 - SSIM), and dL/dimage (3DGS, Eq. 7: w = 0.2).

    Images are float32 [H, W, 3], RGB in [0, 1]. The result is byte-identical for any number of threads.
    ValueError is raised if they have another type or shape.
    """
    _require_alike(image, target)
    height, width, _ = image.shape
    num = 3 * width
    x, stride = _padded(image)
    t, _ = _padded(target)
    slopes = np.zeros(3 * len(x), np.float32)
    ssim_sums, l1_sums = np.empty(height), np.empty(height)
    over_ranges(_ssim_rows, height, threads, num, stride, x, t, slopes, ssim_sums, l1_sums)
    gradient = np.empty((height, num), np.float32)
    count = height * num
    weights = np.float32((1 - ssim_weight) / count), np.float32(ssim_weight / count)
    over_ranges(_gradient_rows, height, threads, num, stride, x, t, slopes, *weights, gradient)
    loss = (1 - ssim_weight) * l1_sums.sum() / count + ssim_weight * (1 - ssim_sums.sum() / count)
    return float(loss), gradient.reshape(height, width, 3)


def ssim(image: np.ndarray, target: np.ndarray) -> float:
    """Return the mean structural similarity of two RGB images in [0, 1], as computed by 3DGS.

    Errors as in `photometric_loss`.
    """
    _require_alike(image, target)
    height, width, _ = image.shape
    x, stride = _padded(image)
    t, _ = _padded(target)
    ssim_sums, l1_sums = np.empty(height), np.empty(height)
    _ssim_rows(0, height, 3 * width, stride, x, t, np.empty(0, np.float32), ssim_sums, l1_sums)
    return float(ssim_sums.sum() / (3 * width * height))


def psnr(image: np.ndarray, target: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio in dB of two RGB images in [0, 1]; infinite if they are equal.

    Errors as in `photometric_loss`.
    """
    _require_alike(image, target)
    error = np.square(image.astype(np.float64) - target).mean()
    return float("inf") if error == 0 else float(-10 * np.log10(error))
