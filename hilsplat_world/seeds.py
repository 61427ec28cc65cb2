"""Scene seeds reserved for training the small models, for development, and for the benchmark."""

TRAINING_SEEDS = range(1_000_000, 2_000_000)  # scenes on which the small embedded models are trained

SPLITS = {"training": TRAINING_SEEDS, "development": range(100, 200), "benchmark": range(200, 300)}
"""Scenes for training, for choosing settings, and for reported results; no scene has two of these uses."""


def split_of_seed(seed: int) -> str:
    """Return "training", "development", "benchmark", or "free" for a seed in no split."""
    return next((split for split, seeds in SPLITS.items() if seed in seeds), "free")
