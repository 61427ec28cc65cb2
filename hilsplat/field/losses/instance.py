"""The instance-wise loss L_ins (paper, Eq. 3) in three readings."""

import math

from jaxtyping import Float, Int
from torch import Tensor

from hilsplat.field.losses.distances import off_diagonal_mean, soft_distances


def instance_loss_literal(
    means: Float[Tensor, "M D"], level: Int[Tensor, " M"], omega: float
) -> Float[Tensor, ""]:
    """L_ins as printed (Eq. 3): the distance of two masks should be Omega^-|l_i - l_j|.

    Masks of the same level are thus pushed to distance 1, related or not, which more than D + 1
    masks cannot all satisfy. Departs only in the softened distance.

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
    """L_ins with relation instead of level: the distance should be Omega^-depth.

    Departs: |l_i - l_j| of Eq. 3 is replaced by the depth of the deepest common ancestor in the
    coverage tree, so that unrelated masks go to distance 1, parts of one object to 1 / Omega,
    subparts of one part to 1 / Omega^2: the nesting the text describes.

    Args:
        means: mean rendered feature of each mask of one view, all levels.
        depth: `common_ancestor_depth` of every pair.
        omega: similarity degree, above 1.

    Returns:
        mean over ordered pairs of the squared difference of logarithms.
    """
    target = depth.to(means.dtype) * math.log(omega)
    return off_diagonal_mean((-soft_distances(means).log() - target).square())


def instance_loss_logratio(
    means: Float[Tensor, "M D"], depth: Int[Tensor, "M M"], omega: float
) -> Float[Tensor, ""]:
    """L_ins in the log-ratio form it cites: only ratios of distances are matched.

    For every anchor a and pair i < j: (log d_ai / d_aj - log y_ai / y_aj)^2 with the wanted distance
    y = Omega^-depth. Scaling all features changes nothing (but for the softening).

    Source: Kim et al., CVPR 2019 (log-ratio loss), with the degrees of the coverage tree.

    Args:
        means: mean rendered feature of each mask of one view, all levels.
        depth: `common_ancestor_depth` of every pair.
        omega: similarity degree, above 1.

    Returns:
        mean over triplets of distinct masks; 0 for fewer than three.
    """
    rows = len(means)
    if rows < 3:
        return means.sum() * 0
    excess = soft_distances(means).log() + depth.to(means.dtype) * math.log(omega)
    excess = excess - excess.diag().diag()  # the anchor itself is no member of its triplets
    others = rows - 1
    # The pairs' squared differences of one anchor: others * sum of squares - square of sum.
    pairs = others * excess.square().sum(1) - excess.sum(1).square()
    return pairs.sum() / (rows * others * (others - 1) / 2)
