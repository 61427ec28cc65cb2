"""Scene seeds reserved for training the small models, for development, and for the benchmark."""

TRAINING_SEEDS = range(1_000_000, 2_000_000)
"""Scenes on which the small embedded models are trained."""

DEVELOPMENT_SEEDS = range(100, 200)
"""Scenes for choosing settings; never used for training or reported results."""

BENCHMARK_SEEDS = range(200, 300)
"""Scenes for reported results; never used for training or for choosing settings."""

SPLITS = {"training": TRAINING_SEEDS, "development": DEVELOPMENT_SEEDS, "benchmark": BENCHMARK_SEEDS}


def split_of_seed(seed: int) -> str:
    """Return "training", "development", "benchmark", or "free" for a seed in no split."""
    for split, seeds in SPLITS.items():
        if seed in seeds:
            return split
    return "free"
