"""Peak rate of fused multiply-adds on this machine."""

import time
from typing import no_type_check

import numba
import numpy as np

from cpusplat.lanes import lane_sum, lanes

CHAINS = 12  # number of independent sums, enough to hide a latency of 4 to 5 cycles on 2 units


@numba.njit
@no_type_check
def _multiply_add(rounds, factor, term):
    """Compute CHAINS x 16 fused multiply-adds per round."""
    x, y = lanes(factor), lanes(term)
    a, b, c, d, e, f = y, y, y, y, y, y
    g, h, i, j, k, m = y, y, y, y, y, y
    for _ in range(rounds):
        a, b, c, d = a * x + y, b * x + y, c * x + y, d * x + y
        e, f, g, h = e * x + y, f * x + y, g * x + y, h * x + y
        i, j, k, m = i * x + y, j * x + y, k * x + y, m * x + y
    return lane_sum(a + b + c + d + e + f + g + h + i + j + k + m)


def fma_peak_gflops() -> float:
    """Return the peak float32 rate of one core, GFLOP/s; a multiply-add counts as two operations."""
    rounds = 2_000_000
    factor, term = np.float32(0.999), np.float32(1e-3)
    _multiply_add(1, factor, term)
    times = []
    for _ in range(15):
        start = time.thread_time()
        _multiply_add(rounds, factor, term)
        times.append(time.thread_time() - start)
    return 2 * 16 * CHAINS * rounds / min(times) / 1e9
