"""Stage `masks`: masks at three levels for every training view."""

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hilsplat.base.artifacts import write_index
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.cache import ViewCache
from hilsplat.base.code import code_digest
from hilsplat.base.errors import SceneError
from hilsplat.base.levels import LEVELS
from hilsplat.base.lineage import sha256_of_file, sha256_of_json
from hilsplat.base.processes import in_order
from hilsplat.base.progress import stage_log, track
from hilsplat.models.int8 import CHECKED_VIEWS
from hilsplat.models.memory import needs_of
from hilsplat.scene.scene import Scene
from hilsplat.segment.coverage import with_tree_levels
from hilsplat.segment.digests import digests_in, index_entry, load_masks
from hilsplat.segment.generate import Candidates, candidates_key, decode_candidates, masks_from_candidates
from hilsplat.segment.graph import segment_graph
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.sam import SamModel
from hilsplat.settings import CoverageTreeSettings, MasksSettings

logger = logging.getLogger(__name__)


def train_views(scene: Scene) -> list[str]:
    """Return the training views of a scene, or raise a SceneError if there are none."""
    views = scene.views("train")
    if not views:
        raise SceneError(f"{scene.name} has no training view", fix="hold out fewer views (poses.test_every)")
    return views


def run_masks(
    scene_folder: Path,
    out: Path,
    cache: Path,
    settings: MasksSettings,
    threads: int,
    memory_mib: float | None = None,
    key_views: Sequence[str] | None = None,
    prompts: Callable[[str], np.ndarray | None] = lambda view: None,
    finished: Path | None = None,
) -> None:
    """Segment training views at three levels.

    Args:
        out: folder to write: `<view>.npz` (`HierarchicalMasks`) and `index.json` (`digests.index_entry`).
        cache: folder of the view cache. For SAM it contains the decoder's candidates and the masks, so
            changing thresholds doesn't rerun the networks, and changing levels needs no computation.
        threads: views processed in parallel if they fit into memory; the result does not depend on it.
        memory_mib: memory that the stage may use; None for all free memory.
        key_views: views to segment; None for every training view.
        prompts: function that returns a view's prompt points for SAM (x, y, px), or None to use the grid.
        finished: earlier output of this stage whose views are reused unchanged.
    """
    scene = Scene.load(scene_folder)
    views = train_views(scene) if key_views is None else list(key_views)
    view_cache = ViewCache(cache / "masks")
    taken = digests_in(finished) if finished else {}
    model: SamModel | None = None
    identity: dict[str, str | None] = {"segmenter": settings.segmenter, "model": None, "model_sha256": None}

    def segment(view: str) -> HierarchicalMasks:
        if finished and view in taken:
            return load_masks(finished, view, taken)
        if model is None:
            masks = graph_masks(scene, view, view_cache, settings)
        else:
            masks = sam_masks(scene, view, model, view_cache, settings, prompts(view))
        if settings.levels == "head":
            return masks
        return with_tree_levels(masks, settings.theta or CoverageTreeSettings().theta)

    with stage_log("masks", scene.name) as counts:
        if settings.segmenter == "sam":
            model = SamModel.load(Path(settings.model), settings.variant)
            every = train_views(scene)  # independent of `key_views`
            checked = [scene.image(view) for view in every[:: max(1, len(every) // CHECKED_VIEWS)]]
            model.choose_precision(settings.precision, checked[:CHECKED_VIEWS], cache, threads)
            identity.update(model=settings.model, model_sha256=model.digest, precision=model.precision)
            limit = model.thresholds(settings).points_per_batch
            batch = model.prompts_per_call(limit, settings.points_per_side**2)
            needs = needs_of(model.model, batch, as_exported=model.as_exported)
            threads = needs.views_at_once(threads, memory_mib)
            logger.info("masks %s: %d views at once, %.0f MiB each", scene.name, threads, needs.view_mib)
        else:
            logger.info("masks %s: graph segmenter (no model); the levels are three scales", scene.name)
        index: dict[str, Any] = {}
        with atomic_folder(out) as folder:
            found = in_order(segment, views, threads)
            for view, masks in zip(views, track(found, "masks of views", len(views)), strict=True):
                masks.save(folder / f"{view}.npz")
                index[view] = index_entry(masks)
            write_index(folder, index, scene=scene.name, partial=key_views is not None, **identity)
        total = {level.label: sum(entry[level.label] for entry in index.values()) for level in LEVELS}
        for level, number in total.items():
            if not number:
                logger.warning("masks %s: no view has a mask at level %s", scene.name, level)
        counts.update(views=len(views), **total, from_cache=view_cache.hits)


def sam_masks(
    scene: Scene,
    view: str,
    model: SamModel,
    cache: ViewCache,
    settings: MasksSettings,
    points: Float[np.ndarray, "P 2"] | None = None,
) -> HierarchicalMasks:
    """Segment one view with SAM; the networks run only if the view's candidates are not in the cache."""
    key = candidates_key(sha256_of_file(scene.image_path(view)), model, settings, points)
    size_hw = scene.cameras[view].size_hw

    def from_candidates() -> dict[str, np.ndarray]:
        decoded = cache.get(key, lambda: vars(decode_candidates(scene.image(view), model, settings, points)))
        return masks_from_candidates(Candidates(**decoded), size_hw, model, settings).arrays()

    masks_key = sha256_of_json(
        {
            "candidates": key,
            "size": size_hw,
            "settings": settings.model_dump(exclude={"levels", "theta", "key_views", "prompts"}),
            "code": code_digest(masks_from_candidates, HierarchicalMasks),
        }
    )
    return HierarchicalMasks.from_arrays(cache.get(masks_key, from_candidates))


def graph_masks(scene: Scene, view: str, cache: ViewCache, settings: MasksSettings) -> HierarchicalMasks:
    """Segment one view with the graph segmenter."""
    key = sha256_of_json(
        {
            "image": sha256_of_file(scene.image_path(view)),
            "settings": [settings.graph_scales, settings.min_area_px],
            "code": code_digest(segment_graph, HierarchicalMasks),
        }
    )

    def segment() -> dict[str, np.ndarray]:
        return segment_graph(scene.image(view), settings.graph_scales, settings.min_area_px).arrays()

    return HierarchicalMasks.from_arrays(cache.get(key, segment))
