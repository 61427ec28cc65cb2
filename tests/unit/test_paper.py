"""docs/paper.md names functions, settings, tests and tables that exist."""

import importlib
import re

import pytest
import yaml

from hilsplat.configuration import validated
from hilsplat.evaluate.protocols.cards import CARDS
from hilsplat.evaluate.tables.build import TABLES
from tests.conftest import PROJECT

PAGE = (PROJECT / "docs/paper.md").read_text(encoding="utf-8")
NAMES = sorted(set(re.findall(r"`([^`]+)`", PAGE)))
FUNCTIONS = [name for name in NAMES if re.fullmatch(r"hilsplat[\w.]*:\w+", name)]
SETTINGS = [name for name in NAMES if re.fullmatch(r"\w+\.\w+: .+", name)]


@pytest.mark.parametrize("place", FUNCTIONS)
def test_functions_exist(place):
    module, _, name = place.partition(":")
    assert callable(getattr(importlib.import_module(module), name))


@pytest.mark.parametrize("setting", SETTINGS)
def test_settings_take_the_value_of_the_literal_reading(setting):
    place, _, value = setting.partition(": ")
    section, _, key = place.partition(".")
    name = {"name": "hi_lsplat"} if section == "method" else {}
    validated(section, {**name, key: yaml.safe_load(value)}, section)


def test_every_equation_and_table_has_a_row():
    for number in range(1, 7):
        assert re.search(rf"\| Eq\. {number}[,:]", PAGE), number
    shown = {name for line in section("Tables") for name in re.findall(r"`([\w-]+)`", line)}
    assert {name for name in TABLES if not name.endswith("-seconds")} <= shown
    unknown = shown - set(TABLES) - {"data_root", "-seconds"}
    assert not unknown


def test_named_protocols_exist():
    protocols = {name for name in NAMES if re.fullmatch(r"(lerf|world|hierarchy|3d-ovs)/[\w-]+", name)}
    assert protocols and protocols <= {card.name for card in CARDS}


def section(title):
    """Lines of a section of the page."""
    return PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0].splitlines()
