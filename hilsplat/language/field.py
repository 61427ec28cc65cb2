"""The language field: one latent per Gaussian and level, solved with geometry frozen.

With the rendered map M = W F, the mask means A F, the areas n and the mask latents h (see
`contributions`), and all sums divided by the number of labelled pixels:

- language loss (squared regression): tr F'GF - 2 sum n h.(AF) + sum n |h|^2
- clustering loss L_h (Eq. 2):        tr F'GF - sum n |AF|^2
- instance and part losses (Eq. 3-5): functions of the mask means alone
- ridge: sum of visible mass x |F - F_lifted|^2

The first, second and fourth are one quadratic form, solved by a few conjugate-gradient steps from
the lifted average; the contrastive losses are added by L-BFGS. More steps fit the noise of mask
borders, so both stop early.
"""

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors.numpy
import scipy.sparse as sp
import torch
from jaxtyping import Float, Float32, Float64, Int64
from safetensors import SafetensorError, safe_open
from torch import Tensor

from hilsplat.base.artifacts import atomic_path, read_index, read_npz, sha256_of_file, write_json
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.base.progress import stage_log
from hilsplat.language.autoencoder import METADATA_KEY, autoencoder_file, load_latents, one_torch_thread
from hilsplat.language.losses.distances import common_ancestor_depth
from hilsplat.language.losses.instance import (
    instance_loss_literal,
    instance_loss_logratio,
    instance_loss_tree,
)
from hilsplat.language.losses.part import part_loss_disentangle, part_loss_literal
from hilsplat.language.mask_rows import Contributions
from hilsplat.language.quadratic import Quadratic, level_mass
from hilsplat.settings import LanguageSettings

logger = logging.getLogger(__name__)

LBFGS_MEMORY = 8
SUFFICIENT_DECREASE = 1e-4
MAX_HALVINGS = 12


@dataclass(frozen=True)
class LanguageField:
    """One latent per Gaussian and level.

    Attributes:
        features: N Gaussians, L = 3 levels coarse to fine, D latent numbers; 0 where unseen.
        gaussians_sha256: digest of the PLY they belong to.
        autoencoder_sha256: digest of the autoencoder that decodes them.
    """

    features: Float32[np.ndarray, "N 3 D"]
    gaussians_sha256: str
    autoencoder_sha256: str

    def save(self, path: Path) -> None:
        """Write `language.safetensors` atomically; the same field gives the same bytes."""
        about = {"gaussians_sha256": self.gaussians_sha256, "autoencoder_sha256": self.autoencoder_sha256}
        metadata = {METADATA_KEY: json.dumps(about, sort_keys=True)}
        features = np.ascontiguousarray(self.features)
        with atomic_path(path) as temporary:
            safetensors.numpy.save_file({"features": features}, temporary, metadata=metadata)

    @staticmethod
    def load(path: Path) -> "LanguageField":
        """Read `language.safetensors`.

        Raises:
            ArtifactError: the file is missing, damaged or no language field.
        """
        try:
            with safe_open(path, framework="np") as file:
                about = json.loads(file.metadata()[METADATA_KEY])
                return LanguageField(file.get_tensor("features"), **about)
        except (FileNotFoundError, SafetensorError, KeyError, TypeError) as error:
            raise ArtifactError(
                f"{path} cannot be read: {error}", fix="run the language stage again"
            ) from error


