"""Models and devices of a run: checks before the first job, and descriptions of the models."""

import functools
import shlex
from pathlib import Path

from hilsplat.base.errors import HilsplatError, SettingsError
from hilsplat.base.files import INSTALLED
from hilsplat.baselines import OURS, method_of
from hilsplat.configuration import CONFIG, StageSettings, parse_run, read_config
from hilsplat.models.card import card_problem, require_card
from hilsplat.models.store import RELEASES, meaningless, read_model
from hilsplat.scene.sheet import PHOTOS


def check_models(stages: StageSettings, where: str) -> None:
    """Raise an error if a model is missing or of the wrong kind; `stages` must not contain `auto`."""
    models = [("clip", "clip", stages.clip.model, stages.clip.variant)]
    if stages.masks.segmenter == "sam":
        models.append(("masks", "sam", stages.masks.model, stages.masks.variant))
    for section, kind, folder, variant in models:
        try:
            _require_model(Path(folder), kind, variant)
        except HilsplatError as error:
            raise HilsplatError(f"{section}.model of {where}: {error}") from error


def check_stages(stages: StageSettings, where: str) -> None:
    """Raise SettingsError for settings that exclude each other."""
    if stages.masks.levels == "tree" and stages.masks.segmenter == "truth-perturbed":
        raise SettingsError(
            f"{where}: masks.levels is tree, but these masks come with their levels",
            fix="remove masks.levels, or run this variant on scenes whose masks SAM or graph makes",
        )
    ours, evidence = stages.method.name == OURS, stages.semantic_tree.evidence
    if not ours and method_of(stages.method.name).averages and stages.autoencoder.code == "network":
        raise SettingsError(
            f"{where}: method {stages.method.name} averages codes, which a network does not allow",
            expected="autoencoder.code pca",
            fix="set autoencoder: {code: pca, latent: 64, targets: mask} in the variant",
        )
    if stages.contributions.keep == "none" and (ours or evidence == "features"):
        raise SettingsError(
            f"{where}: contributions.keep is none, but the field or the tree needs pairs of Gaussians",
            fix="remove contributions.keep, or set method.name to a baseline, and evidence to masks",
        )


def check_device(stages: StageSettings, where: str) -> None:
    """Raise an error for `device: cuda` if this machine cannot be expected to have a usable CUDA device."""
    from hilsplat.splat.rasterise.device import expected_problem, require_cuda

    for section, values in stages:
        if getattr(values, "device", "") == "cuda":
            try:
                if section in ("masks", "clip"):
                    require_card(card_problem(), section)
                else:
                    require_cuda(expected_problem())
            except HilsplatError as error:
                raise HilsplatError(f"{section}.device of {where}: {error}") from error


@functools.cache
def _require_model(folder: Path, kind: str, variant: str) -> None:
    from hilsplat.models.folder import open_model_folder  # onnxruntime is slow to import

    is_released = any(folder.name == release.name for release in RELEASES)
    fix = f"fetch it: hilsplat models get {shlex.quote(folder.name)}" if is_released else ""
    open_model_folder(folder, kind, variant=variant, fix=fix)


def describe_models(stages: StageSettings, features: Path | None = None) -> str:
    """Describe the segmenter and CLIP in settings without `auto`, or LangSplat's files that replace them."""
    if features is not None:
        return f"masks and their vectors from {features}; text queries by {Path(stages.clip.model).name}"
    masks = {
        "sam": f"masks by {Path(stages.masks.model).name}",
        "graph": "masks by the graph segmenter, regions of uniform colour",
        "truth-perturbed": "masks from ground-truth labels",
    }[stages.masks.segmenter]
    return f"{masks}; text queries by {Path(stages.clip.model).name}"


def doubt_about_photographs(stages: StageSettings) -> str:
    """Return why answers about photographs are meaningless with these settings, or an empty string."""
    clip = read_model(Path(stages.clip.model))
    return meaningless(clip.folder.name) if clip is not None and clip.embedded else ""


def settings_of_photographs(config: Path, scene: str) -> StageSettings:
    """Return the settings of a scene of photographs; without `config`, those of the installed one."""
    run = parse_run(read_config(config if config.is_file() else INSTALLED / CONFIG))
    return run.stages("default", (PHOTOS, f"{PHOTOS}/{scene}")).resolve_auto()


def models_of_photographs(stages: StageSettings, features: Path | None = None) -> list[str]:
    """Return lines about the models that a scene of photographs will use."""
    return [line for line in (describe_models(stages, features), doubt_about_photographs(stages)) if line]
