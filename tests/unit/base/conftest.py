"""Fixtures for the tests of the base package."""

import os
from pathlib import Path

import pytest


@pytest.fixture
def flushed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Paths of the files and folders that are flushed to disk, at that time."""
    names: list[str] = []
    monkeypatch.setattr(os, "fsync", lambda file: names.append(str(Path(f"/proc/self/fd/{file}").readlink())))
    return names
