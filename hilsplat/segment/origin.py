"""Labels of the source of a scene's masks, used in table rows and titles."""

from pathlib import Path

from hilsplat.base.artifacts import read_index


def masks_label(masks_folder: Path) -> str:
    """Return the label in the masks' index, else the model's name, else the segmenter's name.

    The label of masks made from ground-truth labels lists their simulated faults.
    """
    index = read_index(masks_folder)
    if "label" in index:
        return str(index["label"])
    return Path(index["model"]).name if index["model"] else index["segmenter"]


def made_from_truth(masks: str) -> bool:
    """Return whether masks with this label were made from ground-truth labels (for diagnosis only)."""
    return masks.startswith("truth-perturbed")
