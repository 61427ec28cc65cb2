"""Stage `method`: compute a language field with a baseline, from the same artifacts as our method.

Everything else (Gaussians, masks, CLIP vectors, the scene's code, queries, protocols, tables) is shared, so
that table rows differ only in the method.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float32, Int32, Int64

from hilsplat.base.errors import ArtifactError, SettingsError
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.lineage import require_made_from, sha256_of_file
from hilsplat.base.plugins import load
from hilsplat.base.progress import stage_log, track
from hilsplat.baselines import MethodSettings, method_of
from hilsplat.contributions.compositing import normalised_weights
from hilsplat.contributions.mask_operator import MaskOperator
from hilsplat.contributions.rows import Contributions
from hilsplat.contributions.view_matrices import label_maps
from hilsplat.field.code import LanguageField, LinearCode, autoencoder_file, load_code, load_latents
from hilsplat.scene.cameras import Camera
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import digests_in, load_masks
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import pixel_weights


@dataclass(frozen=True)
class MethodInputs:
    """Artifacts of a scene, read on first use."""

    scene_folder: Path  # scene artifact; a method may use only its training views
    gaussians_ply: Path
    masks_folder: Path
    contributions_folder: Path
    autoencoder_folder: Path
    coverage_tree_folder: Path
    threads: int = 1  # rasteriser threads; results must not depend on this number

    @cached_property
    def contributions(self) -> Contributions:
        """Contributions, with one row per mask of all training views."""
        return Contributions.load(self.contributions_folder)

    @cached_property
    def latents(self) -> Float32[np.ndarray, "M D"]:
        """Code of each mask's CLIP vector, in the row order of the contributions."""
        return load_latents(self.autoencoder_folder, self.contributions)

    def view_weights(self, view: str, step: int = 1) -> sp.csr_matrix:
        """Return a view's compositing weights (pixels x Gaussians); rows sum to 1, or 0 if uncovered.

        Rows of pixels outside every `step`-th row and column are 0.
        """
        gaussians, scene = self._loaded
        least, threads = self.contributions.min_weight, self.threads
        weights = pixel_weights(gaussians, scene.cameras[view], min_weight=least, threads=threads, step=step)
        return normalised_weights(weights)

    def view_labels(self, view: str) -> Int32[np.ndarray, "P 3"]:
        """Return the row of the view's painted mask at each pixel and level, -1 for none.

        The masks are checked to match the contributions.
        """
        return label_maps(load_masks(self.masks_folder, view, digests_in(self.contributions_folder)))

    def view_camera(self, view: str) -> Camera:
        return self._loaded[1].cameras[view]

    def no_features(self) -> Float32[np.ndarray, "N 3 D"]:
        return np.zeros((self.contributions.num_gaussians, len(LEVELS), self.latents.shape[1]), np.float32)

    def seen(self) -> Bool[np.ndarray, "N 3"]:
        """Return whether each Gaussian is visible in any mask of each level."""
        masks = MaskOperator(self.contributions.matrix("A"), self.contributions.level)
        return masks.spread(np.ones((len(self.latents), 1), np.float32))[:, :, 0] > 0

    def linear_code(self, method: str) -> LinearCode:
        """Return the scene's code, for methods that average codes (`Method.averages`).

        Raises:
            SettingsError: the code is a network, whose latents cannot be averaged like vectors.
        """
        code = load_code(self.autoencoder_folder)
        if not isinstance(code, LinearCode):
            raise SettingsError(
                f"method {method} needs a linear code",
                expected="autoencoder.code pca",
                found="autoencoder.code network",
                fix="set autoencoder: {code: pca, latent: 64, targets: mask} in the variant",
            )
        return code

    @cached_property
    def _loaded(self) -> tuple[Gaussians, Scene]:
        scene = Scene.load(self.scene_folder)
        recorded, digest = self.contributions.gaussians_sha256, sha256_of_file(self.gaussians_ply)
        require_made_from(self.contributions.folder, self.gaussians_ply, recorded, digest)
        return load_ply(self.gaussians_ply), scene


Fit = Callable[[MethodInputs, Any, int], np.ndarray]
"""A baseline: maps inputs, settings and a seed to the features of every Gaussian and level, (N, 3, D)."""


def run_method(inputs: MethodInputs, out: Path, settings: MethodSettings, seed: int) -> None:
    """Compute the field of a scene with a baseline, and write it to `out`, a `field.safetensors` file.

    Raises:
        SettingsError: there is no such method, or it averages codes and the scene's code is a network.
        ArtifactError: the method returned features of the wrong shape or non-finite values.
    """
    method = method_of(settings.name)
    if method.averages:
        inputs.linear_code(settings.name)
    contributions = inputs.contributions
    fit: Fit = load(method.fit)
    with stage_log(f"method {settings.name}", Path(inputs.scene_folder).parent.name) as counts:
        features = np.asarray(fit(inputs, settings, seed), dtype=np.float32)
        expected = (contributions.num_gaussians, len(LEVELS), inputs.latents.shape[1])
        if features.shape != expected or not np.isfinite(features).all():
            raise ArtifactError(
                f"method {settings.name} did not return a language field",
                expected=f"finite features of shape {expected}",
                found=f"shape {features.shape}, {np.count_nonzero(~np.isfinite(features))} non-finite",
                fix=f"correct {method.fit}",
            )
        digest = sha256_of_file(autoencoder_file(inputs.autoencoder_folder))
        LanguageField(features, contributions.gaussians_sha256, digest).save(out)
        counts |= {"Gaussians": len(features), "latent": expected[2]}


@dataclass(frozen=True)
class LabelledView:
    """Covered pixels of one view that are labelled at any level, on the grid of `method.pixel_step`."""

    number: int  # index of the view in the contributions
    rows: Int64[np.ndarray, " m"]  # rows of the view's masks in the contributions
    weights: sp.csr_matrix  # compositing weights (pixels x Gaussians), rows summing to 1
    # row, among the view's masks, of the mask painted at each pixel and level, -1 for none
    labels: Int32[np.ndarray, "p 3"]
    xy: Int64[np.ndarray, "p 2"]  # column and row of each pixel, px

    def chosen(self, pixels: Int64[np.ndarray, " q"]) -> "LabelledView":
        return replace(self, weights=self.weights[pixels], labels=self.labels[pixels], xy=self.xy[pixels])

    def at(self, level: Level) -> Int64[np.ndarray, " q"]:
        return np.flatnonzero(self.labels[:, level.index] >= 0)


def labelled_views(inputs: MethodInputs, pixel_step: int) -> list[LabelledView]:
    """Return each training view's labelled pixels, if any, in every `pixel_step`-th row and column.

    Raises:
        ArtifactError: no view has a labelled pixel.
    """
    views = []
    rows = inputs.contributions.rows_of_views()
    for number, name in enumerate(track(list(inputs.contributions.views), "weights of views")):
        weights, labels = inputs.view_weights(name, pixel_step), inputs.view_labels(name)
        width = inputs.view_camera(name).size_hw[1]
        covered = np.flatnonzero(np.diff(weights.indptr))
        pixels = covered[(labels[covered] >= 0).any(axis=1)]
        if len(pixels):
            xy = np.stack([pixels % width, pixels // width], axis=1)
            views.append(LabelledView(number, rows[number], weights[pixels], labels[pixels], xy))
    if not views:
        raise ArtifactError(
            f"no training view has a labelled pixel on a {pixel_step} px grid",
            fix="reduce method.pixel_step, or loosen masks.predicted_iou_min and rerun the masks stage",
        )
    return views
