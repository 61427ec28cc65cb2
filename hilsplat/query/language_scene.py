"""A finished scene that accepts text queries, on its semantic tree or on its decoded language field.

`hilsplat.open` opens it; docs/python.md shows how to query it. From text to Gaussians: `query` parses the
text, `select` searches the tree by cosine margins (`node_search.search`), and each `Hit` has its Gaussians.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast, get_args

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float32, Int64, UInt8

from hilsplat.base.artifacts import sha256_of_file
from hilsplat.base.errors import ArtifactError, ModelError, SettingsError
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.field.code import Code, autoencoder_file, load_code
from hilsplat.field.language_field import LanguageField
from hilsplat.models.store import is_embedded, meaningless
from hilsplat.query.caches import Opened, ViewStore
from hilsplat.query.field_answers import FieldAnswers
from hilsplat.query.hits import Doubt, Hit, doubts_of
from hilsplat.query.names import PATH_SEPARATOR, NodeNames, read_names
from hilsplat.query.node_names import NodeNaming
from hilsplat.query.node_search import NodeHits, TextAnswer, search
from hilsplat.query.relevancy import margin_of_relevancy, margins, relevancy_of_margins
from hilsplat.query.scene_views import SceneViews, members_of
from hilsplat.scene.finished import FinishedScene, SceneParts, is_drawn, require_made_for
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.boxes import OrientedBox
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import EvaluateSettings
from hilsplat.splat.gaussians import Gaussians

if TYPE_CHECKING:
    from hilsplat.viewer.embedded import EmbeddedViewer

logger = logging.getLogger(__name__)

NAMED = 2.0
"""Cosine margin of a node for the name that the user gave it: the maximum, so that it is ranked first."""

BEST_VIEWS = 3
"""Maximum number of views of an answer."""

TextEncoder = Callable[[list[str]], np.ndarray]
PictureEncoder = Callable[[np.ndarray], np.ndarray]
Answerer = Literal["tree", "field"]


@dataclass(frozen=True)
class LanguageScene:
    """A finished scene that accepts text queries.

    Attributes:
        language: the field; None if the run has not computed it yet, and only the tree accepts queries.
        autoencoder: decodes the field; None if there is no field.
        encode_texts: returns the unit CLIP vectors of texts.
        pixel_weights: returns the compositing weights of a view (pixels x Gaussians).
        settings: canonical phrases, relevancy scale, and selection of nodes.
        caution: sentence that explains why CLIP's answers are meaningless here; empty if they are not.
        names: the user's names for nodes, which are matched first.
        naming: vocabulary names of the nodes, and words for absent things; None if the stage has not run.
        unknown_words: returns the words of a text that are not in the text model's vocabulary.
        encode_picture: returns the unit CLIP vector of an RGB image; None if images cannot be embedded.
        finished: location and variant of the scene; None if it was assembled from parts.
    """

    scene: Scene
    gaussians: Gaussians
    tree: SemanticTree
    language: LanguageField | None
    autoencoder: Code | None
    encode_texts: TextEncoder
    pixel_weights: Callable[[str], sp.csr_matrix]
    settings: EvaluateSettings = field(default_factory=EvaluateSettings)
    threads: int = 1
    caution: str = ""
    names: NodeNames = field(default_factory=NodeNames)
    naming: NodeNaming | None = field(default=None, repr=False)
    unknown_words: Callable[[str], list[str]] = field(default=lambda text: [], repr=False)
    encode_picture: PictureEncoder | None = field(default=None, repr=False)
    finished: FinishedScene | None = field(default=None, repr=False)
    _views: ViewStore = field(default_factory=ViewStore, repr=False)
    _texts: dict[str, np.ndarray] = field(default_factory=dict, repr=False)
    _by_chance: dict[str, np.ndarray] = field(default_factory=dict, repr=False)

    @staticmethod
    def open(folder: Path | str, variant: str = "default", *, threads: int = 1) -> "LanguageScene":
        """Open `results/<dataset>/<scene>`, or a copy of it anywhere, with the settings that made it.

        Canonical phrases, template, scale and node selection are read from the provenance of the variant's
        evaluation, or of its panel if the scene has no labels.

        Args:
            folder: a finished scene.
            variant: named set of settings whose files are queried.
            threads: number of threads for rasterising and look-ups.

        Raises:
            ArtifactError: the scene is not finished.
            MisalignedArtifactError: its parts do not belong together.
            ModelError: the CLIP that embedded its masks is not found.
        """
        scene = LanguageScene.of(FinishedScene.locate(Path(folder), variant), threads=threads)
        if scene.caution:
            logger.warning("%s: %s", scene.scene.name, scene.caution)
        return scene

    @staticmethod
    def of(found: FinishedScene, *, threads: int = 1, opened: Opened | None = None) -> "LanguageScene":
        """Open a located finished scene with its own settings and its nodes' names."""
        scene = LanguageScene.from_parts(
            found.parts,
            found.evaluate_settings(),
            threads=threads,
            opened=opened,
            names=read_names(found.folder, found.parts.semantic_tree),
            naming=NodeNaming.load(found.naming, found.parts.semantic_tree, found.parts.clip),
        )
        return replace(scene, finished=found)

    @staticmethod
    def from_parts(
        parts: SceneParts,
        settings: EvaluateSettings,
        *,
        threads: int = 1,
        opened: Opened | None = None,
        names: NodeNames | None = None,
        naming: NodeNaming | None = None,
    ) -> "LanguageScene":
        """Read a scene's artifacts, each once, and check that they belong together.

        Args:
            parts: paths of the artifacts.
            settings: canonical phrases, template, relevancy scale and selection of nodes.
            threads: number of threads for rasterising and look-ups; results do not depend on it.
            opened: artifacts that other variants of the scene have already opened.
            names: the user's names for nodes; None in evaluation, which scores only the models.
            naming: vocabulary names of the nodes; None in evaluation, which then reports no chance.

        Raises:
            MisalignedArtifactError: the tree or field was made for other Gaussians or cameras, or the field
                for another autoencoder.
            ModelError: the CLIP that embedded the masks is not found.
        """
        from hilsplat.embed.clip import open_clip_of
        from hilsplat.splat.ply import load_ply
        from hilsplat.splat.rasterise.api import pixel_weights

        opened = opened or Opened()
        scene = opened.get(Scene.load, parts.scene)
        gaussians = opened.get(load_ply, parts.gaussians)
        tree = opened.get(SemanticTree.load, parts.semantic_tree, parts.clip)
        made_for = {"semantic tree": tree.gaussians_sha256}
        clip = opened.get(open_clip_of, parts.clip, threads, settings.template)
        language = code = None
        if parts.field is not None and parts.autoencoder is not None:
            language = opened.get(LanguageField.load, parts.field)
            made_for["language field"] = language.gaussians_sha256
            code_file = autoencoder_file(parts.autoencoder)
            own = {"language field": language.autoencoder_sha256}
            require_made_for(code_file, opened.get(sha256_of_file, code_file), scene.name, own)
            code = opened.get(load_code, parts.autoencoder)
            clip.require_width(code.channels, f"autoencoder {parts.autoencoder}")
        cameras = parts.scene / "cameras.npz"
        own = {"semantic tree": tree.cameras_sha256}
        require_made_for(cameras, opened.get(sha256_of_file, cameras), scene.name, own)
        require_made_for(parts.gaussians, opened.get(sha256_of_file, parts.gaussians), scene.name, made_for)
        drawn = is_drawn(parts.scene)
        return LanguageScene(
            scene,
            gaussians,
            tree,
            language,
            code,
            clip.embed_texts,
            lambda view: pixel_weights(
                gaussians, scene.cameras[view], min_weight=tree.min_weight, threads=threads
            ),
            settings,
            threads,
            meaningless(clip.model.folder.name) if is_embedded(clip.model.config) and not drawn else "",
            names=names or NodeNames(),
            naming=naming,
            unknown_words=clip.unknown_words,
            encode_picture=clip.embed_picture,
        )

    def show(self, text: str = "", *, height: int = 640, proxy: str = "") -> "EmbeddedViewer":
        """Show the scene in a notebook: the page of `hilsplat view` in a frame, served by this process.

        Args:
            text: the first query; "" for none.
            height: height of the frame, px.
            proxy: address, containing `{port}`, under which the browser reaches a port of this machine, if
                the browser runs on another machine: "/user/me/proxy/{port}/" on a JupyterHub.

        Raises:
            ArtifactError: the scene was assembled from parts, or has too many Gaussians to show.
        """
        from hilsplat.viewer.embedded import EmbeddedViewer

        if self.finished is None:
            raise ArtifactError("the scene was put together from parts", fix="open it with hilsplat.open")
        return EmbeddedViewer(self.finished, text=text, height=height, proxy=proxy, threads=self.threads)

    def trained(self) -> tuple[LanguageField, Code]:
        """Return the language field and the code that decodes it.

        Raises:
            ArtifactError: the run has not computed them yet.
        """
        if self.language is None or self.autoencoder is None:
            raise ArtifactError(
                f"{self.scene.name} has no language field yet",
                fix="let its tree answer, or wait for the run to end",
            )
        return self.language, self.autoencoder

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
        """Return ranked answers to a text, or to a path such as "bear > head > nose"; several for "mugs".

        Args:
            text: words, or words separated by ">".
            level: "whole", "part", "subpart" or "auto"; for a path, the level of its last text.
            answerer: "tree" compares the nodes' averaged CLIP vectors with the text; "field" compares the
                decoded mean of the paper's field over their Gaussians.
            view: name of a view, to find only nodes that it shows; None: the whole scene.
            threshold: minimum score of an answer, in (0, 1); None: answers near the best, whose margin is at
                most (1 - `node_select`) times the range of the level's margins below it, or three times that
                if they look like it.
            limit: maximum number of answers.

        Raises:
            SettingsError: the text is empty, the level, answerer or view is unknown, a path has more texts
                than levels, or the threshold is not between 0 and 1.
        """
        return self.hits_of(self.find(text, level, answerer=answerer, view=view, threshold=threshold), limit)

    def like_node(self, node: int, *, limit: int = 10) -> list[Hit]:
        """Return the nodes of a node's own level that look most like it, best first; scores are cosines.

        This compares averaged CLIP vectors of masks, so it needs no text.

        Raises:
            SettingsError: there is no such node.
        """
        if not 0 <= node < len(self.tree):
            raise SettingsError(f"there is no node {node}", expected=f"0 to {len(self.tree) - 1}")
        same = self.tree.nodes_of(Level(int(self.tree.level[node])))
        return self._nearest(self.tree.clip[node], same[same != node], limit)

    def like_picture(self, picture: UInt8[np.ndarray, "H W 3"], *, limit: int = 10) -> list[Hit]:
        """Return the nodes of any level that look most like a picture, best first; scores are cosines.

        Raises:
            ModelError: the CLIP of this scene cannot embed pictures.
        """
        if self.encode_picture is None:
            raise ModelError(f"{self.scene.name} was opened without a model that embeds pictures")
        return self._nearest(self.encode_picture(picture), np.arange(len(self.tree)), limit)

    def _nearest(
        self, vector: Float32[np.ndarray, " C"], nodes: Int64[np.ndarray, " n"], limit: int
    ) -> list[Hit]:
        cosine = self.tree.clip[nodes] @ vector
        order = np.lexsort((nodes, -cosine))[:limit]
        return [self._hit(int(nodes[row]), float(cosine[row]), "like", ()) for row in order]

    def hits_of(self, found: NodeHits, limit: int) -> list[Hit]:
        """Return the best nodes, at most `limit`, as answers."""
        doubts = doubts_of(found)
        best = zip(found.ids[:limit].tolist(), found.values[:limit], strict=True)
        return [self._hit(node, self._score(value), found.route, doubts) for node, value in best]

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
            self._shown,
        )

    def find(
        self,
        text: str,
        level: str = "auto",
        *,
        answerer: str = "tree",
        view: str | None = None,
        threshold: float | None = None,
    ) -> NodeHits:
        """Return the answers of `query` as rows of the tree."""
        path = path_of(text)
        if answerer not in get_args(Answerer):
            raise SettingsError(
                f"answerer {answerer!r} is unknown",
                expected=" or ".join(get_args(Answerer)),
                found=answerer,
            )
        names = {each.label: each for each in LEVELS}
        if level != "auto" and level not in names:
            raise SettingsError(
                f"level {level!r} is unknown", expected=f"auto, {', '.join(names)}", found=level
            )
        chosen = cast(Answerer, answerer)
        return self.select(path, level=names.get(level), answerer=chosen, view=view, threshold=threshold)

    def select(
        self,
        path: Sequence[str],
        *,
        level: Level | None = None,
        answerer: Answerer = "tree",
        view: str | None = None,
        threshold: float | None = None,
    ) -> NodeHits:
        """Search the nodes for the texts of a path, coarse to fine; `query` and `find` call this.

        Arguments and errors as in `query`, but with the last text's level as a `Level`, or None for any.
        """
        shown = None if view is None else self.nodes_shown(view)
        found = search(
            self.tree,
            self.node_margins(path, answerer),
            self.node_vectors(answerer),
            tuple(path),
            threshold=self.settings.node_select if threshold is None else 0.0,  # 0: the whole level
            ancestors=self.settings.ancestors,
            level=level,
            shown=shown,
        )
        if threshold is not None:
            kept = found.values >= margin_of_relevancy(threshold, self.settings.relevancy_scale)
            found = replace(found, ids=found.ids[kept], values=found.values[kept])
        return replace(found, texts=tuple(self._doubted(each, answerer, shown) for each in found.texts))

    def _doubted(
        self, answer: TextAnswer, answerer: Answerer, shown: Bool[np.ndarray, " n"] | None
    ) -> TextAnswer:
        """Return a text's answer with the share of words for absent things that score as high."""
        if self.names.nodes_of(answer.text):
            return answer
        chance = None
        if self.naming is not None and len(self.naming.rivals):
            rivals = np.ones(len(self.tree), np.bool_) if shown is None else shown.copy()
            if answer.margin < answer.anywhere:  # only one level was searched
                rivals &= self.tree.level == int(answer.level)
            best = self._margins_by_chance(answerer, self.naming)[:, rivals].max(axis=1, initial=-np.inf)
            chance = (1 + int((best >= answer.margin).sum())) / (1 + len(best))
        return replace(answer, chance=chance, unknown=tuple(self.unknown_words(answer.text)))

    def _margins_by_chance(self, answerer: Answerer, naming: NodeNaming) -> Float32[np.ndarray, "W n"]:
        """Return each node's cosine margin for the words for absent things (`NodeNaming.rivals`)."""
        if answerer not in self._by_chance:
            canonical = self.text_vectors(self.settings.canonical)
            self._by_chance[answerer] = margins(self.node_vectors(answerer), naming.rivals, canonical)
        return self._by_chance[answerer]

    def name_of(self, node: int) -> str:
        """Return the user's name for a node, otherwise its vocabulary name; empty if nothing fits.

        The vocabulary name of a part includes its whole, as in "wheel of car", unless it already does.
        """
        own, parent = self.own_name_of(node), int(self.tree.parent[node])
        if not own or parent == NONE or node in self.names.of_node:
            return own
        while int(self.tree.parent[parent]) != NONE:
            parent = int(self.tree.parent[parent])
        whole = self.name_of(parent)
        return own if not whole or whole in own else f"{own} of {whole}"

    def own_name_of(self, node: int) -> str:
        """Return `name_of` without the whole that a part belongs to."""
        called = self.naming.of_node[node] if self.naming is not None else ""
        return self.names.of_node.get(node, "") or called

    def nodes_shown(self, view: str) -> Bool[np.ndarray, " n"]:
        """Return which nodes have a mask of at least `MIN_SHOWN_SHARE` of a view."""
        return self._shown.shown(view)

    def gaussians_of(self, ids: Sequence[int] | Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " g"]:
        """Return the rows of `gaussians.ply` that belong to any of the nodes."""
        return members_of(self.tree, ids)

    def node_masks(self, view: str, ids: Sequence[int] | Int64[np.ndarray, " n"]) -> Bool[np.ndarray, "H W"]:
        """Return the pixels in which the nodes' Gaussians have a share above 0.5."""
        return self._shown.masks(view, ids)

    # -- views ------------------------------------------------------------------------------------

    @property
    def views(self) -> tuple[str, ...]:
        """Names of all views, in camera order."""
        return self.scene.cameras.names

    def image(self, view: str) -> UInt8[np.ndarray, "H W 3"]:
        """Return a view's undistorted photograph; it is cached and read-only, so copy it to draw on it."""
        return self._shown.image(view)

    def forget(self, view: str) -> None:
        """Free the cached results of a view; later queries recompute them."""
        self._views.forget(view)

    # -- relevancy --------------------------------------------------------------------------------

    def text_vectors(self, texts: Sequence[str]) -> Float32[np.ndarray, "T C"]:
        """Return the unit CLIP vectors of texts; each text is encoded once."""
        new = [text for text in dict.fromkeys(texts) if text not in self._texts]
        if new:
            self._texts.update(zip(new, np.asarray(self.encode_texts(new), np.float32), strict=True))
        return np.stack([self._texts[text] for text in texts])

    def node_margins(self, texts: Sequence[str], answerer: Answerer = "tree") -> Float32[np.ndarray, "T n"]:
        """Return each node's cosine margin for each text, relative to this scene's canonical phrases.

        A node has the margin `NAMED` for the name that the user gave it.
        """
        if not len(texts):
            return np.zeros((0, len(self.tree)), np.float32)
        canonical = self.text_vectors(self.settings.canonical)
        found = margins(self.node_vectors(answerer), self.text_vectors(texts), canonical)
        for row, text in zip(found, texts, strict=True):
            row[self.names.nodes_of(text)] = NAMED
        return found

    def caution_about(self, text: str) -> str:
        """Return `caution`, or "" if every text of a query is a user-given name, so that CLIP is not used."""
        return "" if all(self.names.nodes_of(part) for part in path_of(text)) else self.caution

    def node_relevancy(self, texts: Sequence[str], answerer: Answerer = "tree") -> Float32[np.ndarray, "T n"]:
        """Return the relevancy of each node to each text."""
        return relevancy_of_margins(self.node_margins(texts, answerer), self.settings.relevancy_scale)

    def _score(self, margin: float) -> float:
        return float(relevancy_of_margins(np.array([margin]), self.settings.relevancy_scale)[0])

    def node_vectors(self, answerer: Answerer = "tree") -> Float32[np.ndarray, "n C"]:
        """Return the nodes' unit vectors: their own, or decoded from the field of their Gaussians."""
        return self.tree.clip if answerer == "tree" else self._field.node_vectors

    def node_relevancy_map(self, texts: Sequence[str], view: str) -> Float32[np.ndarray, "T 3 H W"]:
        """Blend the relevancy of the nodes that each pixel shows by its weights, at each level.

        For Gaussians without a node and for uncovered pixels, see `SceneViews.blended`.
        """
        return self._shown.blended(view, self.node_relevancy(texts))

    def field_relevancy(
        self, texts: Sequence[str], view: str, *, exact: bool = True
    ) -> Float32[np.ndarray, "T 3 H W"]:
        """Compute relevancy from decoded rendered latents at every pixel and level, as in the paper.

        Pixels that show mostly Gaussians without a latent at the level count as uncovered (see
        `node_relevancy_map`).

        Args:
            texts: queries.
            view: name of the view.
            exact: whether a network decodes every pixel at every call; otherwise a view is decoded once, and
                results differ by at most 2e-3 (see `LatentRelevancy`). No difference for a linear code.
        """
        return self._field.relevancy(texts, view, exact=exact)

    def node_cosine(
        self, texts: Sequence[str], view: str, pixels: Int64[np.ndarray, " P"]
    ) -> Float32[np.ndarray, "T 3 P"]:
        """Blend the cosines of texts with the nodes that pixels show by their weights, at each level.

        Gaussians without a node have the lowest cosine of the level; uncovered pixels have -inf. User-given
        names are ignored. A pixel's number is row * width + column.
        """
        cosines = self.text_vectors(texts) @ self.tree.clip.astype(np.float32).T
        found = np.full((len(texts), len(LEVELS), len(pixels)), -np.inf, np.float32)
        for level in LEVELS:
            nodes = self.tree.nodes_of(level)
            if not len(nodes):
                continue
            shown = self._shown.nodes(view, level)
            for row, values in enumerate(cosines):
                blended = shown.blend(values, float(values[nodes].min()))
                found[row, level.index] = np.where(shown.covered, blended, -np.inf)[pixels]
        return found

    def field_cosine(
        self, texts: Sequence[str], view: str, pixels: Int64[np.ndarray, " P"]
    ) -> Float32[np.ndarray, "T 3 P"]:
        """Return the cosines of texts with the rendered, decoded latents of pixels, at each level.

        Pixels that show mostly Gaussians without a latent have -inf. Arguments as in `node_cosine`.
        """
        return self._field.cosine(texts, view, pixels)

    def gaussian_relevancy(self, text: str, level: str = "auto") -> Float32[np.ndarray, " N"]:
        """Return each Gaussian's field relevancy at a level, or its maximum over levels; 0 if no latent."""
        return self._field.of_gaussians(text, level)

    def field_image(self, view: str, level: Level) -> UInt8[np.ndarray, "H W 3"]:
        """Render the field of a level as colours (see `field_colours`); uncovered pixels are black."""
        return self._field.image(view, level)

    def view_weights(self, view: str) -> sp.csr_matrix:
        """Return W of a view with rows divided by alpha; rows with an alpha below 0.5 are empty."""
        return self._shown.weights(view)

    @cached_property
    def _shown(self) -> SceneViews:
        return SceneViews(self.scene, self.tree, self.pixel_weights, self._views)

    @cached_property
    def _field(self) -> FieldAnswers:
        language, code = self.trained()
        return FieldAnswers(language, code, self._shown, self.text_vectors, self.settings, self.threads)


def path_of(text: str) -> tuple[str, ...]:
    """Return the texts of a query, coarse to fine: one, or those of a path such as "bear > head > nose".

    Raises:
        SettingsError: a text is empty or not UTF-8.
    """
    if not text.isascii() and text != text.encode(errors="replace").decode():
        raise SettingsError(
            f"the query {text!r} is not UTF-8 text", fix="set the terminal to UTF-8, or write it in ASCII"
        )
    path = tuple(part.strip() for part in text.split(PATH_SEPARATOR))
    if not all(path):
        raise SettingsError(
            f"a text of the query {text!r} is empty",
            fix='write words, or a path such as "bear > head > nose"',
        )
    return path
