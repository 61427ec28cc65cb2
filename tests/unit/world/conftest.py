"""Scenes shared by several tests."""

import pytest

from hilsplat.world.scenes.kinds import build_scene
from hilsplat.world.scenes.scene import WorldScene


@pytest.fixture(scope="session")
def street() -> WorldScene:
    """The street of development seed 100 with seven vehicles and people."""
    return build_scene("street", 100, 7)
