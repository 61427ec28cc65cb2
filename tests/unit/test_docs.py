"""Links, commands, options, settings, configurations, files and functions in the documentation exist."""

import ast
import itertools
import re
import shlex
from pathlib import Path
from typing import Any, get_type_hints

import pytest
import typer
from jaxtyping import AbstractArray
from typer.testing import CliRunner

from hilsplat.base.arrays import described
from hilsplat.baselines import own_settings
from hilsplat.cli.common import PANELS, STAGES
from hilsplat.cli.main import app
from hilsplat.configuration import SECTIONS
from hilsplat.contributions.rows import Contributions
from hilsplat.field.code import LanguageField
from hilsplat.scene import cameras
from hilsplat.segment import masks
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.semantic_tree import tree
from hilsplat.semantic_tree.tree import SemanticTree
from tests.conftest import PROJECT

PAGES = sorted(
    path
    for pattern in ("*.md", "docs/*.md", "config/*.md", "models/*/*.md", "workflow/*.md")
    for path in PROJECT.glob(pattern)
)
ROOTS = ("hilsplat/", "rules/", "config/", "workflow/", "tests/", "docs/", "benchmarks/", "models/")
FILES = ("ply", "json", "safetensors", "csv", "png", "md", "py", "smk")
"""Suffixes in names such as `gaussians.ply`, which are files and not settings."""

FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.M | re.S)

of_every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(PROJECT)))


def prose(page: Path) -> str:
    """Return a page without its code blocks."""
    return FENCE.sub("", page.read_text())


def inline_code(page: Path) -> list[str]:
    """Return a page's texts in single backquotes."""
    return re.findall(r"`([^`]+)`", " ".join(prose(page).split()))


def anchors(page: Path) -> set[str]:
    """Return GitHub's anchors of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", prose(page), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def shell_lines(page: Path) -> list[str]:
    """Return the joined lines of a page's shell blocks, and inline code that begins with a command."""
    blocks = [text for language, text in FENCE.findall(page.read_text()) if language in ("bash", "")]
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [*lines, *(code for code in inline_code(page) if re.match(r"(hilsplat|snakemake) [a-z-]", code))]


def command_of(words: list[str]) -> tuple[Any, list[str]]:
    """Return the command that words after `hilsplat` name, or None, and the remaining words."""
    command: Any = typer.main.get_command(app)
    while words and hasattr(command, "commands") and not words[0].startswith("-"):
        command, words = command.commands.get(words[0]), words[1:]
    return command, words


