"""Settings for training the small models."""

from typing import Literal

from hilsplat.settings import Section, knob


class TrainingSettings(Section):
    """Duration of the training, and amount of data."""

    scenes: int = knob(700, "number of training scenes, of all kinds", ge=1)
    views: int = knob(3, "views of each scene", ge=1)
    validation_scenes: int = knob(40, "number of further scenes, used for validation only", ge=1)
    sam_minutes: float = knob(60.0, "training time of the segmenter; 0: no limit", unit="min", ge=0)
    sam_steps: int = knob(
        0, "training steps of the segmenter, so that a second run gives the same bytes; 0: no limit", ge=0
    )
    clip_minutes: float = knob(20.0, "training time of CLIP; 0: no limit", unit="min", ge=0)
    clip_steps: int = knob(0, "training steps of CLIP; 0: no limit", ge=0)
    segmented_views: int = knob(
        600,
        "training views segmented by the finished segmenter, so that CLIP also learns from its masks",
        ge=0,
    )
    device: Literal["cpu", "cuda"] = knob("cpu", "device of the training")
