"""Fixtures of other folders that tests of the world use."""

from tests.unit.evaluate.conftest import block_world

__all__ = ["block_world"]
