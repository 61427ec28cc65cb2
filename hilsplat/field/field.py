"""Stage `field`: solve the language field.

Geometry is frozen, so the contributions contain all inputs of the losses: see `problem` for the quadratic
part, `contrast` for the hierarchy losses and `solver` for their minimisation.
"""

from pathlib import Path

import numpy as np

from hilsplat.base.artifacts import read_index, read_npz, sealed, sha256_of_file, write_json
from hilsplat.base.errors import MisalignedArtifactError, SettingsError
from hilsplat.base.progress import stage_log
from hilsplat.contributions.mask_operator import MaskOperator
from hilsplat.contributions.rows import Contributions
from hilsplat.field.code import autoencoder_file, load_latents
from hilsplat.field.contrast import Contrast, view_relations
from hilsplat.field.language_field import LanguageField
from hilsplat.field.problem import QuadraticProblem
from hilsplat.field.solver import keep_labelled, solve_field
from hilsplat.segment.digests import require_same_masks
from hilsplat.settings import FieldSettings


def run_field(
    contributions_folder: Path,
    tree_folder: Path,
    autoencoder_folder: Path,
    out: Path,
    settings: FieldSettings,
    threads: int,
    seed: int = 0,
    rendered: tuple[Path, Path, Path] | None = None,
    start: Path | None = None,
) -> None:
    """Solve the language field of a scene: `field.safetensors` and `field.report.json` beside it.

    With `trainer: fast`, only a random start depends on the seed (halves of masks are seeded by the view's
    name). The result does not depend on `threads`.

    Args:
        seed: seed of a random start, and of the order of views of `trainer: literal`.
        rendered: scene, Gaussians and masks that `trainer: literal` renders.
        start: field from which `start: langsplat` begins.

    Raises:
        MisalignedArtifactError: if an input belongs to other masks, Gaussians or codes.
        SettingsError: if an input that the settings require is missing.
    """
    if (settings.trainer == "literal") != (rendered is not None):
        raise SettingsError(
            "field.trainer and the options don't fit together",
            expected="--scene, --gaussians and --masks with trainer: literal, and only there",
        )
    if (settings.start == "langsplat") != (start is not None):
        raise SettingsError(
            "field.start and the options don't fit together",
            expected="--start <field.safetensors> with start: langsplat, and only there",
        )
    contributions = Contributions.load(contributions_folder)
    scene = read_index(contributions_folder)["scene"]
    latents = load_latents(autoencoder_folder, contributions)
    parents = read_parents(tree_folder, contributions)
    with stage_log("field", scene) as counts:
        masks, half_masks = (
            MaskOperator.of(contributions.matrix(name), contributions.level, threads)
            for name in ("A", "A_half")
        )
        pixels = contributions.pixels.astype(np.float32)
        problem = QuadraticProblem.of(
            masks,
            contributions.quadratic(threads),
            pixels,
            latents,
            (settings.weight_language, settings.weight_clustering, settings.ridge),
            _first_features(start, contributions, autoencoder_folder) if start else settings.start,
            seed,
        )
        relations = view_relations(contributions, parents, settings, masks.means(problem.lifted))
        half_pixels = contributions.half_pixels.astype(np.float32)
        contrast = Contrast(masks, half_masks, pixels, half_pixels, relations, settings)
        if rendered is None:
            features, report = solve_field(problem, contrast, settings)
        else:
            from hilsplat.field.literal_trainer import train_literally

            features, report = train_literally(
                problem, contrast, contributions, rendered, settings, seed, threads
            )
        total_mass = contributions.mass().sum(axis=0, dtype=np.float64)
        features = keep_labelled(features, problem.mass, total_mass, settings.min_labelled_share)
        field = LanguageField(
            features, contributions.gaussians_sha256, sha256_of_file(autoencoder_file(autoencoder_folder))
        )
        field.save(out)
        unseen = int((problem.mass.max(axis=1) == 0).sum())
        write_json(
            Path(out).with_suffix(".report.json"),
            {
                "scene": scene,
                "gaussians": len(features),
                "unseen_gaussians": unseen,
                "masks": len(contributions),
                "latent": features.shape[2],
                "contrasted_masks": sum(len(view.rows) for view in relations),
                **report,
            },
        )
        counts |= {"masks": len(contributions), "Gaussians": len(features), "unseen": unseen}


def _first_features(path: Path, contributions: Contributions, autoencoder_folder: Path) -> np.ndarray:
    """Return the features of a field, which must be of the same Gaussians and code."""
    field = LanguageField.load(path)
    digest = sha256_of_file(autoencoder_file(autoencoder_folder))
    if (field.gaussians_sha256, field.autoencoder_sha256) != (contributions.gaussians_sha256, digest):
        raise MisalignedArtifactError(
            f"{path} belongs to other Gaussians, or to another code",
            fix="compute both fields from the same Gaussians and autoencoder",
        )
    return field.features


def read_parents(tree_folder: Path, contributions: Contributions) -> dict[str, np.ndarray]:
    """Return the parent of each mask in the coverage tree of each view.

    Raises:
        MisalignedArtifactError: if the trees were computed from other masks.
    """
    require_same_masks(tree_folder, contributions.folder)
    return {
        view: read_npz(sealed(tree_folder, f"{view}.npz"), "parent")["parent"] for view in contributions.views
    }
