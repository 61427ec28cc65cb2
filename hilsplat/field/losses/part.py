"""The part-wise loss L_part (paper, Eq. 4 and 5) in two readings."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from hilsplat.field.losses.distances import similarity_without_parent

NO_PARENT = -1


def part_loss_literal(
    means: Float[Tensor, "M D"],
    parent: Int[Tensor, " M"],
    parent_means: Float[Tensor, "M D"],
    tau: float,
) -> Float[Tensor, ""]:
    """L_part of one view and level as printed (Eq. 5): siblings attract, children of others repel.

    The denominator holds the negatives alone, as printed. This pulls siblings together ("bear nose" and
    "bear mouth"), whereas the prose around it says to separate them.

    Departs: we read 1 / (L N_p) as the mean, over anchors with at least one positive and one negative, of
    the mean over their positives. The caller leaves out level l = 1, which has no parents; this function
    leaves out orphans. An anchor is not its own positive.

    Args:
        means: mean rendered feature of each mask of the level.
        parent: id of each mask's parent, -1 for an orphan.
        parent_means: mean feature of each mask's parent (any value for orphans).
        tau: temperature.

    Returns:
        mean over anchors; 0 if there is none.
    """
    similarity = similarity_without_parent(means, means, parent_means) / tau
    has_parent = parent != NO_PARENT
    both = has_parent[:, None] & has_parent[None]
    same = parent[:, None] == parent[None]
    itself = torch.eye(len(means), dtype=torch.bool, device=means.device)
    positive, negative = both & same & ~itself, both & ~same
    anchors = positive.any(1) & negative.any(1)
    if not anchors.any():
        return means.sum() * 0
    similarity, positive, negative = similarity[anchors], positive[anchors], negative[anchors]
    repulsion = similarity.masked_fill(~negative, -torch.inf).logsumexp(1)
    attraction = (similarity * positive).sum(1) / positive.sum(1)
    return (repulsion - attraction).mean()


def part_loss_disentangle(
    half: Float[Tensor, "M D"],
    other_half: Float[Tensor, "M D"],
    has_parent: Int[Tensor, " M"],
    parent_means: Float[Tensor, "M D"],
    tau: float,
) -> Float[Tensor, ""]:
    """L_part of one view and level as its prose describes it: parts of one object are separated.

    Departs: the positive of a mask is the other random half of its own pixels; negatives are the other
    halves of all other masks of the level, siblings included; the denominator includes the positive
    (InfoNCE). The anchor's parent mean is subtracted from all.

    Args:
        half: mean feature over a random half of each mask's pixels.
        other_half: mean over the remaining pixels.
        has_parent: 1 for masks with a parent, which are the anchors.
        parent_means: mean feature of each mask's parent (any value for orphans).
        tau: temperature.

    Returns:
        mean over anchors; 0 if there is none, or no second mask.
    """
    anchors = torch.nonzero(has_parent).squeeze(1)
    if not len(anchors) or len(half) < 2:
        return half.sum() * 0
    similarity = similarity_without_parent(half[anchors], other_half, parent_means[anchors]) / tau
    positive = similarity[torch.arange(len(anchors)), anchors]
    return (similarity.logsumexp(1) - positive).mean()
