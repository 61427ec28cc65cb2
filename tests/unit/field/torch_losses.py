"""The losses in torch, from plain differences: the reference for the gradients in `hilsplat.field`."""

import math

import torch
from torch import Tensor

from hilsplat.base.levels import NONE
from hilsplat.field.contrast import ViewRelations
from hilsplat.field.losses import MIN_LENGTH, SOFTENING
from hilsplat.settings import FieldSettings


def log_distance_loss(means: Tensor, log_wanted: Tensor) -> Tensor:
    squares = (means[:, None] - means[None]).square().sum(-1)
    off = (0.5 * (squares + SOFTENING**2).log() - log_wanted)[~torch.eye(len(means), dtype=torch.bool)]
    return off.square().mean()


def similarity_without_parent(anchors: Tensor, others: Tensor, parent: Tensor) -> Tensor:
    """Cosine of anchor - parent and other - parent, with softened lengths; the parent gets no gradient."""
    own, far = anchors - parent.detach(), others[None] - parent.detach()[:, None]
    lengths = [(each.square().sum(-1) + MIN_LENGTH**2).sqrt() for each in (own, far)]
    return (own[:, None] * far).sum(-1) / lengths[0][:, None] / lengths[1]


def instance_loss_literal(means: Tensor, level: Tensor, omega: float) -> Tensor:
    apart = (level[:, None] - level[None]).abs().to(means.dtype)
    return log_distance_loss(means, -apart * math.log(omega))


def instance_loss_tree(means: Tensor, depth: Tensor, omega: float) -> Tensor:
    return log_distance_loss(means, -depth.to(means.dtype) * math.log(omega))


def part_loss_literal(means: Tensor, parent: Tensor, parent_means: Tensor, tau: float) -> Tensor:
    similarity = similarity_without_parent(means, means, parent_means) / tau
    has_parent = parent != NONE
    both = has_parent[:, None] & has_parent[None]
    same = parent[:, None] == parent[None]
    positive, negative = both & same & ~torch.eye(len(means), dtype=torch.bool), both & ~same
    anchors = positive.any(1) & negative.any(1)
    if not anchors.any():
        return means.sum() * 0
    similarity, positive, negative = similarity[anchors], positive[anchors], negative[anchors]
    repulsion = similarity.masked_fill(~negative, -torch.inf).logsumexp(1)
    attraction = (similarity * positive).sum(1) / positive.sum(1)
    return (repulsion - attraction).mean()


def part_loss_disentangle(
    half: Tensor, other_half: Tensor, has_parent: Tensor, parent_means: Tensor, tau: float
) -> Tensor:
    anchors = torch.nonzero(has_parent).squeeze(1)
    similarity = similarity_without_parent(half[anchors], other_half, parent_means[anchors]) / tau
    positive = similarity[torch.arange(len(anchors)), anchors]
    return (similarity.logsumexp(1) - positive).mean()


def instance_term(means: Tensor, view: ViewRelations, settings: FieldSettings) -> Tensor:
    """L_ins of one view."""
    if settings.instance_mode == "literal":
        return instance_loss_literal(means[view.rows], torch.from_numpy(view.level), settings.omega)
    return instance_loss_tree(means[view.rows], torch.from_numpy(view.depth), settings.omega)


def part_term(
    means: Tensor, halves: Tensor, others: Tensor, view: ViewRelations, settings: FieldSettings
) -> Tensor:
    """L_part of one view, as a mean over levels that have parents."""
    losses = []
    for rows, own in view.parts:
        parent = torch.from_numpy(own)
        parents, has_parent = means[parent.clamp(min=0)], (parent != NONE).long()
        if settings.part_mode == "literal":
            losses.append(part_loss_literal(means[rows], parent, parents, settings.tau))
        else:
            losses.append(
                part_loss_disentangle(halves[rows], others[rows], has_parent, parents, settings.tau)
            )
    return torch.stack(losses).mean()
