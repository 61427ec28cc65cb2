"""A check that a network returns the same results for the same input."""

from collections.abc import Mapping

import numpy as np

from hilsplat.base.cache import remembered
from hilsplat.base.errors import ModelError
from hilsplat.models.folder import ModelFolder
from hilsplat.models.network import Network

ROUNDING = 1e-3
"""Maximum difference between two runs, relative to the largest output (at least 1); 0 is usual on a CPU."""


def require_repeatable(
    network: Network, feeds: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray]
) -> None:
    """Raise a ModelError if a network's results for `feeds` change after a run with `other` inputs.

    Between the two runs, the network runs on `other`, because a network that reads memory that it never wrote
    may repeat its last results.
    """
    first, _, second = network(**feeds), network(**other), network(**feeds)
    for name, before, after in zip(network.spec.outputs, first, second, strict=True):
        scale = max(1.0, float(np.nanmax(np.abs(before), initial=0)))
        if not np.allclose(before, after, rtol=0, atol=ROUNDING * scale, equal_nan=True):
            raise ModelError(
                f"network {network.path} returns different results for the same input",
                expected=f"the same {name} in two runs, up to {ROUNDING * scale:.2g}",
                found=f"a difference of {np.nanmax(np.abs(before - after)):.2g}",
                fix="use another model or variant (docs/models.md), or export it again",
            )


def random_pixels(network: Network, side_px: int) -> dict[str, np.ndarray]:
    """Return random input for a network of images: as many (3, side, side) images as a call requires."""
    (name,) = network.spec.inputs
    shape = (network.fixed_axis(name, 0) or 1, 3, side_px, side_px)
    return {name: np.random.default_rng(0).standard_normal(shape, np.float32)}


def require_repeatable_once(
    model: ModelFolder, network: Network, form: str, feeds: Mapping[str, np.ndarray]
) -> None:
    """Apply `require_repeatable` to a form of a slow network, once for each version of its library."""

    def check() -> str:
        require_repeatable(network, feeds, {name: np.flip(value, axis=-1) for name, value in feeds.items()})
        return ""  # no problem

    key = [model.digest, network.path.name, form, network.version, network.runs_on]
    remembered("networks", key, check)
