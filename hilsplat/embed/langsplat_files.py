"""Import of LangSplat's masks and vectors (the `language_features/` of its preprocessing).

Each image, such as `a.jpg`, has two plain arrays:
    a_s.npy  float32 (4, H, W): row of `a_f.npy` at each pixel, -1 for none;
    a_f.npy  float32 (N, C): a CLIP vector per mask.
The four maps are default (all heads mixed), s, m and l (one head each, from fine to coarse). Rows are
numbered across all four maps. File names are truncated at their first dot.
"""

import logging
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float16, UInt8

from hilsplat.base.artifacts import read_npy, write_index, write_npy
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.errors import ArtifactError, HilsplatError, MisalignedArtifactError, in_one_line
from hilsplat.base.levels import Level
from hilsplat.base.progress import stage_log, track
from hilsplat.embed.clip import ClipModel, unit
from hilsplat.scene.cameras import Camera
from hilsplat.scene.placement import placed
from hilsplat.scene.scene import Scene
from hilsplat.segment.coverage import levelled
from hilsplat.segment.digests import MASKS_SHA256, digest_of
from hilsplat.segment.masks import HierarchicalMasks, runs_of_labels
from hilsplat.segment.stage import train_views, write_masks
from hilsplat.settings import ClipSettings, MasksSettings

logger = logging.getLogger(__name__)

OF_HEADS = MasksSettings(levels="head")
MIN_SHARE = 0.5
"""Minimum share of training views with files; if fewer, the files probably belong to a different scene."""
CHECKED_MASKS, MIN_COSINE = 32, 0.8
"""Number of masks embedded again as a check, and the minimum median cosine with the vectors in the files.
The same CLIP model reaches 0.99; a different model of the same width, about 0."""
MAPS: tuple[Level | None, ...] = (None, Level.SUBPART, Level.PART, Level.WHOLE)
"""Levels of the four maps, in order; the first map mixes all levels."""


def stem_of(view: str) -> str:
    """Return the stem of a view's files: its name, truncated at the first dot as in LangSplat."""
    return view.split(".")[0]


def stems_of(views: list[str]) -> dict[str, str]:
    """Return the stem of each view, or raise an ArtifactError if two views have the same stem."""
    stems = {view: stem_of(view) for view in views}
    counts = Counter(stems.values())
    if twins := [view for view in views if counts[stems[view]] > 1]:
        shared = f"these views would use the same LangSplat files: {', '.join(twins[:4])}"
        raise ArtifactError(shared, fix="rename the images so that their names differ before the first dot")
    return stems


def read_view(
    folder: Path, view: str, camera: Camera | None = None, levels: MasksSettings = OF_HEADS
) -> tuple[HierarchicalMasks, Float16[np.ndarray, "M C"]]:
    """Read the masks and vectors of one view, with rows in `content_order`.

    The mixed-level map is ignored. `levels` selects those of the other maps or the depths in the
    view's coverage tree. Where masks of one level overlap, the files contain only the mask painted last.
    The files contain no scores, so predicted IoU and stability are set to 1. Maps of the
    photograph or of a scaled copy, such as LangSplat's 1080 rows, are transferred to the view (nearest
    pixel); without a camera, they stay as they are.

    Raises:
        ArtifactError: a file is missing, damaged, pickled, or in a different format.
        MisalignedArtifactError: the maps fit neither view nor photograph.
    """
    maps_path, vectors_path = (folder / f"{stem_of(view)}_{kind}.npy" for kind in "sf")
    if missing := [path for path in (maps_path, vectors_path) if not path.is_file()]:
        raise ArtifactError(f"{missing[0]} is missing")
    maps, vectors = read_npy(maps_path), read_npy(vectors_path)
    if maps.ndim != 3 or len(maps) != len(MAPS) or not maps.size:
        shape = "an array of shape (4, height, width): default, s, m, l"
        raise ArtifactError(f"{maps_path} is not a LangSplat map", expected=shape, found=f"{maps.shape}")
    if vectors.ndim != 2 or vectors.dtype.kind != "f" or not (np.abs(vectors) < 1e9).all():
        raise ArtifactError(
            f"{vectors_path} is not an array of vectors",
            expected="finite floating-point numbers of shape (masks, channels)",
            found=f"{vectors.dtype} of shape {vectors.shape}",
        )
    labels = np.where(np.isfinite(maps), maps, -2).astype(np.int64)
    if (labels != maps).any() or labels.min() < -1 or labels.max() >= len(vectors):
        raise ArtifactError(
            f"{maps_path} does not match {vectors_path.name}",
            expected=f"row numbers from -1 (none) to {len(vectors) - 1}",
            found=f"row numbers from {maps.min():g} to {maps.max():g}",
            fix="use two files from the same preprocessing run",
        )
    parts, vector_rows = [], []
    for level, drawn in zip(MAPS, labels, strict=True):
        if level is None:
            continue
        label_map = drawn if camera is None else placed(drawn + 1, camera, str(maps_path)) - 1  # 0: outside
        rows = np.unique(label_map[label_map >= 0])
        ones = np.ones(len(rows), np.float32)
        runs = runs_of_labels(label_map, rows)
        parts.append(HierarchicalMasks.from_runs(*runs, level, ones, ones, label_map.shape))
        vector_rows.append(rows)
    masks = levelled(HierarchicalMasks.concatenate(parts), levels)
    order = masks.content_order()
    vectors = vectors[np.concatenate(vector_rows)[order]].astype(np.float32)
    return masks.take(order), unit(vectors).astype(np.float16)