@dataclass(frozen=True)
class MaskOperator:
    """A for all levels: features of Gaussians to means of masks, and back.

    Attributes:
        rows: rows of the M masks at each level.
        forward: A of each level (M_l x N).
        backward: its transpose.
    """

    rows: tuple[Int64[np.ndarray, " _"], ...]
    forward: tuple[sp.csr_matrix, ...]
    backward: tuple[sp.csr_matrix, ...]

    @staticmethod
    def of(A: sp.csr_matrix, level: np.ndarray) -> "MaskOperator":
        """Split A by the level of its rows."""
        rows = tuple(np.flatnonzero(level == int(each)) for each in LEVELS)
        parts = tuple(A[chosen].tocsr() for chosen in rows)
        return MaskOperator(rows, parts, tuple(part.T.tocsr() for part in parts))

    def means(self, features: Float32[np.ndarray, "N 3 D"]) -> Float32[np.ndarray, "M D"]:
        """A F: mean rendered feature of each mask at its level."""
        out = np.zeros((sum(map(len, self.rows)), features.shape[2]), np.float32)
        for index, (rows, part) in enumerate(zip(self.rows, self.forward, strict=True)):
            out[rows] = part @ np.ascontiguousarray(features[:, index])
        return out

    def spread(self, values: Float32[np.ndarray, "M D"]) -> Float32[np.ndarray, "N 3 D"]:
        """A' x at each level: the adjoint of `means`."""
        parts = [part @ values[rows] for rows, part in zip(self.rows, self.backward, strict=True)]
        return np.ascontiguousarray(np.stack(parts, axis=1))


@dataclass(frozen=True)
class QuadraticProblem:
    """Language loss, clustering loss and ridge: everything but the contrastive losses.

    Attributes:
        masks: A.
        quadratic: G or W.
        mass: G 1, the visible mass of each Gaussian at each level, px.
        pixels: n.
        latents: h.
        lifted: the lifted average, towards which the ridge pulls.
        weights: of the language loss, the clustering loss and the ridge.
    """

    masks: MaskOperator
    quadratic: Quadratic
    mass: Float32[np.ndarray, "N 3"]
    pixels: Float32[np.ndarray, " M"]
    latents: Float32[np.ndarray, "M D"]
    lifted: Float32[np.ndarray, "N 3 D"]
    weights: tuple[float, float, float]

    @staticmethod
    def of(
        masks: MaskOperator,
        quadratic: Quadratic,
        pixels: Float32[np.ndarray, " M"],
        latents: Float32[np.ndarray, "M D"],
        weights: tuple[float, float, float],
    ) -> "QuadraticProblem":
        """Add mass and lifted average."""
        mass = level_mass(quadratic)
        lifted = lifted_average(masks, mass, pixels, latents)
        return QuadraticProblem(masks, quadratic, mass, pixels, latents, lifted, weights)

    @property
    def total_pixels(self) -> float:
        """Labelled pixels of all levels: the divisor that turns sums into means."""
        return max(float(self.pixels.sum(dtype=np.float64)), 1.0)

    def hessian_product(self, features: Float32[np.ndarray, "N 3 D"]) -> Float32[np.ndarray, "N 3 D"]:
        """Half the Hessian of the sums, times the features."""
        language, clustering, ridge = self.weights
        out = np.float32(language + clustering) * self.quadratic.product(features)
        if clustering:
            means = self.masks.means(features)
            out -= np.float32(clustering) * self.masks.spread(self.pixels[:, None] * means)
        return out + np.float32(ridge) * self.mass[:, :, None] * features

    def right_side(self) -> Float32[np.ndarray, "N 3 D"]:
        """Where half the gradient of the sums vanishes: hessian_product(F) = right_side."""
        language, _, ridge = self.weights
        target = np.float32(language) * self.masks.spread(self.pixels[:, None] * self.latents)
        return target + np.float32(ridge) * self.mass[:, :, None] * self.lifted

    def terms(self, features: Float32[np.ndarray, "N 3 D"]) -> dict[str, float]:
        """Unweighted means over labelled pixels of the language loss, L_h and the ridge."""
        form = _dot(features, self.quadratic.product(features))
        means = self.masks.means(features).astype(np.float64)
        pixels = self.pixels[:, None].astype(np.float64)
        linear = float((pixels * means * self.latents).sum())
        constant = float((pixels * np.square(self.latents, dtype=np.float64)).sum())
        cohesion = float((pixels * means**2).sum())
        pull = features - self.lifted
        return {
            "language": (form - 2 * linear + constant) / self.total_pixels,
            "clustering": (form - cohesion) / self.total_pixels,
            "ridge": _dot(self.mass[:, :, None] * pull, pull) / self.total_pixels,
        }


