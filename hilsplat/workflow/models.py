"""Models and devices of a run: checks before the first job, and what the models are good for."""

import functools
from pathlib import Path

from hilsplat.base.device import compute_device
from hilsplat.base.errors import HilsplatError
from hilsplat.configuration import StageSettings, parse_run, read_config
from hilsplat.models.store import RELEASES, meaningless, read_model
from hilsplat.scene.sheet import PHOTOS


def check_models(stages: StageSettings, where: str) -> None:
    """Refuse a model folder that is missing or holds another kind of model.

    Args:
        stages: settings without `auto` (`StageSettings.with_models`).
        where: scene and variant, for the message.

    Raises:
        HilsplatError: the message names the setting.
    """
    models = [("clip", "clip", stages.clip.model, stages.clip.variant)]
    if stages.masks.segmenter == "sam":
        models.append(("masks", "sam", stages.masks.model, stages.masks.variant))
    for section, kind, folder, variant in models:
        if problem := _model_problem(Path(folder), kind, variant):
            raise HilsplatError(f"{section}.model of {where}: {problem}")


def check_device(stages: StageSettings, where: str) -> None:
    """Refuse `device: cuda` if this machine has no usable CUDA device.

    Raises:
        HilsplatError: the message names the setting.
    """
    for section, values in stages:
        needed = getattr(values, "device", "") == "cuda" and section != "training"
        if needed and (problem := _device_problem(rasterises=section in ("gaussians", "contributions"))):
            raise HilsplatError(f"{section}.device of {where}: {problem}")


@functools.cache
def _model_problem(folder: Path, kind: str, variant: str) -> str:
    from hilsplat.models.folder import open_model_folder  # onnxruntime takes a while to import

    released = any(folder.name == release.name for release in RELEASES)
    fix = f"fetch it: hilsplat models get {folder.name}" if released else ""
    try:
        open_model_folder(folder, kind, variant=variant, fix=fix)
    except HilsplatError as error:
        return str(error)
    return ""


@functools.cache
def _device_problem(rasterises: bool) -> str:
    from hilsplat.splat.rasterise.device import choose_device

    try:
        if rasterises:
            choose_device("cuda")
        compute_device("cuda")
    except HilsplatError as error:
        return str(error)
    return ""


def describe_models(stages: StageSettings) -> str:
    """Name the segmenter and the CLIP of settings without `auto`."""
    masks = {
        "sam": f"masks by {Path(stages.masks.model).name}",
        "graph": "masks by the graph segmenter, regions of even colour",
        "truth-perturbed": "masks from the true labels",
    }[stages.masks.segmenter]
    return f"{masks}; text queries by {Path(stages.clip.model).name}"


def doubt_about_photographs(stages: StageSettings) -> str:
    """Return why answers about photographs are meaningless with these settings, or an empty text."""
    clip = read_model(Path(stages.clip.model))
    return meaningless(clip.folder.name) if clip is not None and clip.embedded else ""


def models_of_photographs(config: Path, scene: str) -> list[str]:
    """Return lines about the models that a scene of photographs will use.

    Args:
        config: configuration of the project; without one the result is empty.
        scene: name of the scene.

    Raises:
        SettingsError: the configuration cannot be used.
    """
    if not config.is_file():
        return []
    run = parse_run(read_config(config))
    stages = run.stages("default", (PHOTOS, f"{PHOTOS}/{scene}")).with_models()
    return [line for line in (describe_models(stages), doubt_about_photographs(stages)) if line]
