"""Digests of each view's masks, recorded in artifacts computed from the masks and checked on reading.

CLIP vectors, contributions, coverage trees, nodes and codes refer to masks by row number, so they may be
combined only if they were computed from the same masks in the same order.
"""

import itertools
from collections.abc import Mapping
from pathlib import Path

from hilsplat.base.artifacts import INDEX, OTHER_VERSION, damaged, read_index, rebuild_command
from hilsplat.base.levels import LEVELS
from hilsplat.base.lineage import require_made_from, sha256_of_bytes
from hilsplat.segment.masks import HierarchicalMasks

MASKS_SHA256 = "masks_sha256"  # key of the digest in a view's entry of `index.json`


def digest_of(masks: HierarchicalMasks) -> str:
    """Return the SHA-256 of all arrays of a view's masks: sizes, pixels, levels and scores, in row order."""
    parts = []
    for name, array in masks.arrays().items():
        parts += [f"{name} {array.dtype.str} {array.shape}".encode(), array.tobytes()]
    return sha256_of_bytes(*parts)


def pixel_digests(masks: HierarchicalMasks) -> list[str]:
    """Return the SHA-256 of each mask's pixels, independent of its level and row."""
    ends = masks.offsets.tolist()
    return [sha256_of_bytes(masks.runs[start:end].tobytes()) for start, end in itertools.pairwise(ends)]


def index_entry(masks: HierarchicalMasks) -> dict[str, int | str]:
    """Return the index entry of a view's masks: their number per level and their digest."""
    return {**{level.label: len(masks.rows_of(level)) for level in LEVELS}, MASKS_SHA256: digest_of(masks)}


def digests_in(folder: Path) -> dict[str, str]:
    """Return the digest of each view's masks, as recorded in the masks or an artifact computed from them.

    An ArtifactError is raised if the artifact is missing, incomplete or from a different version of hilsplat.
    """
    digests: dict[str, str] = {}
    for view, entry in read_index(folder, "views")["views"].items():
        digest = entry.get(MASKS_SHA256) if isinstance(entry, dict) else None
        if not isinstance(digest, str):
            expected = f"{MASKS_SHA256} of every view in {INDEX}"
            raise damaged(folder, OTHER_VERSION, expected, found=f"none for view {view}")
        digests[view] = digest
    return digests


def load_masks(folder: Path, view: str, digests: Mapping[str, str]) -> HierarchicalMasks:
    """Read a view's masks; raise a MisalignedArtifactError unless they have its digest (from `digests_in`).

    The check adds 0.03 s for 48 views of 300 masks at 800 x 600.
    """
    path = folder / f"{view}.npz"
    masks = HierarchicalMasks.load(path)
    entry, fix = f"the index entry of view {view}", rebuild_command(path)
    require_made_from(entry, path, digests.get(view), digest_of(masks), fix)
    return masks


def require_same_masks(folder: Path, other: Path) -> list[str]:
    """Return the views of `other` in order if both artifacts were computed from the same masks.

    Either artifact may be the masks artifact itself.

    Raises:
        MisalignedArtifactError: if the digests of a view differ, or only one artifact contains the view.
    """
    recorded, digests = digests_in(folder), digests_in(other)
    fix = f"rerun the stage that writes {folder}; if the error persists, also that of {other}"
    for view in {**digests, **recorded}:
        masks = f"the masks of view {view} in {other}"
        require_made_from(folder, masks, recorded.get(view), digests.get(view), fix)
    return list(digests)