def lifted_average(
    masks: MaskOperator,
    mass: Float32[np.ndarray, "N 3"],
    pixels: Float32[np.ndarray, " M"],
    latents: Float32[np.ndarray, "M D"],
) -> Float32[np.ndarray, "N 3 D"]:
    """Average of the latents of the pixels that show a Gaussian, weighted by how much they show it.

    Exact, one sparse product, and within about a tenth of the regression's optimum. Gaussians that
    no labelled pixel shows get 0.
    """
    sums = masks.spread(pixels[:, None] * latents)
    return np.where(mass[:, :, None] > 0, sums / np.maximum(mass, 1e-12)[:, :, None], np.float32(0))


def conjugate_gradient(
    problem: QuadraticProblem, start: Float32[np.ndarray, "N 3 D"], steps: int
) -> np.ndarray:
    """Minimise the quadratic part by a few steps, preconditioned by the visible mass.

    Levels and channels do not interact, so each has its own step sizes. Dot products are summed in
    float64 in a fixed order.
    """
    scale = problem.mass[:, :, None] * np.float32(max(sum(problem.weights), 1e-12))
    inverse = np.where(scale > 0, 1 / np.maximum(scale, 1e-20), 0).astype(np.float32)
    features = start.copy()
    residual = problem.right_side() - problem.hessian_product(features)
    step = inverse * residual
    direction = step.copy()
    power = _channel_dot(residual, step)
    for _ in range(steps):
        curved = problem.hessian_product(direction)
        curvature = _channel_dot(direction, curved)
        length = _ratio(power, curvature)
        features += length * direction
        residual -= length * curved
        step = inverse * residual
        before, power = power, _channel_dot(residual, step)
        direction = (
            step
            + np.where(before > 0, power / np.where(before > 0, before, 1), 0).astype(np.float32) * direction
        )
    return features


@dataclass(frozen=True)
class ViewRelations:
    """What the contrastive losses need of one view.

    Attributes:
        rows: masks that take part, all levels.
        depth: depth of the deepest common ancestor of every two of them.
        level: their levels.
        part_rows: for PART and SUBPART, the masks that take part.
        part_parent: the row of each one's parent in the coverage tree, -1 for none.
    """

    rows: Tensor
    depth: Tensor
    level: Tensor
    part_rows: tuple[Tensor, ...]
    part_parent: tuple[Tensor, ...]


def view_relations(
    contributions: Contributions, parents: dict[str, np.ndarray], settings: LanguageSettings
) -> list[ViewRelations]:
    """Choose the masks of each view that take part in the contrastive losses, largest first.

    Args:
        contributions: rows.
        parents: per view, the coverage tree's parent of each mask (row among the view's masks).
        settings: least size and greatest number of masks.
    """
    relations = []
    for number, view in enumerate(contributions.views):
        rows = np.flatnonzero(contributions.view == number)
        pixels = contributions.pixels[rows]
        half = contributions.half_pixels[rows]
        parent = parents[view]
        usable = (pixels >= settings.min_mask_px) & (half > 0) & (half < pixels)
        chosen: dict[Level, np.ndarray] = {}
        for level in LEVELS:
            local = np.flatnonzero(usable & (contributions.level[rows] == int(level)))
            order = local[np.lexsort((local, -pixels[local]))][: settings.max_masks_per_level]
            chosen[level] = np.sort(order)
        every = np.sort(np.concatenate(list(chosen.values())))
        depth = common_ancestor_depth(parent)
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


