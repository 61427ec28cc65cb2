"""Faster forms of networks on a CPU. If one can't be prepared, the network runs as exported."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from hilsplat.base.errors import first_line

logger = logging.getLogger(__name__)

Fast = TypeVar("Fast")


def or_as_exported(network: Path, cost: str, prepare: Callable[[], Fast]) -> Fast | None:
    """Return the result of `prepare`; log a warning and return None if it raises any exception.

    Args:
        network: file of the network.
        cost: what running the network as exported costs, such as "each image takes twice as long".
    """
    try:
        return prepare()
    except Exception as error:  # exporters write many forms of graphs, and each of them can run as exported
        logger.warning("%s runs as exported, and %s: %s", network, cost, first_line(error))
        return None
