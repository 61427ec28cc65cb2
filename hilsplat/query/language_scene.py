"""A finished scene that accepts text queries of its semantic tree or its decoded language field.

docs/python.md describes the usage. `query` parses the text, `select` searches the tree by cosine margins
(`node_search.search`), and each `Hit` has its Gaussians.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8

from hilsplat.base.errors import ArtifactError, ModelError, SettingsError
from hilsplat.base.levels import LEVELS, NONE, Level, path_of
from hilsplat.base.lineage import require_made_from, sha256_of_file
from hilsplat.field.code import LanguageField, autoencoder_file, load_code
from hilsplat.models.store import is_embedded, meaningless
from hilsplat.query.field_answers import FieldScene
from hilsplat.query.hits import Doubt, Hit, doubts_of
from hilsplat.query.names import NodeNames, read_names
from hilsplat.query.node_names import NodeNaming
from hilsplat.query.node_search import NodeHits, TextAnswer, search
from hilsplat.query.relevancy import margin_of_relevancy, margins, relevancy_of_margins
from hilsplat.query.scene_views import Opened
from hilsplat.scene.finished import FinishedScene, SceneParts, is_drawn
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.tree import OrientedBox, SemanticTree
from hilsplat.settings import EvaluateSettings

if TYPE_CHECKING:
    from hilsplat.viewer.app import EmbeddedViewer

logger = logging.getLogger(__name__)

NAMED = 2.0
"""Cosine margin of a node for its user-given name: the maximum, so that the node is ranked first."""

BEST_VIEWS = 3
"""Maximum number of best views of an answer."""

ANSWERERS = ("tree", "field")


@dataclass(frozen=True)
class LanguageScene(FieldScene):
    """A finished scene that accepts text queries.

    Attributes:
        caution: sentence that explains why CLIP's answers are meaningless for this scene, or empty.
        names: the user's names for nodes, which are matched first.
        naming: vocabulary names of the nodes, and words for absent objects; None if the stage has not run.
        unknown_words: returns the words of a text that are not in the text model's vocabulary.
        encode_picture: returns the unit CLIP vector of an RGB image; None if images cannot be embedded.
        finished: location and variant of the scene; None if it was assembled from parts.
    """

    caution: str = ""
    names: NodeNames = field(default_factory=NodeNames)
    naming: NodeNaming | None = field(default=None, repr=False)
    unknown_words: Callable[[str], list[str]] = field(default=lambda text: [], repr=False)
    encode_picture: Callable[[np.ndarray], np.ndarray] | None = field(default=None, repr=False)
    finished: FinishedScene | None = field(default=None, repr=False)
    _by_chance: dict[str, np.ndarray] = field(default_factory=dict, repr=False, kw_only=True)
    """Margins (W, n) of all nodes for `naming.rivals`, by answerer."""

    @staticmethod
    def open(folder: Path | str, variant: str = "default", *, threads: int = 1) -> "LanguageScene":
        """Open `results/<dataset>/<scene>`, or a copy of that folder, with the settings that created it.

        Canonical phrases, template, scale and node selection are read from the provenance of the variant's
        evaluation, or of its panel if the scene has no labels.

        Raises:
            ArtifactError: the scene is not finished.
            MisalignedArtifactError: the scene's parts do not belong together.
            ModelError: the CLIP that embedded the scene's masks is not found.
        """
        scene = LanguageScene.of(FinishedScene.locate(Path(folder), variant), threads=threads)
        if scene.caution:
            logger.warning("%s: %s", scene.scene.name, scene.caution)
        return scene

    @staticmethod
    def of(found: FinishedScene, *, threads: int = 1, opened: Opened | None = None) -> "LanguageScene":
        """Open a finished scene with its own settings and the names of its nodes."""
        parts = found.parts
        scene = LanguageScene.from_parts(parts, found.evaluate_settings(), threads=threads, opened=opened)
        names = read_names(found.folder, parts.semantic_tree)
        naming = NodeNaming.load(parts.clip.parent / "names", parts.semantic_tree, parts.clip)
        return replace(scene, names=names, naming=naming, finished=found)

    @staticmethod
    def from_parts(
        parts: SceneParts,
        settings: EvaluateSettings,
        *,
        threads: int = 1,
        opened: Opened | None = None,
    ) -> "LanguageScene":
        """Read each artifact of a scene once, except node names, and check that the artifacts match.

        Args:
            opened: artifacts that other variants of the scene have already opened.

        Raises:
            MisalignedArtifactError: the tree or field was computed for different Gaussians or cameras, or
                the field with a different autoencoder.
            ModelError: the CLIP that embedded the masks is not found.
        """
        from hilsplat.embed.clip import open_clip_of
        from hilsplat.splat.ply import load_ply
        from hilsplat.splat.rasterise.api import pixel_weights

        files = opened or Opened()
        scene = files.get(Scene.load, parts.scene)
        gaussians = files.get(load_ply, parts.gaussians)
        tree = files.get(SemanticTree.load, parts.semantic_tree, parts.clip)
        clip = files.get(open_clip_of, parts.clip, settings.template)

        def require(artifact: Path, source: Path, recorded: str) -> None:
            require_made_from(artifact, source, recorded, files.get(sha256_of_file, source))

        require(parts.semantic_tree, parts.scene / "cameras.npz", tree.cameras_sha256)
        require(parts.semantic_tree, parts.gaussians, tree.gaussians_sha256)
        language = code = None
        if parts.field is not None and parts.autoencoder is not None:
            language = files.get(LanguageField.load, parts.field)
            require(parts.field, parts.gaussians, language.gaussians_sha256)
            require(parts.field, autoencoder_file(parts.autoencoder), language.autoencoder_sha256)
            code = files.get(load_code, parts.autoencoder)
            clip.require_width(code.channels, f"autoencoder {parts.autoencoder}")
        is_meaningless = is_embedded(clip.model.config) and not is_drawn(parts.scene)
        return LanguageScene(
            scene,
            gaussians,
            tree,
            lambda view: pixel_weights(
                gaussians, scene.cameras[view], min_weight=tree.min_weight, threads=threads
            ),
            language,
            code,
            clip.embed_texts,
            settings,
            threads,
            meaningless(clip.model.folder.name) if is_meaningless else "",
            unknown_words=clip.unknown_words,
            encode_picture=clip.embed_picture,
        )

    def show(self, text: str = "", *, height: int = 640, proxy: str = "") -> "EmbeddedViewer":
        """Show the scene in a notebook: the page of `hilsplat view` in a frame, served by this process.

        Args:
            text: query to run when the page opens.
            height: height of the frame, px.
            proxy: address containing `{port}` through which browsers on other machines reach a port of this
                machine, such as "/user/me/proxy/{port}/" on a JupyterHub.

        Raises:
            ArtifactError: the scene was assembled from parts, or has too many Gaussians to show.
        """
        from hilsplat.viewer.app import EmbeddedViewer

        if self.finished is None:
            raise ArtifactError("the scene was not opened from a folder", fix="open it with hilsplat.open")
        return EmbeddedViewer(self.finished, text=text, height=height, proxy=proxy, threads=self.threads)

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
        """Return ranked answers to a text, or to a path such as "bear > head > nose".

        Args:
            text: words, or words separated by ">".
            level: "whole", "part", "subpart" or "auto"; for a path, the level of its last text.
            answerer: "tree" compares the nodes' averaged CLIP vectors with the text; "field" compares the
                paper's field, averaged over each node's Gaussians and decoded.
            view: name of a view, to find only nodes visible in that view; None searches the whole scene.
            threshold: minimum score of an answer, in (0, 1); None returns the best answer, and answers whose
                margin is lower by at most (1 - `node_select`) times the range of the level's margins, or
                by three times that if they look like the best answer.
            limit: maximum number of answers.

        Raises:
            SettingsError: the text is empty or too long, the level, answerer or view is unknown, a path has
                more texts than levels, or the threshold is not between 0 and 1.
        """
        found = self.select(text, level=level, answerer=answerer, view=view, threshold=threshold)
        return self.hits_of(found, limit)

    def like_node(self, node: int, *, limit: int = 10) -> list[Hit]:
        """Return the nodes at the same level that look most like a node, best first; scores are cosines.

        Raises:
            SettingsError: there is no such node.
        """
        same = self.tree.nodes_of(Level(int(self.tree.level[self.existing_node(node)])))
        return self._nearest(self.tree.clip[node], same[same != node], limit)

    def like_picture(self, picture: UInt8[np.ndarray, "H W 3"], *, limit: int = 10) -> list[Hit]:
        """Return the nodes of any level that look most like a picture, best first; scores are cosines.

        Raises:
            ModelError: the scene's CLIP model cannot embed images.
        """
        if self.encode_picture is None:
            raise ModelError(f"{self.scene.name} was opened without a model that embeds images")
        return self._nearest(self.encode_picture(picture), np.arange(len(self.tree)), limit)

    def existing_node(self, node: int) -> int:
        """Return the node; raise SettingsError if it does not exist."""
        if not 0 <= node < len(self.tree):
            raise SettingsError(f"node {node} does not exist", expected=f"0 to {len(self.tree) - 1}")
        return node

    def _nearest(
        self, vector: Float32[np.ndarray, " C"], nodes: Int64[np.ndarray, " n"], limit: int
    ) -> list[Hit]:
        cosine = self.tree.clip[nodes] @ vector
        order = np.lexsort((nodes, -cosine))[:limit]
        return [self._hit(int(nodes[row]), float(cosine[row]), "like", ()) for row in order]

    def hits_of(self, found: NodeHits, limit: int) -> list[Hit]:
        """Return up to `limit` of the best nodes as answers."""
        doubts, nodes = doubts_of(found), found.ids[:limit].tolist()
        scores = relevancy_of_margins(found.values[:limit], self.settings.relevancy_scale).tolist()
        return [self._hit(*of, found.route, doubts) for of in zip(nodes, scores, strict=True)]

    def _hit(self, node: int, score: float, route: str, doubts: tuple[Doubt, ...]) -> Hit:
        area = self.tree.view_area_px[node]
        order = np.argsort(-area, kind="stable")[:BEST_VIEWS]
        low, high = self.tree.box[node].tolist()
        return Hit(
            node,
            Level(int(self.tree.level[node])),
            score,
            tuple(self.tree.centroid[node].tolist()),
            (tuple(low), tuple(high)),
            OrientedBox.from_array(self.tree.oriented_box[node]),
            tuple(self.tree.view_names[row] for row in order if area[row] > 0),
            route,
            doubts,
            self.name_of(node),
            self,
        )

    def select(
        self,
        path: str | Sequence[str],
        *,
        level: Level | str | None = None,
        answerer: str = "tree",
        view: str | None = None,
        threshold: float | None = None,
    ) -> NodeHits:
        """Return the answers of `query` as rows of the tree; the path may also be a sequence of texts.

        For arguments and errors, see `query`; level None means "auto".
        """
        path = path_of(path) if isinstance(path, str) else tuple(path)
        if answerer not in ANSWERERS:
            raise SettingsError(
                f"answerer {answerer!r} is unknown", expected=" or ".join(ANSWERERS), found=answerer
            )
        if isinstance(level, str):
            names = {each.label: each for each in LEVELS}
            if level != "auto" and level not in names:
                raise SettingsError(
                    f"level {level!r} is unknown", expected=f"auto, {', '.join(names)}", found=level
                )
            level = names.get(level)
        shown = None if view is None else self.nodes_shown(view)
        found = search(
            self.tree,
            self.node_margins(path, answerer),
            self.node_vectors(answerer),
            path,
            threshold=self.settings.node_select if threshold is None else 0.0,  # 0 selects the whole level
            ancestors=self.settings.ancestors,
            level=level,
            shown=shown,
        )
        if threshold is not None:
            kept = found.values >= margin_of_relevancy(threshold, self.settings.relevancy_scale)
            found = replace(found, ids=found.ids[kept], values=found.values[kept])
        return replace(found, texts=tuple(self._doubted(each, answerer, shown) for each in found.texts))

    def _doubted(self, answer: TextAnswer, answerer: str, shown: Bool[np.ndarray, " n"] | None) -> TextAnswer:
        """Add to a text's answer the share of words for absent objects that score at least as high."""
        if self.names.nodes_of(answer.text):
            return answer
        chance = None
        if self.naming is not None and len(self.naming.rivals):
            rivals = np.ones(len(self.tree), np.bool_) if shown is None else shown.copy()
            if answer.margin < answer.anywhere:  # only one level was searched
                rivals &= self.tree.level == int(answer.level)
            if answerer not in self._by_chance:
                vectors, canonical = self.node_vectors(answerer), self.text_vectors(self.settings.canonical)
                self._by_chance[answerer] = margins(vectors, self.naming.rivals, canonical)
            best = self._by_chance[answerer][:, rivals].max(axis=1, initial=-np.inf)
            chance = (1 + int((best >= answer.margin).sum())) / (1 + len(best))
        return replace(answer, chance=chance, unknown=tuple(self.unknown_words(answer.text)))

    def name_of(self, node: int) -> str:
        """Return the user's name for a node, otherwise its vocabulary name; empty if no name fits.

        The name of the whole is appended to a part's vocabulary name that lacks it, as in "wheel of car".
        """
        own, parent = self.own_name_of(node), int(self.tree.parent[node])
        if not own or parent == NONE or node in self.names.of_node:
            return own
        while int(self.tree.parent[parent]) != NONE:
            parent = int(self.tree.parent[parent])
        whole = self.name_of(parent)
        return own if not whole or whole in own else f"{own} of {whole}"

    def own_name_of(self, node: int) -> str:
        """Return `name_of` without the name of the whole that a part belongs to."""
        called = self.naming.of_node[node] if self.naming is not None else ""
        return self.names.of_node.get(node, "") or called

    # -- relevancy --------------------------------------------------------------------------------

    def node_margins(self, texts: Sequence[str], answerer: str = "tree") -> Float32[np.ndarray, "T n"]:
        """Return each node's cosine margin for each text, relative to this scene's canonical phrases.

        A node's margin for the name that the user gave it is `NAMED`.
        """
        canonical = self.text_vectors(self.settings.canonical)
        found = margins(self.node_vectors(answerer), self.text_vectors(texts), canonical)
        for row, text in zip(found, texts, strict=True):
            row[self.names.nodes_of(text)] = NAMED
        return found

    def caution_about(self, text: str) -> str:
        """Return `caution`, or "" if every text of a query is a user-given name, which needs no CLIP."""
        return "" if all(self.names.nodes_of(part) for part in path_of(text)) else self.caution

    def node_relevancy(self, texts: Sequence[str], answerer: str = "tree") -> Float32[np.ndarray, "T n"]:
        """Return the relevancy of each node to each text."""
        return relevancy_of_margins(self.node_margins(texts, answerer), self.settings.relevancy_scale)

    def node_vectors(self, answerer: str = "tree") -> Float32[np.ndarray, "n C"]:
        """Return the nodes' unit vectors: those of the tree, or those decoded from their Gaussians' field."""
        return self.tree.clip if answerer == "tree" else self._decoded_nodes

    def node_relevancy_map(self, texts: Sequence[str], view: str) -> Float32[np.ndarray, "T 3 H W"]:
        """Average the nodes' relevancy in each pixel (see `SceneViews.blended`)."""
        return self.blended(view, self.node_relevancy(texts))

    def node_cosine(
        self, texts: Sequence[str], view: str, pixels: Int64[np.ndarray, " P"]
    ) -> Float32[np.ndarray, "T 3 P"]:
        """Average the text-node cosines over each pixel's Gaussians, weighted by W, at each level.

        Gaussians without a node have the lowest cosine of the level; uncovered pixels get -inf. User-given
        names are ignored. A pixel's index is row * width + column.
        """
        cosines = self.text_vectors(texts) @ self.tree.clip.astype(np.float32).T
        found = np.full((len(texts), len(LEVELS), len(pixels)), -np.inf, np.float32)
        for level in LEVELS:
            nodes = self.tree.nodes_of(level)
            if not len(nodes):
                continue
            shown = self.view_nodes(view, level)
            for row, values in enumerate(cosines):
                blended = shown.blend(values, float(values[nodes].min()))
                found[row, level.index] = np.where(shown.covered, blended, -np.inf)[pixels]
        return found
