"""Stages that segment training views at three levels, with SAM or with the graph segmenter."""

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
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
from hilsplat.segment.coverage import levelled
from hilsplat.segment.digests import digests_in, index_entry, load_masks
from hilsplat.segment.generate import Candidates, candidates_key, decode_candidates, masks_from_candidates
from hilsplat.segment.graph import segment_graph
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.sam import SamModel
from hilsplat.settings import MasksSettings

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
    prompts: Callable[[str], np.ndarray] | None = None,
    finished: Path | None = None,
) -> None:
    """Segment training views, and write their masks to `out` (`write_masks`).

    For other arguments, see `segment_views`.
    """
    scene, view_cache = Scene.load(scene_folder), ViewCache(cache / "masks")
    with stage_log("masks", scene.name) as counts:
        chosen = train_views(scene) if views is None else views
        masks, origin = segment_views(
            scene, chosen, view_cache, settings, threads, memory_mib, prompts, finished
        )
        counts.update(write_masks(out, scene, masks, len(chosen), **origin))
        counts.update(from_cache=view_cache.hits)


def segment_views(
    scene: Scene,
    views: Sequence[str],
    view_cache: ViewCache,
    settings: MasksSettings,
    threads: int,
    memory_mib: float | None = None,
    prompts: Callable[[str], np.ndarray] | None = None,
    finished: Path | None = None,
) -> tuple[Iterator[tuple[str, HierarchicalMasks]], dict[str, Any]]:
    """Segment views with the segmenter in the settings.

    Args:
        view_cache: contains SAM's candidates and the masks, so changing thresholds doesn't rerun the
            networks, and changing levels needs no computation.
        threads: views processed in parallel if they fit into memory; the result does not depend on it.
        memory_mib: memory that SAM may use; None for all free memory.
        prompts: function that returns a view's prompt points (x, y, px) for SAM; None for the grid.
        finished: earlier output of this stage whose views are reused unchanged.

    Returns:
        each view with its masks, computed on demand, and the origin of the masks, for their index.
    """
    if settings.segmenter not in ("sam", "graph"):
        raise SettingsError(
            f"masks.segmenter {settings.segmenter} needs a generated scene's ground truth",
            fix="set masks.segmenter to sam or graph; the workflow runs `hilsplat world perturb`",
        )
    origin: dict[str, Any] = {"segmenter": settings.segmenter}
    if settings.segmenter == "graph":
        logger.info("masks %s: graph segmenter (no model); the levels are three scales", scene.name)

        def segment_view(view: str) -> HierarchicalMasks:
            return _graph_masks(scene, view, view_cache, settings)
    else:
        model, threads = _opened_sam(scene, view_cache.folder.parent, settings, threads, memory_mib)
        origin |= {"model": settings.model, "model_sha256": model.digest, "precision": model.precision}
        origin |= recorded(model.device)

        def segment_view(view: str) -> HierarchicalMasks:
            points = prompts(view) if prompts else None
            return sam_masks(scene, view, model, view_cache, settings, points)

    finished_digests = digests_in(finished) if finished else {}

    def segment(view: str) -> HierarchicalMasks:
        if finished and view in finished_digests:
            return load_masks(finished, view, finished_digests)
        masks = segment_view(view)
        if settings.levels == "head":
            return masks
        masks = levelled(masks, settings)
        return masks.take(masks.content_order())

    return zip(views, in_order(segment, views, threads), strict=True), origin


def _opened_sam(
    scene: Scene, cache: Path, settings: MasksSettings, threads: int, memory_mib: float | None
) -> tuple[SamModel, int]:
    """Return the model in the precision that the settings select, and the number of views at once."""
    model = SamModel.load(Path(settings.model), settings.variant, settings.device)
    training = train_views(scene)
    checked = training[:: max(1, len(training) // CHECKED_VIEWS)][:CHECKED_VIEWS]
    model.choose_precision(settings.precision, [scene.image(view) for view in checked], cache, threads)
    limit = model.thresholds(settings).points_per_batch
    batch = model.prompts_per_call(limit, settings.points_per_side**2)
    needs = needs_of(model.model, batch, as_exported=model.as_exported)
    threads = needs.views_at_once(threads, memory_mib)
    logger.info("masks %s: %d views at once, %.0f MiB each", scene.name, threads, needs.view_mib)
    return model, threads


def _graph_masks(scene: Scene, view: str, cache: ViewCache, settings: MasksSettings) -> HierarchicalMasks:
    arguments = settings.graph_scales, settings.min_area_px
    key = sha256_of_json(
        {
            "image": sha256_of_file(scene.image_path(view)),
            "settings": arguments,
            "code": code_digest(segment_graph, HierarchicalMasks),
        }
    )
    arrays = cache.get(key, lambda: segment_graph(scene.image(view), *arguments).arrays())
    return HierarchicalMasks.from_arrays(arrays)


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
