"""Changes of artifacts as another run would have made them: with a record, and with a seal that fits."""

from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import provenance_path, read_index, write_index, write_json


def write_record(artifact: Path, **parts: Any) -> None:
    """Write provenance with these parts, and nothing in the others."""
    empty = {
        "stage": "",
        "code": "",
        "plugins": [],
        "settings": {},
        "seed": None,
        "inputs": {},
        "outputs": {},
    }
    write_json(provenance_path(artifact), {**empty, **parts})


def change_index(folder: Path, **entries: Any) -> None:
    """Change entries of a folder's index, and seal the folder as it is now."""
    index = {**read_index(folder), **entries}
    write_index(folder, index.pop("views"), **index)
