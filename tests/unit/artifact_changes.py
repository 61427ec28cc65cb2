"""Changes to artifacts as another run would make them: with provenance and a matching seal."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from hilsplat.base.artifacts import provenance_path, read_index, write_index, write_json
from hilsplat.base.atomic import atomic_folder


def write_record(artifact: Path, **parts: Any) -> None:
    """Write a provenance record with these fields; the others are empty."""
    empty = {"stage": "", "code": "", "plugins": [], "settings": {}, "inputs": {}, "outputs": {}}
    write_json(provenance_path(artifact), {**empty, "seed": None, **parts})


def write_again(artifact: Path) -> None:
    """Replace an artifact by an equal one, as a rerun stage does."""
    if artifact.is_dir():
        with atomic_folder(artifact) as new:
            shutil.copytree(artifact, new, dirs_exist_ok=True, copy_function=shutil.copyfile)
    else:
        shutil.copy(artifact, artifact.with_name("new"))
        artifact.with_name("new").replace(artifact)


def flip_bit(path: Path, share: float, number: int = 0) -> bytes:
    """Flip a bit of a file at a share of its length, and return its former content."""
    content = path.read_bytes()
    changed = bytearray(content)
    changed[int(share * len(content))] ^= 1 << number % 8
    path.write_bytes(changed)
    return content


def change_index(folder: Path, **entries: Any) -> None:
    """Change entries of a folder's index, and update its seal."""
    index = {**read_index(folder), **entries}
    write_index(folder, index.pop("views"), **index)


def loosen(scene: Path, rows: np.ndarray) -> None:
    """Remove Gaussians from all nodes of a scene's tree."""
    folder = scene / "default/semantic_tree"
    arrays = dict(np.load(folder / "tree.npz"))
    arrays["node_of_gaussian"][rows] = -1
    np.savez(folder / "tree.npz", **arrays)
    change_index(folder)
