"""Stages that segment training views at three levels, with SAM or with the graph segmenter."""

import logging
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hilsplat.base.artifacts import write_index
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.cache import ViewCache
from hilsplat.base.code import code_digest
from hilsplat.base.errors import SceneError, SettingsError
from hilsplat.base.levels import LEVELS
from hilsplat.base.lineage import sha256_of_file, sha256_of_json
from hilsplat.base.processes import in_order
from hilsplat.base.progress import stage_log, track
from hilsplat.models.card import recorded
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
    views: Sequence[str] | None = None,
) -> None:
    """Segment training views with the segmenter in the settings; arguments as in `run_sam_masks`."""
    if settings.segmenter == "sam":
        run_sam_masks(scene_folder, out, cache, settings, threads, memory_mib, views)
    elif settings.segmenter == "graph":
        run_graph_masks(scene_folder, out, cache, settings, threads, views)
    else:
        raise SettingsError(
            f"masks.segmenter {settings.segmenter} needs a generated scene's ground truth",
            fix="set masks.segmenter to sam or graph; the workflow runs `hilsplat world perturb`",
        )


def run_sam_masks(
    scene_folder: Path,
    out: Path,
    cache: Path,
    settings: MasksSettings,
    threads: int,
    memory_mib: float | None = None,
    views: Sequence[str] | None = None,
    prompts: Callable[[str], np.ndarray] | None = None,
    finished: Path | None = None,
) -> None:
    """Segment training views with SAM.

    Args:
        out: folder to write (`write_masks`).
        cache: folder of the view cache. It contains the decoder's candidates and the masks, so changing
            thresholds doesn't rerun the networks, and changing levels needs no computation.
        threads: views processed in parallel if they fit into memory; the result does not depend on it.
        memory_mib: memory that the stage may use; None for all free memory.
        views: views to segment; None for every training view.
        prompts: function that returns a view's prompt points (x, y, px); None for the grid.
        finished: earlier output of this stage whose views are reused unchanged.
    """
    scene, view_cache = Scene.load(scene_folder), ViewCache(cache / "masks")
    finished_digests = digests_in(finished) if finished else {}
    with stage_log("masks", scene.name) as counts:
        model = SamModel.load(Path(settings.model), settings.variant, settings.device)
        training = train_views(scene)
        checked = training[:: max(1, len(training) // CHECKED_VIEWS)][:CHECKED_VIEWS]
        model.choose_precision(settings.precision, [scene.image(view) for view in checked], cache, threads)
        limit = model.thresholds(settings).points_per_batch
        batch = model.prompts_per_call(limit, settings.points_per_side**2)
        needs = needs_of(model.model, batch, as_exported=model.as_exported)
        threads = needs.views_at_once(threads, memory_mib)
        logger.info("masks %s: %d views at once, %.0f MiB each", scene.name, threads, needs.view_mib)

        def segment(view: str) -> HierarchicalMasks:
            if finished and view in finished_digests:
                return load_masks(finished, view, finished_digests)
            points = prompts(view) if prompts else None
            return _with_levels(sam_masks(scene, view, model, view_cache, settings, points), settings)

        chosen = training if views is None else views
        masks = zip(chosen, in_order(segment, chosen, threads), strict=True)
        origin = {"model": settings.model, "model_sha256": model.digest, "precision": model.precision}
        origin |= recorded(model.device)
        counts.update(write_masks(out, scene, masks, len(chosen), "sam", **origin))
        counts.update(from_cache=view_cache.hits)


def run_graph_masks(
    scene_folder: Path,
    out: Path,
    cache: Path,
    settings: MasksSettings,
    threads: int,
    views: Sequence[str] | None = None,
) -> None:
    """Segment training views with the graph segmenter; arguments as in `run_sam_masks`."""
    scene, view_cache = Scene.load(scene_folder), ViewCache(cache / "masks")
    with stage_log("masks", scene.name) as counts:
        arguments = settings.graph_scales, settings.min_area_px
        logger.info("masks %s: graph segmenter (no model); the levels are three scales", scene.name)

        def segment(view: str) -> HierarchicalMasks:
            key = sha256_of_json(
                {
                    "image": sha256_of_file(scene.image_path(view)),
                    "settings": arguments,
                    "code": code_digest(segment_graph, HierarchicalMasks),
                }
            )
            arrays = view_cache.get(key, lambda: segment_graph(scene.image(view), *arguments).arrays())
            return _with_levels(HierarchicalMasks.from_arrays(arrays), settings)

        chosen = train_views(scene) if views is None else views
        masks = zip(chosen, in_order(segment, chosen, threads), strict=True)
        counts.update(write_masks(out, scene, masks, len(chosen), "graph"))
        counts.update(from_cache=view_cache.hits)


def write_masks(
    out: Path,
    scene: Scene,
    masks: Iterable[tuple[str, HierarchicalMasks]],
    number: int,
    segmenter: str,
    *,
    model: str | None = None,
    model_sha256: str | None = None,
    **more: str,
) -> dict[str, int]:
    """Write `<view>.npz` of each view and `index.json` (`digests.index_entry`); return the totals to log.

    Args:
        masks: view and masks, for `number` training views.
        segmenter, model, model_sha256, more: origin of the masks, recorded in the index.
    """
    index: dict[str, Any] = {}
    with atomic_folder(out) as folder:
        for view, masks_of_view in track(masks, "masks of views", number):
            masks_of_view.save(folder / f"{view}.npz")
            index[view] = index_entry(masks_of_view)
        origin = {"segmenter": segmenter, "model": model, "model_sha256": model_sha256, **more}
        write_index(folder, index, scene=scene.name, partial=number < len(train_views(scene)), **origin)
    totals = {level.label: sum(entry[level.label] for entry in index.values()) for level in LEVELS}
    for level, total in totals.items():
        if not total:
            logger.warning("masks %s: no view has a mask at level %s", scene.name, level)
    return {"views": number, **totals}


def _with_levels(masks: HierarchicalMasks, settings: MasksSettings) -> HierarchicalMasks:
    if settings.levels == "head":
        return masks
    return with_tree_levels(masks, settings.theta or CoverageTreeSettings().theta)


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
            "settings": settings.model_dump(exclude={"levels", "theta", "key_views", "prompts", "device"}),
            "code": code_digest(masks_from_candidates, HierarchicalMasks),
        }
    )
    return HierarchicalMasks.from_arrays(cache.get(masks_key, from_candidates))
