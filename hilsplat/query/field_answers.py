"""Relevancy from a scene's decoded language field, as in the paper."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from hilsplat.base.images import to_uint8
from hilsplat.base.levels import LEVELS, Level, path_of
from hilsplat.contributions.compositing import rendered_latents
from hilsplat.embed.clip import ClipModel
from hilsplat.field.code import Code, LanguageField, LinearCode
from hilsplat.query.relevancy import LatentRelevancy
from hilsplat.query.scene_views import SceneViews, View
from hilsplat.semantic_tree.nodes import node_means
from hilsplat.settings import EvaluateSettings


@dataclass(frozen=True)
class FieldAnswers:
    """Relevancy from a scene's language field, which `clip` compares with texts."""

    views: SceneViews
    language: LanguageField
    code: Code
    clip: ClipModel
    settings: EvaluateSettings

    def relevancy(
        self, texts: Sequence[str], view: View, *, exact: bool = True
    ) -> Float32[np.ndarray, "T 3 H W"]:
        """Compute relevancy from decoded rendered latents at every pixel and level.

        Pixels that show mostly Gaussians without a latent at the level get the other pixels' lowest value.

        Args:
            exact: whether a network decodes every pixel at every call. If not, it decodes each view once, and
                results differ by at most 2e-3 (see `LatentRelevancy`). This has no effect for a linear code.
        """
        height, width = self.views.camera(view).size_hw
        relevancy, levels = self._latent_relevancy, self.latents(view)
        vectors, prepared = self.clip.embed_texts(texts), None
        if isinstance(self.code, LinearCode) or not exact:
            prepared = self.views.cached(
                "prepared", view, lambda: [relevancy.prepare(latents) for _, latents in levels]
            )
        maps = np.zeros((len(texts), len(LEVELS), height * width), np.float32)
        for index, (pixels, latents) in enumerate(levels):
            if not len(pixels):
                continue
            if prepared is None:
                of_texts = relevancy.exact(latents, vectors)
            else:
                of_texts = relevancy.fast(prepared[index], vectors)
            maps[:, index] = of_texts.min(axis=1, keepdims=True)
            maps[:, index, pixels] = of_texts
        return maps.reshape(len(texts), len(LEVELS), height, width)

    def cosine(
        self, texts: Sequence[str], view: View, pixels: Int64[np.ndarray, " P"]
    ) -> Float32[np.ndarray, "T 3 P"]:
        """Return the cosines of texts with pixels' rendered and decoded latents, at each level.

        Pixels (row * width + column) that show mostly Gaussians without a latent get -inf.
        """
        vectors, pixels = self.clip.embed_texts(texts), self.views.existing_pixels(view, pixels)
        cosines = np.full((len(texts), len(LEVELS), len(pixels)), -np.inf, np.float32)
        for index, (with_latent, latents) in enumerate(self.latents(view)):
            has_latent = np.flatnonzero(np.isin(pixels, with_latent))
            if len(has_latent):
                rows = np.searchsorted(with_latent, pixels[has_latent])
                decoded = self.code.decode_array(np.ascontiguousarray(latents[rows], np.float32))
                cosines[:, index, has_latent] = vectors @ decoded.T
        return cosines

    def gaussian_relevancy(self, text: str, level: str = "auto") -> Float32[np.ndarray, " N"]:
        """Return each Gaussian's field relevancy at a level or its maximum over levels; 0 without latents."""
        features, vector = self.language.features, self.clip.embed_texts(list(path_of(text)[-1:]))
        out = np.zeros(len(features), np.float32)
        for searched in LEVELS if level == "auto" else [Level.of(level)]:
            latents = features[:, searched.index]
            has_latent = (latents != 0).any(axis=1)
            relevancy = self._latent_relevancy.exact(latents[has_latent], vector)[0]
            out[has_latent] = np.maximum(out[has_latent], relevancy)
        return out

    def image(self, view: View, level: Level | str) -> UInt8[np.ndarray, "H W 3"]:
        """Render the field of a level as colours (see `field_colours`); uncovered pixels are black."""
        colours = field_colours(self.language.features[:, Level.of(level).index])
        size_hw = self.views.camera(view).size_hw
        return to_uint8((self.views.view_weights(view) @ colours).reshape(*size_hw, 3))

    @cached_property
    def node_vectors(self) -> Float32[np.ndarray, "n C"]:
        """Decoded mean latent of each node's Gaussians at the node's level, unit vectors."""
        tree = self.views.tree
        return self.code.decode_array(node_means(tree.node_of_gaussian, tree.level, self.language.features))

    def latents(self, view: View) -> list[tuple[np.ndarray, Float32[np.ndarray, "P D"]]]:
        """Return, for each level, the pixels that show mostly Gaussians with a latent, and their latents."""
        return self.views.cached(
            "latents", view, lambda: rendered_latents(self.views.view_weights(view), self.language.features)
        )

    @cached_property
    def _latent_relevancy(self) -> LatentRelevancy:
        canonical = self.clip.embed_texts(list(self.settings.canonical))
        return LatentRelevancy(self.code, canonical, self.settings.relevancy_scale, self.views.threads)


def field_colours(features: Float32[np.ndarray, "N D"]) -> Float32[np.ndarray, "N 3"]:
    """Map a level's features to colours along their three principal directions, stretched to [0, 1].

    The largest component of each direction is positive, and the 2nd to 98th percentiles over all Gaussians
    span the colour range, so that all views use the same colours. Gaussians without a feature are black; with
    fewer than three directions, the remaining channels are 0.
    """
    colours = np.zeros((len(features), 3), np.float32)
    has_feature = (features != 0).any(axis=1)
    if not has_feature.any():
        return colours
    values = features[has_feature].astype(np.float64)
    centred = values - values.mean(axis=0)
    directions = np.linalg.eigh(np.einsum("nc,nd->cd", centred, centred))[1][:, ::-1][:, :3]
    peak = np.abs(directions).argmax(axis=0)
    along = centred @ (directions * np.sign(directions[peak, np.arange(directions.shape[1])]))
    low, high = np.percentile(along, (2, 98), axis=0)
    colours[has_feature, : along.shape[1]] = np.clip((along - low) / np.maximum(high - low, 1e-9), 0, 1)
    return colours
