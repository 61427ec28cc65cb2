"""Matches of predicted instances, stored beside `scores.csv` so that scans are evaluated together.

The official average precision pools all scans before computing a curve; one number per scan is not enough.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from hilsplat.base.artifacts import read_npz, write_npz

if TYPE_CHECKING:
    from hilsplat.evaluate.metrics.instances import InstanceMatches

FIELDS = ("class_index", "overlap_index", "confidence", "is_match", "misses", "has_truth")


def instances_path(scores: Path) -> Path:
    """Return the path of the matches that belong to a score file."""
    return Path(scores).with_name("instances.npz")


def write_instances(scores: Path, matches: Mapping[tuple[str, ...], "InstanceMatches"]) -> None:
    """Write a scene's matches by (data set, scene, variant, masks, method); the file may hold none."""
    arrays = {
        "/".join([*key, name]): getattr(found, name) for key, found in matches.items() for name in FIELDS
    }
    write_npz(instances_path(scores), **arrays)


def read_instances(scores: Iterable[Path]) -> dict[tuple[str, ...], "InstanceMatches"]:
    """Read the matches beside score files by (data set, scene, variant, masks, method)."""
    paths = [path for path in map(instances_path, scores) if path.is_file()]
    if not paths:
        return {}
    from hilsplat.evaluate.metrics.instances import InstanceMatches

    found: dict[tuple[str, ...], dict] = {}
    for path in paths:
        for name, array in read_npz(path).items():
            *key, part = name.split("/")
            found.setdefault(tuple(key), {})[part] = array
    return {key: InstanceMatches(**arrays) for key, arrays in found.items()}
