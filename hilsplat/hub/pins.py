"""Commits and digests of the released models, from public sources (docs/models.md)."""

import csv
from dataclasses import dataclass
from functools import cache
from pathlib import Path

TABLE = Path(__file__).with_name("pins.tsv")


@dataclass(frozen=True)
class Pin:
    """The commit of a repository that is downloaded by default."""

    commit: str
    sha256: dict[str, str]  # digests of files whose digest is known, by path


@cache
def pins() -> dict[str, Pin]:
    """Return the pinned commit of each repository of a released model."""
    by_repository: dict[str, Pin] = {}
    with TABLE.open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream, delimiter="\t"):
            pin = by_repository.setdefault(row["repository"], Pin(row["commit"], {}))
            if row["path"]:
                pin.sha256[row["path"]] = row["sha256"]
    return by_repository
