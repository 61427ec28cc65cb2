"""The diagnostic segmenter `truth-perturbed`: masks from the true labels of a synthetic scene.

It separates errors of the method from errors of the small segmenter. It is the only code before `evaluate`
that reads annotations, and it is never a default: the rule and the command pass the truth folder only if the
settings request it, the index records the faults, and every row built on such masks has `SEGMENTER` in its
masks column.
"""

import logging
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int32

from hilsplat.base.artifacts import atomic_folder, read_index, read_json, write_index
from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.base.levels import LEVELS
from hilsplat.base.processes import in_order
from hilsplat.base.progress import stage_log, track
from hilsplat.datasets.synthetic.hierarchy import HierarchyAnnotations
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import index_entry
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.stage import train_views
from hilsplat.settings import PerturbSettings
from hilsplat.world.mask_faults import Draws, TrueNodes, faulty_masks

logger = logging.getLogger(__name__)

SEGMENTER = "truth-perturbed"
"""Name of the segmenter, and prefix of its masks' label."""

FAULTS = (
    *("boundary_px", "merge", "split", "missing", "missing_level", "wrong_level", "dropped_views"),
    *("systematic_merge", "systematic_missing"),
)
"""Settings of `PerturbSettings` that change masks; if all are 0, the masks are exact."""


def run_truth_masks(
    scene_folder: Path, truth: Path, out: Path, settings: PerturbSettings, min_area_px: int, threads: int
) -> None:
    """Write masks of every training view from the true labels, with faults (see `mask_faults.faulty_masks`).

    The index also contains the requested faults and, per view, the number of faults. The result does not
    depend on `threads`.

    Raises:
        MisalignedArtifactError: if label images differ in size from the cameras.
        ArtifactError: if the truth folder is missing or incomplete.
    """
    scene = Scene.load(scene_folder)
    views = train_views(scene)
    read_index(truth)
    annotations = HierarchyAnnotations.load(truth)
    background = read_json(Path(truth) / "scene.json")["background"]
    nodes = TrueNodes.of(
        annotations.nodes, background, (true_labels(annotations, view) for view in annotations.views)
    )
    draws = Draws(settings.seed, scene.name)
    label = faults_label(settings)
    with stage_log("masks", scene.name) as counts:
        logger.warning(
            "masks %s: %s, made from the TRUE labels: a diagnostic, not a result", scene.name, label
        )

        def segment(view: str) -> tuple[HierarchicalMasks, dict[str, int]]:
            labels = true_labels(annotations, view)
            expected = scene.cameras[view].size_hw
            if labels.shape[1:] != expected:
                raise MisalignedArtifactError(
                    f"label image of view {view} does not match its camera",
                    expected=f"{expected[0]} x {expected[1]} (height x width)",
                    found=f"{labels.shape[1]} x {labels.shape[2]}",
                    fix="run poses without shrinking the images (poses.max_side_px)",
                )
            return faulty_masks(labels, nodes, view, draws, settings, min_area_px)

        index: dict[str, Any] = {}
        with atomic_folder(out) as folder:
            found = in_order(segment, views, threads)
            for view, (masks, faults) in zip(views, track(found, "masks of views", len(views)), strict=True):
                masks.save(folder / f"{view}.npz")
                index[view] = {**index_entry(masks), "faults": faults}
            made_by = {"segmenter": SEGMENTER, "model": None, "model_sha256": None, "label": label}
            write_index(folder, index, scene=scene.name, **made_by, perturb=settings.model_dump(mode="json"))
        masks_per_level = {level.label: sum(row[level.label] for row in index.values()) for level in LEVELS}
        counts.update(views=len(views), **masks_per_level)


def true_labels(annotations: HierarchyAnnotations, view: str) -> Int32[np.ndarray, "3 H W"]:
    """Return the node id per level and pixel, -1 if the level has none."""
    return np.stack([annotations.label_image(view, level) for level in LEVELS])


def faults_label(settings: PerturbSettings) -> str:
    """Return the label of these masks in tables: the segmenter, then "exact" or the non-default settings.

    Example:
        >>> faults_label(PerturbSettings(merge=0.2))
        'truth-perturbed (merge 0.2)'
    """
    if not any(np.any(getattr(settings, fault)) for fault in FAULTS):
        return f"{SEGMENTER} (exact)"
    changed = []
    for name, value in settings.model_dump(exclude_defaults=True).items():
        text = "/".join(f"{each:g}" for each in value) if isinstance(value, tuple) else f"{value}"
        changed.append(f"{name} {text}")
    return f"{SEGMENTER} ({', '.join(changed)})" if changed else SEGMENTER
