"""The scene autoencoder of LangSplat: a trained network from CLIP vectors to a few numbers and back."""

import json
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from hilsplat.base.artifacts import atomic_path
from hilsplat.base.device import one_torch_thread
from hilsplat.field.code import CHUNK_ROWS
from hilsplat.field.linear_code import METADATA_KEY
from hilsplat.settings import AutoencoderSettings

ENCODER_WIDTHS = (256, 128, 64, 32)
DECODER_WIDTHS = (16, 32, 64, 128, 256, 256)


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
        with one_torch_thread():
            return self.encode(torch.from_numpy(np.ascontiguousarray(vectors))).numpy()

    @torch.no_grad()
    def decode_array(self, latents: Float32[np.ndarray, "B D"]) -> Float32[np.ndarray, "B C"]:
        """`decode` for arrays, in chunks."""
        out = np.empty((len(latents), self.channels), np.float32)
        with one_torch_thread():
            for start in range(0, len(latents), CHUNK_ROWS):
                part = torch.from_numpy(np.ascontiguousarray(latents[start : start + CHUNK_ROWS]))
                out[start : start + len(part)] = self.decode(part).numpy()
        return out

    @staticmethod
    def from_arrays(channels: int, latent: int, arrays: dict[str, np.ndarray]) -> "Autoencoder":
        """A trained network from its saved weights."""
        model = Autoencoder(channels, latent)
        model.load_state_dict({name: torch.from_numpy(values) for name, values in arrays.items()})
        return model.eval()

    def save(self, path: Path) -> None:
        """Write a .safetensors file; the same weights give the same bytes."""
        about = json.dumps({"channels": self.channels, "latent": self.latent}, sort_keys=True)
        tensors = {name: value.detach().contiguous() for name, value in self.state_dict().items()}
        with atomic_path(path) as temporary:
            safetensors.torch.save_file(tensors, temporary, metadata={METADATA_KEY: about})


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
