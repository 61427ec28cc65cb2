"""One query of all finished scenes in a results folder, from the index that the stage `names` writes."""

import os
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from hilsplat.base.artifacts import read_index, run_command
from hilsplat.base.errors import ArtifactError, HilsplatError, first_line, nearest
from hilsplat.base.levels import Level
from hilsplat.base.tables import aligned_table, counted
from hilsplat.embed.clip import ClipModel, open_clip_of
from hilsplat.query.hits import Doubt, checked_count, doubts_of
from hilsplat.query.names import NodeNames, read_names
from hilsplat.query.node_index import FILE, NodeIndex
from hilsplat.query.node_names import NodeNaming
from hilsplat.query.node_queries import NodeQueries, caution_of
from hilsplat.query.node_search import NodeHits
from hilsplat.query.relevancy import relevancy_of_margins
from hilsplat.scene.finished import FinishedScene, changed_input, matching_scenes, scenes_in
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import EvaluateSettings


@dataclass(frozen=True)
class SceneHit:
    """One answer in one of many scenes; lengths are in the scene's units.

    Attributes:
        scene: name, `<dataset>/<scene>`.
        folder: the scene's folder, for `hilsplat.open_scene`.
        node: row of the scene's semantic tree.
        score: as in `Hit`; a query of the scene alone gives the same score.
        name: the user's name for the node, otherwise its vocabulary name; empty if no name fits.
        gaussians: number of the node's Gaussians.
        size: lengths of the oriented box's sides.
        picture: the undistorted photograph in which the node is largest.
        doubts: texts of the query that may match nothing in this scene.
        caution: as `LanguageScene.caution`, but empty if all texts are user-given names.
    """

    scene: str
    folder: Path
    node: int
    level: Level
    score: float
    name: str
    gaussians: int
    centroid: tuple[float, float, float]
    size: tuple[float, float, float]
    picture: Path
    route: str
    doubts: tuple[Doubt, ...]
    caution: str

    def __repr__(self) -> str:
        answer = f"{self.node}, {self.level.label}, {self.name!r}, score {self.score:.2f}"
        return f"SceneHit({self.scene}: {answer})"

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON values."""
        plain = {"folder": str(self.folder), "picture": str(self.picture), "level": self.level.label}
        return asdict(self) | plain | {"doubts": [str(doubt) for doubt in self.doubts]}


@dataclass(frozen=True)
class IndexedScene(NodeQueries):
    """A scene as the index stores it: nodes and vectors, without Gaussians and views."""

    folder: Path
    index: NodeIndex
    clip: ClipModel
    settings: EvaluateSettings
    names: NodeNames
    naming: NodeNaming | None = None
    _rival_margins: dict[str, np.ndarray] = field(default_factory=dict, repr=False, kw_only=True)

    @property
    def tree(self) -> SemanticTree:
        return self.index.tree

    @property
    def caution(self) -> str:
        return caution_of(self.clip, self.folder / "scene")

    def node_vectors(self, answerer: str = "tree") -> Float32[np.ndarray, "n C"]:
        return self.tree.clip


@dataclass(frozen=True)
class FoundScene:
    """A finished scene whose index matches its artifacts; the index is read at each query."""

    name: str
    finished: FinishedScene = field(repr=False)
    clip: ClipModel = field(repr=False)
    settings: EvaluateSettings = field(repr=False)

    @property
    def index(self) -> Path:
        """The artifact of the stage `names`."""
        return self.finished.parts.clip.parent / "names"

    def opened(self, naming: NodeNaming | None = None) -> IndexedScene:
        folder, index = self.finished.folder, NodeIndex.load(self.index)
        names = read_names(folder, self.finished.parts.semantic_tree)
        return IndexedScene(folder, index, self.clip, self.settings, names, naming)

    def naming(self) -> NodeNaming:
        """Return the vocabulary names; raise ArtifactError if the index is of another tree."""
        parts = self.finished.parts
        naming = NodeNaming.load(self.index, parts.semantic_tree, parts.clip)
        if naming is None:
            raise ArtifactError(f"{self.index} was not made from the current semantic tree and CLIP vectors")
        return naming


@dataclass(frozen=True, eq=False)
class Scenes:
    """The finished scenes of a results folder, which accept text queries together.

    Attributes:
        found: scenes that are searched.
        skipped: scene -> why it is not searched; a query adds scenes whose artifacts have changed since.
    """

    found: tuple[FoundScene, ...]
    skipped: dict[str, str]

    def __repr__(self) -> str:
        return f"Scenes({len(self.found)} found, {len(self.skipped)} skipped)"

    def query(
        self,
        text: str,
        level: str = "auto",
        *,
        threshold: float | None = None,
        limit: int = 10,
        each: int = 1,
    ) -> list[SceneHit]:
        """Return the best answers in each of the best scenes, best scene first.

        Scores can be compared between scenes if one CLIP model embedded them.

        Args:
            text, level, threshold: as in `LanguageScene.query`.
            limit: maximum number of scenes.
            each: maximum number of answers in each scene.

        Raises:
            SettingsError: as in `LanguageScene.query`.
        """
        limit, each = checked_count(limit), checked_count(each, "each")

        def answers(scene: IndexedScene) -> NodeHits:
            return scene.select(text, level=level, threshold=threshold)

        best: list[tuple[float, str, FoundScene]] = []
        for entry in self.found:
            with self._skipping(entry.name):
                best += [(-score, entry.name, entry) for score in _scores(answers(entry.opened()), entry, 1)]
        hits: dict[str, list[SceneHit]] = {}
        for _, name, entry in sorted(best, key=lambda entry: entry[:2]):
            if len(hits) < limit:
                with self._skipping(name):
                    scene = entry.opened(entry.naming())
                    hits[name] = _hits_of(entry, scene, answers(scene), scene.caution_about(text), each)
        return [hit for of_scene in hits.values() for hit in of_scene]

    @contextmanager
    def _skipping(self, name: str) -> Iterator[None]:
        """Skip a scene that was changed, rebuilt or deleted since the scenes were opened."""
        try:
            yield
        except ArtifactError as error:
            self.skipped[name] = first_line(error)


def _scores(nodes: NodeHits, found: FoundScene, limit: int) -> list[float]:
    return relevancy_of_margins(nodes.values[:limit], found.settings.relevancy_scale).tolist()


def _hits_of(
    found: FoundScene, scene: IndexedScene, nodes: NodeHits, caution: str, each: int
) -> list[SceneHit]:
    index, folder, doubts = scene.index, found.finished.folder, doubts_of(nodes)
    return [
        SceneHit(
            found.name,
            folder,
            node,
            Level(int(scene.tree.level[node])),
            score,
            scene.name_of(node),
            int(index.gaussians[node]),
            tuple(scene.tree.centroid[node].tolist()),
            tuple(scene.tree.oriented_box[node, 4].tolist()),
            folder / "scene/images" / index.views[index.best_view[node]],
            nodes.route,
            doubts,
            caution,
        )
        for node, score in zip(nodes.ids[:each].tolist(), _scores(nodes, found, each), strict=True)
    ]


def open_scenes(results: Path | str = "results", pattern: str = "*", variant: str = "default") -> Scenes:
    """Open the finished scenes of a results folder for queries of all of them.

    A scene is skipped, with the reason, if its stage `names` has not finished, if one of the artifacts behind
    its index was rebuilt or removed since, or if its CLIP model is not found.

    Args:
        pattern: scenes to search, such as `photos`, `photos/desk` or `kitchen-?`.

    Raises:
        ArtifactError: no scene matches, or none is finished.
    """
    results, skipped, found = Path(results).absolute(), dict[str, str](), list[FoundScene]()
    models: dict[tuple[str, str], ClipModel] = {}
    names = scenes_in(results)
    for name in matching_scenes(names, pattern):
        folder = results / name
        try:
            finished = FinishedScene.locate(folder, variant)
            clip, settings = finished.parts.clip, finished.evaluate_settings()
            key = read_index(clip, "model_sha256")["model_sha256"], settings.template
            if key not in models:
                models[key] = open_clip_of(clip, settings.template)
            scene = FoundScene(name, finished, models[key], settings)
            if not (scene.index / FILE).is_file():
                raise ArtifactError(f"{scene.index / FILE} is missing", fix=run_command(scene.index))
            if changed := changed_input(scene.index, folder):
                raise ArtifactError(f"{scene.index} was not made from the current {changed}")
            found.append(scene)
        except HilsplatError as error:
            skipped[name] = first_line(error)
    if not found:
        raise ArtifactError(
            f"{results} has no finished scene" + (f" that matches {pattern!r}" if pattern != "*" else ""),
            expected=nearest(pattern, names) if names and not skipped else None,
            found="; ".join(f"{name}: {reason}" for name, reason in list(skipped.items())[:3]) or None,
            fix="run the workflow, or specify the results folder",
        )
    return Scenes(tuple(found), skipped)


def report_of(scenes: Scenes, text: str, hits: Sequence[SceneHit], level: str = "auto") -> str:
    """Return answers, doubts and skipped scenes as text; `level` is that of the query."""
    lines = [f"{counted(len(hits), 'answer')} to {text!r} in {counted(len(scenes.found), 'scene')}"]
    if hits:
        columns = "score", "scene", "node", "level", "name", "picture"
        rows = [
            (f"{hit.score:.2f}", hit.scene, hit.node, hit.level.label, hit.name or "?", _shown(hit.picture))
            for hit in hits
        ]
        lines += aligned_table([columns, *rows], {"scene", "level", "name", "picture"})
        variant = scenes.found[0].finished.variant
        options = [] if level == "auto" else ["--level", level]
        options += [] if variant == "default" else ["--variant", variant]
        command = shlex.join(["hilsplat", "query", _shown(hits[0].folder), text, *options])
        lines.append(f"more about the best: {command}")
    lines += [f"doubtful: {doubt}" for hit in hits[:1] for doubt in hit.doubts]
    lines += dict.fromkeys(hit.caution for hit in hits if hit.caution)
    lines += [f"{name} is skipped: {reason}" for name, reason in sorted(scenes.skipped.items())]
    return "\n".join(lines)


def _shown(path: Path) -> str:
    """Return a path as short as the working folder allows."""
    return os.path.relpath(path) if path.is_relative_to(Path.cwd()) else str(path)
