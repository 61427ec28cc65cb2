"""A check that a network returns the same results for the same input."""

import os
from collections.abc import Mapping

import numpy as np
import onnxruntime

from hilsplat.base.artifacts import sha256_of_json, write_json
from hilsplat.base.errors import ModelError
from hilsplat.models.folder import ModelFolder
from hilsplat.models.network import Network

ROUNDING = 1e-3
"""Maximum difference between two runs, relative to the largest output (at least 1); 0 is usual on a CPU."""


def require_repeatable(
    network: Network, feeds: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray]
) -> None:
    """Raise a ModelError if a network's results for `feeds` change after a run with `other` inputs.

    A network that reads memory that it never wrote often repeats its last results, so a run with other inputs
    comes between the two.
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


def require_repeatable_once(
    model: ModelFolder, network: Network, form: str, feeds: Mapping[str, np.ndarray]
) -> None:
    """Apply `require_repeatable` to a form of a slow network, once for each version of onnxruntime.

    The result is kept in `.checked` beside the model folder, unless that place is read-only.
    """
    beside = model.folder.parent
    key = sha256_of_json([model.digest, network.path.name, form, onnxruntime.__version__, network.providers])
    place = beside / ".checked" / key
    if not place.is_file():
        require_repeatable(network, feeds, {name: -value for name, value in feeds.items()})
        if os.access(beside, os.W_OK):
            write_json(place, {"model": model.folder.name, "network": network.path.name})
