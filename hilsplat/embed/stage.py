"""Stage `clip`: CLIP vectors of each node's best crops, or of all masks."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

from hilsplat.base.artifacts import read_index, read_npz, sealed, write_index, write_npy
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.cache import ViewCache
from hilsplat.base.code import code_digest
from hilsplat.base.errors import MisalignedArtifactError, ModelError
from hilsplat.base.lineage import require_size, sha256_of_bytes, sha256_of_file, sha256_of_json
from hilsplat.base.processes import in_order
from hilsplat.base.progress import stage_log, track
from hilsplat.embed.clip import ClipModel, unit
from hilsplat.models import int8
from hilsplat.models.card import in_turn, recorded
from hilsplat.models.memory import needs_of
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import MASKS_SHA256, digests_in, load_masks, pixel_digests, require_same_masks
from hilsplat.settings import ClipSettings

FEW_CROPS = 10  # number of crops from which equal vectors show a broken model
RERUN_MASKS = "rerun the masks stage for this scene"


def run_clip(
    scene_folder: Path,
    masks_folder: Path,
    semantic_tree_folder: Path | None,
    out: Path,
    cache: Path,
    settings: ClipSettings,
    threads: int,
    memory_mib: float | None = None,
) -> None:
    """Embed the crops selected by the settings.

    Args:
        semantic_tree_folder: output of the semantic tree stage, with crop ranks; None to embed every mask.
        out: folder to write: `<view>.npy`, float16 (M, C) unit vectors in the masks' order, zero for masks
            that were not selected, and `index.json` with C and the model.
        cache: folder of the view cache. Entries accumulate: a run that selects different masks embeds only
            those that no earlier run embedded.
        threads: views embedded in parallel, if they fit into memory; the result does not depend on it.
        memory_mib: memory that the stage may use; None for all free memory.

    Raises:
        MisalignedArtifactError: views or sizes of the masks differ from the scene's, or the masks differ from
            those recorded in their index.
    """
    scene = Scene.load(scene_folder)
    digests = digests_in(masks_folder)
    views = list(digests)
    training = scene.views("train")
    if unknown := sorted(set(views) - set(training)):
        raise MisalignedArtifactError(
            f"masks in {masks_folder} do not match the training views of {scene.name}",
            expected=f"only masks of its {len(training)} training views",
            found=", ".join(unknown[:5]),
            fix=RERUN_MASKS,
        )
    chosen = None
    if semantic_tree_folder is not None:
        require_same_masks(semantic_tree_folder, masks_folder)
        chosen = chosen_masks(semantic_tree_folder, settings.crops_per_node)
    model = ClipModel.load(Path(settings.model), settings.variant, settings.device)
    _choose_precision(model, scene, masks_folder, digests, chosen, cache, settings, threads)
    threads = needs_of(model.model, settings.batch).views_at_once(threads, memory_mib)
    view_cache = ViewCache(cache / "clip")

    def embed(view: str) -> np.ndarray:
        masks = load_masks(masks_folder, view, digests)
        pixels = pixel_digests(masks)
        order = sorted(range(len(pixels)), key=pixels.__getitem__)  # cache order, independent of levels
        key = sha256_of_json(
            {
                "image": sha256_of_file(scene.image_path(view)),
                "masks": [pixels[row] for row in order],
                "model": model.digest,
                "precision": model.precision,
                "providers": model.vision.runs_on,
                "settings": settings.model_dump(include={"crop", "background", "batch"}),
                "code": code_digest(ClipModel),
            }
        )
        problem = f"masks of view {view} of {scene.name} do not match the size of its camera"
        require_size(problem, masks.size_hw, scene.cameras[view].size_hw, RERUN_MASKS)
        rows = np.arange(len(masks)) if chosen is None else chosen[view]
        entry = view_cache.find(key)
        cached = np.zeros((len(masks), model.width), np.float16)
        if entry is not None:
            cached[order] = entry["clip"]
        missing = rows[~cached[rows].any(axis=1)]
        if len(missing):
            cached[missing] = model.embed_masks(scene.image(view), masks, settings, missing)
            view_cache.put(key, {"clip": cached[order]})
        else:
            view_cache.hits += 1
        vectors = np.zeros_like(cached)
        vectors[rows] = cached[rows]
        return vectors

    with stage_log("clip", scene.name) as counts, atomic_folder(out) as folder:
        index: dict[str, dict[str, Any]] = {}
        distinct = set[bytes]()
        embedded = track(in_order(embed, views, threads), "CLIP of views", len(views))
        for view, vectors in zip(views, embedded, strict=True):
            write_npy(folder / f"{view}.npy", vectors)
            crops = vectors[vectors.any(axis=1)]
            distinct.update(vector.tobytes() for vector in crops[:FEW_CROPS])
            index[view] = {MASKS_SHA256: digests[view], "masks": len(vectors), "crops": len(crops)}
        more = {"precision": model.precision, "background": settings.background, **recorded(model.device)}
        if len(distinct) == 1 and sum(entry["crops"] for entry in index.values()) >= FEW_CROPS:
            raise ModelError(
                f"the CLIP model {settings.model} gives the same vector for all crops of {scene.name}",
                fix="use another variant (clip.variant), or another export of the model",
            )
        write_index(folder, index, scene=scene.name, **model.about(settings), **more)
        totals = {name: sum(entry[name] for entry in index.values()) for name in ("masks", "crops")}
        counts.update(views=len(views), **totals, dim=model.width, from_cache=view_cache.hits)


def _choose_precision(
    model: ClipModel,
    scene: Scene,
    masks_folder: Path,
    digests: Mapping[str, str],
    chosen: Mapping[str, Int64[np.ndarray, " m"]] | None,
    cache: Path,
    settings: ClipSettings,
    threads: int,
) -> None:
    """Switch the model to a lower precision if the settings require it, or if scene crops agree."""
    form = int8.reduced_precision(settings.precision, model.model, "vision_model", model.device)
    if not form:
        return
    entries = read_index(masks_folder)["views"]
    rows = chosen or {view: np.arange(entries[view]["whole"]) for view in digests}
    pairs = [(view, row) for view in digests for row in rows[view].tolist()]
    pairs = pairs[:: max(1, len(pairs) // int8.CHECKED_CROPS)][: int8.CHECKED_CROPS]
    if not pairs:
        return
    reduced = (
        int8.int8_network(model.model, "vision_model", cache) if form == "int8" else model.vision.in_half()
    )
    if reduced is None:
        return

    def crop(pair: tuple[str, int]) -> np.ndarray:
        view, row = pair
        return model.crop(scene.image(view), load_masks(masks_folder, view, digests), row, settings)

    def embed_twice(crop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        def run() -> tuple[np.ndarray, np.ndarray]:
            (vectors,) = reduced(**{model.pixels: model.prepare(crop[None])})
            return model.embed_crops(crop[None]), unit(vectors)

        return in_turn(model.device, "clip", run)

    def measure() -> dict[str, float]:
        full, lower = map(np.concatenate, zip(*in_order(embed_twice, list(crops), threads), strict=True))
        return int8.agreement_of_vectors(full, lower, model.embed_texts(list(int8.WORDS)))

    crops = np.stack(list(map(crop, pairs)))

    inputs = {"model": model.digest, "crops": sha256_of_bytes(crops.tobytes()), "words": int8.WORDS}
    if int8.use_reduced(form, settings.precision, "CLIP", cache, inputs, measure):
        model.vision, model.precision = reduced, form


def chosen_masks(semantic_tree_folder: Path, per_node: int) -> dict[str, Int64[np.ndarray, " m"]]:
    """Return the rows of each view's masks that are among a node's `per_node` best crops by rank.

    If no mask is ranked, all masks are returned.
    """
    rank = read_npz(sealed(semantic_tree_folder, "tree.npz"), "crop_rank")["crop_rank"]
    is_chosen = (rank >= 0) & (rank < per_node)
    is_chosen |= not is_chosen.any()
    counts = {view: entry["masks"] for view, entry in read_index(semantic_tree_folder)["views"].items()}
    parts = np.split(is_chosen, np.cumsum(list(counts.values())))
    return {view: np.flatnonzero(part) for view, part in zip(counts, parts, strict=False)}
