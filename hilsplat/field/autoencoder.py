"""The scene autoencoder: CLIP vectors to a few numbers, and back, by a network or linearly."""

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from jaxtyping import Float, Float32
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from hilsplat.base.artifacts import (
    atomic_folder,
    atomic_path,
    read_index,
    read_npz,
    sha256_of_file,
    write_index,
    write_npz,
)
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.base.progress import stage_log
from hilsplat.contributions.rows import Contributions, mask_embeddings
from hilsplat.field.linear_code import METADATA_KEY, LinearCode
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import AutoencoderSettings

logger = logging.getLogger(__name__)

ENCODER_WIDTHS = (256, 128, 64, 32)
DECODER_WIDTHS = (16, 32, 64, 128, 256, 256)
CHUNK_ROWS = 4096
"""Rows to decode at once: their hidden layers, 4 MiB, stay in the processor's cache. Chunks of 65,536 rows
took twice as long."""


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Make torch sum in one order: the same bytes for any number of threads of the stage."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Autoencoder(nn.Module):
    """LangSplat's scene autoencoder, C -> 256 -> 128 -> 64 -> 32 -> d and back, unit length at both ends.

    Departs: layer widths never exceed C. The encoder's BatchNorm (better than LayerNorm or none when
    measured) sees full batches only, and ends with the statistics of all vectors: see `train_autoencoder`.

    Args:
        channels: width C of the CLIP vectors.
        latent: size d of a latent.
    """

    def __init__(self, channels: int, latent: int) -> None:
        super().__init__()
        self.channels, self.latent = channels, latent
        widths = [min(width, channels) for width in ENCODER_WIDTHS]
        layers: list[nn.Module] = [nn.Linear(channels, widths[0])]
        for before, after in zip(widths, [*widths[1:], latent], strict=True):
            layers += [nn.BatchNorm1d(before), nn.ReLU(), nn.Linear(before, after)]
        self.encoder = nn.Sequential(*layers)
        widths = [min(width, channels) for width in DECODER_WIDTHS]
        layers = [nn.Linear(latent, widths[0])]
        for before, after in zip(widths, [*widths[1:], channels], strict=True):
            layers += [nn.ReLU(), nn.Linear(before, after)]
        self.decoder = nn.Sequential(*layers)

    def encode(self, vectors: Float[Tensor, "B C"]) -> Float[Tensor, "B D"]:
        """Latents of unit length."""
        return nn.functional.normalize(self.encoder(vectors), dim=-1)

    def decode(self, latents: Float[Tensor, "B D"]) -> Float[Tensor, "B C"]:
        """Vectors of unit length, from latents of any length."""
        return nn.functional.normalize(self.decoder(latents), dim=-1)

    @torch.no_grad()
    def encode_array(self, vectors: Float32[np.ndarray, "B C"]) -> Float32[np.ndarray, "B D"]:
        """`encode` for arrays."""
        return self.encode(torch.from_numpy(np.ascontiguousarray(vectors))).numpy()

    @torch.no_grad()
    def decode_array(self, latents: Float32[np.ndarray, "B D"]) -> Float32[np.ndarray, "B C"]:
        """`decode` for arrays, in chunks."""
        out = np.empty((len(latents), self.channels), np.float32)
        for start in range(0, len(latents), CHUNK_ROWS):
            part = torch.from_numpy(np.ascontiguousarray(latents[start : start + CHUNK_ROWS]))
            out[start : start + len(part)] = self.decode(part).numpy()
        return out

    def save(self, path: Path) -> None:
        """Write a .safetensors file; the same weights give the same bytes."""
        about = json.dumps({"channels": self.channels, "latent": self.latent}, sort_keys=True)
        tensors = {name: value.detach().contiguous() for name, value in self.state_dict().items()}
        with atomic_path(path) as temporary:
            safetensors.torch.save_file(tensors, temporary, metadata={METADATA_KEY: about})


Code = Autoencoder | LinearCode


def load_code(folder: Path) -> Code:
    """Read the code of a finished folder, network or linear.

    Raises:
        ArtifactError: the file is missing or damaged.
    """
    path = autoencoder_file(folder)
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads(file.metadata()[METADATA_KEY])
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if about.get("code") == "pca":
            return LinearCode(state["mean"].numpy(), state["basis"].numpy())
        model = Autoencoder(about["channels"], about["latent"])
    except (FileNotFoundError, SafetensorError, KeyError, TypeError) as error:
        raise ArtifactError(
            f"{path} cannot be read: {error}", fix="run the autoencoder stage again"
        ) from error
    model.load_state_dict(state)
    return model.eval()


