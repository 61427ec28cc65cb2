"""Stage `names`: the best vocabulary word for each node, and vectors of words for absent objects."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from hilsplat.base import artifacts
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.cache import ViewCache
from hilsplat.base.code import code_digest
from hilsplat.base.errors import ArtifactError, SettingsError, foreign
from hilsplat.base.files import regular
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.base.lineage import sha256_of_file, sha256_of_json
from hilsplat.base.progress import stage_log, track
from hilsplat.embed.clip import ClipModel, open_clip_of
from hilsplat.models.store import AUTO
from hilsplat.query.names import NAME_RULE, checked_name, tree_digest
from hilsplat.query.node_index import NodeIndex
from hilsplat.query.relevancy import margins
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import EvaluateSettings, QuerySettings

CANDIDATES = 5  # number of texts stored for each node, best first

STANDS_OUT = 0.5
"""Minimum lead of a name's margin over that of the fifth-nearest text (nearer texts include synonyms), in
standard deviations of the vocabulary's margins. Chosen on development scenes (docs/experiments.md)."""

MIN_ABSENT = 100
"""Minimum number of known words for absent objects. If there are fewer, they are replaced by the vocabulary
words that are not the nearest word of any node. If these are too few as well, chance is not estimated."""

VOCABULARY = "vocabulary.txt"
"""Vocabulary file in a model's folder; models without this file use the one of this package."""

COMMON = Path(__file__).with_suffix(".txt")
SECTIONS = ("things", "parts", "surfaces", "absent")


@dataclass(frozen=True)
class Vocabulary:
    """Distinct texts by kind; `absent` contains words for objects found in few scenes, and may be empty."""

    things: tuple[str, ...]
    parts: tuple[str, ...] = ()
    surfaces: tuple[str, ...] = ()
    absent: tuple[str, ...] = ()

    @staticmethod
    def read(path: Path) -> "Vocabulary":
        """Read a text file: texts on lines or between commas, in sections [things] (default), [parts], ...

        Raises:
            SettingsError: the file cannot be read or contains no text, or a section or name is invalid.
        """
        with foreign(f"the vocabulary {path}", SettingsError, fix="correct the path, or save it as UTF-8"):
            lines = regular(Path(path)).read_text(encoding="utf-8-sig").splitlines()
        texts: dict[str, dict[str, None]] = {section: {} for section in SECTIONS}
        section = SECTIONS[0]
        for number, line in enumerate(lines, 1):
            text = line.partition("#")[0].strip()
            if text.startswith("["):
                section = text.strip("[]").strip().lower()
                if section not in texts:
                    raise SettingsError(
                        f"line {number} of the vocabulary {path} has an unknown section",
                        expected=", ".join(f"[{known}]" for known in SECTIONS),
                        found=text,
                    )
            else:
                try:
                    names = map(checked_name, text.split(","))
                    texts[section] |= dict.fromkeys(name for name in names if name)
                except ValueError as error:
                    raise SettingsError(f"line {number} of {path}: {error}", expected=NAME_RULE) from error
        if not (texts["things"] or texts["parts"] or texts["surfaces"]):
            raise SettingsError(f"the vocabulary {path} contains no texts", expected="one text per line")
        return Vocabulary(**{section: tuple(of_section) for section, of_section in texts.items()})


@dataclass(frozen=True)
class NodeNaming:
    """Vocabulary names of the nodes of a tree.

    Attributes:
        of_node: name of each node; "" if no name fits.
        surfaces: whether each node's name is that of a surface.
        rivals: unit vectors of words for absent objects, to estimate chance; may be empty.
    """

    of_node: tuple[str, ...]
    surfaces: tuple[bool, ...]
    rivals: Float32[np.ndarray, "W C"]

    @staticmethod
    def load(folder: Path, semantic_tree: Path, clip_folder: Path) -> "NodeNaming | None":
        """Read the artifact; return None if it is missing or was computed for a different tree or vectors.

        Raises:
            ArtifactError: the artifact is damaged.
        """
        if not folder.is_dir():
            return None
        index = artifacts.read_index(folder, "tree_sha256", "clip_sha256", "nodes")
        made_for = index["tree_sha256"], index["clip_sha256"]
        if made_for != (tree_digest(semantic_tree), sha256_of_file(clip_folder / artifacts.INDEX)):
            return None
        rows = artifacts.read_json(artifacts.sealed(folder, "names.json"))
        fix = partial(artifacts.rebuild_command, folder)
        what = f"{folder / 'names.json'} or rivals.npy"
        expected = f"{index['nodes']} names, and vectors (W, C)"
        with foreign(what, ArtifactError, problem="is damaged", expected=expected, fix=fix):
            names = tuple(checked_name(str(row["name"])) for row in rows)
            surfaces = tuple(bool(row["surface"]) for row in rows)
            rivals = artifacts.read_npy(artifacts.sealed(folder, "rivals.npy")).astype(np.float32)
            if len(rows) != index["nodes"] or rivals.ndim != 2:
                raise ValueError(f"{len(rows)} names, rivals of shape {rivals.shape}")
        return NodeNaming(names, surfaces, rivals)


