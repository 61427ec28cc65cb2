"""The instance-wise loss L_ins (paper, Eq. 3) in two readings."""

import math

from jaxtyping import Float, Int
from torch import Tensor

from hilsplat.field.losses.distances import off_diagonal_mean, soft_distances


def instance_loss_literal(
    means: Float[Tensor, "M D"], level: Int[Tensor, " M"], omega: float
) -> Float[Tensor, ""]:
    """L_ins as printed (Eq. 3): the distance of two masks should be Omega^-|l_i - l_j|.

    This pushes masks of the same level to distance 1, related or not, which more than D + 1 masks cannot
    all satisfy. Departs only in the softened distance.

    Args:
        means: mean rendered feature of each mask of one view, all levels.
        level: `Level` of each mask.
        omega: similarity degree, above 1.

    Returns:
        mean over ordered pairs of the squared difference of logarithms.
    """
    apart = (level[:, None] - level[None]).abs().to(means.dtype)
    return off_diagonal_mean((-soft_distances(means).log() - apart * math.log(omega)).square())


def instance_loss_tree(
    means: Float[Tensor, "M D"], depth: Int[Tensor, "M M"], omega: float
) -> Float[Tensor, ""]:
    """L_ins by relation instead of level: the distance should be Omega^-depth.

    Departs: the depth of the deepest common ancestor in the coverage tree replaces |l_i - l_j| of Eq. 3, so
    that unrelated masks go to distance 1, parts of one object to 1 / Omega, and subparts of one part to
    1 / Omega^2: the nesting that the text describes.

    Args:
        means: mean rendered feature of each mask of one view, all levels.
        depth: `common_ancestor_depth` of every pair.
        omega: similarity degree, above 1.

    Returns:
        mean over ordered pairs of the squared difference of logarithms.
    """
    target = depth.to(means.dtype) * math.log(omega)
    return off_diagonal_mean((-soft_distances(means).log() - target).square())
