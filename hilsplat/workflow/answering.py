"""Which models answer, in words, for the person who starts a run."""

from pathlib import Path

from hilsplat.configuration import StageSettings, parse_run, read_config
from hilsplat.models.store import meaningless, read_model
from hilsplat.scene.sheet import PHOTOS


def models_of(stages: StageSettings) -> str:
    """What makes masks and words under settings without `auto`."""
    masks = {
        "sam": f"masks by {Path(stages.masks.model).name}",
        "graph": "masks by the graph segmenter, regions of even colour",
        "truth-perturbed": "masks from the true labels",
    }[stages.masks.segmenter]
    return f"{masks}; words by {Path(stages.clip.model).name}"


def doubt_about_photographs(stages: StageSettings) -> str:
    """Why these settings give photographs meaningless answers; empty if they do not."""
    clip = read_model(Path(stages.clip.model))
    return meaningless(clip.folder.name) if clip is not None and clip.embedded else ""


def models_of_photographs(config: Path, scene: str) -> list[str]:
    """Lines for a scene of photographs: the models that answer, and the doubt about them if there is one.

    Args:
        config: the configuration of the project; without one there is nothing to say.
        scene: its name.

    Raises:
        SettingsError: the configuration cannot be used.
    """
    if not config.is_file():
        return []
    run = parse_run(read_config(config))
    stages = run.stages("default", (PHOTOS, f"{PHOTOS}/{scene}")).with_models()
    return [line for line in (models_of(stages), doubt_about_photographs(stages)) if line]
