"""Settings that this machine cannot meet, told before a job begins."""

import functools
from pathlib import Path

from hilsplat.base.device import compute_device
from hilsplat.base.errors import HilsplatError
from hilsplat.configuration import StageSettings
from hilsplat.models.store import RELEASES


def require_feasible(stages: StageSettings, where: str) -> None:
    """Refuse a device that is not here, and a model folder that is missing or of the wrong kind.

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
        problem = _model_problem(Path(folder), kind, variant)
        if problem:
            raise HilsplatError(f"{section}.model of {where}: {problem}")
    for section, values in stages:
        if getattr(values, "device", "") == "cuda" and section != "training":
            problem = _device_problem(rasterises=section in ("gaussians", "contributions"))
            if problem:
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
