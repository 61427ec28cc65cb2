"""Label files as their writers left them."""

from pathlib import Path

import numpy as np

from hilsplat.annotate.labels import Label, known_labels
from hilsplat.datasets.images.isat import read_isat
from hilsplat.scene.cameras import Cameras


def read_labels(path: Path) -> list[Label]:
    """The labels of a file whose view has the size that the file states; empty if there is no file."""
    if not path.is_file():
        return []
    view, sizes = f"{path.stem}.png", np.array([read_isat(path).size_hw], np.int32)
    cameras = Cameras((view,), np.eye(4)[None], np.eye(3)[None], sizes)
    return known_labels(path.parent, cameras, [view]).get(view, [])
