"""A finished scene that accepts text queries of its semantic tree or its decoded language field.

docs/python.md describes the usage. `query` parses the text, `select` searches the tree by cosine margins
(`node_search.search`), and each `Hit` has its Gaussians.
"""

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8

from hilsplat.base.errors import ArtifactError, SettingsError
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.lineage import require_made_from, sha256_of_file
from hilsplat.embed.clip import ClipModel, open_clip_of
from hilsplat.field.code import LanguageField, autoencoder_file, load_code
from hilsplat.query.field_answers import FieldAnswers
from hilsplat.query.hits import Doubt, Hit, Node, checked_count, doubts_of
from hilsplat.query.names import NodeNames, read_names
from hilsplat.query.node_names import NodeNaming
from hilsplat.query.node_queries import NodeQueries, caution_of
from hilsplat.query.node_search import NodeHits
from hilsplat.query.relevancy import relevancy_of_margins
from hilsplat.query.scene_views import Opened, SceneViews, View, ViewStore
from hilsplat.scene.cameras import Camera
from hilsplat.scene.finished import FinishedScene, SceneParts
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.tree import OrientedBox, SemanticTree
from hilsplat.settings import EvaluateSettings
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import Rendering, render

logger = logging.getLogger(__name__)

BEST_VIEWS = 3  # maximum number of best views of an answer


