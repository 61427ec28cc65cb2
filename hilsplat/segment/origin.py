"""The name, in rows and titles, of what made the masks of a scene."""

from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import read_index


def masks_label(masks_folder: Path) -> str:
    """What made the masks, as rows name it.

    The model folder's name, or the segmenter's if it has no model; masks made from true labels have a
    label that also names their faults.
    """
    return label_of_index(read_index(masks_folder))


def label_of_index(index: dict[str, Any]) -> str:
    """The same, from the index of a masks artifact."""
    if "label" in index:
        return str(index["label"])
    return Path(index["model"]).name if index["model"] else index["segmenter"]


def made_from_truth(masks: str) -> bool:
    """Whether masks with this label were made from true labels: a diagnostic, not a result."""
    return masks.startswith("truth-perturbed")
