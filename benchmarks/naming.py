"""Measure how often node names and doubts about queries are correct, on finished synthetic scenes.

    python -m benchmarks.naming results/synthetic/dev-1 results/synthetic-rooms/dev-room

Only nodes that have an IoU above 0.5 with a ground-truth node are counted. A name is correct if it is the
ground-truth text or a synonym. Present texts are those of the matched nodes. Absent texts are those of the
vocabulary that name nothing in the scene. Words outside the model's vocabulary are always doubted and are not
counted.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

import hilsplat
from hilsplat.base.artifacts import read_json
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.tables import markdown_table
from hilsplat.datasets.hierarchy import HierarchyAnnotations
from hilsplat.query.node_names import Vocabulary
from hilsplat_world.diagnostics.tree_truth import measure_tree, true_votes

ABSENT = 200  # maximum number of queries for absent texts, spread over the vocabulary


@dataclass
class Counts:
    """Number of correct cases, and of all cases."""

    right: int = 0
    all: int = 0

    def add(self, right: bool) -> None:
        """Count one case."""
        self.right, self.all = self.right + right, self.all + 1

    def __str__(self) -> str:
        return f"{self.right / self.all:.0%} of {self.all}" if self.all else "-"


@dataclass
class Naming:
    """Counts of a level over scenes."""

    top1: Counts = field(default_factory=Counts)  # the nearest text is correct
    top5: Counts = field(default_factory=Counts)  # one of the nearest five texts is correct
    named: Counts = field(default_factory=Counts)  # the node has a name
    right: Counts = field(default_factory=Counts)  # the node's name is correct
    doubted: Counts = field(default_factory=Counts)  # the query for a present text was doubted


def measure(folder: Path, levels: dict[Level, Naming], missed: Counts) -> None:
    """Add the counts of a scene; `missed` counts absent texts that were not doubted."""
    scene = hilsplat.open_scene(folder)
    assert scene.naming is not None, f"{folder} has no names: hilsplat run {folder}/default/names"
    rows = read_json(folder / "default/names/names.json")
    truth = HierarchyAnnotations.load(folder / "world/truth")
    ply = folder / "gaussians.ply"
    views = scene.scene.views("train")
    votes = true_votes(scene.scene, ply, truth, views, scene.tree.min_weight, threads=2)
    for level, measured in measure_tree(scene.tree, votes, truth).items():
        counts = levels[level]
        for node, partner in measured.pairs:
            texts = {truth.nodes[partner].text, *truth.nodes[partner].synonyms}
            nearest = [text for text, _ in rows[node]["candidates"]]
            name = scene.naming.of_node[node]
            counts.top1.add(nearest[0] in texts)
            counts.top5.add(bool(texts & {*nearest}))
            counts.named.add(bool(name))
            if name:
                counts.right.add(name in texts)
            counts.doubted.add(bool(scene.query(truth.nodes[partner].text)[0].doubts))
    known = Vocabulary.read(Path("models/clip-tiny/vocabulary.txt"))
    here = {text for node in truth.nodes for text in (node.text, *node.synonyms)}
    absent = [text for text in (*known.things, *known.parts) if text not in here]
    for text in absent[:: -(-len(absent) // ABSENT)]:
        missed.add(not scene.query(text)[0].doubts)


def main() -> None:
    """Measure the scenes named on the command line."""
    levels, missed = {level: Naming() for level in LEVELS}, Counts()
    for name in sys.argv[1:]:
        measure(Path(name), levels, missed)
    rows = [
        (level.label, *map(str, (counts.top1, counts.top5, counts.named, counts.right, counts.doubted)))
        for level, counts in levels.items()
    ]
    head = ("level", "top-1", "top-5", "named", "of the named, right", "present, doubted")
    print(markdown_table(head, rows, 1))
    print(f"absent texts, not doubted: {missed}")


if __name__ == "__main__":
    main()
