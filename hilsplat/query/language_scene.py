"""Answer texts: rank the nodes of the semantic tree, search along a path, or decode the rendered field.

from hilsplat.query.language_scene import LanguageScene

scene = LanguageScene.open("results/photos/desk")
for hit in scene.query("mug handle", level="auto"):
    print(hit.score, hit.level.label, hit.centroid, hit.oriented_box.size, hit.best_views)
scene.query("mug > handle")                     # a handle inside a mug
scene.node_masks("000.png", [hit.node])         # (H, W) bool
scene.gaussians_of([hit.node])                  # rows of gaussians.ply
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Float32, Int64, UInt8

from hilsplat.base.device import ComputeDevice, compute_device
from hilsplat.base.errors import SettingsError
from hilsplat.base.images import to_uint8
from hilsplat.base.levels import LEVELS, Level
from hilsplat.contributions.compositing import normalised_weights
from hilsplat.field.autoencoder import Code, autoencoder_file, load_code
from hilsplat.field.field import LanguageField
from hilsplat.query.field_colours import field_colours
from hilsplat.query.hits import Hit
from hilsplat.query.latent_relevancy import LatentRelevancy
from hilsplat.query.node_search import NodeHits, ancestor_margins, automatic_level, best_nodes, search_path
from hilsplat.query.relevancy import relevancy
from hilsplat.query.view_nodes import ViewNodes
from hilsplat.query.view_store import ViewStore
from hilsplat.scene.finished import FinishedScene, require_same
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.nodes import node_means
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import EvaluateSettings
from hilsplat.splat.gaussians import Gaussians

CANONICAL: tuple[str, ...] = EvaluateSettings().canonical
RELEVANCY_SCALE: float = EvaluateSettings().relevancy_scale
NODE_SELECT: float = EvaluateSettings().node_select
ANCESTORS: float = EvaluateSettings().ancestors

PATH_SEPARATOR = ">"

MIN_SHOWN_SHARE = 1e-4
"""Of a view: 14 px at 384 x 384 px show nothing."""

MIN_LATENT_SHARE = 0.5
"""A pixel has a latent at a level where Gaussians with one make up more than this share of it."""

TextEncoder = Callable[[list[str]], np.ndarray]
Answerer = Literal["tree", "field"]


@dataclass(frozen=True)
class LanguageScene:
    """A finished scene that answers texts.

    Attributes:
        scene: cameras and views.
        gaussians: frozen geometry.
        tree: nodes.
        language: the field.
        autoencoder: its decoder.
        encode_texts: unit CLIP vectors of texts.
        pixel_weights: compositing weights of a view (pixels x Gaussians).
        canonical: phrases that a text must beat.
        relevancy_scale: scale of the cosines.
        node_select: threshold of `query` where none is given.
        ancestors: share of the mean margin of a node's ancestors that is added to its own.
        threads: for look-ups.
        device: "cpu" or "cuda", for look-ups of the field.
    """

    scene: Scene
    gaussians: Gaussians
    tree: SemanticTree
    language: LanguageField
    autoencoder: Code
    encode_texts: TextEncoder
    pixel_weights: Callable[[str], sp.csr_matrix]
    canonical: tuple[str, ...] = CANONICAL
    relevancy_scale: float = RELEVANCY_SCALE
    threads: int = 1
    node_select: float = NODE_SELECT
    ancestors: float = ANCESTORS
    device: ComputeDevice = "cpu"
    _views: ViewStore = field(default_factory=ViewStore, repr=False)
    _texts: dict[str, np.ndarray] = field(default_factory=dict, repr=False)

    @staticmethod
    def open(
        folder: Path | str, variant: str = "default", *, threads: int = 1, device: ComputeDevice = "cpu"
    ) -> "LanguageScene":
        """Open `results/<dataset>/<scene>` with the settings that made it.

        Canonical phrases, template, scale and what selects nodes are those that the variant was evaluated
        with, read from its provenance; of a scene without labels those that its panel was drawn with.

        Args:
            folder: of a finished scene.
            variant: named set of settings whose files answer.
            threads: for rasterising and look-ups.
            device: "cpu" or "cuda": where the field is looked up (`field_relevancy` with exact=False).

        Raises:
            ArtifactError: the scene is not finished.
            MisalignedArtifactError: its parts do not belong together.
            DeviceError: cuda was asked for and torch finds no device.
        """
        parts = FinishedScene.locate(Path(folder), variant)
        settings = parts.evaluate_settings()
        return LanguageScene.from_parts(
            parts.scene,
            parts.gaussians,
            parts.semantic_tree,
            parts.field,
            parts.autoencoder,
            parts.clip_model,
            canonical=settings.canonical,
            template=settings.template,
            relevancy_scale=settings.relevancy_scale,
            node_select=settings.node_select,
            ancestors=settings.ancestors,
            threads=threads,
            device=device,
        )

    @staticmethod
    def from_parts(
        scene_folder: Path,
        gaussians_ply: Path,
        semantic_tree: Path,
        language: Path,
        autoencoder: Path,
        clip_model_folder: Path,
        *,
        canonical: Sequence[str] = CANONICAL,
        template: str = "{}",
        relevancy_scale: float = RELEVANCY_SCALE,
        node_select: float = NODE_SELECT,
        ancestors: float = ANCESTORS,
        threads: int = 1,
        device: ComputeDevice = "cpu",
    ) -> "LanguageScene":
        """Read a scene's artifacts one by one and check that they belong together.

        Raises:
            MisalignedArtifactError: tree or field were made for other Gaussians, or the field for
                another autoencoder.
        """
        from hilsplat.embed.clip import ClipModel
        from hilsplat.splat.ply import load_ply
        from hilsplat.splat.rasterise.api import pixel_weights

        scene = Scene.load(scene_folder)
        gaussians = load_ply(gaussians_ply)
        tree = SemanticTree.load(semantic_tree)
        features = LanguageField.load(language)
        require_same("semantic tree", scene.name, gaussians_ply, tree.gaussians_sha256)
        require_same("language field", scene.name, gaussians_ply, features.gaussians_sha256)
        require_same("language field", scene.name, autoencoder_file(autoencoder), features.autoencoder_sha256)
        clip = ClipModel.load(clip_model_folder, threads, template)
        code = load_code(autoencoder)
        clip.require_width(code.channels, f"autoencoder {autoencoder}")
        return LanguageScene(
            scene,
            gaussians,
            tree,
            features,
            code,
            clip.embed_texts,
            lambda view: pixel_weights(
                gaussians, scene.cameras[view], min_weight=tree.min_weight, threads=threads
            ),
            tuple(canonical),
            relevancy_scale,
            threads,
            node_select,
            ancestors,
            compute_device(device),
        )

    # -- answers ----------------------------------------------------------------------------------

    def query(
        self,
        text: str,
        level: str = "auto",
        *,
        answerer: str = "tree",
        view: str | None = None,
        threshold: float | None = None,
        limit: int = 10,
    ) -> list[Hit]:
        """Ranked answers to a text, or to a path such as "bear > head > nose"; several for "mugs".

        Args:
            text: words, or words separated by ">".
            level: "whole", "part", "subpart" or "auto"; of a path, that of its last text.
            answerer: "tree": nodes answer with their averaged CLIP vectors; "field": with what the
                paper's field holds for their Gaussians, decoded.
            view: name of a view, to ask only for what it shows; None: the whole scene.
            threshold: hits lie at most 1 - threshold of the range of the level's margins below the best
                one (that the view shows), and three times as far if they look like it; None: the scene's
                own (`node_select`).
            limit: answers at most.

        Raises:
            SettingsError: the text is empty, level, answerer or view are unknown, or a path has more texts
                than levels.
        """
        hits = self.find(text, level, threshold, answerer, view)
        return [
            Hit.of(self.tree, int(node), float(score), hits.route)
            for node, score in zip(hits.ids[:limit], hits.scores[:limit], strict=True)
        ]

    def find(
        self,
        text: str,
        level: str = "auto",
        threshold: float | None = None,
        answerer: str = "tree",
        view: str | None = None,
    ) -> NodeHits:
        """Like `query`, as rows of the tree."""
        path = tuple(part.strip() for part in text.split(PATH_SEPARATOR))
        if not all(path):
            raise SettingsError(
                f"the query {text!r} holds no text", fix='write words, or "bear > head > nose"'
            )
        if answerer not in get_args(Answerer):
            raise SettingsError(
                f"nothing answers as {answerer!r}", expected=" or ".join(get_args(Answerer)), found=answerer
            )
        names = {each.label: each for each in LEVELS}
        if level != "auto" and level not in names:
            raise SettingsError(
                f"level {level!r} is unknown", expected=f"auto, {', '.join(names)}", found=level
            )
        if view is not None and view not in self.scene.cameras.names:
            raise SettingsError(
                f"{self.scene.name} has no view {view!r}",
                expected=f"one of {', '.join(self.scene.views()[:3])}, ... ({len(self.scene.views())} views)",
                found=view,
            )
        given = names.get(level)
        if len(path) > 1:
            return self.select_path(path, level=given, threshold=threshold, answerer=answerer, view=view)
        return self.select_nodes(path[0], level=given, threshold=threshold, answerer=answerer, view=view)

    def select_nodes(
        self,
        text: str,
        *,
        level: Level | None,
        threshold: float | None = None,
        answerer: Answerer = "tree",
        view: str | None = None,
    ) -> NodeHits:
        """Nodes whose margin is near that of the best, and those a little further that look like it.

        To a node's margin a share (`ancestors`) of the mean of its ancestors' is added; see `best_nodes`.

        Args:
            text: the query.
            level: which nodes compete; None chooses it (see `automatic_level`).
            threshold: as in `query`.
            answerer: as in `query`.
            view: as in `query`.
        """
        scores = self.node_relevancy([text], answerer)[0]
        shown = None if view is None else self.nodes_shown(view)
        if level is None:
            level = automatic_level(self.tree, scores, shown)
        threshold = self.node_select if threshold is None else threshold
        added = self.ancestors * ancestor_margins(self.tree, scores)
        nodes = self.tree.nodes_of(level)
        return best_nodes(scores, self.node_vectors(answerer), nodes, level, threshold, shown, added)

    def select_path(
        self,
        path: tuple[str, ...],
        *,
        level: Level | None,
        threshold: float | None = None,
        answerer: Answerer = "tree",
        view: str | None = None,
    ) -> NodeHits:
        """Search what answers the last text and lies in what answers those before; see `search_path`.

        Raises:
            SettingsError: the path is empty or longer than the levels down to the last text's.
        """
        scores = self.node_relevancy(list(path), answerer) if path else np.zeros((0, len(self.tree)))
        threshold = self.node_select if threshold is None else threshold
        shown = None if view is None else self.nodes_shown(view)
        return search_path(self.tree, scores, self.node_vectors(answerer), path, threshold, level, shown)

    def nodes_shown(self, view: str) -> Bool[np.ndarray, " n"]:
        """Which nodes have a mask of at least `MIN_SHOWN_SHARE` of a view."""

        def measure() -> np.ndarray:
            num = len(self.tree)
            height, width = self.scene.cameras[view].size_hw
            area_px = sum(self._view_nodes(view, level).area_px(num) for level in LEVELS)
            return area_px >= MIN_SHOWN_SHARE * height * width

        return self._views.get(("shown", view), measure, lambda kept: kept.nbytes)

    def gaussians_of(self, ids: Sequence[int] | Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " g"]:
        """Gaussians of any of the nodes."""
        return np.flatnonzero(np.isin(self.tree.node_of_gaussian, np.asarray(ids)).any(axis=1))

    def node_masks(self, view: str, ids: Sequence[int] | Int64[np.ndarray, " n"]) -> Bool[np.ndarray, "H W"]:
        """Pixels where Gaussians of the nodes make up more than half of what is seen."""
        ids = np.asarray(ids, np.int64)
        height, width = self.scene.cameras[view].size_hw
        chosen = np.zeros(len(self.tree), np.bool_)
        chosen[ids] = True
        levels = np.unique(self.tree.level[ids])
        if len(levels) == 1:
            return self._view_nodes(view, Level(int(levels[0]))).mask(chosen).reshape(height, width)
        member = np.zeros(len(self.tree.node_of_gaussian), np.float32)
        member[self.gaussians_of(ids)] = 1
        return (self.view_weights(view) @ member > 0.5).reshape(height, width)

    # -- relevancy --------------------------------------------------------------------------------

    def text_vectors(self, texts: Sequence[str]) -> Float32[np.ndarray, "T C"]:
        """Unit CLIP vectors of texts; each text is encoded once."""
        new = [text for text in dict.fromkeys(texts) if text not in self._texts]
        if new:
            self._texts.update(zip(new, np.asarray(self.encode_texts(new), np.float32), strict=True))
        return np.stack([self._texts[text] for text in texts])

    def relevancy(
        self, embeddings: Float[np.ndarray, "B C"], texts: Sequence[str]
    ) -> Float32[np.ndarray, "T B"]:
        """Relevancy of embeddings to texts against this scene's canonical phrases."""
        return relevancy(
            embeddings, self.text_vectors(texts), self.text_vectors(self.canonical), self.relevancy_scale
        )

    def node_relevancy(self, texts: Sequence[str], answerer: Answerer = "tree") -> Float32[np.ndarray, "T n"]:
        """Relevancy of every node to every text."""
        return self.relevancy(self.node_vectors(answerer), texts)

    def node_vectors(self, answerer: Answerer = "tree") -> Float32[np.ndarray, "n C"]:
        """Unit vectors by which nodes answer: their own, or what the field holds for their Gaussians."""
        return self.tree.clip if answerer == "tree" else self._node_field_vectors

    def node_relevancy_map(self, texts: Sequence[str], view: str) -> Float32[np.ndarray, "T 3 H W"]:
        """Relevancy of the nodes a pixel shows, blended by its weights, at each level.

        Gaussians without a node count as the level's least relevant node. Pixels that the Gaussians do
        not cover get the least relevancy of the covered ones, so that they are never selected and do
        not stretch the range.
        """
        scores = self.node_relevancy(texts)
        height, width = self.scene.cameras[view].size_hw
        maps = np.zeros((len(texts), len(LEVELS), height * width), np.float32)
        for level in LEVELS:
            nodes = self.tree.nodes_of(level)
            if not len(nodes):
                continue
            shown = self._view_nodes(view, level)
            for row, values in enumerate(scores):
                maps[row, level.index] = shown.blend(values, float(values[nodes].min()))
        return maps.reshape(len(texts), len(LEVELS), height, width)

    def field_relevancy(
        self, texts: Sequence[str], view: str, *, exact: bool = True
    ) -> Float32[np.ndarray, "T 3 H W"]:
        """Rendered latent -> decoder -> relevancy, at every pixel and level, as the paper answers.

        Pixels that show mostly Gaussians without a latent at the level are as the uncovered ones of
        `node_relevancy_map`.

        Args:
            texts: queries.
            view: name of the view.
            exact: a network decodes every pixel for every call; else a view is decoded once and answers
                within 2e-3 of that (see `latent_relevancy`). A linear code has one way.
        """
        by_look_up = self._latent_relevancy.is_linear or not exact
        shown, placed = self._view_latents(view), self._placed_latents(view) if by_look_up else None
        vectors = self.text_vectors(texts)
        answer = self._latent_relevancy
        height, width = self.scene.cameras[view].size_hw
        maps = np.zeros((len(texts), len(LEVELS), height * width), np.float32)
        for index, (pixels, latents) in enumerate(shown):
            if not len(pixels):
                continue
            found = answer.fast(placed[index], vectors) if by_look_up else answer.exact(latents, vectors)
            for row, level_map in zip(found, maps[:, index], strict=True):
                if len(pixels) == len(level_map):
                    level_map[:] = row
                else:
                    level_map[:] = row.min()
                    level_map[pixels] = row
        return maps.reshape(len(texts), len(LEVELS), height, width)

    def field_image(self, view: str, level: Level) -> UInt8[np.ndarray, "H W 3"]:
        """The field of a level as colours (see `field_colours`); uncovered pixels are black."""
        weights = self.view_weights(view)
        colours = field_colours(self.language.features[:, level.index])
        return to_uint8((weights @ colours).reshape(*self.scene.cameras[view].size_hw, 3))

    # -- what is kept of a view -------------------------------------------------------------------

    def view_weights(self, view: str) -> sp.csr_matrix:
        """W of a view with rows divided by alpha, empty below half coverage."""
        return self._views.get(
            ("weights", view),
            lambda: normalised_weights(self.pixel_weights(view)),
            lambda kept: kept.data.nbytes + kept.indices.nbytes + kept.indptr.nbytes,
        )

    def _view_nodes(self, view: str, level: Level) -> ViewNodes:
        return self._views.get(
            ("nodes", view, level),
            lambda: ViewNodes.of(self.view_weights(view), self.tree.node_of_gaussian[:, level.index]),
            lambda kept: kept.nbytes,
        )

    def _view_latents(self, view: str) -> list[tuple[np.ndarray, Float32[np.ndarray, "P D"]]]:
        """Per level the pixels that show mostly Gaussians with a latent, and their rendered latents."""

        def render() -> list[tuple[np.ndarray, np.ndarray]]:
            weights = self.view_weights(view)
            shown = []
            for index in range(len(LEVELS)):
                own = np.ascontiguousarray(self.language.features[:, index], np.float32)
                has = (own != 0).any(axis=1).astype(np.float32)
                share = weights @ has
                pixels = np.flatnonzero(share > MIN_LATENT_SHARE)
                # Gaussians without a latent hold zeros, which a code would read as one: they do not count.
                shown.append((pixels, ((weights[pixels] @ own) / share[pixels, None]).astype(np.float32)))
            return shown

        return self._views.get(
            ("latents", view), render, lambda kept: sum(a.nbytes + b.nbytes for a, b in kept)
        )

    def _placed_latents(self, view: str) -> list:
        """What look-ups of a view need, level by level; made when it is first looked up."""
        return self._views.get(
            ("placed", view),
            lambda: [self._latent_relevancy.prepare(latents) for _, latents in self._view_latents(view)],
            lambda kept: sum(each.nbytes for each in kept),
        )

    @cached_property
    def _latent_relevancy(self) -> LatentRelevancy:
        return LatentRelevancy(
            self.autoencoder,
            self.text_vectors(self.canonical),
            self.relevancy_scale,
            self.threads,
            self.device,
        )

    @cached_property
    def _node_field_vectors(self) -> Float32[np.ndarray, "n C"]:
        """Decoded mean latent of each node's Gaussians at its level."""
        means = node_means(self.tree.node_of_gaussian, self.tree.level, self.language.features)
        return self.autoencoder.decode_array(means)