@dataclass(frozen=True, eq=False)
class LanguageScene(NodeQueries):
    """A finished scene that accepts text queries.

    Attributes:
        views: the views, with the Gaussians and nodes that they show.
        decoded_field: relevancy from the language field; None if the run has not computed it yet.
    """

    views: SceneViews
    clip: ClipModel
    settings: EvaluateSettings
    decoded_field: FieldAnswers | None = None
    names: NodeNames = dataclasses.field(default_factory=NodeNames)
    naming: NodeNaming | None = None
    _rival_margins: dict[str, np.ndarray] = dataclasses.field(default_factory=dict, repr=False, kw_only=True)

    def __repr__(self) -> str:
        nodes = ", ".join(f"{len(self.tree.nodes_of(level))} {level.label}" for level in LEVELS)
        counts = f"{len(self.views.names)} views, {len(self.gaussians)} Gaussians, nodes: {nodes}"
        return f"LanguageScene({self.scene.name}: {counts})"

    @staticmethod
    def of(finished: FinishedScene, *, threads: int = 1, opened: Opened | None = None) -> "LanguageScene":
        """Open a finished scene with its own settings and the names of its nodes."""
        parts = finished.parts
        scene = LanguageScene.from_parts(parts, finished.evaluate_settings(), threads=threads, opened=opened)
        names = read_names(finished.folder, parts.semantic_tree)
        naming = NodeNaming.load(parts.clip.parent / "names", parts.semantic_tree, parts.clip)
        if naming is not None and scene.caution:  # the vocabulary's model cannot describe this scene
            count = len(naming.of_node)
            naming = replace(naming, of_node=("",) * count, surfaces=(False,) * count)
        return replace(scene, names=names, naming=naming)

    @staticmethod
    def from_parts(
        parts: SceneParts, settings: EvaluateSettings, *, threads: int = 1, opened: Opened | None = None
    ) -> "LanguageScene":
        """Read each artifact of a scene once, except node names, and check that the artifacts match.

        Args:
            opened: artifacts that other variants of the scene have already opened.

        Raises:
            MisalignedArtifactError: the tree or field was computed for different Gaussians or cameras, or
                the field with a different autoencoder.
            ModelError: the CLIP that embedded the masks is not found.
        """
        files = opened or Opened()
        scene = files.get(Scene.load, parts.scene)
        gaussians = files.get(load_ply, parts.gaussians)
        tree = files.get(SemanticTree.load, parts.semantic_tree, parts.clip)
        clip = files.get(open_clip_of, parts.clip, settings.template)
        views = SceneViews(scene, gaussians, tree, threads, ViewStore(files.max_mib))

        def require(artifact: Path, source: Path, recorded: str) -> None:
            require_made_from(artifact, source, recorded, files.get(sha256_of_file, source))

        require(parts.semantic_tree, parts.scene / "cameras.npz", tree.cameras_sha256)
        require(parts.semantic_tree, parts.gaussians, tree.gaussians_sha256)
        decoded_field = None
        if parts.field is not None and parts.autoencoder is not None:
            language = LanguageField.load(parts.field)  # not kept: variants have fields of their own
            require(parts.field, parts.gaussians, language.gaussians_sha256)
            require(parts.field, autoencoder_file(parts.autoencoder), language.autoencoder_sha256)
            code = files.get(load_code, parts.autoencoder)
            clip.require_width(code.channels, f"autoencoder {parts.autoencoder}")
            decoded_field = FieldAnswers(views, language, code, clip, settings)
        return LanguageScene(views, clip, settings, decoded_field)

    @property
    def scene(self) -> Scene:
        """Cameras, photographs and split."""
        return self.views.scene

    @property
    def gaussians(self) -> Gaussians:
        """The scene's Gaussians, in the order of `gaussians.ply`."""
        return self.views.gaussians

    @property
    def tree(self) -> SemanticTree:
        """The scene's nodes."""
        return self.views.tree

    @cached_property
    def nodes(self) -> tuple[Node, ...]:
        """The tree's nodes, by row, as queries return them."""
        return tuple(map(self._node, range(len(self.tree))))

    def camera(self, view: str) -> Camera:
        """Return the camera of a view; raise SettingsError if the scene has no such view."""
        return self.views.camera(view)

    def render(self, view: View) -> Rendering:
        """Render the Gaussians in a view of the scene or any camera, over black; errors as in `camera`."""
        return render(self.gaussians, self.views.camera(view), threads=self.views.threads)

    @property
    def field(self) -> FieldAnswers:
        """Relevancy from the language field; raises ArtifactError if it is not computed yet."""
        if self.decoded_field is None:
            fix = "query its tree, or wait for the run to end"
            raise ArtifactError(f"{self.scene.name} has no language field yet", fix=fix)
        return self.decoded_field

    @cached_property
    def caution(self) -> str:
        return caution_of(self.clip, self.scene.folder)

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
        nodes = self.select(text, level=level, answerer=answerer, view=view, threshold=threshold)
        return self.hits_of(nodes, limit)

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
            SettingsError: the picture has another type or shape, or no pixel.
        """
        is_array = isinstance(picture, np.ndarray)
        if not is_array or picture.dtype != np.uint8 or picture.shape[2:] != (3,) or not picture.size:
            raise SettingsError(
                "the picture is not an RGB image",
                expected="a (height, width, 3) array of uint8",
                found=f"{picture.dtype} of shape {picture.shape}" if is_array else type(picture).__name__,
            )
        return self._nearest(self.clip.embed_picture(picture), np.arange(len(self.tree)), limit)

    def existing_node(self, node: int) -> int:
        """Return the node; raise SettingsError if it does not exist."""
        return int(self.views.existing([node])[0])

    def _nearest(
        self, vector: Float32[np.ndarray, " C"], nodes: Int64[np.ndarray, " n"], limit: int
    ) -> list[Hit]:
        """Return the nodes, given in ascending order, whose vectors are nearest to a vector."""
        cosine = self.tree.clip[nodes] @ vector
        order = np.argsort(-cosine, kind="stable")[: checked_count(limit)]
        return [self._hit(int(nodes[row]), float(cosine[row]), "like", ()) for row in order]

    def hits_of(self, nodes: NodeHits, limit: int) -> list[Hit]:
        """Return up to `limit` of the best nodes as answers."""
        doubts, first = doubts_of(nodes), slice(checked_count(limit))
        return [
            self._hit(node, score, nodes.route, doubts)
            for node, score in zip(nodes.ids[first].tolist(), self.scores_of(nodes)[first], strict=True)
        ]

    def scores_of(self, nodes: NodeHits) -> list[float]:
        """Return the relevancies of selected nodes."""
        return relevancy_of_margins(nodes.values, self.settings.relevancy_scale).tolist()

    def _hit(self, node: int, score: float, route: str, doubts: tuple[Doubt, ...]) -> Hit:
        return Hit(**vars(self._node(node)), score=score, route=route, doubts=doubts)

    def _node(self, node: int) -> Node:
        area = self.tree.view_area_px[node]
        order = np.argsort(-area, kind="stable")[:BEST_VIEWS]
        low, high = self.tree.box[node].tolist()
        return Node(
            node,
            Level(int(self.tree.level[node])),
            int(self.tree.parent[node]),
            tuple(self.tree.centroid[node].tolist()),
            (tuple(low), tuple(high)),
            OrientedBox.from_array(self.tree.oriented_box[node]),
            tuple(self.tree.view_names[row] for row in order if area[row] > 0),
            self.name_of(node),
            self.views,
        )

    def _visible(self, view: str | None) -> Bool[np.ndarray, " n"]:
        return super()._visible(view) if view is None else self.views.visible_nodes(view)

    # -- relevancy --------------------------------------------------------------------------------

    def node_vectors(self, answerer: str = "tree") -> Float32[np.ndarray, "n C"]:
        """Return the nodes' unit vectors: those of the tree, or those decoded from their Gaussians' field."""
        return self.tree.clip if answerer == "tree" else self.field.node_vectors

    def node_relevancy_map(self, texts: Sequence[str], view: View) -> Float32[np.ndarray, "T 3 H W"]:
        """Average the nodes' relevancy in each pixel (see `SceneViews.blended`)."""
        return self.views.blended(view, self.node_relevancy(texts))

    def node_cosine(
        self, texts: Sequence[str], view: View, pixels: Int64[np.ndarray, " P"]
    ) -> Float32[np.ndarray, "T 3 P"]:
        """Average the text-node cosines in each pixel, as `SceneViews.blended` does, at each level.

        Uncovered pixels and levels without nodes get -inf. User-given names are ignored. A pixel's index is
        row * width + column.
        """
        of_nodes = self.clip.embed_texts(texts) @ self.tree.clip.T
        pixels = self.views.existing_pixels(view, pixels)
        cosines = np.full((len(texts), len(LEVELS), len(pixels)), -np.inf, np.float32)
        for level in LEVELS:
            nodes = self.tree.nodes_of(level)
            if not len(nodes):
                continue
            in_view = self.views.view_nodes(view, level)
            for row, values in enumerate(of_nodes):
                blended = in_view.blend(values, float(values[nodes].min()))
                cosines[row, level.index] = np.where(in_view.covered, blended, -np.inf)[pixels]
        return cosines


def open_scene(folder: Path | str, variant: str = "default", *, threads: int = 1) -> LanguageScene:
    """Open `results/<dataset>/<scene>`, or a copy of that folder, with the settings that created it.

    Canonical phrases, template, scale and node selection are read from the provenance of the variant's
    evaluation, or of its panel if the scene has no labels.

    Raises:
        ArtifactError: the scene is not finished.
        MisalignedArtifactError: the scene's parts do not belong together.
        ModelError: the CLIP that embedded the scene's masks is not found.
    """
    scene = LanguageScene.of(FinishedScene.locate(Path(folder).absolute(), variant), threads=threads)
    if scene.caution:
        logger.warning("%s: %s", scene.scene.name, scene.caution)
    return scene
