"""Read the masks' CLIP vectors."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Shaped

from hilsplat.base.artifacts import read_npy, rebuild_command, sealed
from hilsplat.base.errors import ArtifactError
from hilsplat.segment.digests import require_same_masks

UNIT_TOLERANCE = 2e-3  # maximum deviation of a vector's length from 1; vectors are stored as float16


def mask_embeddings(clip_folder: Path, folder: Path) -> Float32[np.ndarray, "M C"]:
    """Read the CLIP vectors of all masks, in the row order of artifact `folder`; zero for missing vectors.

    Raises:
        ArtifactError: a file is missing or damaged, or its vectors do not have length 1.
        MisalignedArtifactError: the vectors were computed from other masks.
    """
    views = require_same_masks(clip_folder, folder)
    vectors = {view: read_npy(sealed(clip_folder, f"{view}.npy")) for view in views}
    for view, part in vectors.items():
        lengths = np.linalg.norm(part.astype(np.float32), axis=1)
        invalid = ~((lengths == 0) | (np.abs(lengths - 1) < UNIT_TOLERANCE))  # also NaN
        if invalid.any():
            raise ArtifactError(
                f"{np.count_nonzero(invalid)} CLIP vectors of {view} in {clip_folder} are invalid",
                expected="vectors of length 1, or 0 for crops that were not embedded",
                found=f"length {lengths[invalid][0]}",
                fix=rebuild_command(clip_folder),
            )
    return np.concatenate(list(vectors.values()), dtype=np.float32)


def require_every_vector(vectors: Shaped[np.ndarray, "M C"], clip_folder: Path, purpose: str) -> None:
    """Raise an ArtifactError unless every mask has a vector, not only the best crops of nodes."""
    if without := int((~vectors.any(axis=1)).sum()):
        raise ArtifactError(
            f"{without} of {len(vectors)} masks have no CLIP vector in {clip_folder}; {purpose} needs all",
            fix="set clip.crops to masks and rerun the clip stage, or use the vectors of a variant with "
            "autoencoder.targets: mask",
        )