def contrastive_terms(
    means: Float[Tensor, "M D"],
    halves: Float[Tensor, "M D"],
    other_halves: Float[Tensor, "M D"],
    relations: list[ViewRelations],
    settings: LanguageSettings,
) -> tuple[Tensor, Tensor]:
    """L_ins and L_part, averaged over the views (and levels) that have masks to compare.

    Args:
        means: mean feature of each mask.
        halves: mean over a random half of its pixels.
        other_halves: mean over the other pixels.
        relations: per view.
        settings: which reading of each loss, Omega and tau.
    """
    instance, part = [], []
    for view in relations:
        if len(view.rows) >= 2:
            chosen = means[view.rows]
            if settings.instance_mode == "literal":
                instance.append(instance_loss_literal(chosen, view.level, settings.omega))
            elif settings.instance_mode == "tree":
                instance.append(instance_loss_tree(chosen, view.depth, settings.omega))
            else:
                instance.append(instance_loss_logratio(chosen, view.depth, settings.omega))
        for rows, parent in zip(view.part_rows, view.part_parent, strict=True):
            has_parent = parent != NONE
            if len(rows) < 2 or not has_parent.any():
                continue
            parent_means = means[parent.clamp(min=0)]
            if settings.part_mode == "literal":
                part.append(part_loss_literal(means[rows], parent, parent_means, settings.tau))
            else:
                part.append(
                    part_loss_disentangle(
                        halves[rows], other_halves[rows], has_parent.long(), parent_means, settings.tau
                    )
                )
    zero = means.sum() * 0
    return (
        torch.stack(instance).mean() if instance else zero,
        torch.stack(part).mean() if part else zero,
    )


@dataclass(frozen=True)
class Contrast:
    """The contrastive losses as functions of the field.

    Attributes:
        masks: A.
        half_masks: A over a random half of each mask's pixels.
        pixels: n.
        half_pixels: pixels of the halves.
        relations: per view.
        settings: readings and weights.
    """

    masks: MaskOperator
    half_masks: MaskOperator
    pixels: Float32[np.ndarray, " M"]
    half_pixels: Float32[np.ndarray, " M"]
    relations: list[ViewRelations]
    settings: LanguageSettings

    def terms(
        self, features: Float32[np.ndarray, "N 3 D"], weights: tuple[float, float]
    ) -> tuple[dict[str, float], Float32[np.ndarray, "N 3 D"]]:
        """Unweighted L_ins and L_part, and the gradient of their weighted sum."""
        means = torch.from_numpy(self.masks.means(features)).double().requires_grad_()
        halves = torch.from_numpy(self.half_masks.means(features)).double().requires_grad_()
        n = torch.from_numpy(self.pixels).double()[:, None]
        half = torch.from_numpy(self.half_pixels).double()[:, None]
        others = (n * means - half * halves) / (n - half).clamp(min=1)
        instance, part = contrastive_terms(means, halves, others, self.relations, self.settings)
        total = weights[0] * instance + weights[1] * part
        by_means, by_halves = torch.autograd.grad(total, (means, halves), allow_unused=True)
        gradient = self.masks.spread(by_means.float().numpy())
        if by_halves is not None:
            gradient += self.half_masks.spread(by_halves.float().numpy())
        return {"instance": float(instance.detach()), "part": float(part.detach())}, gradient


Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]


def lbfgs(objective: Objective, start: np.ndarray, steps: int, first_step: float) -> np.ndarray:
    """Limited-memory BFGS with step halving; every sum is taken in a fixed order.

    Args:
        objective: value and gradient at a point.
        start: where to begin.
        steps: iterations; each costs one evaluation unless steps must be halved.
        first_step: inverse curvature assumed before anything is known.
    """
    point = start
    value, gradient = objective(point)
    memory: list[tuple[np.ndarray, np.ndarray, float]] = []
    for _ in range(steps):
        direction = -_two_loops(gradient, memory, first_step)
        slope = _dot(direction, gradient)
        if slope >= 0:
            break
        length = 1.0
        for _halving in range(MAX_HALVINGS):
            candidate = point + np.float32(length) * direction
            new_value, new_gradient = objective(candidate)
            if new_value <= value + SUFFICIENT_DECREASE * length * slope:
                break
            length /= 2
        else:
            break
        moved, turned = candidate - point, new_gradient - gradient
        curvature = _dot(moved, turned)
        if curvature > 0:
            memory = [*memory, (moved, turned, curvature)][-LBFGS_MEMORY:]
        point, value, gradient = candidate, new_value, new_gradient
    return point


