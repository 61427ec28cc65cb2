"""Vocabulary for naming nodes: the texts that the embedded CLIP was trained on."""

from collections.abc import Iterable

import numpy as np

from hilsplat.base.levels import Level
from hilsplat.datasets.synthetic.hierarchy import AnnotatedNode
from hilsplat.world.objects.builder import ModelNode
from hilsplat.world.objects.catalogue import (
    FURNITURE,
    STREET,
    TABLETOP,
    build_furniture,
    build_object,
    build_street_object,
)
from hilsplat.world.scenes.kinds import KINDS, build_scene
from hilsplat.world.seeds import TRAINING_SEEDS

DRAWS = 8
"""Objects drawn per class, because some parts of a class are random."""

SURFACES = {
    *("ceiling", "curb", "floor", "ground", "lane marker", "road"),
    *("rug", "sidewalk", "sky", "table", "tablecloth", "wall"),
}


def world_vocabulary() -> str:
    """Return the vocabulary of the synthetic world as file content for `hilsplat.query.vocabulary`."""
    things: set[str] = set()
    parts: set[str] = set()

    def take(nodes: Iterable[ModelNode | AnnotatedNode]) -> None:
        for node in nodes:
            (things if node.level == int(Level.WHOLE) else parts).add(node.text)

    for build, names in (
        (build_object, TABLETOP),
        (build_furniture, FURNITURE),
        (build_street_object, STREET),
    ):
        for name in names:
            for seed in range(TRAINING_SEEDS.start, TRAINING_SEEDS.start + DRAWS):
                take(build(name, np.random.default_rng(seed)).nodes)
    for kind in KINDS:
        for seed in range(TRAINING_SEEDS.start, TRAINING_SEEDS.start + DRAWS):
            take(build_scene(kind, seed, 1).nodes)
    sections = {"things": things - SURFACES, "parts": parts, "surfaces": things & SURFACES}
    lines = ["# What clip-tiny was taught, by `python -m models.training`."]
    for section, texts in sections.items():
        lines += ["", f"[{section}]", *sorted(texts)]
    return "\n".join(lines) + "\n"
