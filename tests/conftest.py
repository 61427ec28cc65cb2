"""Shared fixtures and the rules that hold for all tests."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

PROJECT = Path(__file__).resolve().parents[1]

os.environ.setdefault("MPLBACKEND", "Agg")

# No test fails for being slow on a busy machine, and every run tries the same examples.
settings.register_profile("hilsplat", deadline=None, derandomize=True)
settings.load_profile("hilsplat")


@pytest.fixture(scope="session")
def project() -> Path:
    """Root of the checkout."""
    return PROJECT
