"""Export of masks and vectors in the format of LangSplat's preprocessing (see `langsplat_files`)."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64

from hilsplat.base.artifacts import read_npy, write_npy
from hilsplat.base.atomic import atomic_folder
from hilsplat.embed.langsplat_files import MAPS, stems_of
from hilsplat.embed.vectors import require_every_vector
from hilsplat.scene.exporting import add_colmap
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import digests_in, load_masks, require_same_masks
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.splat.coordinates import write_source_ply


def maps_of(masks: HierarchicalMasks) -> tuple[Float32[np.ndarray, "4 H W"], Int64[np.ndarray, " N"]]:
    """Return LangSplat's four maps of a view, and the mask of each row of the view's vectors.

    The mixed-level map contains all masks, painted from large to small.
    """
    maps, rows = [], []
    count = 0
    for level in MAPS:
        of_level = np.arange(len(masks)) if level is None else masks.rows_of(level)
        labels = masks.label_map(level)
        maps.append(np.where(labels >= 0, count + np.searchsorted(of_level, labels), -1))
        rows.append(of_level)
        count += len(of_level)
    return np.stack(maps).astype(np.float32), np.concatenate(rows)


def export_langsplat(scene: Scene, masks: Path, clip: Path, gaussians: Path, out: Path) -> None:
    """Export a scene as LangSplat's input: images, `sparse/0`, `language_features/` and `point_cloud.ply`.

    `masks` contains the training views' masks; `out` is replaced if it exists.

    Raises:
        MisalignedArtifactError: the CLIP vectors were computed from other masks.
        ArtifactError: a mask has no vector.
    """
    with atomic_folder(out) as folder:
        add_colmap(scene, folder)
        write_source_ply(gaussians, folder / "point_cloud.ply")
        write_langsplat(masks, clip, folder / "language_features")


def write_langsplat(masks_folder: Path, clip_folder: Path, folder: Path) -> None:
    """Write `<stem>_s.npy` and `<stem>_f.npy` of all views with masks; errors as in `export_langsplat`."""
    folder.mkdir(parents=True, exist_ok=True)
    digests = digests_in(masks_folder)
    require_same_masks(clip_folder, masks_folder)
    for view, stem in stems_of(list(digests)).items():
        masks = load_masks(masks_folder, view, digests)
        vectors = read_npy(clip_folder / f"{view}.npy")
        require_every_vector(vectors, clip_folder, "LangSplat's format")
        maps, rows = maps_of(masks)
        write_npy(folder / f"{stem}_s.npy", maps)
        write_npy(folder / f"{stem}_f.npy", vectors[rows].astype(np.float32))