def run_names(
    semantic_tree: Path,
    clip_folder: Path,
    out: Path,
    cache: Path,
    settings: QuerySettings,
    evaluate: EvaluateSettings,
) -> None:
    """Name the nodes of a tree, and index them for queries of many scenes (`node_index`).

    Writes `names.json`, `rivals.npy`, `nodes.safetensors` and an index to `out`.

    Args:
        clip_folder: CLIP vectors of the masks.
        cache: folder of text vectors, shared by all scenes with the same model.

    Raises:
        SettingsError: the vocabulary cannot be read.
        ModelError: the CLIP that embedded the masks is not found.
    """
    tree = SemanticTree.load(semantic_tree, clip_folder)
    model = open_clip_of(clip_folder, evaluate.template)
    path = Path(settings.vocabulary)
    if settings.vocabulary == AUTO:
        of_model = model.model.folder / VOCABULARY
        path = of_model if of_model.is_file() else COMMON
    vocabulary = Vocabulary.read(path)
    absent = vocabulary.absent or Vocabulary.read(COMMON).absent
    with stage_log("names", Path(out).parent.parent.name) as counts, atomic_folder(out) as folder:
        known = [text for text in absent if not model.unknown_words(text)]
        texts = [*vocabulary.things, *vocabulary.parts, *vocabulary.surfaces]
        every = list(dict.fromkeys([*texts, *known, *evaluate.canonical]))
        vectors = dict(zip(every, text_vectors(model, every, cache), strict=True))

        def of(words: Sequence[str]) -> np.ndarray:
            return np.array([vectors[word] for word in words], np.float32).reshape(-1, tree.clip.shape[1])

        margin = margins(tree.clip, of(texts), of(evaluate.canonical)).T
        if len(known) < MIN_ABSENT:
            nearest = set(margin.argmax(axis=1).tolist())
            known = [text for row, text in enumerate(texts) if row not in nearest]
        rivals = known if len(known) >= MIN_ABSENT else []
        rows = named(tree, vocabulary, margin)
        artifacts.write_json(folder / "names.json", rows)
        artifacts.write_npy(folder / "rivals.npy", of(rivals).astype(np.float16))
        NodeIndex.of(tree).save(folder)
        artifacts.write_index(
            folder,
            {},
            tree_sha256=tree_digest(semantic_tree),
            clip_sha256=sha256_of_file(clip_folder / artifacts.INDEX),
            vocabulary=path.name,
            vocabulary_sha256=sha256_of_file(path),
            nodes=len(tree),
            texts=len(texts),
            rivals=len(rivals),
        )
        named_nodes = sum(bool(row["name"]) for row in rows)
        counts |= {"nodes": len(tree), "named": named_nodes, "texts": len(texts)}


def text_vectors(model: ClipModel, texts: Sequence[str], cache: Path) -> Float32[np.ndarray, "T C"]:
    """Return the unit vectors of texts, cached because a full-size CLIP takes 30 s for a vocabulary."""
    made_from = {"model": model.digest, "template": model.template, "texts": list(texts)}
    key = sha256_of_json({**made_from, "code": code_digest(ClipModel)})

    def embed() -> dict[str, np.ndarray]:
        vectors = [model.embed_texts([text]) for text in track(texts, "texts", len(texts))]
        return {"vectors": np.concatenate(vectors)}

    return ViewCache(Path(cache) / "texts").get(key, embed)["vectors"]


def named(
    tree: SemanticTree, vocabulary: Vocabulary, margin: Float32[np.ndarray, "n T"]
) -> list[dict[str, Any]]:
    """Name each node by the text nearest to its vector, if that text stands out from the others.

    Wholes get names of things or surfaces; parts and subparts, of parts or things (a plate on a table).

    Args:
        margin: the nodes' cosine margins for the vocabulary's things, parts and surfaces, in this order.

    Returns:
        for each node, its `name`, whether it is a `surface`, and the nearest texts, best first, with margins.
    """
    groups = {"thing": vocabulary.things, "part": vocabulary.parts, "surface": vocabulary.surfaces}
    words = [word for group in groups.values() for word in group]
    kinds = np.array([kind for kind, group in groups.items() for _ in group])
    rows: list[dict[str, Any]] = []
    for node, level in enumerate(tree.level.tolist()):
        columns = np.flatnonzero(kinds != ("part" if level == Level.WHOLE else "surface"))
        margins_of_node = margin[node, columns]
        order = np.argsort(-margins_of_node, kind="stable")[:CANDIDATES]
        nearest, best = columns[order], margins_of_node.max(initial=0.0)
        fits = best > 0 and best - margins_of_node[order[-1]] >= STANDS_OUT * margins_of_node.std()
        rows.append(
            {
                "name": words[nearest[0]] if fits else "",
                "surface": bool(fits and kinds[nearest[0]] == "surface"),
                "candidates": [[words[word], round(float(margin[node, word]), 4)] for word in nearest],
            }
        )
    for level in LEVELS[1:]:  # a part does not get the name of its parent
        for node in tree.nodes_of(level).tolist():
            parent = int(tree.parent[node])
            if parent != NONE and rows[node]["name"] == rows[parent]["name"]:
                rows[node]["name"] = ""
    return rows
