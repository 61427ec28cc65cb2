"""Digests of each view's masks, recorded in artifacts computed from the masks and checked on reading.

CLIP vectors, contributions, coverage trees, nodes and codes refer to masks by row number, so they may be
combined only if they were computed from the same masks in the same order.
"""

import itertools
from collections.abc import Mapping
from pathlib import Path

from hilsplat.base.artifacts import INDEX, read_index, remake, sha256_of_bytes
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.base.levels import LEVELS
from hilsplat.segment.masks import HierarchicalMasks

MASKS_SHA256 = "masks_sha256"
"""Key of the digest in a view's entry of `index.json`."""


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
            raise ArtifactError(
                f"{folder} was written by a different version of hilsplat",
                expected=f"{MASKS_SHA256} of every view in {INDEX}",
                found=f"none for view {view}",
                fix=remake(folder),
            )
        digests[view] = digest
    return digests


def load_masks(folder: Path, view: str, digests: Mapping[str, str]) -> HierarchicalMasks:
    """Read a view's masks; raise a MisalignedArtifactError unless they have the view's digest (`digests_in`).

    The check adds 0.03 s for 48 views of 300 masks at 800 x 600.
    """
    path = folder / f"{view}.npz"
    masks = HierarchicalMasks.load(path)
    _require_same(view, digests.get(view), digest_of(masks), f"{path} contains different masks", remake(path))
    return masks


def require_same_masks(folder: Path, other: Path) -> list[str]:
    """Return the views of `other` in order if both artifacts were computed from the same masks.

    Either artifact may be the masks artifact itself.

    Raises:
        MisalignedArtifactError: if the digests of a view differ, or only one artifact contains the view.
    """
    found, expected = digests_in(folder), digests_in(other)
    what = f"{folder} and {other} refer to different masks"
    fix = f"rerun the stage that writes {folder}; if the error persists, also that of {other}"
    for view in {**expected, **found}:
        _require_same(view, expected.get(view), found.get(view), what, fix)
    return list(expected)


def _require_same(view: str, expected: str | None, found: str | None, what: str, fix: str) -> None:
    if found != expected:
        raise MisalignedArtifactError(
            f"{what} (view {view})",
            expected=f"masks with digest {expected[:12]}" if expected else "no masks for this view",
            found=f"digest {found[:12]}" if found else "no masks for this view",
            fix=fix,
        )