@of_every_page
def test_every_relative_link_has_a_target(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        place = (page.parent / path).resolve() if path else page
        assert place.exists(), f"{target} is missing"
        assert not anchor or anchor in anchors(place), f"{target}: no such heading"


@of_every_page
def test_every_command_and_option_exists(page: Path) -> None:
    for line in shell_lines(page):
        if not line.startswith("hilsplat "):
            continue
        words = shlex.split(line.replace("...", ""), comments=True)[1:]
        command, rest = command_of(words)
        assert command is not None, f"{line}: no such command"
        options = {name for each in command.params for name in (*each.opts, *each.secondary_opts, "--help")}
        own = rest[: rest.index("--")] if "--" in rest else rest  # the others are Snakemake's
        unknown = [word for word in own if word.startswith("--") and word not in options]
        assert not unknown, f"{line}: no option {', '.join(unknown)}"


@of_every_page
def test_every_configuration_and_forced_rule_exists(page: Path) -> None:
    rules = "".join(path.read_text() for path in sorted((PROJECT / "rules").glob("*.smk")))
    for line in shell_lines(page):
        for name in re.findall(r"--(?:config|configfile|workflow-profile) ((?:config|profiles)/\S+)", line):
            assert (PROJECT / name).exists(), f"{line}: {name} is missing"
        for name in re.findall(r"--forcerun (\S+)", line):
            assert re.search(rf"rule (\w+ as )?{name}( with)?:", rules), f"{line}: no such rule"


@of_every_page
def test_every_setting_exists(page: Path) -> None:
    """`section.knob`, alone or before its value; the changelog also names those that were removed."""
    if page.name == "CHANGELOG.md":
        return
    for code in inline_code(page):
        match = re.fullmatch(r"(\w+)\.(\w+)(?::.*)?", code)
        if match and match[1] in SECTIONS and match[2] not in FILES:
            of_methods = own_settings().values() if match[1] == "method" else ()
            names = {*SECTIONS[match[1]].model_fields}.union(*of_methods)
            assert match[2] in names, f"`{code}`: no such knob"


def test_every_page_is_linked_from_the_readme() -> None:
    links = set(re.findall(r"\]\((docs/[^)#]+\.md)", (PROJECT / "README.md").read_text()))
    assert links == {f"docs/{path.name}" for path in (PROJECT / "docs").glob("*.md")}


def test_every_page_that_the_code_names_exists() -> None:
    sources = [*(PROJECT / "hilsplat").rglob("*.py"), *(PROJECT / "rules").glob("*.smk")]
    sources += [PROJECT / "Makefile", *(PROJECT / "config").glob("*.yaml")]
    for source in sources:
        for name in re.findall(r"docs/\w+\.md", source.read_text()):
            assert (PROJECT / name).exists(), f"{source.relative_to(PROJECT)} names {name}"


CHECKED = (
    ("scene/cameras.npz", cameras.Cameras, {"size_hw": (1, cameras.MAX_SIDE_PX)}),
    ("masks/<view>.npz", HierarchicalMasks, masks.LIMITS),
    ("contributions/rows.npz", Contributions, {}),
    ("semantic_tree/tree.npz", SemanticTree, tree.LIMITS),
    ("field.safetensors", LanguageField, {}),
)
"""Files whose arrays are checked when they are opened: the class that declares them, and limits of values."""


def checked_arrays() -> list[str]:
    """Return a table row per file, from the annotations by which its arrays are checked."""
    lines = []
    for file, maker, limits in CHECKED:
        cells = []
        for name, declared in get_type_hints(maker).items():
            if isinstance(declared, type) and issubclass(declared, AbstractArray):
                low, high = limits.get(name, (None, None))
                values = f", {low:g} to {high:g}" if low is not None else ""
                cells.append(f"`{name}` {described(declared)}{values}")
        lines.append(f"| `{file}` | {'; '.join(cells)} |")
    return lines


def test_the_architecture_lists_the_arrays_that_are_checked() -> None:
    page = (PROJECT / "docs/architecture.md").read_text()
    missing = [line for line in checked_arrays() if line not in page]
    assert not missing, "write these lines:\n" + "\n".join(missing)


@of_every_page
def test_every_place_in_the_code_exists(page: Path) -> None:
    """`path.py` is a file, `folder/` a folder, and `path.py:name` or `path.py:Class.method` a definition."""
    form = rf"({'|'.join(ROOTS)})[\w./-]*(/|\.(py|smk|json|tsv|txt|yaml|sh)(:[\w.]+)?)"
    places = [code for code in inline_code(page) if re.fullmatch(form, code)]
    assert places or page.stem not in ("architecture", "SECURITY", "paper")
    for place in places if page.name != "CHANGELOG.md" else ():
        path, _, name = place.partition(":")
        assert (PROJECT / path).exists(), f"{path} is missing"
        scope: ast.AST = ast.parse((PROJECT / path).read_text()) if name else ast.Module()
        for part in name.split(".") if name else ():
            parts = [*ast.iter_child_nodes(scope)]
            definitions = {ast.unparse(name): each for each in parts for name in getattr(each, "targets", ())}
            definitions |= {each.name: each for each in parts if hasattr(each, "name")}
            assert part in definitions, f"{place}: {path} does not define {part}"
            scope = definitions[part]


def test_every_package_is_in_the_architecture_and_has_at_most_twenty_files() -> None:
    named = set(inline_code(PROJECT / "docs/architecture.md"))
    rooms = {path.parent for path in (PROJECT / "hilsplat").glob("*/__init__.py")}
    assert {f"hilsplat/{room.name}/" for room in rooms} <= named
    folders = {path.parent for path in (PROJECT / "hilsplat").rglob("*.py")}
    assert {folder: count for folder in folders if (count := len(list(folder.glob("*.py")))) > 20} == {}


def test_help_lists_commands_for_people_before_stages():
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "200", "TERM": "dumb"}).output
    panels = [*PANELS, STAGES]
    assert [shown.count(f" {panel} ") for panel in panels] == [1] * len(panels)
    assert sorted(panels, key=lambda panel: shown.index(f" {panel} ")) == panels
    for panel, after in itertools.zip_longest(panels, panels[1:]):
        part = shown[shown.index(f" {panel} ") : shown.index(f" {after} ") if after else None]
        for name in PANELS.get(panel, ("poses", "masks", "field", "evaluate")):
            assert re.search(rf"^\W*{name} ", part, re.MULTILINE), name
