"""The instance-wise loss L_ins (paper, Eq. 3) in two readings, with its gradient."""

import math

import numpy as np
from jaxtyping import Float, Float64, Int

from hilsplat.field.losses.distances import log_distance_loss


def instance_loss_literal(
    means: Float[np.ndarray, "M D"], level: Int[np.ndarray, " M"], omega: float
) -> tuple[float, Float64[np.ndarray, "M D"]]:
    """L_ins as printed (Eq. 3): the distance of two masks should be Omega^-|l_i - l_j|.

    This pushes masks of the same level to distance 1, related or not, which more than D + 1 masks cannot
    all satisfy. Departs only in the softened distance.

    Args:
        means: mean rendered feature of each mask of one view, all levels; at least two.
        level: `Level` of each mask.
        omega: similarity degree, above 1.

    Returns:
        mean over ordered pairs of the squared difference of logarithms, and its gradient.
    """
    return log_distance_loss(means, -np.abs(level[:, None] - level[None]) * math.log(omega))


def instance_loss_tree(
    means: Float[np.ndarray, "M D"], depth: Int[np.ndarray, "M M"], omega: float
) -> tuple[float, Float64[np.ndarray, "M D"]]:
    """L_ins by relation instead of level: the distance should be Omega^-depth.

    Departs: the depth of the deepest common ancestor in the coverage tree replaces |l_i - l_j| of Eq. 3, so
    that unrelated masks go to distance 1, parts of one object to 1 / Omega, and subparts of one part to
    1 / Omega^2: the nesting that the text describes.

    Args:
        means: mean rendered feature of each mask of one view, all levels; at least two.
        depth: `common_ancestor_depth` of every pair.
        omega: similarity degree, above 1.

    Returns:
        mean over ordered pairs of the squared difference of logarithms, and its gradient.
    """
    return log_distance_loss(means, -depth * math.log(omega))