def read_views(
    folder: Path, cameras: Mapping[str, Camera | None], levels: MasksSettings = OF_HEADS
) -> tuple[dict[str, tuple[HierarchicalMasks, Float16[np.ndarray, "M C"]]], list[str]]:
    """Read training views (`read_view`); also return why others, whose files cannot be used, are left out.

    Raises:
        ArtifactError: less than `MIN_SHARE` of the views can be used, two views share their files, or vectors
            differ in width.
    """
    maps, lost = {}, []
    for view in track(stems_of([*cameras]), "LangSplat's files"):
        try:
            maps[view] = read_view(folder, view, cameras[view], levels)
        except HilsplatError as error:
            lost.append(in_one_line(error))
    if len(maps) < MIN_SHARE * len(cameras):
        raise ArtifactError(
            f"{folder} has usable maps of only {len(maps)} of {len(cameras)} training views",
            found="; ".join(lost[:3]),
            fix="pass the language_features folder that LangSplat wrote for the same images",
        )
    widths = sorted({vectors.shape[1] for _, vectors in maps.values()})
    if len(widths) > 1:
        problem = f"{folder} has vectors of {' and '.join(map(str, widths))} numbers"
        raise ArtifactError(problem, expected="vectors of one CLIP model", fix="run the preprocessing again")
    return maps, lost


def run_imported_masks(scene_folder: Path, files: Path, out: Path, levels: MasksSettings = OF_HEADS) -> None:
    """Write LangSplat's masks in the format of `segment.stage.write_masks`."""
    scene = Scene.load(scene_folder)
    with stage_log("langsplat masks", scene.name) as counts:
        views, lost = read_views(files, {view: scene.cameras[view] for view in train_views(scene)}, levels)
        if lost:
            logger.warning("%s: %d views are left out: %s", files, len(lost), "; ".join(lost[:5]))
        masks = {view: masks for view, (masks, _) in views.items()}
        counts.update(write_masks(out, scene, masks.items(), len(masks), "langsplat"))


def run_imported_clip(
    scene_folder: Path, files: Path, out: Path, settings: ClipSettings, levels: MasksSettings = OF_HEADS
) -> None:
    """Write LangSplat's vectors in the format of the clip stage, with rows as in `run_imported_masks`.

    A MisalignedArtifactError is raised unless the vectors are those of `settings.model`, which embeds texts.
    """
    scene = Scene.load(scene_folder)
    model = ClipModel.load(Path(settings.model), variant=settings.variant)
    with stage_log("langsplat clip", scene.name) as counts, atomic_folder(out) as folder:
        index = {}
        views, _ = read_views(files, {view: scene.cameras[view] for view in train_views(scene)}, levels)
        view = max(views, key=lambda view: len(views[view][0]))
        require_model(model, files, view, scene.image(view), *views[view])
        for view, (masks, vectors) in views.items():
            write_npy(folder / f"{view}.npy", vectors)
            index[view] = {MASKS_SHA256: digest_of(masks), "masks": len(vectors)}
        write_index(folder, index, scene=scene.name, **model.about(settings), background="langsplat")
        counts.update(views=len(index), dim=model.width)


def require_model(
    model: ClipModel,
    files: Path,
    view: str,
    image: UInt8[np.ndarray, "H W 3"],
    masks: HierarchicalMasks,
    vectors: Float16[np.ndarray, "M C"],
) -> None:
    """Raise MisalignedArtifactError unless the vectors of a view, from `read_view`, are those of a model.

    Some masks are embedded again, as LangSplat does, and the vectors are compared. Comparing only widths
    would not distinguish all CLIP models.
    """
    model.require_width(vectors.shape[1], f"{files / stem_of(view)}_f.npy")
    rows = np.arange(0, len(masks), -(-len(masks) // CHECKED_MASKS) or 1)
    again = model.embed_masks(image, masks, ClipSettings(crop="langsplat"), rows)
    cosines = (again.astype(np.float32) * vectors[rows].astype(np.float32)).sum(axis=1)
    cosine = float(np.median(cosines)) if len(rows) else 1.0
    logger.info("the CLIP model in %s agrees with %s: median cosine %.3f", model.model.folder, files, cosine)
    if cosine < MIN_COSINE:
        raise MisalignedArtifactError(
            f"the vectors in {files} were not computed by the CLIP model in {model.model.folder}",
            expected=f"a median cosine of at least {MIN_COSINE} with the model's vectors of the same masks",
            found=f"{cosine:.3f} for {len(rows)} masks of {view}",
            fix="set clip.model to the model that computed them; LangSplat uses clip-vit-b-16-laion2b "
            "(hilsplat models get clip-vit-b-16-laion2b)",
        )