def autoencoder_file(folder: Path) -> Path:
    """File of the weights in a finished folder."""
    return Path(folder) / "autoencoder.safetensors"


def reconstruction_loss(
    decoded: Float[Tensor, "B C"], vectors: Float[Tensor, "B C"], cosine_weight: float
) -> Float[Tensor, ""]:
    """Mean squared error plus `cosine_weight` times the mean over vectors of 1 - cosine.

    Departs: LangSplat takes the cosine along the batch axis, which compares channels, not vectors.
    """
    cosine = nn.functional.cosine_similarity(decoded, vectors, dim=1)
    return (decoded - vectors).square().mean() + cosine_weight * (1 - cosine).mean()


def train_autoencoder(
    vectors: Float32[np.ndarray, "B C"], settings: AutoencoderSettings, seed: int
) -> Autoencoder:
    """Train on one scene's vectors: Adam with cosine decay, full batches drawn without replacement.

    Args:
        vectors: unit CLIP vectors, at least one.
        settings: latent size, steps and weights.
        seed: for the initial weights and the order of vectors.

    Returns:
        the trained model; the same bytes for the same input and seed on any number of threads.
    """
    with one_torch_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        data = torch.from_numpy(np.ascontiguousarray(vectors))
        model = Autoencoder(data.shape[1], settings.latent)
        if len(data) == 1:
            data = data.repeat(2, 1)  # BatchNorm needs two rows
        batch = min(settings.batch, len(data))
        per_epoch = len(data) // batch
        steps = max(settings.epochs * per_epoch, settings.min_steps)
        optimiser = torch.optim.Adam(model.parameters(), lr=settings.learning_rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        for step in range(steps):
            place = step % per_epoch
            if place == 0:
                order = torch.randperm(len(data))
            chosen = data[order[place * batch : (place + 1) * batch]]
            loss = reconstruction_loss(model.decode(model.encode(chosen)), chosen, settings.cosine_weight)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
        settle_batch_norm(model, data)
        return model.eval()


@torch.no_grad()
def settle_batch_norm(model: Autoencoder, data: Float[Tensor, "B C"]) -> None:
    """Replace the running statistics, which favour the last batches, by those of all vectors."""
    for module in model.modules():
        if isinstance(module, nn.BatchNorm1d):
            module.reset_running_stats()
            module.momentum = None  # a plain average over what follows: one pass over everything
    model.train()
    model.encoder(data)


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
    """
    contributions = Contributions.load(contributions_folder)
    tree = SemanticTree.load(semantic_tree_folder)
    if len(tree.node_of_mask) != len(contributions):
        raise MisalignedArtifactError(
            f"{semantic_tree_folder} and {contributions_folder} belong to different masks",
            expected=f"{len(contributions)} masks",
            found=f"{len(tree.node_of_mask)}",
            fix="rerun the semantic_tree stage",
        )
    clip = mask_embeddings(clip_folder, contributions)
    target, train = mask_targets(clip, tree, settings.targets)
    with stage_log("autoencoder", read_index(contributions_folder)["scene"]) as counts:
        model: Code
        if settings.code == "pca":
            model = LinearCode.fit(train, settings.latent)
        else:
            model = train_autoencoder(train, settings, seed)
        with one_torch_thread():
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
                {view: {} for view in contributions.views},
                code=settings.code,
                channels=model.channels,
                latent=model.latent,
                vectors=len(train),
                masks=len(clip),
                decoder_cosine=round(cosine, 6),
                decoder_cosine_own=round(own, 6),
                autoencoder_sha256=sha256_of_file(autoencoder_file(folder)),
            )


def load_latents(folder: Path, contributions: Contributions) -> Float32[np.ndarray, "M D"]:
    """Latent of each mask, checked against the contributions' rows.

    Raises:
        MisalignedArtifactError: the numbers of rows differ.
    """
    read_index(folder)
    latents = read_npz(Path(folder) / "latents.npz")["latents"]
    if len(latents) != len(contributions):
        raise MisalignedArtifactError(
            f"latents of {folder} do not belong to these contributions",
            expected=f"{len(contributions)} rows",
            found=f"{len(latents)} rows",
            fix="run the autoencoder stage again",
        )
    return latents
