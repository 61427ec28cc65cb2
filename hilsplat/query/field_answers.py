"""Relevancy from a scene's decoded language field, as in the paper."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from hilsplat.base.errors import ArtifactError
from hilsplat.base.images import to_uint8
from hilsplat.base.levels import LEVELS, Level, path_of
from hilsplat.contributions.compositing import rendered_latents
from hilsplat.field.code import Code, LanguageField, LinearCode
from hilsplat.query.relevancy import LatentRelevancy
from hilsplat.query.scene_views import SceneViews
from hilsplat.semantic_tree.nodes import node_means
from hilsplat.settings import EvaluateSettings


@dataclass(frozen=True)
class FieldScene(SceneViews):
    """A scene whose language field can be queried.

    Attributes:
        language: the field; None, like `autoencoder`, if the run has not computed it yet.
        encode_texts: returns the unit CLIP vectors of texts.
    """

    language: LanguageField | None
    autoencoder: Code | None
    encode_texts: Callable[[list[str]], np.ndarray]
    settings: EvaluateSettings = field(default_factory=EvaluateSettings)
    threads: int = 1
    _texts: dict[str, np.ndarray] = field(default_factory=dict, repr=False, kw_only=True)

    def trained(self) -> tuple[LanguageField, Code]:
        """Return the language field and its code; raise ArtifactError if they are not computed yet."""
        if self.language is None or self.autoencoder is None:
            raise ArtifactError(
                f"{self.scene.name} has no language field yet",
                fix="query its tree, or wait for the run to end",
            )
        return self.language, self.autoencoder

    def text_vectors(self, texts: Sequence[str]) -> Float32[np.ndarray, "T C"]:
        """Return the unit CLIP vectors of texts; each text is encoded once."""
        new = [text for text in dict.fromkeys(texts) if text not in self._texts]
        if new:
            self._texts.update(zip(new, np.asarray(self.encode_texts(new), np.float32), strict=True))
        return np.stack([self._texts[text] for text in texts])

    def field_relevancy(
        self, texts: Sequence[str], view: str, *, exact: bool = True
    ) -> Float32[np.ndarray, "T 3 H W"]:
        """Compute relevancy from decoded rendered latents at every pixel and level, as in the paper.

        Pixels that show mostly Gaussians without a latent at the level get the other pixels' lowest value.

        Args:
            exact: whether a network decodes every pixel at every call. If not, it decodes each view once, and
                results differ by at most 2e-3 (see `LatentRelevancy`). This has no effect for a linear code.
        """
        answer = self._latent_relevancy
        shown, vectors = self.latents(view), self.text_vectors(texts)
        placed = None
        if isinstance(self.autoencoder, LinearCode) or not exact:
            placed = self._views.get(("placed", view), lambda: [answer.prepare(each) for _, each in shown])
        height, width = self.camera(view).size_hw
        maps = np.zeros((len(texts), len(LEVELS), height * width), np.float32)
        for index, (pixels, latents) in enumerate(shown):
            if not len(pixels):
                continue
            found = answer.exact(latents, vectors) if placed is None else answer.fast(placed[index], vectors)
            for text_map, values in zip(maps[:, index], found, strict=True):
                text_map[:] = values.min()
                text_map[pixels] = values
        return maps.reshape(len(texts), len(LEVELS), height, width)

    def field_cosine(
        self, texts: Sequence[str], view: str, pixels: Int64[np.ndarray, " P"]
    ) -> Float32[np.ndarray, "T 3 P"]:
        """Return the cosines of texts with pixels' rendered and decoded latents, at each level.

        Pixels (row * width + column) that show mostly Gaussians without a latent get -inf.
        """
        vectors = self.text_vectors(texts)
        found = np.full((len(texts), len(LEVELS), len(pixels)), -np.inf, np.float32)
        for index, (shown, latents) in enumerate(self.latents(view)):
            has_latent = np.flatnonzero(np.isin(pixels, shown))
            if len(has_latent):
                rows = np.searchsorted(shown, pixels[has_latent])
                decoded = self.trained()[1].decode_array(np.ascontiguousarray(latents[rows], np.float32))
                found[:, index, has_latent] = vectors @ decoded.T
        return found

    def gaussian_relevancy(self, text: str, level: str = "auto") -> Float32[np.ndarray, " N"]:
        """Return each Gaussian's field relevancy at a level or its maximum over levels; 0 without latents."""
        features = self.trained()[0].features
        out = np.zeros(len(features), np.float32)
        vector = self.text_vectors(path_of(text)[-1:])
        for each in LEVELS:
            if level in ("auto", each.label):
                latents = features[:, each.index]
                has = (latents != 0).any(axis=1)
                out[has] = np.maximum(out[has], self._latent_relevancy.exact(latents[has], vector)[0])
        return out

    def field_image(self, view: str, level: Level) -> UInt8[np.ndarray, "H W 3"]:
        """Render the field of a level as colours (see `field_colours`); uncovered pixels are black."""
        weights = self.view_weights(view)
        colours = field_colours(self.trained()[0].features[:, level.index])
        return to_uint8((weights @ colours).reshape(*self.camera(view).size_hw, 3))

    @cached_property
    def _decoded_nodes(self) -> Float32[np.ndarray, "n C"]:
        """Decoded mean latent of each node's Gaussians at the node's level."""
        language, code = self.trained()
        return code.decode_array(node_means(self.tree.node_of_gaussian, self.tree.level, language.features))

    def latents(self, view: str) -> list[tuple[np.ndarray, Float32[np.ndarray, "P D"]]]:
        """Return, for each level, the pixels that show mostly Gaussians with a latent, and their latents."""
        return self._views.get(
            ("latents", view),
            lambda: rendered_latents(self.view_weights(view), self.trained()[0].features),
        )

    @cached_property
    def _latent_relevancy(self) -> LatentRelevancy:
        canonical = self.text_vectors(self.settings.canonical)
        return LatentRelevancy(self.trained()[1], canonical, self.settings.relevancy_scale, self.threads)


def field_colours(features: Float32[np.ndarray, "N D"]) -> Float32[np.ndarray, "N 3"]:
    """Map a level's features to colours along their three principal directions, stretched to [0, 1].

    The largest component of each direction is positive, and the 2nd to 98th percentiles over all Gaussians
    span the colour range, so that all views use the same colours. Gaussians without a feature are black; with
    fewer than three directions, the remaining channels are 0.
    """
    values = features.astype(np.float64)
    seen = np.square(values).sum(axis=1) > 0
    centred = values - values[seen].mean(axis=0) if seen.any() else values
    covariance = np.einsum("nc,nd->cd", centred[seen], centred[seen])
    _, directions = np.linalg.eigh(covariance)
    directions = directions[:, ::-1][:, :3]
    peak = np.abs(directions).argmax(axis=0)
    directions = directions * np.sign(directions[peak, np.arange(directions.shape[1])])
    colours = np.zeros((len(features), 3), np.float32)
    for channel, along in enumerate((centred @ directions).T):
        low, high = np.percentile(along[seen], (2, 98)) if seen.any() else (0.0, 1.0)
        colours[:, channel] = np.clip((along - low) / max(high - low, 1e-9), 0, 1) * seen
    return colours
