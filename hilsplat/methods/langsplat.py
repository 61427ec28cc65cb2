"""LangSplat, and the paper's method, which adds the losses L_h, L_ins and L_part to LangSplat's training.

LangSplat trains an independent field per level with an L1 loss between rendered and painted codes. The
published code renders one random view per step (using each view once before repeating any) and compares
every labelled pixel (minghanqin/LangSplat `train.py`). Geometry is frozen, so rendering is a product with
fixed compositing weights, which we compute once per view. `hi_lsplat` minimises, at the same views,
LangSplat's loss plus L (paper, Eq. 6); with all weights 0, it is LangSplat.

Departs from LangSplat's published code:
    - fewer steps, and a pixel grid instead of all pixels (`TrainedSettings`);
    - L1 is averaged over the labelled pixels of the grid; LangSplat averages over all pixels, counting
      unlabelled pixels as 0, so views with larger masks have more weight;
    - rendered codes are divided by alpha, as in queries, and pixels with alpha below `MIN_ALPHA` are ignored;
      LangSplat compares premultiplied codes wherever a mask is painted;
    - Gaussians' codes are blended unscaled; LangSplat first scales each code to unit length;
    - weights below `contributions.min_weight` are dropped.

Departs from the paper: Eq. 6 has no language loss, so a constant field minimises L; here, LangSplat's L1 loss
is added, summed over levels. L_h is a mean over pixels. `field/losses.py` lists the readings of L_ins and
L_part. Each level takes a step in turn, with its own view, and the losses are those of that view.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt8

from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.base.progress import track
from hilsplat.baselines import HiLSplatSettings, TrainedSettings
from hilsplat.contributions.view_matrices import painted_indicator, random_half
from hilsplat.field.adam import Adam, in_random_order
from hilsplat.field.contrast import ViewRelations, instance_term, part_term, read_parents, view_relations
from hilsplat.methods.kernels import WIDTH, padded_rows, rendered_gradient, weighted_sums
from hilsplat.methods.method import LabelledView, MethodInputs, labelled_views


@dataclass(frozen=True)
class MaskHalves:
    """Masks of one view, each as two random halves of its pixels; row 2 r + h is half h of mask r."""

    labels: Int32[np.ndarray, "p 3"]  # row of the half painted at each pixel and level, -1 for none
    sums: sp.csr_matrix  # summed weights: halves x 3 N, where a mask has entries at its own level
    pixels: Int64[np.ndarray, "m 2"]
    latents: Float32[np.ndarray, "m D"]
    relations: tuple[ViewRelations, ...]  # per level: masks compared by L_ins and, at this level, by L_part

    @staticmethod
    def of(
        view: LabelledView,
        in_half: Bool[np.ndarray, " p"],
        level: UInt8[np.ndarray, " m"],
        parent: Int32[np.ndarray, " m"],
        latents: Float32[np.ndarray, "m D"],
        settings: HiLSplatSettings,
    ) -> "MaskHalves":
        """Divide the masks of a view, and select those to compare."""
        labels = np.where(view.labels >= 0, 2 * view.labels + in_half[:, None], NONE).astype(np.int32)
        size, every = 2 * len(level), np.ones(len(labels), bool)
        of_level = (np.where(np.arange(len(LEVELS)) == of.index, labels, NONE) for of in LEVELS)
        painted = (painted_indicator(one, size, every).astype(np.float32) for one in of_level)
        pixels = np.bincount(labels[labels >= 0], minlength=size).reshape(-1, 2)
        of_image = pixels * settings.pixel_step**2
        rows, areas = np.arange(len(level)), (of_image.sum(axis=1), of_image[:, 1])
        of_view = view_relations(rows, level, parent, *areas, settings, latents)
        relations = (
            replace(of_view, parts=tuple(part for part in of_view.parts if level[part[0][0]] == int(of)))
            for of in LEVELS
        )
        sums = sp.hstack([indicator @ view.weights for indicator in painted], format="csr")
        return MaskHalves(labels, sums, pixels, latents, tuple(relations))


@dataclass(frozen=True)
class HierarchyTerms:
    """L_h, L_ins and L_part on rendered codes, scaled so that means over views are the solver's terms."""

    views: list[MaskHalves]
    settings: HiLSplatSettings
    num_pixels: int  # labelled pixels of all views and levels
    num_instance: int  # views with masks that L_ins compares
    num_part: int  # pairs of view and level with masks that L_part compares

    @staticmethod
    def of(inputs: MethodInputs, views: list[LabelledView], settings: HiLSplatSettings) -> "HierarchyTerms":
        """Prepare the masks of all views."""
        contributions, divided = inputs.contributions, []
        parents = read_parents(inputs.coverage_tree_folder, contributions)
        for view in views:
            name = contributions.views[view.number]
            height, width = inputs.view_camera(name).size_hw
            in_half = random_half(name, height * width)[view.xy @ (1, width)]
            masks = contributions.level[view.rows], parents[name], inputs.latents[view.rows]
            divided.append(MaskHalves.of(view, in_half, *masks, settings))
        num_pixels = sum(int(view.pixels.sum()) for view in divided)
        num_instance = sum(len(view.relations[0].rows) > 1 for view in divided)
        num_part = sum(len(relations.parts) for view in divided for relations in view.relations)
        return HierarchyTerms(divided, settings, num_pixels, max(num_instance, 1), max(num_part, 1))

    def gradient(
        self, number: int, level: Level, features: Float32[np.ndarray, "3 N W"], num_views: int
    ) -> tuple[float, Float64[np.ndarray, "R D"]]:
        """Return the gradient of a view's losses at the rendered codes x of a level: a x + offset.

        Args:
            number: index of the view.
            level: level of the pixels; offsets of masks of other levels are meaningless.
            features: features of every level, padded from D to W numbers.
            num_views: number of views among which this view is drawn.

        Returns:
            a, and the offset of each half of a mask; with `language: squared`, both include that loss.
        """
        settings, view = self.settings, self.views[number]
        relations, latents = [view.relations[level.index]], view.latents
        wide, sums = features.shape[2], view.sums
        rendered = np.empty((2 * len(view.pixels), wide), np.float32)
        matrix = sums.indptr, sums.indices, sums.data
        weighted_sums(*matrix, wide, features.reshape(-1), rendered.reshape(-1))
        halves = rendered[:, : latents.shape[1]].astype(np.float64).reshape(len(view.pixels), 2, -1)
        by_pixel = 1 / np.maximum(view.pixels, 1)[:, :, None]
        by_mask = 1 / np.maximum(view.pixels.sum(axis=1), 1)[:, None]
        means, halves = by_mask * halves.sum(axis=1), by_pixel * halves
        scale = 2 * num_views / self.num_pixels
        attraction, of_mask = scale * settings.weight_clustering, np.zeros(means.shape)
        of_half = np.zeros(halves.shape)
        if settings.weight_instance:
            _, by_means = instance_term(means, relations, settings)
            of_mask += settings.weight_instance * num_views / self.num_instance * by_means
        if settings.weight_part:
            _, (by_means, by_half, by_rest) = part_term(
                means, halves[:, 1], halves[:, 0], relations, settings
            )
            share = settings.weight_part * num_views * len(relations[0].parts) / self.num_part
            of_mask += share * by_means
            of_half += share * np.stack([by_rest, by_half], axis=1)
        of_mask = by_mask * of_mask - attraction * means
        if settings.language == "squared":
            attraction += scale
            of_mask -= scale * latents
        return attraction, (of_mask[:, None] + by_pixel * of_half).reshape(-1, latents.shape[1])


