"""Views of random training scenes, rendered into a cache, and the vocabulary of the world."""

import json
import logging
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path

import numpy as np

from hilsplat.base.artifacts import read_npz, write_npz
from hilsplat.base.errors import ArtifactError, SceneError
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.lineage import sha256_of_bytes, sha256_of_json
from hilsplat.base.processes import in_processes
from hilsplat.base.progress import track
from hilsplat.datasets.hierarchy import AnnotatedNode
from hilsplat_world.objects.builder import ObjectModel
from hilsplat_world.objects.catalogue import CLASSES, GENERATOR_VERSION, build_object
from hilsplat_world.render import label_view, render_view
from hilsplat_world.scenes.kinds import KINDS, TRAINING_SEEDS, build_scene, split_of_seed
from hilsplat_world.scenes.scene import WorldScene
from models.training.cameras import training_camera
from models.training.data import LabelledNode, LabelledViews
from models.training.sam import FRAME_PX

logger = logging.getLogger(__name__)

# Kinds of training scenes: share, and the minimum and maximum number of requested objects.
MIXTURE: dict[str, tuple[float, int, int]] = {
    "tabletop": (0.6, 3, 10),
    "room": (0.2, 6, 14),
    "street": (0.2, 6, 14),
}
# Sub-samples per pixel side: half the time of the benchmark's 3, with no visible difference in a crop.
SAMPLES = 2
DRAWS = 8  # objects drawn per class for the vocabulary, because some parts of a class are random
SURFACES = {
    *("ceiling", "curb", "floor", "ground", "lane marker", "road"),
    *("rug", "sidewalk", "sky", "table", "tablecloth", "wall"),
}


def phrases_of(nodes: Sequence[AnnotatedNode]) -> tuple[LabelledNode, ...]:
    """Return nodes with their phrases: the text, its synonyms, and the bare name of a part.

    The bare name ("head" of "bear head") is usual as the second text of a path.
    """
    labelled = []
    for node in nodes:
        phrases = [node.text, *node.synonyms]
        if node.level != int(Level.WHOLE):
            root = node
            while root.parent >= 0:
                root = nodes[root.parent]
            ending = f" of the {root.text}"
            phrases += [text.removesuffix(ending) for text in node.synonyms if text.endswith(ending)]
        labelled.append(LabelledNode(node.level, node.parent, tuple(dict.fromkeys(phrases))))
    return tuple(labelled)


def kind_of_seed(seed: int) -> tuple[str, int]:
    """Return the kind of a training scene and its number of objects, both derived from the seed."""
    rng = np.random.default_rng((seed, 11))
    kinds = list(MIXTURE)
    kind = kinds[int(rng.choice(len(kinds), p=[MIXTURE[name][0] for name in kinds]))]
    _, least, most = MIXTURE[kind]
    return kind, int(rng.integers(least, most + 1))


def scene_of_seed(seed: int) -> WorldScene:
    """Build a training scene; raise SceneError if the seed is not in the training split."""
    if seed not in TRAINING_SEEDS:
        raise SceneError(
            f"scene seed {seed} is not in the training split",
            expected=f"{TRAINING_SEEDS.start} to {TRAINING_SEEDS.stop - 1}",
            found=f"{seed}, split {split_of_seed(seed)}",
            fix="use a seed from this split; scenes for training and for evaluation must differ",
        )
    kind, objects = kind_of_seed(seed)
    return build_scene(kind, seed, objects)


def render_training_scene(seed: int, views: int, path: Path) -> None:
    """Render views of a scene from random cameras and write images and labels."""
    scene = scene_of_seed(seed)
    rng = np.random.default_rng((seed, 12))
    images, labels = [], []
    for _ in range(views):
        camera = training_camera(scene, rng, FRAME_PX)
        images.append(render_view(scene, camera, SAMPLES))
        labels.append(label_view(scene, camera).astype(np.int16))
    nodes = json.dumps([asdict(node) for node in phrases_of(scene.nodes)]).encode()
    write_npz(
        path, images=np.stack(images), labels=np.stack(labels), nodes=np.frombuffer(nodes, dtype=np.uint8)
    )


def objects_of_every_class(seed: int) -> Iterator[ObjectModel]:
    """Build an object of each class of the world with the same seed."""
    for kind, names in CLASSES.items():
        for name in names:
            yield build_object(kind, name, np.random.default_rng(seed))


