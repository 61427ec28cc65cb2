"""The language field: one latent per Gaussian and level."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors.numpy
from jaxtyping import Float32
from safetensors import SafetensorError, safe_open

from hilsplat.base.artifacts import atomic_path, parse_json, remake
from hilsplat.base.errors import ArtifactError
from hilsplat.field.linear_code import METADATA_KEY


@dataclass(frozen=True)
class LanguageField:
    """One latent per Gaussian and level.

    Attributes:
        features: latents of N Gaussians at L = 3 levels, coarse to fine; 0 without a latent.
        gaussians_sha256: digest of the PLY that they belong to.
        autoencoder_sha256: digest of the autoencoder that decodes them.
    """

    features: Float32[np.ndarray, "N 3 D"]
    gaussians_sha256: str
    autoencoder_sha256: str

    def save(self, path: Path) -> None:
        """Write `field.safetensors` atomically; the same field gives the same bytes."""
        about = {"gaussians_sha256": self.gaussians_sha256, "autoencoder_sha256": self.autoencoder_sha256}
        metadata = {METADATA_KEY: json.dumps(about, sort_keys=True)}
        features = np.ascontiguousarray(self.features)
        with atomic_path(path) as temporary:
            safetensors.numpy.save_file({"features": features}, temporary, metadata=metadata)

    @staticmethod
    def load(path: Path) -> "LanguageField":
        """Read `field.safetensors`.

        Raises:
            ArtifactError: the file is missing, damaged or not a language field.
        """
        try:
            with safe_open(path, framework="np") as file:
                about = parse_json(file.metadata()[METADATA_KEY])
                return LanguageField(file.get_tensor("features"), **about)
        except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
            raise ArtifactError(f"{path} cannot be read: {error}", fix=remake(path)) from error


def report_path(field: Path) -> Path:
    """Path of the report on a field: `field.report.json` for `field.safetensors`."""
    return Path(field).with_suffix(".report.json")