def train(
    views: list[LabelledView],  # at least one; their weights are replaced by padded rows
    latents: Float32[np.ndarray, "M D"],
    num_gaussians: int,
    settings: TrainedSettings,
    seed: int,
    terms: HierarchyTerms | None = None,  # of the same views
) -> Float32[np.ndarray, "N 3 D"]:
    """Train with Adam from zeros, on a random view per step; each view is used once before a repeat.

    With `terms`, the levels take steps in turn. Level l draws its views with the seed `seed` + l. Levels
    without a labelled pixel stay 0.
    """
    channels = latents.shape[1]
    wide = channels + -channels % WIDTH

    def padded(rows: np.ndarray) -> np.ndarray:
        out = np.zeros((len(rows), wide), np.float32)
        out[:, :channels] = rows
        return out.reshape(-1)

    features = np.zeros((len(LEVELS), num_gaussians, wide), np.float32)
    gradient, levels = np.zeros(num_gaussians * wide, np.float32), []
    for level in LEVELS:
        if labelled := [number for number, view in enumerate(views) if len(view.at(level))]:
            order = in_random_order(labelled, np.random.default_rng(seed + level.index), settings.steps)
            levels.append((level, Adam(features[level.index], settings.rate), order, len(labelled)))
    repeats = 1 if terms is None else 2
    codes = [padded(np.repeat(latents[view.rows], repeats, axis=0)) for view in views]
    painted = []  # labelled pixels and their labels, by view and level
    for number, view in enumerate(views):
        views[number] = replace(view, weights=padded_rows(view.weights))
        labels = view.labels if terms is None else terms.views[number].labels
        painted.append([(rows := view.at(level), labels[rows, level.index]) for level in LEVELS])
    by_l1 = terms is None or terms.settings.language == "l1"
    # Levels that don't interact are trained one after the other, because their arrays then stay in the cache.
    groups = [[member] for member in levels] if terms is None else [levels]
    turns = (member for group in groups for _ in range(settings.steps) for member in group)
    for level, adam, order, num_views in track(turns, "steps", total=settings.steps * len(levels)):
        number = next(order)
        weights, attraction, offsets = views[number].weights, 0.0, np.zeros(0, np.float32)
        if terms is not None:
            attraction, of_rows = terms.gradient(number, level, features, num_views)
            offsets = padded(of_rows)
        pixels, labels = painted[number][level.index]
        share = by_l1 / (len(pixels) * channels)
        rendered_gradient(
            *(weights.indptr, weights.indices, weights.data, pixels, labels),
            *(codes[number], np.float32(share), np.float32(attraction), offsets),
            *(wide, features[level.index].reshape(-1), gradient),
        )
        adam.step(gradient)
    return np.ascontiguousarray(features[:, :, :channels].transpose(1, 0, 2))


def fit(inputs: MethodInputs, settings: TrainedSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Train all levels, with the paper's losses for `hi_lsplat`."""
    views = labelled_views(inputs, settings.pixel_step)
    terms = HierarchyTerms.of(inputs, views, settings) if isinstance(settings, HiLSplatSettings) else None
    num_gaussians = inputs.contributions.num_gaussians
    return train(views, inputs.latents, num_gaussians, settings, seed, terms)
