"""The stages `masks` and `tree`: one file per training view."""

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from hilsplat.base.artifacts import (
    ViewCache,
    atomic_folder,
    read_index,
    sha256_of_file,
    sha256_of_json,
    write_index,
    write_npz,
)
from hilsplat.base.errors import ArtifactError, SceneError
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.base.progress import stage_log, track
from hilsplat.scene.scene import Scene
from hilsplat.segment import graph
from hilsplat.segment.coverage import coverage_tree
from hilsplat.segment.generate import (
    Candidates,
    candidates_key,
    decode_candidates,
    masks_from_candidates,
)
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.sam import SamModel
from hilsplat.settings import MasksSettings, TreeSettings

logger = logging.getLogger(__name__)
Item = TypeVar("Item")
Result = TypeVar("Result")


def in_order(work: Callable[[Item], Result], items: list[Item], threads: int) -> Iterator[Result]:
    """Results of `work` in the order of `items`, several at once.

    At most twice `threads` results wait at a time. When one fails, those not begun are given up.
    """
    with ThreadPoolExecutor(max_workers=max(1, threads)) as pool:
        waiting = []
        rest = iter(items)
        try:
            for item in rest:
                waiting.append(pool.submit(work, item))
                if len(waiting) >= 2 * max(1, threads):
                    yield waiting.pop(0).result()
            while waiting:
                yield waiting.pop(0).result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def train_views(scene: Scene) -> list[str]:
    """Training views of a scene.

    Raises:
        SceneError: there is none.
    """
    views = scene.views("train")
    if not views:
        raise SceneError(
            f"{scene.name} has no training view", fix="hold out fewer views (poses.test_every)"
        )
    return views


def run_masks(scene_folder: Path, out: Path, cache: Path, settings: MasksSettings, threads: int) -> None:
    """Segment every training view at three levels.

    Args:
        scene_folder: the `Scene` artifact.
        out: folder to write: `<view>.npz` (`HierarchicalMasks`) and `index.json`.
        cache: folder of the view cache. With SAM it holds the decoder's candidates, so a change of
            thresholds runs no network.
        settings: which segmenter, and how.
        threads: views worked on at once; the result does not depend on it.
    """
    scene = Scene.load(scene_folder)
    views = train_views(scene)
    view_cache = ViewCache(cache)
    with stage_log("masks", scene.name) as counts:
        if settings.segmenter == "sam":
            model = SamModel.load(Path(settings.model))
            identity = {"segmenter": "sam", "model": settings.model, "model_sha256": model.digest}

            def segment(view: str) -> HierarchicalMasks:
                return sam_masks(scene, view, model, view_cache, settings)

        else:
            logger.info("masks %s: graph segmenter, without a model; levels are three scales", scene.name)
            identity = {"segmenter": "graph", "model": None, "model_sha256": None}

            def segment(view: str) -> HierarchicalMasks:
                return graph_masks(scene, view, view_cache, settings)

        index: dict[str, Any] = {}
        with atomic_folder(out) as folder:
            found = in_order(segment, views, threads)
            for view, masks in zip(views, track(found, "masks of views", len(views)), strict=True):
                masks.save(folder / f"{view}.npz")
                index[view] = {level.label: len(masks.rows_of(level)) for level in LEVELS}
            write_index(folder, index, scene=scene.name, **identity)
        total = {level.label: sum(entry[level.label] for entry in index.values()) for level in LEVELS}
        for level, number in total.items():
            if not number:
                logger.warning("masks %s: no view has a mask at level %s", scene.name, level)
        counts.update(views=len(views), **total, from_cache=view_cache.hits)


def sam_masks(
    scene: Scene, view: str, model: SamModel, cache: ViewCache, settings: MasksSettings
) -> HierarchicalMasks:
    """One view's masks by SAM; the networks run only where the cache lacks the view."""
    key = candidates_key(sha256_of_file(scene.image_path(view)), model, settings)
    arrays = cache.get(key, lambda: decode_candidates(scene.image(view), model, settings).arrays())
    return masks_from_candidates(Candidates(**arrays), scene.cameras[view].size_hw, model, settings)


def graph_masks(scene: Scene, view: str, cache: ViewCache, settings: MasksSettings) -> HierarchicalMasks:
    """One view's masks by the graph segmenter."""
    key = sha256_of_json(
        {
            "image": sha256_of_file(scene.image_path(view)),
            "settings": [settings.graph_scales, settings.min_area_px],
            "code": sha256_of_file(Path(graph.__file__)),
        }
    )
    arrays = cache.get(
        key,
        lambda: graph.segment_graph(
            scene.image(view), settings.graph_scales, settings.min_area_px
        ).arrays(),
    )
    return HierarchicalMasks.from_arrays(arrays)


def run_tree(masks_folder: Path, out: Path, settings: TreeSettings) -> None:
    """Build the coverage tree of every view.

    Args:
        masks_folder: what `run_masks` wrote.
        out: folder to write: `<view>.npz` with `parent` i32 (M) and `depth` u8 (M), rows as the
            masks, and `index.json`.
        settings: threshold and where a parent may come from.
    """
    masks_index = read_index(masks_folder)
    index: dict[str, Any] = {}
    with stage_log("tree", masks_index["scene"]) as counts, atomic_folder(out) as folder:
        for view in track(list(masks_index["views"]), "coverage trees"):
            masks = HierarchicalMasks.load(Path(masks_folder) / f"{view}.npz")
            parent, depth = coverage_tree(masks, settings)
            write_npz(folder / f"{view}.npz", parent=parent, depth=depth)
            has_parent = parent != NONE
            index[view] = {
                "masks": len(masks),
                "roots": int((~has_parent).sum()),
                "part_with_parent": int(has_parent[masks.rows_of(Level.PART)].sum()),
                "subpart_with_parent": int(has_parent[masks.rows_of(Level.SUBPART)].sum()),
                "deepest": int(depth.max(initial=0)),
            }
        write_index(folder, index, scene=masks_index["scene"], theta=settings.theta, parents=settings.parents)
        counts.update(
            views=len(index),
            masks=sum(entry["masks"] for entry in index.values()),
            roots=sum(entry["roots"] for entry in index.values()),
        )


def load_view_masks(masks_folder: Path, view: str) -> HierarchicalMasks:
    """Masks of a view that the index lists.

    Raises:
        ArtifactError: the folder is incomplete or does not hold the view.
    """
    index = read_index(masks_folder)
    if view not in index["views"]:
        raise ArtifactError(
            f"{masks_folder} has no masks of view {view}",
            found=f"{len(index['views'])} views",
            fix="run the masks stage again for this scene",
        )
    return HierarchicalMasks.load(Path(masks_folder) / f"{view}.npz")