def solve_field(
    problem: QuadraticProblem, contrast: Contrast, settings: LanguageSettings
) -> tuple[Float32[np.ndarray, "N 3 D"], dict[str, object]]:
    """Lifted average, conjugate gradient, then L-BFGS where a contrastive weight is on.

    Returns:
        the features, and a report: every term before and after, and gradient norms at the lift.
    """
    weights = (settings.weight_instance, settings.weight_part)
    total = problem.total_pixels
    # The variables of L-BFGS are scaled by the root of the mass: the quadratic part is then about round.
    root = np.sqrt(problem.mass)[:, :, None]
    inverse_root = np.where(root > 0, 1 / np.maximum(root, 1e-10), 0).astype(np.float32)
    right = problem.right_side()

    def objective(scaled: np.ndarray) -> tuple[float, np.ndarray]:
        features = scaled * inverse_root
        curved = problem.hessian_product(features)
        value = (_dot(features, curved) - 2 * _dot(features, right)) / total
        terms, gradient = contrast.terms(features, weights)
        value += weights[0] * terms["instance"] + weights[1] * terms["part"]
        gradient = gradient + np.float32(2 / total) * (curved - right)
        return value, gradient * inverse_root

    lifted = problem.lifted
    report: dict[str, object] = {
        "lifted": problem.terms(lifted) | contrast.terms(lifted, weights)[0],
        "gradient_norms": gradient_norms(problem, contrast, inverse_root),
    }
    features = lifted
    if settings.cg_steps and any(problem.weights):
        features = conjugate_gradient(problem, lifted, settings.cg_steps)
        report["after_cg"] = problem.terms(features) | contrast.terms(features, weights)[0]
    if any(weights) and settings.lbfgs_steps:
        first_step = total / (2 * max(sum(problem.weights), 1e-3))
        features = lbfgs(objective, features * root, settings.lbfgs_steps, first_step) * inverse_root
        report["after_lbfgs"] = problem.terms(features) | contrast.terms(features, weights)[0]
    return features.astype(np.float32), report


def gradient_norms(
    problem: QuadraticProblem, contrast: Contrast, inverse_root: Float32[np.ndarray, "N 3 1"]
) -> dict[str, float]:
    """Norm of each unweighted term's gradient at the lifted average, in mass-scaled variables."""
    lifted, factor = problem.lifted, np.float32(2 / problem.total_pixels)
    curved = problem.quadratic.product(lifted)
    means = problem.masks.means(lifted)
    gradients = {
        "language": factor * (curved - problem.masks.spread(problem.pixels[:, None] * problem.latents)),
        "clustering": factor * (curved - problem.masks.spread(problem.pixels[:, None] * means)),
        "instance": contrast.terms(lifted, (1.0, 0.0))[1],
        "part": contrast.terms(lifted, (0.0, 1.0))[1],
    }
    return {name: float(np.sqrt(_dot(g * inverse_root, g * inverse_root))) for name, g in gradients.items()}


