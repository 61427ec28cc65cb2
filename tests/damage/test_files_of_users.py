"""Every option that names an output or a cache, pointed at files of a user: none of them changes."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import typer

from hilsplat.base.errors import HilsplatError
from hilsplat.cli.main import app
from tests.conftest import PROJECT
from tests.unit.finished_desk import SCENE, pack_photographs

VARIANT = SCENE / "default"
VALUES = {
    "--masks": VARIANT / "masks",
    "--clip": VARIANT / "clip",
    "--contributions": VARIANT / "contributions",
    "--autoencoder": VARIANT / "autoencoder",
    "--scene": SCENE / "scene",
    "--gaussians": SCENE / "gaussians.ply",
    "--coverage-tree": VARIANT / "coverage_tree",
    "--semantic-tree": VARIANT / "semantic_tree",
    "--field": VARIANT / "field.safetensors",
    "--fit": SCENE / "scene",
    "--images": SCENE / "scene/images",
    "--dataset": "photos",
    "--name": "photos/desk",
    "--method": "mine",
    "--published": PROJECT / "config/published.csv",
    "--table": "table.csv",
    "--scores": VARIANT / "scores.csv",
    "--key-masks": VARIANT / "masks",
    "--key-tree": VARIANT / "semantic_tree",
    "--features": SCENE / "scene",
    "--truth": "made/truth",
    "--source": "world:tabletop:1",
    "--data-root": ".",
    "--folder": SCENE,
    "--blocks": 2,
    "--report": "made/report",
    "--out": "made/out",
}
"""Values of required options that are not pointed at the user's files."""
WORDS = {
    "new": ("chair", "photos.zip"),
    "evaluate-files": ("predictions",),
    "score-means": (str(VARIANT / "scores.csv"),),
    "table": ("lerf",),
    "sweep-plot": ("theta",),
    "query": ("photos/desk", "mug"),
    "export": ("photos/desk",),
    "world masks": ("photos/desk",),
    "datasets export": ("scannet/scene0000_00",),
    "blocks split": ("photos/desk",),
    "blocks join": ("mine",),
}
FAST = {
    "gaussians": ("--settings", '{"iterations": 10}'),
    "masks": ("--settings", '{"segmenter": "graph"}'),
    "key-masks": ("--settings", '{"segmenter": "graph"}'),
    "clip": ("--settings", '{"model": "models/colours"}'),
    "names": ("--settings", '{"vocabulary": "words.txt"}'),
    "world make": ("--settings", '{"views": 3, "image_px": 32}'),
}
OUTPUTS = {"out", "report", "truth", "cache", "folder", "sheet"}
NO_OUTPUTS = {"models check", "comparison", "cache", "blocks join"}
"""Commands whose `folder` is only read, and the one that runs in its own process below."""


