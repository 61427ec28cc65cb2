"""Fixtures of the segmenter's tests."""

from pathlib import Path

import pytest

from tests.unit.segment.handmade import write_disc_sam


@pytest.fixture(scope="session")
def disc_sam(tmp_path_factory) -> Path:
    return write_disc_sam(tmp_path_factory.mktemp("disc-sam"))


@pytest.fixture
def own_sam(tmp_path) -> Path:
    """A disc SAM that a test may change."""
    return write_disc_sam(tmp_path / "sam")