@cache
def generator_digest() -> str:
    """Return the generator's version and a digest of an object of each class and a scene of each kind.

    The digest covers output, not code, so an edit that changes no pixel and no text keeps the cache valid.
    """
    parts: list[bytes] = []
    for model in objects_of_every_class(TRAINING_SEEDS.start):
        texts = json.dumps([asdict(node) for node in model.nodes])
        parts += [model.triangles.astype(np.float32).tobytes(), model.materials.tobytes(), texts.encode()]
    for kind, (_, least, _) in MIXTURE.items():
        scene = build_scene(kind, TRAINING_SEEDS.start, least)
        camera = training_camera(scene, np.random.default_rng((TRAINING_SEEDS.start, 13)), 96)
        nodes = json.dumps([asdict(node) for node in phrases_of(scene.nodes)])
        parts += [render_view(scene, camera, 1).tobytes(), label_view(scene, camera).tobytes()]
        parts.append(nodes.encode())
    return f"{GENERATOR_VERSION}-{sha256_of_bytes(*parts)[:16]}"


def render_training_views(cache: Path, seeds: Sequence[int], views: int, workers: int) -> LabelledViews:
    """Return `views` views of each training scene, and render those that are not in the cache.

    The cache may be deleted at any time. `workers` is the number of rendering processes.
    """
    # The folder's name depends on the generator's output, so that changed scenes are rendered again.
    recipe = {"generator": generator_digest(), "views": views}
    recipe |= {"px": FRAME_PX, "mixture": MIXTURE, "samples": SAMPLES}
    folder = Path(cache) / f"views-{sha256_of_json(recipe)[:12]}"
    paths = [folder / f"{seed}.npz" for seed in seeds]
    missing = [(seed, views, path) for seed, path in zip(seeds, paths, strict=True) if not path.is_file()]
    if missing:
        logger.info("rendering %d of %d training scenes into %s", len(missing), len(paths), folder)
        jobs = in_processes(render_training_scene, missing, workers, chunk=4)
        for _ in track(jobs, "training scenes", total=len(missing)):
            pass
    # Arrays are filled in place: views take gigabytes, and joining a list of them would need twice that.
    images = np.empty((len(paths) * views, FRAME_PX, FRAME_PX, 3), np.uint8)
    labels = np.empty((len(paths) * views, len(LEVELS), FRAME_PX, FRAME_PX), np.int16)
    nodes: list[tuple[LabelledNode, ...]] = []
    for row, path in enumerate(paths):
        arrays = read_npz(path)
        if arrays["images"].shape[0] != views:
            raise ArtifactError(f"{path} is damaged", fix="rerun with another --cache folder")
        at = slice(row * views, (row + 1) * views)
        images[at], labels[at] = arrays["images"], arrays["labels"]
        rows = json.loads(arrays["nodes"].tobytes())
        nodes += [tuple(LabelledNode(r["level"], r["parent"], tuple(r["phrases"])) for r in rows)] * views
    return LabelledViews(images, labels, tuple(nodes))


def training_seeds(scenes: int, validation: int) -> tuple[list[int], list[int]]:
    """Return the seeds of training scenes, and of validation scenes from the end of the range."""
    first, last = TRAINING_SEEDS.start, TRAINING_SEEDS.stop
    return list(range(first, first + scenes)), list(range(last - validation, last))


def world_vocabulary() -> str:
    """Return the vocabulary of the synthetic world as file content for `hilsplat.query.vocabulary`."""
    things: set[str] = set()
    parts: set[str] = set()
    for seed in range(TRAINING_SEEDS.start, TRAINING_SEEDS.start + DRAWS):
        worlds: list[ObjectModel | WorldScene] = [*objects_of_every_class(seed)]
        worlds += [build_scene(kind, seed, 1) for kind in KINDS]
        for world in worlds:
            for node in world.nodes:
                (things if node.level == int(Level.WHOLE) else parts).add(node.text)
    sections = {"things": things - SURFACES, "parts": parts, "surfaces": things & SURFACES}
    lines = ["# Texts that clip-tiny was trained on, written by `python -m models.training`."]
    for section, texts in sections.items():
        lines += ["", f"[{section}]", *sorted(texts)]
    return "\n".join(lines) + "\n"
