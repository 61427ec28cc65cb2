"""The number of steps of a fit; a module that a plan can import without those of the fit."""

from hilsplat.settings import GaussiansSettings

MIN_FIT_STEPS = 1500
"""Steps below which fits to 12 photographs are clearly worse (docs/experiments.md, "Small sets")."""


def fit_steps(settings: GaussiansSettings, num_views: int) -> int:
    """Return the number of steps of a fit; fits to few views overfit sooner, so they take fewer steps."""
    return min(settings.iterations, max(MIN_FIT_STEPS, settings.steps_per_view * num_views))
