"""The tables, described in `kinds.json`: titles, columns, protocols, the paper's rows and footnotes."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from hilsplat.base.tables import described

_DESCRIPTIONS = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))

SECONDS = "-seconds"
"""Name suffix of tables that show times and memory, so they are not reproducible byte for byte."""

NOTES: dict[str, str] = _DESCRIPTIONS["notes"]
"""Footnotes of several tables, by the name under which `kinds.json` lists them."""


@dataclass(frozen=True, kw_only=True)
class TableKind:
    """One table; `like` in `kinds.json` names a table from which omitted values are taken.

    Data sets and kinds of generated scenes name the tables that show them.

    Attributes:
        variants: key of the configuration that lists the variants. Tables of other variants than
            `main_variants` are measured only on the scenes in `sweep_scenes`.
        shows_costs: whether it needs the times of jobs and queries.
        reported: arguments of `rows.reported_block` for each block with the paper's values.
        protocols: prefixes of the protocols that have rows, for each set of measured blocks.
        methods: methods that have rows; empty for all.
        averaged: scenes of a benchmark that averages cover; empty for all.
        columns: value columns. A group whose columns name `{scene}` is repeated for each scene.
        steps: variant -> the variant that its row extends, in ablations; others extend `default`.
        ranked_together: protocols, without versions, whose rows are ranked with each other. Other rows are
            ranked only with rows of the same protocol.
    """

    title: str
    variants: str = "main_variants"
    shows_costs: bool = False
    reported: tuple[dict[str, Any], ...]
    protocols: tuple[tuple[str, ...], ...] = ()
    methods: tuple[str, ...] = ()
    averaged: tuple[str, ...] = ()
    columns: tuple[tuple[str, ...], ...] = ()
    unranked: tuple[str, ...] = ()
    steps: Mapping[str, str] = field(default_factory=dict)
    ranked_together: tuple[str, ...] = ()
    footnotes: tuple[str, ...]

    @property
    def has_levels(self) -> bool:
        """Whether its measured rows need labels with levels."""
        prefixes = [*chain(*self.protocols)]
        return bool(prefixes) and all(prefix.startswith("hierarchy/") for prefix in prefixes)

    def ranked_with(self, protocol: str) -> str:
        """Return the ranking group of rows with a protocol's full name; non-default settings are compared."""
        card, space, settings = protocol.partition(" ")
        return space + settings if card.partition("@")[0] in self.ranked_together else protocol

    def columns_of(self, scenes: Iterable[str]) -> tuple[str, ...]:
        names = sorted(set(scenes))
        return tuple(
            column.format(scene=scene)
            for group in self.columns
            for scene in (names if "{scene}" in group[0] else ("",))
            for column in group
        )


def _kind(name: str) -> TableKind:
    kind = TypeAdapter(TableKind).validate_python(described(_DESCRIPTIONS["tables"], name))
    return replace(kind, footnotes=tuple(NOTES.get(note, note) for note in kind.footnotes))


TABLES: dict[str, TableKind] = {name: _kind(name) for name in _DESCRIPTIONS["tables"]}
"""Every table by name, in report order."""
