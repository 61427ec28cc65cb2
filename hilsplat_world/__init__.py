"""The synthetic world: scenes with exact annotations, their diagnostics, and the rules that make them.

A plugin of hilsplat: pyproject.toml registers its settings, generator, stages, commands and rules.
"""

from pathlib import Path

RULES = Path(__file__).with_name("world.smk")
