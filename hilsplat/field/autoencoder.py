"""The stage that makes the scene's code, a trained network or PCA, and encodes the masks with it."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from hilsplat.base.artifacts import atomic_folder, read_index, sha256_of_file, write_index, write_npz
from hilsplat.base.progress import stage_log
from hilsplat.contributions.rows import Contributions, mask_embeddings
from hilsplat.field.code import Code, autoencoder_file
from hilsplat.field.linear_code import LinearCode
from hilsplat.segment.digests import MASKS_SHA256, digests_in, require_same_masks
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import AutoencoderSettings


def mask_targets(
    clip: Float32[np.ndarray, "M C"], tree: SemanticTree, targets: str
) -> tuple[Float32[np.ndarray, "M C"], Float32[np.ndarray, "B C"]]:
    """The target vector of each mask, and the distinct vectors to train on.

    Args:
        clip: each mask's own vector.
        tree: nodes, and the node each mask fits.
        targets: "node": the node's averaged vector if the mask fits a node, else its own (averaged in CLIP
            space before encoding); "mask": always its own, as in the paper.
    """
    if targets == "mask":
        return clip, clip
    fits = tree.node_of_mask >= 0
    target = clip.copy()
    target[fits] = tree.clip[tree.node_of_mask[fits]]
    return target, np.concatenate([tree.clip, clip[~fits]])


def run_autoencoder(
    clip_folder: Path,
    semantic_tree_folder: Path,
    contributions_folder: Path,
    out: Path,
    settings: AutoencoderSettings,
    seed: int,
) -> None:
    """Train the scene's autoencoder and encode every mask.

    Writes `autoencoder.safetensors`, `latents.npz` (rows as in the contributions) and `index.json`.

    Raises:
        MisalignedArtifactError: the semantic tree or the CLIP vectors belong to other masks.
    """
    contributions = Contributions.load(contributions_folder)
    tree = SemanticTree.load(semantic_tree_folder)
    require_same_masks(semantic_tree_folder, contributions_folder)
    clip = mask_embeddings(clip_folder, contributions)
    target, train = mask_targets(clip, tree, settings.targets)
    with stage_log("autoencoder", read_index(contributions_folder)["scene"]) as counts:
        model: Code
        if settings.code == "pca":
            model = LinearCode.fit(train, settings.latent)
        else:
            from hilsplat.field.network_training import train_autoencoder

            model = train_autoencoder(train, settings, seed)
        latents = model.encode_array(target)
        decoded = model.decode_array(model.encode_array(train))
        cosine = float((decoded * train).sum(axis=1).mean())
        own = float((model.decode_array(latents) * clip).sum(axis=1).mean())
        counts |= {"vectors": len(train), "mean decoder cosine": round(cosine, 4)}
        with atomic_folder(out) as folder:
            model.save(autoencoder_file(folder))
            write_npz(folder / "latents.npz", latents=latents)
            write_index(
                folder,
                {view: {MASKS_SHA256: digest} for view, digest in digests_in(contributions_folder).items()},
                code=settings.code,
                channels=model.channels,
                latent=model.latent,
                vectors=len(train),
                masks=len(clip),
                decoder_cosine=round(cosine, 6),
                decoder_cosine_own=round(own, 6),
                autoencoder_sha256=sha256_of_file(autoencoder_file(folder)),
            )
