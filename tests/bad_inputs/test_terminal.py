"""Texts from files cannot send commands to the terminal: escape sequences, bells, bidirectional overrides."""

import json
import logging
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from hilsplat.base.errors import visible
from hilsplat.base.progress import LOG_FORMAT, LogFormatter
from hilsplat.cli import main as cli
from hilsplat.query.names import tree_digest
from tests.bad_inputs.test_bad_inputs import photographs, write
from tests.unit.finished_desk import SCENE

HOSTILE = "\x1b]0;x\x07\x9b31m\u202eab\x7f\r"
SHOWN = r"\x1b]0;x\x07\x9b31m\u202eab\x7f\r"


def printed(project: Path, *words: str) -> tuple[int, bytes]:
    """Run a command in its own process; return its exit status, and its stdout and stderr."""
    ended = subprocess.run(
        [sys.executable, "-m", "hilsplat", *words],
        cwd=project,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        timeout=300,
        check=False,
    )
    return ended.returncode, ended.stdout


def named(name: str) -> None:
    trees = {tree_digest(SCENE / "default/semantic_tree"): {"0": name}}
    content = {"format": "hilsplat-names-1", "trees": trees}
    (SCENE / "names.json").write_text(json.dumps(content))


def label(category: str) -> None:
    line = {"id": 1, "level": 1, "category": category, "segmentation": [[1, 1], [5, 5]]}
    content = {"info": {"width": 36, "height": 24}, "objects": [line]}
    write("data/annotated/photos/desk/000.json", json.dumps(content))()


def model(name: str) -> None:
    shutil.copytree("models/colours", f"models/{name}")


def no_models() -> None:
    Path("config/config.yaml").write_text(f'masks: {{model: "models/{SHOWN}"}}\n')


QUERY = ("query", "photos/desk", "mug", "--out", "answer")
NEW = ("new", "chair", "photos")
EXPORT = ("export", "photos/desk", "--out", "tree")
LABELS = ("datasets", "check", "annotated", "--data-root", "data")


@pytest.mark.parametrize(
    ("lay", "command", "part"),
    [
        (lambda: named(HOSTILE), QUERY, r"names.json is damaged"),
        (lambda: named(HOSTILE), EXPORT, r"names.json is damaged"),
        (lambda: named("mug\ud800"), EXPORT, r"mug\ud800"),
        (lambda: label(HOSTILE), LABELS, r"\x1b]0;x\x07"),
        (lambda: label("mug\ud800"), LABELS, r"mug\ud800"),
        (photographs(f"{HOSTILE}.png"), NEW, r"\x1b]0;x\x07"),
        (lambda: [photographs()(), write(f"photos/{HOSTILE}.png", b"")()], NEW, r"\x1b]0;x\x07"),
        (lambda: [photographs()(), write("photos/b\udcff.png", b"")()], NEW, r"b\udcff.png"),
        (lambda: write(SCENE / f"{HOSTILE}.provenance.json", "{")(), ("verify",), r"\x1b]0;x\x07"),
        (lambda: model(HOSTILE), ("models", "list"), r"\x1b]0;x\x07"),
        (no_models, ("run",), r"\x1b]0;x\x07"),
    ],
)
def test_the_terminal_gets_only_printable_text(
    lay: Callable[[], object], command: tuple[str, ...], part: str, project: Path
) -> None:
    lay()
    _, output = printed(project, *command)
    text = output.decode()
    assert part in text
    assert "Traceback" not in text
    assert text.replace("\n", "").replace("\t", "").isprintable()


def test_unprintable_characters_are_escaped_and_other_text_is_unchanged() -> None:
    assert visible(HOSTILE) == SHOWN
    assert visible("é 漢字 👍\n\ta") == "é 漢字 👍\n\ta"
    assert visible("\x00\u2028\ud800\u200b") == r"\x00\u2028\ud800\u200b"


def test_log_records_and_their_tracebacks_are_escaped(capsys, monkeypatch) -> None:
    record = logging.LogRecord("hilsplat", 30, "", 0, "image %s", (HOSTILE,), None)
    assert LogFormatter(LOG_FORMAT).format(record).endswith(f"WARNING hilsplat: image {SHOWN}")

    def fail() -> None:
        raise RuntimeError(HOSTILE)

    monkeypatch.setattr(cli, "app", fail)
    with pytest.raises(SystemExit):
        cli.main()
    told = capsys.readouterr().err
    assert "Traceback" in told and f"RuntimeError: {SHOWN}" in told
