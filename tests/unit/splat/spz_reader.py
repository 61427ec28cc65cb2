"""A reader of SPZ, written from the description of the format."""

import gzip

import numpy as np

from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.spz import HARMONIC_SIGNS, HEADER, MAGIC


def decoded(data: bytes) -> Gaussians:
    """The Gaussians of an SPZ file of version 2, in our axes."""
    data = gzip.decompress(data)
    magic, version, n, degree, bits, flags, reserved = HEADER.unpack(data[: HEADER.size])
    assert (magic, version, flags, reserved) == (MAGIC, 2, 0, 0)
    others, at = 3 * ((degree + 1) ** 2 - 1), HEADER.size

    def column(width: int) -> np.ndarray:
        nonlocal at
        found = np.frombuffer(data, np.uint8, n * width, at).reshape(n, width).astype(np.int64)
        at += n * width
        return found

    low, middle, high = column(9).reshape(n, 3, 3).transpose(2, 0, 1)
    fixed = low + 256 * middle + 65536 * high
    means = np.where(fixed >= 2**23, fixed - 2**24, fixed) / 2.0**bits
    alpha = np.clip(column(1)[:, 0] / 255, 1e-6, 1 - 1e-6)
    colour = (column(3) / 255 - 0.5) / 0.15
    log_scales = column(3) / 16 - 10
    xyz = column(3) / 127.5 - 1
    harmonics = (column(others).reshape(n, -1, 3) - 128) / 128 * HARMONIC_SIGNS[: others // 3, None]
    assert at == len(data)
    w = np.sqrt(np.maximum(0, 1 - np.square(xyz).sum(axis=1)))
    flip = np.array([1, -1, -1])
    return Gaussians(
        means=(means * flip).astype(np.float32),
        log_scales=log_scales.astype(np.float32),
        quats=np.column_stack([w, xyz * flip]).astype(np.float32),
        opacity_logits=(np.log(alpha) - np.log1p(-alpha)).astype(np.float32),
        sh=np.concatenate([colour[:, None], harmonics], axis=1).astype(np.float32),
    )
