"""Text queries of a scene's nodes by their vectors: margins, names, selection and doubts.

`LanguageScene` is an open scene; an `IndexedScene` has only what the index of many scenes stores.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import NONE, Level, path_of
from hilsplat.embed.clip import ClipModel
from hilsplat.models.store import is_embedded, meaningless
from hilsplat.query.names import NodeNames
from hilsplat.query.node_names import NodeNaming
from hilsplat.query.node_search import NodeHits, TextAnswer, search
from hilsplat.query.relevancy import margin_of_relevancy, margins, relevancy_of_margins
from hilsplat.scene.finished import is_drawn
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import EvaluateSettings

NAMED = 2.0  # cosine margin of a node for its user-given name: the maximum, so that the node is ranked first

ANSWERERS = ("tree", "field")


class NodeQueries(ABC):
    """A scene whose nodes accept text queries.

    Attributes:
        clip: the model that embedded the scene's masks.
        names: the user's names for nodes, which are matched first.
        naming: vocabulary names of the nodes, and words for absent objects; None if the stage has not run.
    """

    clip: ClipModel
    settings: EvaluateSettings
    names: NodeNames
    naming: NodeNaming | None
    _rival_margins: dict[str, np.ndarray]
    """Margins (W, n) of all nodes for `naming.rivals`, by answerer."""

    @property
    @abstractmethod
    def tree(self) -> SemanticTree:
        """The scene's nodes."""

    @property
    @abstractmethod
    def caution(self) -> str:
        """Reason why CLIP's answers are meaningless for this scene, as a sentence; empty if they are not."""

    @abstractmethod
    def node_vectors(self, answerer: str = "tree") -> Float32[np.ndarray, "n C"]:
        """Return the nodes' unit vectors: those of the tree, or those decoded from their Gaussians' field."""

    def _visible(self, view: str | None) -> Bool[np.ndarray, " n"]:
        """Return whether a view shows each node; all nodes compete if it is None."""
        return np.ones(len(self.tree), np.bool_)

    def select(
        self,
        path: str | Sequence[str],
        *,
        level: Level | str | None = None,
        answerer: str = "tree",
        view: str | None = None,
        threshold: float | None = None,
    ) -> NodeHits:
        """Return the nodes that `LanguageScene.query` finds, as rows of the tree.

        For arguments and errors, see there. The path may also be a sequence of texts; level None is "auto".
        """
        path = path_of(path) if isinstance(path, str) else tuple(path)
        if answerer not in ANSWERERS:
            raise SettingsError(f"answerer {answerer!r} is unknown", expected=" or ".join(ANSWERERS))
        visible = self._visible(view)
        nodes = search(
            self.tree,
            self.node_margins(path, answerer),
            self.node_vectors(answerer),
            path,
            threshold=self.settings.node_select if threshold is None else 0.0,  # 0 selects the whole level
            ancestors=self.settings.ancestors,
            visible=visible,
            level=None if level in (None, "auto") else Level.of(level),
        )
        if threshold is not None:
            is_above = nodes.values >= margin_of_relevancy(threshold, self.settings.relevancy_scale)
            nodes = replace(nodes, ids=nodes.ids[is_above], values=nodes.values[is_above])
        return replace(nodes, texts=tuple(self._doubted(text, answerer, visible) for text in nodes.texts))

    def _doubted(self, answer: TextAnswer, answerer: str, visible: Bool[np.ndarray, " n"]) -> TextAnswer:
        """Add to a text's answer the share of words for absent objects that score at least as high."""
        if self.names.nodes_of(answer.text):
            return answer
        chance = None
        if self.naming is not None and len(self.naming.rivals):
            if answer.margin < answer.anywhere:  # only one level was searched
                visible = visible & (self.tree.level == int(answer.level))
            if answerer not in self._rival_margins:
                self._rival_margins[answerer] = self._margins(self.naming.rivals, answerer)
            best = self._rival_margins[answerer][:, visible].max(axis=1, initial=-np.inf)
            chance = (1 + int((best >= answer.margin).sum())) / (1 + len(best))
        return replace(answer, chance=chance, unknown=tuple(self.clip.unknown_words(answer.text)))

    def name_of(self, node: int) -> str:
        """Return the user's name for a node, otherwise its vocabulary name; empty if no name fits.

        The name of the whole is appended to a part's vocabulary name that lacks it, as in "wheel of car".
        """
        name, parent = self.own_name_of(node), int(self.tree.parent[node])
        if not name or parent == NONE or node in self.names.of_node:
            return name
        while int(self.tree.parent[parent]) != NONE:
            parent = int(self.tree.parent[parent])
        whole = self.name_of(parent)
        return name if not whole or f" {whole} " in f" {name} " else f"{name} of {whole}"

    def own_name_of(self, node: int) -> str:
        """Return `name_of` without the name of the whole that a part belongs to."""
        vocabulary_name = self.naming.of_node[node] if self.naming is not None else ""
        return self.names.of_node.get(node, "") or vocabulary_name

    def caution_about(self, text: str) -> str:
        """Return `caution`, or "" if every text of a query is a user-given name, whatever the CLIP model."""
        return "" if all(self.names.nodes_of(part) for part in path_of(text)) else self.caution

    def node_margins(self, texts: Sequence[str], answerer: str = "tree") -> Float32[np.ndarray, "T n"]:
        """Return each node's cosine margin for each text, relative to this scene's canonical phrases.

        A node's margin for the name that the user gave it is `NAMED`.
        """
        of_texts = self._margins(self.clip.embed_texts(texts), answerer)
        for row, text in zip(of_texts, texts, strict=True):
            row[self.names.nodes_of(text)] = NAMED
        return of_texts

    def _margins(self, vectors: Float32[np.ndarray, "T C"], answerer: str) -> Float32[np.ndarray, "T n"]:
        canonical = self.clip.embed_texts(list(self.settings.canonical))
        return margins(self.node_vectors(answerer), vectors, canonical)

    def node_relevancy(self, texts: Sequence[str], answerer: str = "tree") -> Float32[np.ndarray, "T n"]:
        """Return the relevancy of each node to each text."""
        return relevancy_of_margins(self.node_margins(texts, answerer), self.settings.relevancy_scale)


def caution_of(clip: ClipModel, scene: Path) -> str:
    """Return why a model's answers are meaningless for a `Scene` artifact, as a sentence, or ""."""
    is_meaningless = is_embedded(clip.model.config) and not is_drawn(scene)
    return meaningless(clip.model.folder.name) if is_meaningless else ""
