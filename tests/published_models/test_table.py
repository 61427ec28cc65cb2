"""The table of published models agrees with the releases, the pinned commits and docs/models.md."""

import csv
import re
from pathlib import Path

from hilsplat.hub.catalogue import pins
from hilsplat.models.store import RELEASES
from tests.conftest import PROJECT

SIGNATURES = {
    "sam": "test_the_published_sam_decoder_is_factored",
    "sam2": "test_the_published_sam_2_decoder_is_factored",
    "clip": "test_the_published_clip_gives_what_transformers_gives",
    "clip-exported": "test_clip_gives_what_transformers_gives",
}
"""Signature -> test of it."""


def rows() -> list[dict[str, str]]:
    with Path(__file__).with_name("releases.tsv").open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream, delimiter="\t"))


def test_each_release_has_a_row_with_its_pinned_commit_and_a_tested_signature():
    found = {row["name"]: row for row in rows()}
    assert list(found) == [release.name for release in RELEASES]
    tests = "".join(path.read_text() for path in PROJECT.glob("tests/**/test_*.py"))
    for release in RELEASES:
        row, pin = found[release.name], pins()[release.repository]
        assert (row["repository"], row["licence"]) == (release.repository, release.licence)
        assert row["commit"] == pin.commit
        named = {path for path in pin.sha256 if path.endswith((".onnx", ".onnx_data"))}
        assert named <= set(row["files"].split())
        assert f"def {SIGNATURES[row['signature']]}(" in tests
        assert re.match("[SRB]: ", row["evidence"])


def test_the_documentation_has_the_same_rows():
    text = (PROJECT / "docs/models.md").read_text(encoding="utf-8")
    for row in rows():
        cells = (f"`{row['name']}`", f"`{row['commit'][:7]}`", row["weights"], f"`{row['signature']}`")
        assert f"| {' | '.join(cells)} | {row['evidence']} |\n" in text
