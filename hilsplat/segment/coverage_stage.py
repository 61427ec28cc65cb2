"""Stage `coverage_tree`: build the coverage tree of every view that has masks."""

from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import atomic_folder, read_index, write_index, write_npz
from hilsplat.base.levels import NONE, Level
from hilsplat.base.progress import stage_log, track
from hilsplat.segment.coverage import coverage_tree
from hilsplat.segment.digests import MASKS_SHA256, digests_in, load_masks
from hilsplat.settings import CoverageTreeSettings


def run_coverage_tree(masks_folder: Path, out: Path, settings: CoverageTreeSettings) -> None:
    """Write `<view>.npz` of every view with `parent` i32 (M) and `depth` u8 (M), and `index.json`.

    Rows are in the order of the masks.

    Raises:
        MisalignedArtifactError: if the masks of a view differ from those recorded in their index.
    """
    scene, digests = read_index(masks_folder)["scene"], digests_in(masks_folder)
    index: dict[str, Any] = {}
    with stage_log("coverage_tree", scene) as counts, atomic_folder(out) as folder:
        for view in track(list(digests), "coverage trees"):
            masks = load_masks(masks_folder, view, digests)
            parent, depth = coverage_tree(masks, settings.theta)
            write_npz(folder / f"{view}.npz", parent=parent, depth=depth)
            has_parent = parent != NONE
            index[view] = {
                MASKS_SHA256: digests[view],
                "masks": len(masks),
                "roots": int((~has_parent).sum()),
                "part_with_parent": int(has_parent[masks.rows_of(Level.PART)].sum()),
                "subpart_with_parent": int(has_parent[masks.rows_of(Level.SUBPART)].sum()),
                "deepest": int(depth.max(initial=0)),
            }
        write_index(folder, index, scene=scene, theta=settings.theta)
        counts.update(
            views=len(index),
            masks=sum(entry["masks"] for entry in index.values()),
            roots=sum(entry["roots"] for entry in index.values()),
        )
