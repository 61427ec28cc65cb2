"""Reading the CLIP vectors of masks."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Shaped

from hilsplat.base.artifacts import read_npy
from hilsplat.base.errors import ArtifactError
from hilsplat.segment.digests import require_same_masks


def mask_embeddings(clip_folder: Path, folder: Path) -> Float32[np.ndarray, "M C"]:
    """CLIP vectors of all masks in the row order of an artifact of theirs; zero where none was computed.

    Raises:
        MisalignedArtifactError: the vectors were computed from other masks.
    """
    views = require_same_masks(clip_folder, folder)
    parts = [read_npy(Path(clip_folder) / f"{view}.npy") for view in views]
    return np.concatenate(parts, dtype=np.float32)


def require_every_vector(vectors: Shaped[np.ndarray, "M C"], clip_folder: Path, purpose: str) -> None:
    """Refuse vectors of the crops that show nodes best where every mask needs one.

    Raises:
        ArtifactError: a mask has no vector.
    """
    without = int((~vectors.any(axis=1)).sum())
    if without:
        raise ArtifactError(
            f"{without} of {len(vectors)} masks have no CLIP vector in {clip_folder}; {purpose} needs all",
            fix="set clip.crops: masks, and rerun the clip stage; or take the vectors of a variant with "
            "autoencoder.targets: mask",
        )
