"""Spherical harmonics of 3DGS and their rotation."""

import numpy as np
from jaxtyping import Float64
from scipy.special import sph_harm_y


def sh_basis(directions: Float64[np.ndarray, "P 3"], degree: int) -> Float64[np.ndarray, "P K"]:
    """Return real spherical harmonics at unit directions, in the order and with the signs of 3DGS.

    Within a band, orders run from -l to l; negative orders are the sines. 3DGS keeps the
    Condon-Shortley sign (-1)^m, which real harmonics often omit.
    """
    x, y, z = directions.T
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    columns = []
    for band in range(degree + 1):
        for order in range(-band, band + 1):
            value = sph_harm_y(band, abs(order), polar, azimuth)
            if order == 0:
                columns.append(value.real)
            else:
                columns.append(np.sqrt(2) * (value.imag if order < 0 else value.real))
    return np.stack(columns, axis=1)


def sh_rotation(rotation: Float64[np.ndarray, "3 3"], degree: int) -> Float64[np.ndarray, "K K"]:
    """Return the matrix that rotates spherical-harmonics coefficients.

    The rotated colour along R d is the original colour along d. A rotated harmonic stays in its band, so the
    matrix has one block per band. Each block is a least-squares solution over more directions than harmonics,
    exact up to rounding.
    """
    # directions spread over the sphere along a spiral
    number = 64
    height = 1 - (2 * np.arange(number) + 1) / number
    angle = np.arange(number) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - height**2)
    turned = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    before = sh_basis(turned @ rotation, degree)  # rows are R^T d
    after = sh_basis(turned, degree)
    out = np.zeros(((degree + 1) ** 2,) * 2)
    for band in range(degree + 1):
        block = slice(band**2, (band + 1) ** 2)
        out[block, block] = np.linalg.lstsq(after[:, block], before[:, block], rcond=None)[0]
    return out
