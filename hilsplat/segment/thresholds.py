"""Thresholds of masks whose best values depend on the SAM model."""

from dataclasses import dataclass, replace
from typing import Any

from hilsplat.base.errors import ModelError, foreign
from hilsplat.models.folder import ModelFolder
from hilsplat.settings import MasksSettings

OWN = "mask_generation"  # key of `config.json` under which a model specifies its own `Thresholds`


@dataclass(frozen=True)
class Thresholds:
    """Resolved settings of `masks` whose best value depends on the model (`SamModel.thresholds`)."""

    predicted_iou_min: float
    stability_min: float
    nms_score: float
    points_per_batch: int


REAL_SAM = Thresholds(predicted_iou_min=0.7, stability_min=0.85, nms_score=0.7, points_per_batch=8)
"""LangSplat's thresholds for the released SAM models. A ViT-B call takes 60 MB per prompt, and calls of
more than 8 prompts are no faster per prompt."""


def own_thresholds(model: ModelFolder) -> Thresholds:
    """Return the thresholds in a model folder's `config.json`, or `REAL_SAM`.

    A ModelError is raised for an unknown key or a value out of range.
    """
    thresholds: Any = model.config.get(OWN, {})
    names = vars(REAL_SAM)
    what = f"{model.folder / 'config.json'}: {OWN}"
    with foreign(what, ModelError, problem="is invalid", fix="correct or remove it"):
        if not isinstance(thresholds, dict) or not thresholds.keys() <= names.keys():
            raise ValueError(f"known keys are {', '.join(names)}")
        settings = MasksSettings(**thresholds)
        return replace(REAL_SAM, **{name: getattr(settings, name) for name in thresholds})
