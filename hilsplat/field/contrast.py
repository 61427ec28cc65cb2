"""The contrastive losses L_ins and L_part (paper, Eq. 3 to 5) as functions of the field.

Both depend only on the mask means, so a step needs a sparse product but no rendering.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt8

from hilsplat.base.artifacts import read_npz, sealed
from hilsplat.base.levels import LEVELS, NONE
from hilsplat.contributions.mask_operator import MaskOperator
from hilsplat.contributions.rows import Contributions
from hilsplat.field.code import unit_rows
from hilsplat.field.losses import (
    common_ancestor_depth,
    instance_loss_literal,
    instance_loss_tree,
    part_loss_disentangle,
    part_loss_literal,
)
from hilsplat.segment.digests import require_same_masks
from hilsplat.settings import FieldSettings, HierarchyLosses

MAX_MASKS_PER_LEVEL = 96  # maximum masks per view and level in the losses, because all pairs are compared


@dataclass(frozen=True)
class ViewRelations:
    """Inputs of the contrastive losses for one view."""

    rows: Int64[np.ndarray, " m"]  # selected masks of all levels
    depth: Int64[np.ndarray, "m m"]  # depth of the deepest common ancestor of each pair of masks
    level: Int64[np.ndarray, " m"]  # level of each selected mask
    # of each level with masks to compare: the selected masks and the rows of their parents, -1 for none
    parts: tuple[tuple[Int64[np.ndarray, " _"], Int64[np.ndarray, " _"]], ...]


def view_relations(
    rows: Int64[np.ndarray, " m"],  # rows of the view's masks in the arrays that contain their means
    level: UInt8[np.ndarray, " m"],
    parent: Int32[np.ndarray, " m"],  # row of each mask's parent among the view's masks, -1 for none
    pixels: Int64[np.ndarray, " m"],  # pixels that show each mask
    half_pixels: Int64[np.ndarray, " m"],  # those in the random half
    settings: HierarchyLosses,
    means: Float32[np.ndarray, "m D"],  # features that represent the masks, to prune similar ones
) -> ViewRelations:
    """Select the masks of a view for the contrastive losses, largest first."""
    depth = common_ancestor_depth(parent)
    usable = (pixels >= settings.min_mask_px) & (half_pixels > 0) & (half_pixels < pixels)
    chosen = []
    for of_level in LEVELS:
        local = np.flatnonzero(usable & (level == int(of_level)))
        order = local[np.lexsort((local, -pixels[local]))][:MAX_MASKS_PER_LEVEL]
        if settings.prune_cosine < 1:
            order = order[distinct(means[order], depth[np.ix_(order, order)], settings.prune_cosine)]
        chosen.append(np.sort(order))
    every = np.sort(np.concatenate(chosen))
    visible_parent = np.where((parent != NONE) & (pixels[parent] > 0), rows[parent], NONE)
    parts = ((rows[masks], visible_parent[masks]) for masks in chosen[1:])
    return ViewRelations(
        rows=rows[every],
        depth=depth[np.ix_(every, every)],
        level=level[every].astype(np.int64),
        parts=tuple(part for part in parts if len(part[0]) > 1 and (part[1] != NONE).any()),
    )


def read_parents(tree_folder: Path, contributions: Contributions) -> dict[str, np.ndarray]:
    """Return, by view, the row of each mask's parent in the view's coverage tree, -1 for none.

    Raises:
        MisalignedArtifactError: the trees were computed from different masks.
    """
    require_same_masks(tree_folder, contributions.folder)
    return {
        view: read_npz(sealed(tree_folder, f"{view}.npz"), "parent")["parent"] for view in contributions.views
    }


def distinct(
    means: Float32[np.ndarray, "m D"], depth: Int64[np.ndarray, "m m"], most_alike: float
) -> Int64[np.ndarray, " k"]:
    """Return the rows to keep as contrastive samples: those unlike every unrelated row that was kept earlier.

    The paper keeps the most distinct samples but specifies no numbers. A pair of masks that are similar but
    unrelated in the tree adds almost no information to the gradients of the kept pairs. Rows are in order of
    preference, `depth` is their `common_ancestor_depth`, and `most_alike` is a cosine.
    """
    unit = unit_rows(means)
    alike = (unit @ unit.T > most_alike) & (depth == 0)
    is_distinct = np.zeros(len(means), bool)
    for row in range(len(means)):
        is_distinct[row] = not (alike[row] & is_distinct).any()
    return np.flatnonzero(is_distinct)


def instance_term(
    means: Float64[np.ndarray, "M D"], relations: list[ViewRelations], settings: HierarchyLosses
) -> tuple[float, Float64[np.ndarray, "M D"]]:
    """Compute L_ins of the mask means, averaged over views with at least two masks, and its gradient."""
    losses, gradient = [], np.zeros(means.shape)
    for view in relations:
        if len(view.rows) < 2:
            continue
        chosen = means[view.rows]
        if settings.instance_mode == "literal":
            loss, by_chosen = instance_loss_literal(chosen, view.level, settings.omega)
        else:
            loss, by_chosen = instance_loss_tree(chosen, view.depth, settings.omega)
        losses.append(loss)
        gradient[view.rows] += by_chosen
    count = max(len(losses), 1)
    return sum(losses) / count, gradient / count


def part_term(
    means: Float64[np.ndarray, "M D"],
    halves: Float64[np.ndarray, "M D"],  # means over a random half of each mask's pixels
    other_halves: Float64[np.ndarray, "M D"],  # means over the other pixels
    relations: list[ViewRelations],
    settings: HierarchyLosses,
) -> tuple[float, tuple[Float64[np.ndarray, "M D"], ...]]:
    """Compute L_part, averaged over views and levels that have masks to compare, and its three gradients."""
    losses = []
    by_means, by_halves, by_others = (np.zeros(means.shape) for _ in range(3))
    for view in relations:
        for rows, parent in view.parts:
            parent_means = means[np.maximum(parent, 0)]
            if settings.part_mode == "literal":
                loss, by_rows = part_loss_literal(means[rows], parent, parent_means, settings.tau)
                by_means[rows] += by_rows
            else:
                loss, by_half, by_other = part_loss_disentangle(
                    halves[rows], other_halves[rows], parent != NONE, parent_means, settings.tau
                )
                by_halves[rows] += by_half
                by_others[rows] += by_other
            losses.append(loss)
    count = max(len(losses), 1)
    return sum(losses) / count, (by_means / count, by_halves / count, by_others / count)


@dataclass(frozen=True)
class Contrast:
    """The contrastive losses as functions of the field."""

    masks: MaskOperator  # A
    half_masks: MaskOperator  # A over a random half of each mask's pixels
    pixels: Float32[np.ndarray, " M"]  # n
    half_pixels: Float32[np.ndarray, " M"]  # pixels in the halves
    relations: list[ViewRelations]
    settings: FieldSettings
    # in a block: the parts of the means over masks and halves that come from all other Gaussians
    others: tuple[Float32[np.ndarray, "M D"], Float32[np.ndarray, "M D"]] | None = None

    def values(self, features: Float32[np.ndarray, "N 3 D"]) -> dict[str, float]:
        """Return the unweighted L_ins and L_part."""
        means, halves, others = self._means(features)
        instance, _ = instance_term(means, self.relations, self.settings)
        part, _ = part_term(means, halves, others, self.relations, self.settings)
        return {"instance": instance, "part": part}

    def weighted(self, features: Float32[np.ndarray, "N 3 D"]) -> tuple[float, Float32[np.ndarray, "N 3 D"]]:
        """Return the weighted sum of L_ins and L_part, and its gradient; losses with weight 0 are skipped."""
        settings, (means, halves, others) = self.settings, self._means(features)
        total, by_means, by_halves = 0.0, np.zeros(means.shape), None
        if settings.weight_instance:
            loss, gradient = instance_term(means, self.relations, settings)
            total += settings.weight_instance * loss
            by_means += settings.weight_instance * gradient
        if settings.weight_part:
            loss, (by_mean, by_half, by_other) = part_term(means, halves, others, self.relations, settings)
            total += settings.weight_part * loss
            n, half, outside = self._counts()
            by_means += settings.weight_part * (by_mean + n / outside * by_other)
            by_halves = settings.weight_part * (by_half - half / outside * by_other)
        gradient = self.masks.spread(by_means.astype(np.float32))
        if by_halves is not None:
            gradient += self.half_masks.spread(by_halves.astype(np.float32))
        return total, gradient

    def _means(self, features: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the mean features of each mask, its random half and its other half, in float64."""
        means = self.masks.means(features).astype(np.float64)
        halves = self.half_masks.means(features).astype(np.float64)
        if self.others is not None:
            means, halves = means + self.others[0], halves + self.others[1]
        n, half, outside = self._counts()
        return means, halves, (n * means - half * halves) / outside

    def _counts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return pixel counts of each mask, its random half and its other half (at least 1), as columns."""
        n, half = (count.astype(np.float64)[:, None] for count in (self.pixels, self.half_pixels))
        return n, half, np.maximum(n - half, 1)
