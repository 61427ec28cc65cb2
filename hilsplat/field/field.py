"""Stage `field`: solve the language field from the contributions, because geometry is frozen."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from hilsplat.base.artifacts import read_index, write_json
from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import LEVELS
from hilsplat.base.lineage import require_made_from, sha256_of_file
from hilsplat.base.memory import require_memory
from hilsplat.base.progress import stage_log
from hilsplat.contributions.compositing import column_sums
from hilsplat.contributions.mask_operator import MaskOperator
from hilsplat.contributions.rows import Contributions
from hilsplat.field.code import LanguageField, autoencoder_file, load_latents
from hilsplat.field.contrast import Contrast, read_parents, view_relations
from hilsplat.field.problem import QuadraticProblem
from hilsplat.field.solver import LBFGS_MEMORY, keep_labelled, solve_field
from hilsplat.settings import FieldSettings

PROCESS_MIB = 250  # memory of the stage without features: libraries, masks, losses


def run_field(
    contributions_folder: Path,
    tree_folder: Path,
    autoencoder_folder: Path,
    out: Path,
    settings: FieldSettings,
    threads: int,
    seed: int = 0,  # for a random start
    start: Path | None = None,  # field from which `start: langsplat` begins
    memory_mib: float | None = None,
) -> None:
    """Solve the language field of a scene; write `field.safetensors` and, beside it, `field.report.json`.

    Only a random start depends on the seed (mask halves are seeded by the view's name). The result does not
    depend on `threads`.

    Raises:
        MemoryLimitError: the field needs more than `memory_mib`, or more than this machine has.
        MisalignedArtifactError: an input belongs to different masks, Gaussians or codes.
        SettingsError: an initial field is missing, or one is given that the settings do not use.
    """
    if (settings.start == "langsplat") != (start is not None):
        raise SettingsError(
            "field.start and the options do not match",
            expected="--start <field.safetensors> if and only if start: langsplat",
        )
    contributions = Contributions.load(contributions_folder)
    scene = read_index(contributions_folder)["scene"]
    latents = load_latents(autoencoder_folder, contributions)
    require_memory(
        field_mib(contributions, latents.shape[1], settings),
        memory_mib,
        f"the field of {contributions.num_gaussians:,} Gaussians with {latents.shape[1]} channels",
        "lower field.block_gaussians (which changes results slightly), or leave out Gaussians",
    )
    parents = read_parents(tree_folder, contributions)
    code_sha256 = sha256_of_file(autoencoder_file(autoencoder_folder))
    with stage_log("field", scene) as counts:
        first: str | np.ndarray = settings.start
        if start is not None:
            initial = LanguageField.load(start)
            gaussians = f"the Gaussians of {contributions_folder}"
            require_made_from(start, gaussians, initial.gaussians_sha256, contributions.gaussians_sha256)
            require_made_from(start, autoencoder_folder, initial.autoencoder_sha256, code_sha256)
            first = initial.features
        problem, contrast = field_losses(contributions, parents, latents, settings, first, seed, threads)
        features, report = solve_field(problem, contrast)
        total_mass = column_sums(contributions.matrix("mass"))
        features = keep_labelled(features, problem.mass, total_mass, settings.min_labelled_share)
        LanguageField(features, contributions.gaussians_sha256, code_sha256).save(out)
        unseen = int((problem.mass.max(axis=1) == 0).sum())
        write_json(
            Path(out).with_suffix(".report.json"),
            {
                "scene": scene,
                "gaussians": len(features),
                "unseen_gaussians": unseen,
                "masks": len(contributions),
                "latent": features.shape[2],
                "contrasted_masks": sum(len(view.rows) for view in contrast.relations),
                **report,
            },
        )
        counts |= {"masks": len(contributions), "Gaussians": len(features), "unseen": unseen}


def field_mib(contributions: Contributions, channels: int, settings: FieldSettings) -> float:
    """Return the memory of the stage in MiB, without the files of A and G, which the system can drop.

    It contains the features and two copies, and for a block six more arrays and two arrays of visible
    features per step of L-BFGS.
    """
    num, visible = contributions.num_gaussians, column_sums(contributions.matrix("mass")) > 0
    block = min(num, settings.block_gaussians)
    of_block = block * (6 + 2 * min(settings.lbfgs_steps, LBFGS_MEMORY) * visible.mean())
    return PROCESS_MIB + (3 * num + of_block) * len(LEVELS) * channels * 4 / 2**20


def field_losses(
    contributions: Contributions,
    parents: dict[str, np.ndarray],
    latents: Float32[np.ndarray, "M D"],
    settings: FieldSettings,
    start: str | Float32[np.ndarray, "N 3 D"],
    seed: int,
    threads: int,
) -> tuple[QuadraticProblem, Contrast]:
    """Return the losses of a scene's field; `start` and `seed` are as in `QuadraticProblem.of`."""
    masks, half_masks = (
        MaskOperator(contributions.matrix(name), contributions.level, threads) for name in ("A", "A_half")
    )
    pixels = contributions.pixels.astype(np.float32)
    half_pixels = contributions.half_pixels.astype(np.float32)
    weights = settings.weight_language, settings.weight_clustering, settings.ridge
    quadratic = contributions.quadratic(threads)
    block = settings.block_gaussians
    problem = QuadraticProblem.of(masks, quadratic, pixels, latents, weights, start, seed, block)
    means = masks.means(problem.lifted)
    relations = [
        view_relations(
            rows,
            contributions.level[rows],
            parents[view],
            contributions.pixels[rows],
            contributions.half_pixels[rows],
            settings,
            means[rows],
        )
        for view, rows in zip(contributions.views, contributions.rows_of_views(), strict=True)
    ]
    return problem, Contrast(masks, half_masks, pixels, half_pixels, relations, settings)
