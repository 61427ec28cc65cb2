"""The language field: one latent per Gaussian and level."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from hilsplat.base.arrays import made, read_tensors, write_tensors


@dataclass(frozen=True)
class LanguageField:
    """One latent per Gaussian and level."""

    # latents of N Gaussians at three levels, coarse to fine; 0 for no latent
    features: Float32[np.ndarray, "N 3 D"]
    gaussians_sha256: str  # digest of the Gaussians' PLY
    autoencoder_sha256: str  # digest of the code that decodes the latents

    def save(self, path: Path) -> None:
        """Write `field.safetensors` atomically; equal fields give equal bytes."""
        about = {"gaussians_sha256": self.gaussians_sha256, "autoencoder_sha256": self.autoencoder_sha256}
        write_tensors(path, {"features": self.features}, **about)

    @staticmethod
    def load(path: Path) -> "LanguageField":
        """Read `field.safetensors`.

        Raises:
            ArtifactError: the file is missing, damaged or not a language field.
        """
        return made(LanguageField, *read_tensors(path), path)
