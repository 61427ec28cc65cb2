"""Settings for training the small models."""

from typing import Literal

from hilsplat.settings import Section, knob


class TrainingSettings(Section):
    """Duration of the training, and amount of data."""

    scenes: int = knob(700, "number of training scenes (all kinds together)", ge=1)
    views: int = knob(3, "number of views per scene", ge=1)
    validation_scenes: int = knob(40, "number of additional scenes, for validation only", ge=1)
    sam_minutes: float = knob(60.0, "training time of the segmenter; 0: no limit", unit="min", ge=0)
    sam_steps: int = knob(
        0, "training steps of the segmenter; unlike minutes, they make runs reproducible; 0: no limit", ge=0
    )
    clip_minutes: float = knob(20.0, "training time of CLIP; 0: no limit", unit="min", ge=0)
    clip_steps: int = knob(0, "training steps of CLIP; 0: no limit", ge=0)
    segmented_views: int = knob(
        600, "number of training views whose masks from the finished segmenter also train CLIP", ge=0
    )
    device: Literal["cpu", "cuda"] = knob("cpu", "training device")
