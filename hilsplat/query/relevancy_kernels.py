"""Compiled loops for relevancy look-ups."""

import numpy as np

from cpusplat.compiled import compiled

BLOCK = 2048
"""Number of pixels processed at once: sums fit in the L1 cache, and blocks are long enough to prefetch."""


@compiled
def _dots_of_block(channels, begin, end, offset, slope, out):
    """Write the offset plus the weighted channel sum of pixels begin..end to the start of `out`.

    Eight channels are summed at a time, so that sums are read and written one eighth as often.
    """
    for p in range(end - begin):
        out[p] = offset
    eights = len(channels) // 8 * 8
    for c in range(0, eights, 8):
        s, t, u, v = slope[c], slope[c + 1], slope[c + 2], slope[c + 3]
        w, x, y, z = slope[c + 4], slope[c + 5], slope[c + 6], slope[c + 7]
        row_s, row_t = channels[c, begin:end], channels[c + 1, begin:end]
        row_u, row_v = channels[c + 2, begin:end], channels[c + 3, begin:end]
        row_w, row_x = channels[c + 4, begin:end], channels[c + 5, begin:end]
        row_y, row_z = channels[c + 6, begin:end], channels[c + 7, begin:end]
        for p in range(end - begin):
            first = s * np.float32(row_s[p]) + t * np.float32(row_t[p])
            second = u * np.float32(row_u[p]) + v * np.float32(row_v[p])
            third = w * np.float32(row_w[p]) + x * np.float32(row_x[p])
            fourth = y * np.float32(row_y[p]) + z * np.float32(row_z[p])
            out[p] += (first + second) + (third + fourth)
    for c in range(eights, len(channels)):
        row, weight = channels[c, begin:end], slope[c]
        for p in range(end - begin):
            out[p] += weight * np.float32(row[p])


@compiled
def lengths_and_generic(channels, cross, mean_square, offsets, slopes, length, generic):
    """Write |m + U z| and the largest cosine with a canonical phrase; `slopes` has shape (K, D)."""
    dots = np.empty(BLOCK, np.float32)
    for begin in range(0, len(length), BLOCK):
        end = min(begin + BLOCK, len(length))
        squares = np.full(end - begin, mean_square, np.float32)
        for c in range(len(channels)):
            row = channels[c, begin:end]
            for p in range(end - begin):
                squares[p] += row[p] * (np.float32(2) * cross[c] + row[p])
        best = np.full(end - begin, -np.inf, np.float32)
        for k in range(len(offsets)):
            _dots_of_block(channels, begin, end, offsets[k], slopes[k], dots)
            for p in range(end - begin):
                best[p] = max(best[p], dots[p])
        for p in range(end - begin):
            length[begin + p] = np.sqrt(max(squares[p], np.float32(1e-20)))
            generic[begin + p] = best[p] / length[begin + p]


@compiled
def texts_relevancy(channels, length, generic, first, offsets, slopes, scale, out):
    """Write the relevancy (T, p) of texts at pixels starting with `first`; `channels` has shape (D, P).

    The cosine of a text is (offset + slope . channels) / length; an empty `length` means length 1. All
    texts are processed while a block of pixels is in the cache.
    """
    dots = np.empty(BLOCK, np.float32)
    last = first + out.shape[1]
    for begin in range(first, last, BLOCK):
        end = min(begin + BLOCK, last)
        for text in range(len(out)):
            _dots_of_block(channels, begin, end, offsets[text], slopes[text], dots)
            if len(length):
                for p in range(end - begin):
                    dots[p] /= length[begin + p]
            _write_relevancy(dots, generic[begin:end], scale, out[text, begin - first : end - first])


@compiled
def _write_relevancy(cosines, generic, scale, out):
    """Write 1 / (1 + exp(-scale (cosine - generic))) for at most `BLOCK` pixels.

    exp(-x) = 2^n 2^f with integer n and f in [-1/2, 1/2]. 2^n is set as the bits of a float, and 2^f is
    approximated by seven terms of its series (relative error 1e-8), so that the compiler can vectorise it.
    """
    fraction, bits = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.int32)
    power = bits.view(np.float32)
    for p in range(len(out)):
        exponent = scale * (generic[p] - cosines[p]) * np.float32(1.44269504)
        exponent = min(max(exponent, np.float32(-100)), np.float32(100))
        whole = np.floor(exponent + np.float32(0.5))
        f = exponent - whole
        series = np.float32(1.5252734e-5)
        series = series * f + np.float32(1.5403530e-4)
        series = series * f + np.float32(1.3333558e-3)
        series = series * f + np.float32(9.6181291e-3)
        series = series * f + np.float32(5.5504109e-2)
        series = series * f + np.float32(2.4022651e-1)
        series = series * f + np.float32(6.9314718e-1)
        fraction[p] = series * f + np.float32(1)
        bits[p] = (np.int32(whole) + np.int32(127)) << np.int32(23)
    for p in range(len(out)):
        out[p] = np.float32(1) / (np.float32(1) + fraction[p] * power[p])
