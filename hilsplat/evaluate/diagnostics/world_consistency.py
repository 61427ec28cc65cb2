"""View consistency of masks on a synthetic scene, measured with its exact geometry."""

from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from hilsplat.base.artifacts import read_index
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.base.levels import Level
from hilsplat.base.tables import markdown_table, write_csv
from hilsplat.datasets.synthetic.hierarchy import HierarchyAnnotations
from hilsplat.evaluate.diagnostics.consistency import measure_consistency, neighbours
from hilsplat.scene.cameras import Cameras
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.origin import masks_label
from hilsplat.world.mesh import TrueMesh

TRUTH = "true regions"
"""Row name of the labels, an upper limit for any masks: label borders are off by up to a pixel."""

COLUMNS = (
    *("scene", "masks", "level", "view_pairs", "masks_compared"),
    *("best_iou", "disagreement", "joined_disagreement"),
)


def run_consistency(truth: Path, masks_folder: Path, out: Path, count: int) -> str:
    """Measure how consistently masks of neighbouring views divide the same surface; return a Markdown table.

    Args:
        truth: truth folder of the scene: true cameras, mesh and labels.
        masks_folder: masks artifact of any segmenter.
        out: CSV to write, one row per level for the masks and for the true regions.
        count: number of neighbours of each view.

    Raises:
        ArtifactError: a folder is missing or incomplete, or fewer than two views have masks.
        MisalignedArtifactError: masks and true cameras differ in size.
    """
    index = read_index(masks_folder)
    views = list(index["views"])
    if len(views) < 2:
        raise ArtifactError(f"{masks_folder} has masks of {len(views)} view(s)", expected="at least two")
    cameras = Cameras.load(Path(truth) / "cameras.npz")
    mesh = TrueMesh.load(Path(truth) / "mesh.ply")
    annotations = HierarchyAnnotations.load(truth)
    pairs = neighbours(cameras, views, count)

    @lru_cache(maxsize=2 * count + 2)
    def depth_of(view: str) -> np.ndarray:
        return mesh.depth(cameras[view])

    @lru_cache(maxsize=2 * count + 2)
    def loaded(view: str) -> HierarchicalMasks:
        masks = HierarchicalMasks.load(Path(masks_folder) / f"{view}.npz")
        expected = cameras[view].size_hw
        if masks.size_hw != expected:
            raise MisalignedArtifactError(
                f"masks of view {view} do not fit its true camera",
                expected=f"{expected[0]} x {expected[1]} (height x width)",
                found=f"{masks.size_hw[0]} x {masks.size_hw[1]}",
                fix="run poses without shrinking the images (poses.max_side_px), then masks again",
            )
        return masks

    def masks_of(view: str, level: Level) -> Bool[np.ndarray, "M H W"]:
        masks = loaded(view)
        return masks.dense(masks.rows_of(level))

    rows = []
    for name, source in (
        (masks_label(masks_folder), masks_of),
        (TRUTH, lambda view, level: true_masks(annotations, view, level)),
    ):
        for level, one in measure_consistency(cameras, pairs, depth_of, source).items():
            shares = [f"{share:.4f}" for share in (one.best_iou, one.disagreement, one.joined_disagreement)]
            rows.append([index["scene"], name, level.label, str(one.pairs), str(one.masks), *shares])
    write_csv(out, COLUMNS, rows)
    return markdown_table(COLUMNS, rows, 3)


def true_masks(annotations: HierarchyAnnotations, view: str, level: Level) -> Bool[np.ndarray, "M H W"]:
    """Return the true regions of a view at a level, one per visible node, including surroundings."""
    labels = annotations.label_image(view, level)
    ids = np.unique(labels[labels >= 0])
    return labels[None] == ids[:, None, None]
