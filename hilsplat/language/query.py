"""Answer texts: rank the nodes of the semantic tree, search along a path, or decode the rendered field."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Float32, Int64, UInt8

from hilsplat.base.artifacts import sha256_of_file
from hilsplat.base.errors import MisalignedArtifactError, SettingsError
from hilsplat.base.images import to_uint8
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.language.autoencoder import Autoencoder, autoencoder_file
from hilsplat.language.contributions import normalised_weights
from hilsplat.language.field import LanguageField
from hilsplat.language.relevancy import min_max, relevancy
from hilsplat.language.semantic_tree import SemanticTree
from hilsplat.scene.scene import Scene
from hilsplat.settings import ContributionsSettings, EvaluateSettings
from hilsplat.splat.gaussians import Gaussians

CANONICAL: tuple[str, ...] = EvaluateSettings().canonical
RELEVANCY_SCALE: float = EvaluateSettings().relevancy_scale
NODE_SELECT: float = EvaluateSettings().node_select

AUTO_SHARE = 0.9
"""The automatic level climbs from the best node to its parent while the parent reaches this share of
the range of all nodes: noisy crops of fine nodes win too often where the text means the whole."""

CACHED_VIEWS = 64
PATH_SEPARATOR = ">"

TextEncoder = Callable[[list[str]], np.ndarray]


@dataclass(frozen=True)
class NodeHits:
    """Nodes that answer a text.

    Attributes:
        ids: rows of the semantic tree, best first.
        scores: their relevancies.
        level: the level that was searched.
        route: how they were reached: "flat", or on a path "child", "descendant" or "fallback" (the
            whole level, as the nodes before hold nothing there).
    """

    ids: Int64[np.ndarray, " n"]
    scores: Float32[np.ndarray, " n"]
    level: Level
    route: str = "flat"


@dataclass(frozen=True)
class Hit:
    """One ranked answer, for people.

    Attributes:
        node: row of the semantic tree.
        level: its level.
        score: relevancy in (0, 1); 0.5 is no better than a generic phrase.
        centroid: scene units.
        box: lower and upper corner, scene units.
        best_views: up to three train views that show it largest.
        route: as in `NodeHits`.
    """

    node: int
    level: Level
    score: float
    centroid: tuple[float, float, float]
    box: tuple[tuple[float, float, float], tuple[float, float, float]]
    best_views: tuple[str, ...]
    route: str


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
        canonical: phrases that a text must beat.
        relevancy_scale: scale of the cosines.
        threads: for rasterising.
        pixel_weights: compositing weights of a view (pixels x Gaussians).
    """

    scene: Scene
    gaussians: Gaussians
    tree: SemanticTree
    language: LanguageField
    autoencoder: Autoencoder
    encode_texts: TextEncoder
    pixel_weights: Callable[[str], sp.csr_matrix]
    canonical: tuple[str, ...] = CANONICAL
    relevancy_scale: float = RELEVANCY_SCALE
    threads: int = 1
    _views: dict[str, tuple[sp.csr_matrix, np.ndarray]] = field(default_factory=dict, repr=False)
    _texts: dict[str, np.ndarray] = field(default_factory=dict, repr=False)

    @staticmethod
    def open(
        scene_folder: Path,
        gaussians_ply: Path,
        semantic_tree: Path,
        language: Path,
        autoencoder: Path,
        clip_model_folder: Path,
        *,
        canonical: Sequence[str] = CANONICAL,
        relevancy_scale: float = RELEVANCY_SCALE,
        threads: int = 1,
    ) -> "LanguageScene":
        """Read a scene's artifacts and check that they belong together.

        Raises:
            MisalignedArtifactError: tree or field were made for other Gaussians, or the field for
                another autoencoder.
        """
        from hilsplat.language.clip import ClipModel
        from hilsplat.splat.ply import load_ply
        from hilsplat.splat.rasterise.api import pixel_weights

        scene = Scene.load(scene_folder)
        gaussians = load_ply(gaussians_ply)
        tree = SemanticTree.load(semantic_tree)
        features = LanguageField.load(language)
        require_same("semantic tree", scene.name, gaussians_ply, tree.gaussians_sha256)
        require_same("language field", scene.name, gaussians_ply, features.gaussians_sha256)
        require_same("language field", scene.name, autoencoder_file(autoencoder), features.autoencoder_sha256)
        clip = ClipModel.load(clip_model_folder, threads)
        min_weight = ContributionsSettings().min_weight
        return LanguageScene(
            scene,
            gaussians,
            tree,
            features,
            Autoencoder.load(autoencoder),
            clip.embed_texts,
            lambda view: pixel_weights(
                gaussians, scene.cameras[view], min_weight=min_weight, threads=threads
            ),
            tuple(canonical),
            relevancy_scale,
            threads,
        )

    def view_weights(self, view: str) -> tuple[sp.csr_matrix, Float32[np.ndarray, " P"]]:
        """W of a view with rows divided by alpha (empty below half coverage), and alpha; kept in memory."""
        if view not in self._views:
            if len(self._views) >= CACHED_VIEWS:
                self._views.pop(next(iter(self._views)))
            self._views[view] = normalised_weights(self.pixel_weights(view))
        return self._views[view]

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

    # -- the rendered field, as the paper answers -------------------------------------------------

    def field_relevancy(self, texts: Sequence[str], view: str) -> Float32[np.ndarray, "T 3 H W"]:
        """Rendered latent -> decoder -> relevancy, at every pixel and level.

        Pixels that the Gaussians do not cover get the least relevancy of the covered ones, so that
        they are never selected and do not stretch the range.
        """
        weights, _ = self.view_weights(view)
        covered = np.flatnonzero(np.diff(weights.indptr))
        rows = weights[covered]

        def one_level(index: int) -> np.ndarray:
            latents = rows @ np.ascontiguousarray(self.language.features[:, index])
            return self.relevancy(self.autoencoder.decode_array(latents.astype(np.float32)), texts)

        return self._maps(view, covered, one_level, len(texts))

    def field_image(self, view: str, level: Level) -> UInt8[np.ndarray, "H W 3"]:
        """The field of a level as colours: its three principal directions over all Gaussians.

        Each direction's sign is fixed (largest component positive) and its 2nd to 98th percentile
        over the Gaussians is stretched to the colour range, so that views share their colours.
        Uncovered pixels are black.
        """
        colours = self._field_colours(level)
        weights, _ = self.view_weights(view)
        height, width = self.scene.cameras[view].size_hw
        return to_uint8((weights @ colours).reshape(height, width, 3))

    def _field_colours(self, level: Level) -> Float32[np.ndarray, "N 3"]:
        features = self.language.features[:, level.index].astype(np.float64)
        seen = np.square(features).sum(axis=1) > 0
        centred = features - features[seen].mean(axis=0) if seen.any() else features
        covariance = np.einsum("nc,nd->cd", centred[seen], centred[seen])
        _, directions = np.linalg.eigh(covariance)
        directions = directions[:, ::-1][:, :3]
        peak = np.abs(directions).argmax(axis=0)
        directions = directions * np.sign(directions[peak, np.arange(directions.shape[1])])
        colours = np.zeros((len(features), 3), np.float32)
        for channel, values in enumerate((centred @ directions).T):
            low, high = np.percentile(values[seen], (2, 98)) if seen.any() else (0.0, 1.0)
            colours[:, channel] = np.clip((values - low) / max(high - low, 1e-9), 0, 1) * seen
        return colours

    # -- the semantic tree ------------------------------------------------------------------------

    def node_relevancy(self, texts: Sequence[str]) -> Float32[np.ndarray, "T n"]:
        """Relevancy of every node to every text."""
        return self.relevancy(self.tree.clip, texts)

    def node_relevancy_map(self, texts: Sequence[str], view: str) -> Float32[np.ndarray, "T 3 H W"]:
        """Relevancy of the nodes a pixel shows, blended by its weights, at each level.

        Gaussians without a node count as the level's least relevant node.
        """
        scores = self.node_relevancy(texts)
        weights, _ = self.view_weights(view)
        covered = np.flatnonzero(np.diff(weights.indptr))
        rows = weights[covered]

        def one_level(index: int) -> np.ndarray:
            nodes = self.tree.nodes_of(LEVELS[index])
            if not len(nodes):
                return np.zeros((len(texts), len(covered)), np.float32)
            own = self.tree.node_of_gaussian[:, index]
            least = scores[:, nodes].min(axis=1, keepdims=True)
            return (rows @ np.where(own >= 0, scores[:, own], least).T).T

        return self._maps(view, covered, one_level, len(texts))

    def select_nodes(
        self,
        text: str,
        *,
        level: Level | None,
        threshold: float = NODE_SELECT,
        within: Int64[np.ndarray, " c"] | None = None,
    ) -> NodeHits:
        """Nodes whose relevancy, stretched to [0, 1] over the level's nodes, reaches the threshold.

        Args:
            text: the query.
            level: which nodes compete; None chooses it (see `automatic_level`).
            threshold: share of the range between the worst and the best node.
            within: only these nodes compete, such as the children of another answer.
        """
        scores = self.node_relevancy([text])[0]
        if level is None:
            level = self.automatic_level(scores, within)
        candidates = self.tree.nodes_of(level)
        if within is not None:
            candidates = np.intersect1d(candidates, within)
        return _select(scores, candidates, level, threshold, "flat")

    def automatic_level(
        self, scores: Float[np.ndarray, " n"], within: Int64[np.ndarray, " c"] | None = None
    ) -> Level:
        """Level that a text most likely means: climb from the best node while its parent scores as well.

        LangSplat takes the level of the highest score. Averages over many small crops are noisy and
        there are more of them, so that this picks the finest level far too often. Here a node must
        beat its parent by more than 1 - `AUTO_SHARE` of the range. The range is that of the cosine
        margins behind the relevancies, which do not saturate.
        """
        candidates = np.arange(len(self.tree)) if within is None else np.asarray(within)
        if not len(candidates):
            return Level.WHOLE
        probability = np.clip(scores.astype(np.float64), 1e-7, 1 - 1e-7)
        margin = np.log(probability / (1 - probability))
        reach = margin[candidates].min() + AUTO_SHARE * np.ptp(margin[candidates])
        node = int(candidates[np.lexsort((candidates, -scores[candidates]))[0]])
        while (parent := int(self.tree.parent[node])) != NONE:
            if margin[parent] < reach or parent not in candidates:
                break
            node = parent
        return Level(int(self.tree.level[node]))

    def select_path(self, path: tuple[str, ...], threshold: float = NODE_SELECT) -> NodeHits:
        """Search each text inside the nodes that answered the one before: ("bear", "head", "nose").

        The i-th text is searched at the i-th level. Falls back from children of the chosen nodes to
        any descendant of the first text's nodes, then to the whole level.

        Raises:
            SettingsError: the path is empty or longer than there are levels.
        """
        if not 1 <= len(path) <= len(LEVELS):
            raise SettingsError(
                f"the path {' > '.join(path)!r} cannot be searched",
                expected=f"1 to {len(LEVELS)} texts, coarse to fine",
                found=f"{len(path)}",
                fix="name the object, then its part, then the part of the part",
            )
        scores = self.node_relevancy(list(path))
        hits = first = _select(scores[0], self.tree.nodes_of(LEVELS[0]), LEVELS[0], threshold, "flat")
        for index, level in enumerate(LEVELS[1 : len(path)], start=1):
            nodes = self.tree.nodes_of(level)
            routes = {
                "child": np.intersect1d(nodes, self.tree.children_of(hits.ids)),
                "descendant": np.intersect1d(nodes, self.tree.descendants_of(first.ids)),
                "fallback": nodes,
            }
            route = next((name for name, found in routes.items() if len(found)), "fallback")
            candidates = routes[route]
            hits = _select(scores[index], candidates, level, threshold, route)
        return hits

    def node_masks(self, view: str, ids: Int64[np.ndarray, " n"]) -> Bool[np.ndarray, "H W"]:
        """Pixels where members of the nodes make up more than half of what is seen."""
        member = np.isin(self.tree.node_of_gaussian, np.asarray(ids)).any(axis=1)
        weights, _ = self.view_weights(view)
        return (weights @ member.astype(np.float32) > 0.5).reshape(self.scene.cameras[view].size_hw)

    def query(
        self, text: str, level: str = "auto", *, threshold: float = NODE_SELECT, limit: int = 10
    ) -> list[Hit]:
        """Ranked answers to a text, or to a path such as "bear > head > nose".

        Args:
            text: words, or words separated by ">".
            level: "whole", "part", "subpart" or "auto"; a path brings its own.
            threshold: as in `select_nodes`.
            limit: answers at most.

        Raises:
            SettingsError: the text is empty or the level is unknown.
        """
        hits = self.find(text, level, threshold)
        return [
            self._hit(int(node), float(score), hits.route)
            for node, score in zip(hits.ids[:limit], hits.scores[:limit], strict=True)
        ]

    def find(self, text: str, level: str = "auto", threshold: float = NODE_SELECT) -> NodeHits:
        """Like `query`, as rows of the tree."""
        path = tuple(part.strip() for part in text.split(PATH_SEPARATOR))
        if not all(path):
            raise SettingsError(
                f"the query {text!r} holds no text", fix='write words, or "bear > head > nose"'
            )
        if len(path) > 1:
            return self.select_path(path, threshold)
        names = {each.label: each for each in LEVELS}
        if level != "auto" and level not in names:
            raise SettingsError(
                f"level {level!r} is unknown", expected=f"auto, {', '.join(names)}", found=level
            )
        return self.select_nodes(path[0], level=names.get(level), threshold=threshold)

    def _hit(self, node: int, score: float, route: str) -> Hit:
        area = self.tree.view_area_px[node]
        order = np.lexsort((np.arange(len(area)), -area))[:3]
        low, high = self.tree.box[node].tolist()
        return Hit(
            node,
            Level(int(self.tree.level[node])),
            score,
            tuple(self.tree.centroid[node].tolist()),
            (tuple(low), tuple(high)),
            tuple(self.tree.view_names[row] for row in order if area[row] > 0),
            route,
        )

    def _maps(
        self, view: str, covered: np.ndarray, one_level: Callable[[int], np.ndarray], num_texts: int
    ) -> Float32[np.ndarray, "T 3 H W"]:
        """Lay the values of covered pixels into maps; the others get the least of them."""
        height, width = self.scene.cameras[view].size_hw
        maps = np.zeros((num_texts, len(LEVELS), height * width), np.float32)
        if len(covered):
            for index in range(len(LEVELS)):
                values = one_level(index)
                maps[:, index] = values.min(axis=1, keepdims=True)
                maps[:, index, covered] = values
        return maps.reshape(num_texts, len(LEVELS), height, width)


def require_same(what: str, scene: str, path: Path, expected_sha256: str) -> None:
    """Refuse artifacts that were made for another file.

    Raises:
        MisalignedArtifactError: the file's digest is another one.
    """
    found = sha256_of_file(path)
    if found != expected_sha256:
        raise MisalignedArtifactError(
            f"the {what} of {scene} was made for another {Path(path).name}",
            expected=f"sha256 {expected_sha256[:12]}",
            found=f"sha256 {found[:12]} in {path}",
            fix=f"rerun the stage that writes the {what}",
        )


def _select(
    scores: Float[np.ndarray, " n"],
    candidates: Int64[np.ndarray, " c"],
    level: Level,
    threshold: float,
    route: str,
) -> NodeHits:
    """Candidates above the threshold of their own range, best first; of equals the lowest row."""
    if not len(candidates):
        return NodeHits(np.zeros(0, np.int64), np.zeros(0, np.float32), level, route)
    chosen = candidates[min_max(scores[candidates]) >= threshold]
    order = np.lexsort((chosen, -scores[chosen]))
    return NodeHits(chosen[order].astype(np.int64), scores[chosen][order].astype(np.float32), level, route)
