"""Commands in messages are commands of this version, with options that they have."""

import ast
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import typer

import hilsplat
from hilsplat.cli.main import app, main

PACKAGE = Path(hilsplat.__file__).parent
PROSE = {
    "cannot",
    "viewer",
    "wrote",
    "may",
    "does",
    "did",
    "keeps",
    "import",
    "reads",
    "needs",
    "version",
    "run has",
    "in",
}
"""What follows the name in sentences about hilsplat."""
SAFE = {"name", "scene", "requested.name"}
"""Names of scenes and of released models, which contain no character that a shell obeys."""
TO_SNAKEMAKE = {"--config"}  # options of Snakemake that messages suggest after `--`


def texts_of(path: Path) -> list[str]:
    """Return the strings in a module except docstrings; expressions in them become X."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    described = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    loose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)} | described
    inner = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = [part.value if isinstance(part, ast.Constant) else "X" for part in node.values]
            found.append("".join(map(str, parts)))
        elif (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and not {id(node)} & (loose | inner)
        ):
            found.append(node.value)
    return found


def options_of(words: list[str]) -> tuple[set[str], int]:
    """Return the options of a command and the number of words that name it; KeyError if there is none."""
    command, number = typer.main.get_command(app), 0
    while hasattr(command, "commands"):
        if number and words[number : number + 1] and words[number].startswith("-"):
            break
        command, number = command.commands[words[number]], number + 1
    return {name for parameter in command.params for name in parameter.opts}, number


MESSAGES = sorted(
    {
        (str(path.relative_to(PACKAGE)), match)
        for path in PACKAGE.rglob("*.py")
        for text in texts_of(path)
        for match in re.findall(r"\b(?:hilsplat|snakemake) [a-z-][^`;()\n]*", text)
    }
)


def test_messages_with_commands_are_found():
    assert len(MESSAGES) > 25
    assert any("models get" in text for _, text in MESSAGES)


@pytest.mark.parametrize(("module", "text"), MESSAGES)
def test_a_command_in_a_message_can_be_parsed(module, text):
    program, *words = text.replace("'", " ").replace('"', " ").replace(",", " ").split()
    if program == "snakemake":
        assert not words[0].startswith("-"), "a folder made by `hilsplat init` has no Snakefile"
        return
    if words[0] in PROSE or " ".join(words[:2]) in PROSE:
        return
    known, number = options_of(words)
    for word in words[number:]:
        if word == "--":
            break
        assert not word.startswith("-") or word.partition("=")[0].rstrip(".") in known, text
    after = words[words.index("--") + 1 :] if "--" in words else []
    assert {word for word in after if word.startswith("-")} <= TO_SNAKEMAKE


def test_paths_in_suggested_commands_are_quoted_for_the_shell():
    values = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            before = ""
            for part in node.values if isinstance(node, ast.JoinedStr) else ():
                if isinstance(part, ast.Constant):
                    before += part.value
                elif re.search(r"\bhilsplat (?!run has)[a-z-][^`;()\n]*$", before):
                    values.add(ast.unparse(part.value))
    assert "shlex.quote(str(folder))" in values
    assert {value for value in values if not value.startswith("shlex.quote(")} <= SAFE


def test_ctrl_c_during_an_import_ends_the_command_without_an_error(monkeypatch, caplog):
    """Compiled modules raise an ImportError from it, and their packages another error."""

    def interrupted() -> None:
        try:
            raise ImportError("initialization failed") from KeyboardInterrupt()
        except ImportError as error:
            raise RuntimeError("cannot import the C++ backend") from error

    monkeypatch.setattr("hilsplat.cli.main.app", interrupted)
    monkeypatch.setattr("hilsplat.cli.main.start_logging", lambda: None)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130 and not caplog.records


EARLY = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, *_):
        if name == sys.argv[1]:
            os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores Ctrl-C
sys.meta_path.insert(0, Interrupting())
import hilsplat.cli.main
print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)
"""


def test_ctrl_c_while_a_command_starts_prints_no_traceback():
    for name, expected in (("hilsplat.cli.group_commands", (-signal.SIGINT, "")), ("none", (0, "True\n"))):
        command = [sys.executable, "-c", EARLY, name]
        done = subprocess.run(command, capture_output=True, text=True)
        assert (done.returncode, done.stdout, done.stderr) == (*expected, "")
