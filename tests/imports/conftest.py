"""Import of a folder with known poses, without the later parts of the stage."""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hilsplat.scene.importers.importing import import_poses
from hilsplat.scene.layouts import find_known_poses
from hilsplat.settings import PosesSettings


@pytest.fixture
def imported(tmp_path) -> Callable[..., Any]:
    """Return a function that imports a folder: views, points, split and report."""
    numbers = itertools.count()

    def imported_from(folder: Path, poses: Path | None = None, **settings):
        known = find_known_poses(folder, poses)
        return import_poses(known, tmp_path / f"work{next(numbers)}", "a/b", PosesSettings(**settings), 0, 1)

    return imported_from
