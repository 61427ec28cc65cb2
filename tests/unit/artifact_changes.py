"""Changes of artifacts as another run would have made them: with a record, and with a seal that fits."""

import shutil
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import atomic_folder, provenance_path, read_index, write_index, write_json


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


def write_again(artifact: Path) -> None:
    """Replace an artifact by an equal one, as a stage that was rerun does."""
    if artifact.is_dir():
        with atomic_folder(artifact) as new:
            shutil.copytree(artifact, new, dirs_exist_ok=True)
    else:
        shutil.copy(artifact, artifact.with_name("new"))
        artifact.with_name("new").replace(artifact)


def change_index(folder: Path, **entries: Any) -> None:
    """Change entries of a folder's index, and seal the folder as it is now."""
    index = {**read_index(folder), **entries}
    write_index(folder, index.pop("views"), **index)
