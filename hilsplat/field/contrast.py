"""The contrastive losses L_ins and L_part (paper, Eq. 3 to 5) as functions of the field.

Both depend on the mask means alone, so a step costs a sparse product and no rendering.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.contributions.mask_operator import MaskProducts
from hilsplat.contributions.rows import Contributions
from hilsplat.field.losses.distances import common_ancestor_depth
from hilsplat.field.losses.instance import instance_loss_literal, instance_loss_tree
from hilsplat.field.losses.part import part_loss_disentangle, part_loss_literal
from hilsplat.settings import FieldSettings

MAX_MASKS_PER_LEVEL = 96
"""Most masks of one view and level that take part, since the losses compare all pairs."""


@dataclass(frozen=True)
class ViewRelations:
    """What the contrastive losses need of one view.

    Attributes:
        rows: masks that take part, all levels.
        depth: depth of the deepest common ancestor of every pair of them.
        level: their levels.
        part_rows: for PART and SUBPART, the masks that take part.
        part_parent: the row of their parents in the coverage tree, -1 for none.
    """

    rows: Tensor
    depth: Tensor
    level: Tensor
    part_rows: tuple[Tensor, ...]
    part_parent: tuple[Tensor, ...]


def view_relations(
    contributions: Contributions,
    parents: dict[str, np.ndarray],
    settings: FieldSettings,
    means: Float32[np.ndarray, "M D"] | None = None,
) -> list[ViewRelations]:
    """Choose the masks of each view that take part in the contrastive losses, largest first.

    Args:
        contributions: rows.
        parents: per view, the coverage tree's parent of each mask (row among the view's masks).
        settings: smallest size of a mask, and pruning.
        means: mean lifted feature of each mask, to prune masks that look alike; None keeps all.
    """
    relations = []
    for number, view in enumerate(contributions.views):
        rows = np.flatnonzero(contributions.view == number)
        pixels = contributions.pixels[rows]
        half = contributions.half_pixels[rows]
        parent = parents[view]
        depth = common_ancestor_depth(parent)
        usable = (pixels >= settings.min_mask_px) & (half > 0) & (half < pixels)
        chosen: dict[Level, np.ndarray] = {}
        for level in LEVELS:
            local = np.flatnonzero(usable & (contributions.level[rows] == int(level)))
            order = local[np.lexsort((local, -pixels[local]))][:MAX_MASKS_PER_LEVEL]
            if means is not None and settings.prune_cosine < 1:
                order = order[
                    distinct(means[rows[order]], depth[np.ix_(order, order)], settings.prune_cosine)
                ]
            chosen[level] = np.sort(order)
        every = np.sort(np.concatenate(list(chosen.values())))
        visible_parent = np.where((parent != NONE) & (pixels[parent] > 0), parent, NONE)
        part_parent = []
        for level in LEVELS[1:]:
            own = visible_parent[chosen[level]]
            part_parent.append(np.where(own == NONE, NONE, rows[own]) if len(rows) else own)
        relations.append(
            ViewRelations(
                rows=torch.from_numpy(rows[every]),
                depth=torch.from_numpy(depth[np.ix_(every, every)]),
                level=torch.from_numpy(contributions.level[rows[every]].astype(np.int64)),
                part_rows=tuple(torch.from_numpy(rows[chosen[level]]) for level in LEVELS[1:]),
                part_parent=tuple(torch.from_numpy(np.asarray(own, dtype=np.int64)) for own in part_parent),
            )
        )
    return relations


def distinct(
    means: Float32[np.ndarray, "m D"], depth: Int64[np.ndarray, "m m"], most_alike: float
) -> Int64[np.ndarray, " k"]:
    """Contrastive sample pruning: rows that do not look like an unrelated row kept before them.

    The paper keeps the most distinct samples and gives no numbers. A mask that is unrelated to a kept one in
    the tree, but looks like it, adds a pair whose gradient says little beyond that of the kept pairs.

    Args:
        means: features, in order of preference.
        depth: `common_ancestor_depth` of the rows; 0 means unrelated.
        most_alike: cosine above which a row is dropped.
    """
    unit = means / np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-12)
    alike = (unit @ unit.T > most_alike) & (depth == 0)
    kept = np.zeros(len(means), bool)
    for row in range(len(means)):
        kept[row] = not (alike[row] & kept).any()
    return np.flatnonzero(kept)


def instance_term(
    means: Float[Tensor, "M D"], relations: list[ViewRelations], settings: FieldSettings
) -> Tensor:
    """L_ins, averaged over the views that have masks to compare.

    Args:
        means: mean feature of each mask.
        relations: per view.
        settings: the reading of L_ins, and Omega.
    """
    losses = []
    for view in relations:
        if len(view.rows) < 2:
            continue
        chosen = means[view.rows]
        if settings.instance_mode == "literal":
            losses.append(instance_loss_literal(chosen, view.level, settings.omega))
        else:
            losses.append(instance_loss_tree(chosen, view.depth, settings.omega))
    return torch.stack(losses).mean() if losses else means.sum() * 0


def part_term(
    means: Float[Tensor, "M D"],
    halves: Float[Tensor, "M D"],
    other_halves: Float[Tensor, "M D"],
    relations: list[ViewRelations],
    settings: FieldSettings,
) -> Tensor:
    """L_part, averaged over the views and levels that have masks to compare.

    Args:
        means: mean feature of each mask.
        halves: mean feature over a random half of each mask's pixels.
        other_halves: mean feature over the other pixels.
        relations: per view.
        settings: the reading of L_part, and tau.
    """
    losses = []
    for view in relations:
        for rows, parent in zip(view.part_rows, view.part_parent, strict=True):
            has_parent = parent != NONE
            if len(rows) < 2 or not has_parent.any():
                continue
            parent_means = means[parent.clamp(min=0)]
            if settings.part_mode == "literal":
                losses.append(part_loss_literal(means[rows], parent, parent_means, settings.tau))
            else:
                losses.append(
                    part_loss_disentangle(
                        halves[rows], other_halves[rows], has_parent.long(), parent_means, settings.tau
                    )
                )
    return torch.stack(losses).mean() if losses else means.sum() * 0


@dataclass(frozen=True)
class Contrast:
    """The contrastive losses as functions of the field.

    Attributes:
        masks: A.
        half_masks: A over a random half of each mask's pixels.
        pixels: n.
        half_pixels: number of pixels in the halves.
        relations: per view.
        settings: readings and weights.
    """

    masks: MaskProducts
    half_masks: MaskProducts
    pixels: Float32[np.ndarray, " M"]
    half_pixels: Float32[np.ndarray, " M"]
    relations: list[ViewRelations]
    settings: FieldSettings

    def values(self, features: Float32[np.ndarray, "N 3 D"]) -> dict[str, float]:
        """Unweighted L_ins and L_part."""
        with torch.no_grad():
            means, halves = self._means(features)
            instance, part = self._losses(means, halves, (True, True))
        return {"instance": float(instance), "part": float(part)}

    def weighted(
        self, features: Float32[np.ndarray, "N 3 D"], weights: tuple[float, float]
    ) -> tuple[float, Float32[np.ndarray, "N 3 D"]]:
        """The weighted sum of L_ins and L_part, and its gradient; a loss of weight 0 is not computed."""
        means, halves = (values.requires_grad_() for values in self._means(features))
        losses = self._losses(means, halves, (weights[0] != 0, weights[1] != 0))
        total = weights[0] * losses[0] + weights[1] * losses[1]
        by_means, by_halves = torch.autograd.grad(total, (means, halves), allow_unused=True)
        gradient = self.masks.spread(by_means.float().numpy())
        if by_halves is not None:
            gradient += self.half_masks.spread(by_halves.float().numpy())
        return float(total.detach()), gradient

    def _means(self, features: np.ndarray) -> tuple[Tensor, Tensor]:
        """Mean feature of each mask and of its random half, in float64."""
        return (
            torch.from_numpy(self.masks.means(features)).double(),
            torch.from_numpy(self.half_masks.means(features)).double(),
        )

    def _losses(self, means: Tensor, halves: Tensor, wanted: tuple[bool, bool]) -> tuple[Tensor, Tensor]:
        """L_ins and L_part; 0 for one that is not asked for."""
        n = torch.from_numpy(self.pixels).double()[:, None]
        half = torch.from_numpy(self.half_pixels).double()[:, None]
        others = (n * means - half * halves) / (n - half).clamp(min=1)
        nothing = means.sum() * 0
        return (
            instance_term(means, self.relations, self.settings) if wanted[0] else nothing,
            part_term(means, halves, others, self.relations, self.settings) if wanted[1] else nothing,
        )
