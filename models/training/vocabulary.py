"""Vocabulary for naming nodes: the texts that the embedded CLIP was trained on."""

from hilsplat.base.levels import Level
from hilsplat.world.scenes.kinds import KINDS, build_scene
from hilsplat.world.seeds import TRAINING_SEEDS
from models.training.render import objects_of_every_class

DRAWS = 8  # objects drawn per class, because some parts of a class are random
SURFACES = {
    *("ceiling", "curb", "floor", "ground", "lane marker", "road"),
    *("rug", "sidewalk", "sky", "table", "tablecloth", "wall"),
}


def world_vocabulary() -> str:
    """Return the vocabulary of the synthetic world as file content for `hilsplat.query.vocabulary`."""
    things: set[str] = set()
    parts: set[str] = set()
    for seed in range(TRAINING_SEEDS.start, TRAINING_SEEDS.start + DRAWS):
        scenes = [build_scene(kind, seed, 1) for kind in KINDS]
        for world in (*objects_of_every_class(seed), *scenes):
            for node in world.nodes:
                (things if node.level == int(Level.WHOLE) else parts).add(node.text)
    sections = {"things": things - SURFACES, "parts": parts, "surfaces": things & SURFACES}
    lines = ["# What clip-tiny was taught, by `python -m models.training`."]
    for section, texts in sections.items():
        lines += ["", f"[{section}]", *sorted(texts)]
    return "\n".join(lines) + "\n"