def commands(command: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    if hasattr(command, "commands"):
        for name, each in command.commands.items():
            yield from commands(each, (*words, name))
    if command.params and words:
        yield " ".join(words), command


COMMANDS = dict(commands(typer.main.get_command(app)))
OPTIONS = [
    (name, parameter.name)
    for name, command in COMMANDS.items()
    for parameter in command.params
    if parameter.name in OUTPUTS and not (name in NO_OUTPUTS and parameter.name == "folder")
]
NAMES = (
    *("drawing.png", "film.mp4", "masks/a.png", "clip/b.mp4", "contributions/c.txt", "results/d.csv"),
    *("images/1.jpg", "index.json", "scenes.tsv", ".run.json", "photos/chair/f.jpg", "hidden/.git/HEAD"),
    *("new.pdf", "new.csv", "new.md", "new.json", "new.report.json", "new.tex", "new.html"),
    *("gaussians/0123456789abcdef.npz", f"masks/01/{'0' * 64}.npz", ".writing-01234567-01234567/e.png"),
)
"""Files of the user or of other tools, some with names like ours."""
THEIRS = ("trained.ply", "deep/1.npz")
LINKS = {"link.ply": "trained.ply", "folder": "deep", "lost.json": "nowhere"}
"""Links in the user's folder to files elsewhere."""
PLACES = (
    *("", "drawing.png", "masks", "hidden", "link.ply", "folder", "lost.json", "new.png", "new.safetensors"),
)


@pytest.fixture(scope="module")
def project(desk_project: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished scene, the configuration, and the user's folder `mine` with links out of it."""
    copy = Path(shutil.copytree(desk_project, tmp_path_factory.mktemp("users") / "project"))
    (copy / "words.txt").write_text("mug\nbook\n")
    (copy / "table.csv").write_text("a,b\n")
    pack_photographs(copy)
    mine, theirs = copy / "mine", copy / "theirs"
    for name in NAMES:
        (mine / name).parent.mkdir(parents=True, exist_ok=True)
        (mine / name).write_text(f"{name} of the user")
    (theirs / "deep").mkdir(parents=True)
    for name in THEIRS:
        (theirs / name).write_text(f"{name} elsewhere")
    for name, target in LINKS.items():
        (mine / name).symlink_to(theirs / target)
    return copy


def files_of_user(project: Path) -> dict[str, bytes | str | None]:
    """Return the contents of the user's files and the targets of the links; None for what is missing."""
    links = {
        name: str((project / "mine" / name).readlink())
        for name in LINKS
        if (project / "mine" / name).is_symlink()
    }
    places = [*(project / "mine" / name for name in NAMES), *(project / "theirs" / name for name in THEIRS)]
    return links | {str(path): path.read_bytes() if path.is_file() else None for path in places}


@pytest.mark.parametrize(("name", "option"), OPTIONS)
def test_no_option_changes_a_users_file(project: Path, monkeypatch, name: str, option: str) -> None:
    monkeypatch.chdir(project)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    before = files_of_user(project)
    command = COMMANDS[name]
    (chosen,) = (parameter for parameter in command.params if parameter.name == option)
    for place in PLACES:
        words = list(name.split())
        for parameter in command.params:
            if parameter is chosen or not parameter.required or parameter.param_type_name != "option":
                continue
            words += [parameter.opts[0], str(VALUES[parameter.opts[0]])]
        path = str(Path("mine") / place)
        given = [chosen.opts[0], path] if chosen.param_type_name == "option" else [path]
        words += [*given, *FAST.get(name, ()), *WORDS.get(name, ())]
        try:
            with suppress(HilsplatError):
                app(words)
        except SystemExit as ended:
            assert ended.code != 2, f"not the arguments of the command: {words}"
        except OSError as error:  # reported by `main`
            assert error.errno is not None
        shutil.rmtree("made", ignore_errors=True)
        assert files_of_user(project) == before, words


def test_neither_a_log_nor_pruning_changes_a_users_file(project: Path, monkeypatch) -> None:
    monkeypatch.chdir(project)
    before = files_of_user(project)
    for place in PLACES:
        with suppress(HilsplatError):
            app(
                ["cache", "--folder", f"mine/{place}", "prune", "--days", "0", "--max-mib", "0"],
                standalone_mode=False,
            )
        command = [sys.executable, "-m", "hilsplat", "--log", f"mine/{place}", "settings"]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode != 2 and "Traceback" not in done.stderr, (place, done.stderr)
    assert files_of_user(project) == before


@pytest.mark.parametrize("form", ["tree", "colmap"])
def test_an_export_replaces_only_its_own_files(own_desk: Path, monkeypatch, form: str) -> None:
    monkeypatch.chdir(own_desk.parents[2])
    words, folder = ["export", "photos/desk", "--as", form], SCENE / "export" / form
    app(words, standalone_mode=False)
    app(words, standalone_mode=False)
    written = sorted(path for path in folder.rglob("*") if path.is_file() and path.name[0] != ".")
    for name in (Path("mine/drawing.png"), Path(".git/HEAD"), written[0].relative_to(folder)):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("of the user")
        with pytest.raises(HilsplatError, match=rf"did not write, or that were changed(.|\n)*{name.name}"):
            app(words, standalone_mode=False)
        assert (folder / name).read_text() == "of the user"
        (folder / name).unlink()


KILLED = """
import os, sys, hilsplat.base.ownership
hilsplat.base.{} = lambda *_: os._exit(9)
from hilsplat.cli.main import app
app(sys.argv[1:])
"""


@pytest.mark.parametrize(
    ("form", "moment"),
    [
        ("tree", "ownership.write_json"),
        ("colmap", "ownership.write_json"),
        ("ply", "atomic.replace_folder"),
        ("ply", "ownership.write_json"),
    ],
)
def test_an_export_can_be_repeated_after_a_kill_and_until_then_the_former_one_is_kept(
    own_desk: Path, monkeypatch, form: str, moment: str
) -> None:
    """It is killed after all files are written: before or after their sizes and times are recorded."""
    monkeypatch.chdir(own_desk.parents[2])
    words, folder = ["export", "photos/desk", "--as", form], SCENE / "export" / form
    killed = [sys.executable, "-c", KILLED.format(moment), *words]
    assert subprocess.run(killed).returncode == 9
    app(words, standalone_mode=False)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert before and not any(".writing" in str(path) for path in before)
    assert subprocess.run(killed).returncode == 9
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
    app(words, standalone_mode=False)


def test_a_query_replaces_only_its_own_files(own_desk: Path, monkeypatch) -> None:
    monkeypatch.chdir(own_desk.parents[2])
    words, folder = ["query", "photos/desk", "mug", "--out", "answer", "--spz"], Path("answer")
    folder.mkdir()
    (folder / "notes.txt").write_text("of the user")
    app(words, standalone_mode=False)
    app(words, standalone_mode=False)
    for name in ("panel.png", "selection.ply", "selection.spz"):
        written = (folder / name).read_bytes()
        (folder / name).write_text("of the user")
        with pytest.raises(HilsplatError, match=rf"did not write, or that were changed(.|\n)*{name}"):
            app(words, standalone_mode=False)
        assert (folder / name).read_text() == "of the user"
        (folder / name).unlink()
        app(words, standalone_mode=False)
        assert (folder / name).read_bytes() == written
    assert (folder / "notes.txt").read_text() == "of the user"
