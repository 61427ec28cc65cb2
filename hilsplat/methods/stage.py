"""The stage that runs a baseline and writes `field.safetensors`."""

from pathlib import Path

import numpy as np

from hilsplat.base.artifacts import sha256_of_file
from hilsplat.base.errors import ArtifactError
from hilsplat.base.levels import LEVELS
from hilsplat.base.progress import stage_log
from hilsplat.field.code import autoencoder_file
from hilsplat.field.language_field import LanguageField
from hilsplat.methods.method import MethodInputs
from hilsplat.methods.registry import method_of
from hilsplat.settings import MethodSettings


def run_method(inputs: MethodInputs, out: Path, settings: MethodSettings, seed: int) -> None:
    """Compute the field of a scene by a baseline.

    Args:
        out: `field.safetensors`.
        settings: name and settings of the method.

    Raises:
        SettingsError: there is no such method.
        ArtifactError: the method returned features of the wrong shape or non-finite values.
    """
    method = method_of(settings.name)
    contributions = inputs.contributions
    with stage_log(f"method {method.name}", Path(inputs.scene_folder).parent.name) as counts:
        features = np.asarray(method.fit(inputs, settings, seed), dtype=np.float32)
        expected = (contributions.num_gaussians, len(LEVELS), inputs.latents.shape[1])
        if features.shape != expected or not np.isfinite(features).all():
            raise ArtifactError(
                f"method {method.name} did not return a language field",
                expected=f"finite features of shape {expected}",
                found=f"shape {features.shape}, {np.count_nonzero(~np.isfinite(features))} not finite",
                fix=f"correct hilsplat/methods/{method.name}.py",
            )
        digest = sha256_of_file(autoencoder_file(inputs.autoencoder_folder))
        LanguageField(features, contributions.gaussians_sha256, digest).save(out)
        counts |= {"Gaussians": len(features), "latent": expected[2]}
