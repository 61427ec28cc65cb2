"""Which scene seeds are for training the small models, which for development, and which for the benchmark."""

from hilsplat.base.errors import SceneError

TRAINING_SEEDS = range(1_000_000, 2_000_000)
"""Scenes the embedded small models are trained on."""

DEVELOPMENT_SEEDS = range(100, 200)
"""Scenes for choosing settings; never trained on, never reported."""

BENCHMARK_SEEDS = range(200, 300)
"""Scenes that are reported; never trained on, and no setting is chosen on them."""

SPLITS = {"training": TRAINING_SEEDS, "development": DEVELOPMENT_SEEDS, "benchmark": BENCHMARK_SEEDS}


def split_of_seed(seed: int) -> str:
    """Name of the split a scene seed belongs to.

    Returns:
        "training", "development", "benchmark", or "free" for a seed in no split.
    """
    for split, seeds in SPLITS.items():
        if seed in seeds:
            return split
    return "free"


def require_split(seed: int, split: str) -> None:
    """Refuse a scene seed that is not in the split.

    Raises:
        SceneError: the seed belongs to another split, or the split is unknown.
    """
    if split not in SPLITS:
        raise SceneError(f"unknown split {split!r} of scene seeds", expected=f"one of {', '.join(SPLITS)}")
    if seed not in SPLITS[split]:
        seeds = SPLITS[split]
        raise SceneError(
            f"scene seed {seed} is not in the {split} split",
            expected=f"{seeds.start} to {seeds.stop - 1}",
            found=f"{seed}, split {split_of_seed(seed)}",
            fix="take a seed of the split: trained-on scenes must not be evaluated, nor the reverse",
        )
