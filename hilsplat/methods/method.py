"""Baseline interface: a function that computes a language field from the same artifacts as our method.

All other stages (Gaussians, masks, CLIP vectors, the scene's code, queries, protocols, tables) are shared, so
that rows of a table differ only by method.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float32, Int32

from hilsplat.base.errors import SettingsError
from hilsplat.contributions.compositing import normalised_weights
from hilsplat.contributions.mask_operator import MaskOperator
from hilsplat.contributions.rows import Contributions
from hilsplat.contributions.view_matrices import label_maps
from hilsplat.field.code import load_code, load_latents
from hilsplat.field.linear_code import LinearCode
from hilsplat.scene.cameras import Camera
from hilsplat.scene.finished import require_same
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import digests_in, load_masks
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.settings import MethodSettings
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import pixel_weights


@dataclass(frozen=True)
class MethodInputs:
    """Artifacts of a scene, read on first use.

    Attributes:
        scene_folder: scene artifact; a method may use only its train views.
        threads: rasteriser threads; results must not depend on it.
    """

    scene_folder: Path
    gaussians_ply: Path
    masks_folder: Path
    contributions_folder: Path
    autoencoder_folder: Path
    threads: int = 1

    @cached_property
    def contributions(self) -> Contributions:
        """One row per mask of all train views."""
        return Contributions.load(self.contributions_folder)

    @cached_property
    def latents(self) -> Float32[np.ndarray, "M D"]:
        """Code of each mask's CLIP vector, in the row order of the contributions."""
        return load_latents(self.autoencoder_folder, self.contributions)

    def view_weights(self, view: str) -> sp.csr_matrix:
        """Return a view's compositing weights (pixels x Gaussians), rows summing to 1, empty if uncovered."""
        gaussians, scene = self._loaded
        least = self.contributions.min_weight
        weights = pixel_weights(gaussians, scene.cameras[view], min_weight=least, threads=self.threads)
        return normalised_weights(weights)

    def view_masks(self, view: str) -> HierarchicalMasks:
        """Return the masks of a view, checked to match the contributions."""
        return load_masks(self.masks_folder, view, digests_in(self.contributions_folder))

    def view_labels(self, view: str) -> Int32[np.ndarray, "P 3"]:
        """Return the row of the view's painted mask at each pixel and level, -1 for none."""
        return label_maps(self.view_masks(view))

    def view_camera(self, view: str) -> Camera:
        """Return a view's camera."""
        return self._loaded[1].cameras[view]

    def seen(self) -> Bool[np.ndarray, "N 3"]:
        """Return whether a mask of the level contains the Gaussian."""
        masks = MaskOperator.of(self.contributions.matrix("A"), self.contributions.level)
        return masks.spread(np.ones((len(self.latents), 1), np.float32))[:, :, 0] > 0

    def linear_code(self, method: str) -> LinearCode:
        """Return the scene's code, for a method whose training or averages need CLIP vectors themselves.

        Raises:
            SettingsError: the code is a network, whose numbers cannot be averaged like vectors.
        """
        code = load_code(self.autoencoder_folder)
        if not isinstance(code, LinearCode):
            raise SettingsError(
                f"method {method} needs a linear code",
                expected="autoencoder.code pca",
                found="autoencoder.code network",
                fix="give its variant autoencoder: {code: pca, latent: 64, targets: mask}",
            )
        return code

    @cached_property
    def _loaded(self) -> tuple:
        scene = Scene.load(self.scene_folder)
        require_same("contributions", scene.name, self.gaussians_ply, self.contributions.gaussians_sha256)
        return load_ply(self.gaussians_ply), scene


Fit = Callable[[MethodInputs, MethodSettings, int], np.ndarray]


@dataclass(frozen=True)
class Method:
    """One baseline.

    Attributes:
        name: key in the registry, and value of `method.name` in a variant.
        title: name in tables.
        source: repository or paper that it follows; departures are in the module's docstring.
        fit: maps (inputs, settings, seed) to the features of every Gaussian and level, (N, 3, D).
    """

    name: str
    title: str
    source: str
    fit: Fit
