"""Train the field as in the paper: render a view, compute its losses, and update the features with Adam.

This is the slow reference for the sparse solver (`solver.solve_field`). Both minimise the same objective,
term by term. Here each step computes every term on the rendered maps of one random view; the mean over all
views is the solver's objective.

Departs from `train.py` of minghanqin/LangSplat, whose loop it follows: one run trains all three levels on the
same views; rendered features are divided by alpha, so that losses and queries use the same features; thinly
covered pixels are ignored; features of Gaussians are not scaled to unit length before they are blended.
"""

import logging
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float32, Float64, Int64

from hilsplat.base.levels import LEVELS
from hilsplat.base.lineage import require_made_from, sha256_of_file
from hilsplat.contributions.compositing import MIN_ALPHA
from hilsplat.contributions.rows import Contributions
from hilsplat.contributions.view_matrices import label_maps, painted_indicator, random_half
from hilsplat.field.adam import Adam, in_random_order
from hilsplat.field.contrast import Contrast, ViewRelations, instance_term, num_compared, part_term
from hilsplat.field.problem import QuadraticProblem
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import digests_in, load_masks
from hilsplat.settings import FieldSettings
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import draw

logger = logging.getLogger(__name__)

CURVE_POINTS = 30  # number of points of the loss curve in the report


@dataclass(frozen=True)
class ViewTargets:
    """Masks of one view, restricted to the view's covered pixels."""

    rows: Int64[np.ndarray, " m"]  # rows of the view's masks in the contributions
    level: Int64[np.ndarray, " m"]  # level of each mask, 0 to 2
    painted: sp.csr_matrix  # indicator (masks x pixels) of the pixels that show each mask
    half: sp.csr_matrix  # indicator of the shown pixels that are in the random half
    relations: ViewRelations  # masks compared by L_ins and L_part


def view_losses(
    shown: Float64[np.ndarray, "P 3 D"],  # rendered features divided by alpha
    view: ViewTargets,
    latents: Float32[np.ndarray, "M D"],  # latent of every mask of the scene
    settings: FieldSettings,
    shares: tuple[int, float, int, int],  # totals of the scene: views, labelled pixels, `num_compared`
) -> tuple[dict[str, float], Float64[np.ndarray, "P 3 D"]]:
    """Compute all losses on the rendered maps of one view, and the gradient of their weighted sum.

    The losses are returned unweighted, by name, and scaled so that their mean over all views equals the
    solver's objective. The gradient is 0 where no mask is painted.
    """
    num_views, num_pixels, num_instance, num_part = shares
    pixels, levels, channels = shown.shape
    flat = shown.reshape(pixels, levels * channels)
    count = np.diff(view.painted.indptr).astype(np.float64)[:, None]
    half_count = np.diff(view.half.indptr).astype(np.float64)[:, None]
    of_level = np.arange(len(view.rows)), view.level
    sums, half_sums = (
        (matrix @ flat).reshape(-1, levels, channels)[of_level] for matrix in (view.painted, view.half)
    )
    averages = sums / np.maximum(count, 1)
    mask_of = np.full((pixels, levels), -1)
    of_entry = np.repeat(of_level[0], np.diff(view.painted.indptr))
    mask_of[view.painted.indices, view.level[of_entry]] = of_entry
    inside = mask_of >= 0
    at, painted = mask_of[inside], shown[inside]
    gradient = np.zeros_like(shown)
    scale = num_views / num_pixels
    to_latent, to_mean = painted - latents[view.rows[at]], painted - averages[at]
    losses = {"clustering": scale * float(np.square(to_mean).sum())}
    by_pixel = 2 * scale * settings.weight_clustering * to_mean
    if settings.language == "l1":
        share = 1 / (pixels * channels)  # LangSplat averages over all pixels; unlabelled ones add 0
        losses["language"] = share * float(np.abs(to_latent).sum())
        by_pixel += settings.weight_language * share * np.sign(to_latent)
    else:
        losses["language"] = scale * float(np.square(to_latent).sum())
        by_pixel += 2 * scale * settings.weight_language * to_latent
    means, halves, others = (np.zeros((len(latents), channels)) for _ in range(3))
    rest = np.maximum(count - half_count, 1)
    means[view.rows] = averages
    halves[view.rows] = half_sums / np.maximum(half_count, 1)
    others[view.rows] = (sums - half_sums) / rest
    in_instance, in_part = num_compared([view.relations])
    losses["instance"], by_means = instance_term(means, [view.relations], settings)
    losses["part"], (own_part, by_half, by_other) = part_term(
        means, halves, others, [view.relations], settings
    )
    losses["instance"] *= num_views * in_instance / max(num_instance, 1)
    losses["part"] *= num_views * in_part / max(num_part, 1)
    ins = settings.weight_instance * num_views * in_instance / max(num_instance, 1)
    part = settings.weight_part * num_views * in_part / max(num_part, 1)
    of_mask = (ins * by_means + part * own_part)[view.rows] / np.maximum(count, 1)
    of_other = part * by_other[view.rows] / rest
    of_half = part * by_half[view.rows] / np.maximum(half_count, 1) - of_other
    by_pixel += (of_mask + of_other)[at]
    gradient[inside] = by_pixel
    in_half = np.zeros((pixels, levels), bool)
    in_half[view.half.indices, np.repeat(view.level, np.diff(view.half.indptr))] = True
    gradient[in_half] += of_half[mask_of[in_half]]
    return losses, gradient


