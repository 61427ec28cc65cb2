"""Views of random training scenes, rendered once into a cache."""

import json
import logging
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from hilsplat.base.artifacts import read_npz, sha256_of_bytes, sha256_of_json, write_npz
from hilsplat.base.errors import ArtifactError
from hilsplat.base.levels import Level
from hilsplat.base.progress import track
from hilsplat.datasets.hierarchy import AnnotatedNode
from hilsplat.world.objects.catalogue import GENERATOR_VERSION
from hilsplat.world.render import label_view, render_view
from hilsplat.world.scenes.kinds import build_scene, scene_cameras, training_camera
from hilsplat.world.scenes.scene import WorldScene
from hilsplat.world.seeds import TRAINING_SEEDS, require_split
from hilsplat.world.tiny.data import LabelledNode, LabelledViews
from hilsplat.world.tiny.sam import FRAME_PX

logger = logging.getLogger(__name__)

KIND = "tabletop"
OBJECTS = (3, 9)
"""Objects asked for, least and most."""
SAMPLES = 2
"""Sub-samples per pixel side; half the time of the benchmark's 3, and no visible difference in a crop."""


def phrases_of(nodes: Sequence[AnnotatedNode]) -> tuple[LabelledNode, ...]:
    """Nodes with what may be said of them: the text, its synonyms, and the bare word of a part.

    The bare word ("head" of "bear head") is what people type after a path's first term.
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


def scene_of_seed(seed: int) -> WorldScene:
    """A training scene; its number of objects follows from its seed.

    Raises:
        SceneError: the seed is not one of the training split.
    """
    require_split(seed, "training")
    least, most = OBJECTS
    objects = int(np.random.default_rng((seed, 11)).integers(least, most + 1))
    return build_scene(KIND, seed, objects)


def render_training_scene(seed: int, views: int, path: Path) -> None:
    """Render views of a scene from random cameras and write images and labels.

    Every other view comes from a camera like those of the benchmark's ring.
    """
    scene = scene_of_seed(seed)
    rng = np.random.default_rng((seed, 12))
    ring = scene_cameras(scene, 40, FRAME_PX, 360)
    images, labels = [], []
    for view in range(views):
        ringed = view % 2 == 0
        camera = ring[str(rng.choice(ring.names))] if ringed else training_camera(scene, rng, FRAME_PX)
        images.append(render_view(scene, camera, SAMPLES))
        labels.append(label_view(scene, camera).astype(np.int16))
    nodes = json.dumps([asdict(node) for node in phrases_of(scene.nodes)]).encode()
    write_npz(
        path, images=np.stack(images), labels=np.stack(labels), nodes=np.frombuffer(nodes, dtype=np.uint8)
    )


def generator_digest() -> str:
    """Version of the generator and a digest of what it makes of two training scenes.

    A digest of its output, not of its code: an edit that changes no pixel and no text keeps the cache.
    """
    parts = []
    for seed in (TRAINING_SEEDS.start, TRAINING_SEEDS.stop - 1):
        scene = scene_of_seed(seed)
        camera = training_camera(scene, np.random.default_rng((seed, 13)), 96)
        nodes = json.dumps([asdict(node) for node in phrases_of(scene.nodes)])
        parts += [
            render_view(scene, camera, 1).tobytes(),
            label_view(scene, camera).tobytes(),
            nodes.encode(),
        ]
    return f"{GENERATOR_VERSION}-{sha256_of_bytes(*parts)[:16]}"


def render_training_views(cache: Path, seeds: Sequence[int], views: int, workers: int) -> LabelledViews:
    """Views of some training scenes, rendered where the cache has none.

    Args:
        cache: folder that may be deleted at any time; its entries depend on the generator's code.
        seeds: of training scenes.
        views: per scene.
        workers: processes that render.
    """
    # A killed run goes on where it was; a changed generator renders anew.
    recipe = {
        "generator": generator_digest(),
        "views": views,
        "px": FRAME_PX,
        "objects": OBJECTS,
        "samples": SAMPLES,
    }
    folder = Path(cache) / f"views-{sha256_of_json(recipe)[:12]}"
    paths = [folder / f"{seed}.npz" for seed in seeds]
    missing = [(seed, views, path) for seed, path in zip(seeds, paths, strict=True) if not path.is_file()]
    if missing:
        logger.info("rendering %d of %d training scenes into %s", len(missing), len(paths), folder)
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            jobs = pool.map(render_training_scene, *zip(*missing, strict=True), chunksize=4)
            for _ in track(jobs, "training scenes", total=len(missing)):
                pass
    images, labels, nodes = [], [], []
    for path in paths:
        arrays = read_npz(path)
        if arrays["images"].shape[0] != views:
            raise ArtifactError(f"{path} is damaged", fix="delete it and run again")
        images.append(arrays["images"])
        labels.append(arrays["labels"])
        rows = json.loads(arrays["nodes"].tobytes())
        nodes += [tuple(LabelledNode(r["level"], r["parent"], tuple(r["phrases"])) for r in rows)] * views
    return LabelledViews(np.concatenate(images), np.concatenate(labels), tuple(nodes))


def training_seeds(scenes: int, validation: int) -> tuple[list[int], list[int]]:
    """Seeds of the scenes to train on, and of others (from the far end of the range) to measure on."""
    first, last = TRAINING_SEEDS.start, TRAINING_SEEDS.stop
    return list(range(first, first + scenes)), list(range(last - validation, last))
