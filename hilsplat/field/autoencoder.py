"""Stage `autoencoder`: fit the scene's code, a network or PCA, and encode the masks with it."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from hilsplat.base.artifacts import atomic_folder, read_index, sha256_of_file, write_index, write_npz
from hilsplat.base.progress import stage_log
from hilsplat.embed.vectors import mask_embeddings, require_every_vector
from hilsplat.field.code import Code, autoencoder_file
from hilsplat.field.linear_code import LinearCode
from hilsplat.segment.digests import MASKS_SHA256, digests_in, require_same_masks
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import AutoencoderSettings


def mask_targets(
    clip: Float32[np.ndarray, "M C"], tree: SemanticTree, targets: str
) -> tuple[Float32[np.ndarray, "M C"], Float32[np.ndarray, "B C"]]:
    """Return the target vector of each mask, and the distinct vectors to train on.

    Args:
        clip: each mask's own vector, or zero if it has none.
        tree: nodes with their vectors, and the node that each mask fits best.
        targets: "node": the vector of that node, or the mean of all nodes for a mask that shares no Gaussian
            with any; "mask": its own vector, as in the paper, which is also used if the tree has no nodes.
    """
    if targets == "node" and len(tree):
        or_mean = np.append(tree.clip, tree.clip.mean(axis=0, keepdims=True), axis=0)
        return or_mean[tree.node_of_mask], tree.clip
    return clip, clip


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
        MisalignedArtifactError: if the semantic tree or the CLIP vectors belong to other masks.
        ArtifactError: if a mask needs its own vector and has none.
    """
    require_same_masks(semantic_tree_folder, contributions_folder)
    tree = SemanticTree.load(semantic_tree_folder, clip_folder)
    clip = mask_embeddings(clip_folder, contributions_folder)
    if settings.targets == "mask" or not len(tree):
        require_every_vector(clip, clip_folder, "autoencoder.targets: mask")
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
        embedded = np.flatnonzero(clip.any(axis=1))
        own = float((model.decode_array(latents[embedded]) * clip[embedded]).sum(axis=1).mean())
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
