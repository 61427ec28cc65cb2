"""Round grey Gaussians for tests that need some geometry."""

import numpy as np

from hilsplat.splat.gaussians import Gaussians


def round_gaussians(means: np.ndarray, *, log_scale: float = 0.0, opacity_logit: float = 0.0) -> Gaussians:
    """Gaussians of one size and opacity at the given centres (N, 3)."""
    n = len(means)
    return Gaussians(
        means.astype(np.float32),
        np.full((n, 3), log_scale, np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        np.full(n, opacity_logit, np.float32),
        np.zeros((n, 1, 3), np.float32),
    )
