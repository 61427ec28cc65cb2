"""Drawn views of Gaussians, and the errors of Gaussians that cannot be drawn."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from scipy.sparse import csr_matrix

from cpusplat.views import Parameters
from hilsplat.base.errors import HilsplatError


@dataclass(frozen=True)
class Drawn:
    image: Float32[np.ndarray, "H W C"]  # premultiplied RGB, then features, without background
    alpha: Float32[np.ndarray, "H W"]  # coverage in [0, 1], the sum of the blending weights
    drawn: Bool[np.ndarray, " N"]  # whether each Gaussian reaches a pixel of the view
    # maps gradients of image and alpha to those of the parameters, and of the projected means [N 2] in px
    gradients: Callable[[np.ndarray, np.ndarray], tuple[Parameters, np.ndarray]]


def refuse_broken(broken: int, total: int) -> None:
    """Raise HilsplatError if any Gaussian cannot be drawn."""
    if broken:
        raise HilsplatError(
            f"{broken} of {total} Gaussians cannot be drawn: non-finite parameters or a zero quaternion",
            expected="finite means, log_scales, quats, opacity_logits and sh",
            fix="drop these Gaussians, or rerun the gaussians stage",
        )


def weight_matrix(
    weights: np.ndarray, columns: np.ndarray, row_start: np.ndarray, num_gaussians: int
) -> csr_matrix:
    """Build a matrix from CSR arrays with sorted columns; scipy converts row starts to int32 if they fit."""
    shape = (len(row_start) - 1, num_gaussians)
    matrix = csr_matrix((weights, columns, row_start), shape=shape, copy=False)
    matrix.has_sorted_indices = True
    return matrix
