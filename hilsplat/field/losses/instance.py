"""The instance-wise loss L_ins (paper, Eq. 3) in two variants, with its gradient."""

import math

import numpy as np
from jaxtyping import Float, Float64, Int

from hilsplat.field.losses.distances import log_distance_loss


def instance_loss_literal(
    means: Float[np.ndarray, "M D"], level: Int[np.ndarray, " M"], omega: float
) -> tuple[float, Float64[np.ndarray, "M D"]]:
    """Compute L_ins as printed (Eq. 3): the target distance of two masks is Omega^-|l_i - l_j|.

    This pushes all masks of the same level to distance 1, related or not, which is impossible for more than
    D + 1 masks. Departs only in the softened distance.

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
    """Compute L_ins by relation instead of level: the target distance is Omega^-depth.

    Departs: the depth of the deepest common ancestor in the coverage tree replaces |l_i - l_j| of Eq. 3.
    Unrelated masks thus have a target distance of 1, parts of one object 1 / Omega, and subparts of one part
    1 / Omega^2, which is the nesting that the paper's text describes.

    Args:
        means: mean rendered feature of each mask of one view, all levels; at least two.
        depth: `common_ancestor_depth` of every pair.
        omega: similarity degree, above 1.

    Returns:
        mean over ordered pairs of the squared difference of logarithms, and its gradient.
    """
    return log_distance_loss(means, -depth * math.log(omega))