def train_by_rendering(
    problem: QuadraticProblem,
    contrast: Contrast,
    contributions: Contributions,
    rendered: tuple[Path, Path, Path],  # scene, its frozen Gaussians, and masks
    seed: int,
    threads: int,
) -> tuple[Float32[np.ndarray, "N 3 D"], dict[str, object]]:
    """Run Adam from the field's start, one random view per step; all are used once before any is repeated.

    Returns:
        the features, and a report with the loss curve and every term of the objective before and after.

    Raises:
        MisalignedArtifactError: the contributions belong to different Gaussians or masks.
    """
    settings, (scene_folder, gaussians_ply, masks_folder) = contrast.settings, rendered
    scene = Scene.load(scene_folder)
    recorded, digest = contributions.gaussians_sha256, sha256_of_file(gaussians_ply)
    require_made_from(contributions.folder, gaussians_ply, recorded, digest)
    gaussians = load_ply(gaussians_ply)
    features = problem.lifted.reshape(len(gaussians), -1).astype(np.float32)
    channels = features.shape[1] // len(LEVELS)
    shares = len(contributions.views), problem.total_pixels, *num_compared(contrast.relations)
    report: dict[str, object] = {"start": problem.terms(problem.lifted) | contrast.values(problem.lifted)}
    targets: dict[int, ViewTargets] = {}
    adam, curve, recent = Adam(features, settings.rate), list[dict[str, float]](), list[float]()
    log_every, begin = max(1, settings.iterations // CURVE_POINTS), time.perf_counter()
    ridge = 2 * settings.ridge / problem.total_pixels * problem.mass[:, :, None]

    def targets_of(number: int, covered: Bool[np.ndarray, " P"]) -> ViewTargets:
        view = contributions.views[number]
        masks = load_masks(masks_folder, view, digests_in(contributions.folder))
        labels = label_maps(masks)
        painted, half = (
            painted_indicator(labels, len(masks), pixels)
            for pixels in (covered, covered & random_half(view, len(labels)))
        )
        rows, relations = contributions.rows_of_views()[number], contrast.relations[number]
        return ViewTargets(rows, masks.level.astype(np.int64) - 1, painted, half, relations)

    views = range(len(contributions.views))
    order = in_random_order(views, np.random.default_rng(seed), settings.iterations)
    for step, number in enumerate(order, start=1):
        camera = scene.cameras[contributions.views[number]]
        render = draw(gaussians, camera, 0, features=features, threads=threads)
        if number not in targets:
            targets[number] = targets_of(number, render.alpha.reshape(-1) >= MIN_ALPHA)
        alpha = np.maximum(render.alpha.reshape(-1, 1), 1e-6)
        blended = (render.image[..., 3:].reshape(len(alpha), -1) / alpha).astype(np.float64)
        maps = blended.reshape(len(alpha), len(LEVELS), channels)
        losses, by_maps = view_losses(maps, targets[number], problem.latents, settings, shares)
        by_image = np.zeros((*render.alpha.shape, 3 + features.shape[1]), np.float32)
        by_image[..., 3:] = (by_maps.reshape(blended.shape) / alpha).reshape(*render.alpha.shape, -1)
        gradient = render.gradients(by_image, np.zeros_like(render.alpha)).features
        if settings.ridge:
            pull = ridge * (features.reshape(problem.lifted.shape) - problem.lifted)
            gradient = gradient + pull.reshape(features.shape)
        adam.step(gradient)
        recent.append(sum(getattr(settings, f"weight_{name}") * value for name, value in losses.items()))
        if step % log_every == 0 or step == settings.iterations:
            seconds = round(time.perf_counter() - begin, 2)
            curve.append({"step": step, "loss": float(np.mean(recent)), "seconds": seconds})
            logger.info("literal trainer: step %d, loss %.5f", step, curve[-1]["loss"])
            recent = []
    trained = features.reshape(problem.lifted.shape)
    report["trained"] = problem.terms(trained) | contrast.values(trained)
    return trained, {**report, "curve": curve}