def run_language(
    contributions_folder: Path,
    tree_folder: Path,
    autoencoder_folder: Path,
    out: Path,
    settings: LanguageSettings,
    seed: int,
    threads: int,
) -> None:
    """Solve the language field of a scene: `language.safetensors` and `language.report.json` beside it.

    The result does not depend on `seed` (nothing is random: halves of masks are fixed by the view's
    name) nor on `threads` (sums are taken by one thread, in one order).

    Raises:
        MisalignedArtifactError: coverage trees or latents belong to other masks.
    """
    contributions = Contributions.load(contributions_folder)
    scene = read_index(contributions_folder)["scene"]
    latents = load_latents(autoencoder_folder, contributions)
    parents = read_parents(tree_folder, contributions)
    with stage_log("language", scene) as counts, one_torch_thread():
        masks = MaskOperator.of(contributions.matrix("A"), contributions.level)
        half_masks = MaskOperator.of(contributions.matrix("A_half"), contributions.level)
        pixels = contributions.pixels.astype(np.float32)
        problem = QuadraticProblem.of(
            masks,
            contributions.quadratic(),
            pixels,
            latents,
            (settings.weight_language, settings.weight_clustering, settings.ridge),
        )
        contrast = Contrast(
            masks,
            half_masks,
            pixels,
            contributions.half_pixels.astype(np.float32),
            view_relations(contributions, parents, settings),
            settings,
        )
        features, report = solve_field(problem, contrast, settings)
        field = LanguageField(
            features, contributions.gaussians_sha256, sha256_of_file(autoencoder_file(autoencoder_folder))
        )
        field.save(out)
        unseen = int((problem.mass.max(axis=1) == 0).sum())
        write_json(
            report_path(out),
            {
                "scene": scene,
                "gaussians": len(features),
                "unseen_gaussians": unseen,
                "masks": len(contributions),
                "latent": features.shape[2],
                **report,
            },
        )
        counts |= {"masks": len(contributions), "Gaussians": len(features), "unseen": unseen}


def report_path(field: Path) -> Path:
    """Where the report of a field lies: `language.report.json` for `language.safetensors`."""
    return Path(field).with_suffix(".report.json")


def read_parents(tree_folder: Path, contributions: Contributions) -> dict[str, np.ndarray]:
    """Parent of each mask in the coverage tree of each view.

    Raises:
        MisalignedArtifactError: a tree has another number of masks than the contributions.
    """
    read_index(tree_folder)
    counts = np.bincount(contributions.view, minlength=len(contributions.views))
    parents = {}
    for view, count in zip(contributions.views, counts, strict=True):
        parent = read_npz(Path(tree_folder) / f"{view}.npz")["parent"]
        if len(parent) != count:
            raise MisalignedArtifactError(
                f"the coverage tree of view {view} belongs to other masks",
                expected=f"{count} masks",
                found=f"{len(parent)} in {tree_folder}",
                fix="run the tree and contributions stages again on the same masks",
            )
        parents[view] = parent
    return parents


def _dot(a: np.ndarray, b: np.ndarray) -> float:
    """Sum of products in float64 (no BLAS: its order of summation depends on the threads)."""
    return float(np.multiply(a, b, dtype=np.float64).sum())


def _channel_dot(
    a: Float32[np.ndarray, "N 3 D"], b: Float32[np.ndarray, "N 3 D"]
) -> Float64[np.ndarray, "3 D"]:
    """Sum of products over Gaussians, per level and channel."""
    return np.multiply(a, b, dtype=np.float64).sum(axis=0)


def _ratio(
    above: Float64[np.ndarray, "3 D"], below: Float64[np.ndarray, "3 D"]
) -> Float32[np.ndarray, "3 D"]:
    """Quotient, and 0 where a channel is already solved."""
    return np.where(below > 0, above / np.where(below > 0, below, 1), 0).astype(np.float32)


def _two_loops(
    gradient: np.ndarray, memory: list[tuple[np.ndarray, np.ndarray, float]], first_step: float
) -> np.ndarray:
    """Inverse Hessian times gradient, from the remembered steps."""
    result = gradient.copy()
    factors = []
    for moved, turned, curvature in reversed(memory):
        factor = _dot(moved, result) / curvature
        result -= np.float32(factor) * turned
        factors.append(factor)
    if memory:
        _, turned, curvature = memory[-1]
        result *= np.float32(curvature / _dot(turned, turned))
    else:
        result *= np.float32(first_step)
    for (moved, turned, curvature), factor in zip(memory, reversed(factors), strict=True):
        result += np.float32(factor - _dot(turned, result) / curvature) * moved
    return result
