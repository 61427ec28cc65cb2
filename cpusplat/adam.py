"""Adam (Kingma and Ba 2015) for flat arrays, in one pass over all of them."""

import numpy as np

from cpusplat.compiled import compiled
from cpusplat.lanes import WIDTH, lanes, load, root, store
from cpusplat.threads import over_ranges

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15  # 3DGS


@compiled
def _adam_chunks(begin, end, values, gradients, first, second, rates, root_of_rest2):
    """Take an Adam step, in place, for chunks begin..end, which contain 16 numbers each.

    `rates` (divided by 1 - beta1^t) is cyclic: chunk k uses the rates from index 16 k. `root_of_rest2` is
    sqrt(1 - beta2^t).
    """
    beta1, rest1 = lanes(np.float32(BETA1)), lanes(np.float32(1.0 - BETA1))
    beta2, rest2 = lanes(np.float32(BETA2)), lanes(np.float32(1.0 - BETA2))
    epsilon, scale = lanes(np.float32(EPSILON)), lanes(np.float32(1.0 / root_of_rest2))
    for chunk in range(begin, end):
        at = chunk * WIDTH
        g = load(gradients, at)
        m = beta1 * load(first, at) + rest1 * g
        v = beta2 * load(second, at) + rest2 * g * g
        store(first, at, m)
        store(second, at, v)
        store(values, at, load(values, at) - load(rates, at % len(rates)) * m / (root(v) * scale + epsilon))


def adam_step(
    values: np.ndarray,
    gradients: np.ndarray,
    first: np.ndarray,
    second: np.ndarray,
    rates: list[float] | np.ndarray,
    t: int,
    threads: int = 1,
) -> None:
    """Take step `t` (from 1) of Adam; all arrays are flat float32, and values and moments change in place.

    Args:
        first, second: running moments of the gradients; zeros before the first step.
        rates: step sizes, repeated cyclically over the values.
        threads: CPU threads; the result is byte-identical for any number.

    Raises:
        ValueError: the arrays are not flat, contiguous float32 arrays of one length, or `t` is below 1.
    """
    arrays = values, gradients, first, second
    # the loops check neither types nor bounds
    are_flat = all(array.dtype == np.float32 and array.flags.c_contiguous for array in arrays)
    if not are_flat or {array.shape for array in arrays} != {(len(values),)} or t < 1:
        found = ", ".join(f"{array.dtype} {list(array.shape)}" for array in arrays)
        raise ValueError(f"expected contiguous float32 arrays [N] and t >= 1; found {found}, t = {t}")
    repeated = np.tile(np.asarray(rates, np.float32), WIDTH) / np.float32(1 - BETA1**t)
    root_of_rest2 = float(np.sqrt(1 - BETA2**t))
    whole, tail = divmod(len(values), WIDTH)
    over_ranges(_adam_chunks, whole, threads, *arrays, repeated, root_of_rest2)
    if tail:
        last = [np.concatenate([array[-tail:], np.zeros(WIDTH - tail, np.float32)]) for array in arrays]
        _adam_chunks(0, 1, *last, np.roll(repeated, -WIDTH * whole), root_of_rest2)
        for array, chunk in zip(arrays, last, strict=True):
            array[-tail:] = chunk[:tail]
