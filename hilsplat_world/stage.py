"""The world stage: render a synthetic scene and write its ground truth for evaluation."""

import logging
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path

import numpy as np

from hilsplat.base.artifacts import write_index, write_json, write_npz
from hilsplat.base.atomic import atomic_folder, require_free_space
from hilsplat.base.errors import SceneError
from hilsplat.base.images import write_png
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.processes import in_processes
from hilsplat.base.progress import stage_log, track
from hilsplat.datasets.hierarchy import write_hierarchy
from hilsplat_world.lidar import scan_street
from hilsplat_world.objects.catalogue import GENERATOR_VERSION
from hilsplat_world.render import render_and_label
from hilsplat_world.scenes.kinds import KINDS, TRAINING_SEEDS, build_scene, scene_cameras, split_of_seed
from hilsplat_world.settings import WorldSettings
from hilsplat_world.truth import MIN_SUBPART_AREA, annotated_nodes, write_mesh

logger = logging.getLogger(__name__)

MESH_EDGE: dict[str, float] = {"room": 0.08}
"""Longest mesh edge, scene units, for scene kinds whose vertices are scored; other meshes are not refined."""


def parse_source(source: str) -> tuple[str, int]:
    """Return the kind of scene and the seed in a source such as "world:tabletop:201".

    Raises:
        SceneError: if the format is wrong, the kind is unknown, or the seed is reserved for training.
    """
    words = source.split(":")
    if len(words) != 3 or words[0] != "world" or words[1] not in KINDS or not words[2].isdecimal():
        raise SceneError(
            f"source {source!r} does not name a synthetic scene",
            expected=f"world:<kind>:<seed>, where kind is one of: {', '.join(KINDS)}",
            fix="correct the source in the scene sheet, as in world:tabletop:201",
        )
    seed = int(words[2])
    if seed in TRAINING_SEEDS:
        raise SceneError(
            f"source {source!r} is a scene that the small models were trained on",
            expected=f"a seed outside {TRAINING_SEEDS.start} to {TRAINING_SEEDS.stop - 1}",
            fix="use a seed from 200 to 299 for reported results, or from 100 to 199 for development",
        )
    return words[1], seed


def run_world(source: str, settings: WorldSettings, images: Path, truth: Path, threads: int) -> None:
    """Render a synthetic scene and write its ground truth.

    Each of the two output folders is complete or absent. The next stages read only `images` (000.png,
    001.png, ...). Only `evaluate` may read `truth`: annotations.json and labels/ in the hierarchy format,
    cameras.npz, mesh.ply, scene.json and, for a street, lidar.npz. The files' bytes depend on `source` and
    `settings`, not on `threads`.

    Raises:
        SceneError: if the source does not name a scene.
        DiskSpaceError: if there is not enough disk space.
    """
    kind, seed = parse_source(source)
    with stage_log("world", source) as counts:
        scene = _scene(kind, seed, settings.objects)
        cameras = scene_cameras(scene, settings.views, settings.image_px, settings.arc_deg)
        require_free_space(images, needed_mib=5 + settings.views * settings.image_px**2 * 4 / 2**20)
        smallest: dict[Level, float | int] = dict.fromkeys(LEVELS, settings.min_area_px)
        smallest[Level.SUBPART] = MIN_SUBPART_AREA * settings.image_px**2
        labels, annotated = {}, {}
        size = {"height": settings.image_px, "width": settings.image_px}
        with atomic_folder(images) as folder:
            jobs = [(kind, seed, settings, name) for name in cameras.names]
            views = zip(cameras.names, in_processes(_render, jobs, threads), strict=True)
            for name, (image, label) in track(views, "rendered views", total=len(cameras)):
                write_png(folder / name, image)
                labels[name] = {level: label[level.index] for level in LEVELS}
                annotated[name] = annotated_nodes(label, scene.nodes, scene.background, smallest)
            write_index(folder, dict.fromkeys(cameras.names, size), source=source)
        with atomic_folder(truth) as folder:
            write_hierarchy(folder, scene.nodes, labels, annotated)
            cameras.save(folder / "cameras.npz")
            write_mesh(folder / "mesh.ply", scene, cameras, MESH_EDGE.get(kind))
            if kind == "street":
                centres = np.stack([cameras[name].centre for name in cameras.names])
                write_npz(folder / "lidar.npz", **vars(scan_street(scene, centres)))
            record = {
                "source": source,
                "kind": kind,
                "seed": seed,
                "split": split_of_seed(seed),
                "generator_version": GENERATOR_VERSION,
                "objects_asked": scene.asked,
                "objects_placed": len(scene.placed),
                "placed": [asdict(thing) for thing in scene.placed],
                "background": sorted(scene.background),
                "style": asdict(scene.style),
            }
            write_json(folder / "scene.json", record)
            counted = {name: {"annotated": len(ids)} for name, ids in annotated.items()}
            write_index(folder, counted, source=source)
        counts.update(views=len(cameras), objects=f"{len(scene.placed)} of {scene.asked}")
        counts.update(nodes=len(scene.nodes), triangles=len(scene.triangles))


_scene = lru_cache(maxsize=1)(build_scene)


def _render(kind: str, seed: int, settings: WorldSettings, view: str) -> tuple[np.ndarray, np.ndarray]:
    """Render one view and its labels in a worker process."""
    scene = _scene(kind, seed, settings.objects)
    cameras = scene_cameras(scene, settings.views, settings.image_px, settings.arc_deg)
    return render_and_label(scene, cameras[view], settings.samples)
