"""Commands in messages are commands of this version, with options that they have."""

import ast
import re
from pathlib import Path

import pytest
import typer

import hilsplat
from hilsplat.cli.main import app

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
TO_SNAKEMAKE = {"--unlock", "--config"}
"""Options of Snakemake that messages suggest after `--`."""


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
