"""What commands share: groups, options, the log, and printing."""

import logging
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from hilsplat.base.errors import ArtifactError, HilsplatError, SettingsError, visible
from hilsplat.base.progress import LOG_FORMAT, LogFormatter

PANELS = {
    "Start": ("init", "new", "run", "scenes", "settings", "doctor"),
    "Use a scene": ("query", "view", "annotate", "export", "show-masks"),
    "Data and models": ("models", "datasets", "blocks", "cache", "verify", "world"),
    "Scores and tables": ("evaluate-files", "table", "figures", "comparison", "sweep-plot", "efficiency"),
}
"""Panels of `hilsplat --help` and their commands; all others are stages."""

STAGES = "Stages, which hilsplat run starts"

app = typer.Typer(
    help="Turn photographs into a 3D Gaussian scene that answers text queries at three semantic levels.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
models_app = typer.Typer(help="Get, list, check and split models (SAM, CLIP).", no_args_is_help=True)
datasets_app = typer.Typer(help="List, check and export published data sets.", no_args_is_help=True)
cache_app = typer.Typer(help="Show or prune the caches of a results folder.", invoke_without_command=True)
blocks_app = typer.Typer(
    help="Split a large scene into blocks, and join their results.", no_args_is_help=True
)
app.add_typer(models_app, name="models")
app.add_typer(datasets_app, name="datasets")
app.add_typer(cache_app, name="cache")
app.add_typer(blocks_app, name="blocks")


def sort_into_panels() -> None:
    """Sort the commands and groups of `app` into the panels of its help.

    Raises:
        HilsplatError: a plugin adds a command of the same name as another.
    """
    panels = {name: panel for panel, names in PANELS.items() for name in names}
    every: list[Any] = [app.registered_commands, app.registered_groups]
    for infos in every:
        for info in infos:
            info.name = info.name or info.callback.__name__
            info.rich_help_panel = panels.get(info.name, STAGES)
        infos.sort(key=lambda info: [*panels, info.name].index(info.name))
    for group in (app, *filter(None, (info.typer_instance for info in app.registered_groups))):
        named: list[Any] = [*group.registered_commands, *group.registered_groups]
        names = [info.name or info.callback.__name__ for info in named]
        if repeated := sorted({name for name in names if names.count(name) > 1}):
            raise HilsplatError(
                f"several commands are named {repeated[0]!r}",
                fix="rename it in the package that offers it (hilsplat.commands or hilsplat.stages), or "
                "uninstall the package",
            )


Results = Annotated[Path, typer.Option(help="results folder")]


def start_logging(*, timestamps: bool = False) -> None:
    """Send log records to stderr; `timestamps` adds time, level and logger unless stderr is a terminal."""
    root = logging.getLogger()
    root.setLevel(logging.INFO)
    root.handlers.clear()
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LogFormatter(LOG_FORMAT if timestamps and not sys.stderr.isatty() else None))
    root.addHandler(handler)
    for noisy in ("matplotlib", "numba", "PIL", "fontTools", "urllib3"):
        logging.getLogger(noisy).setLevel(logging.WARNING)


def require_new_folder(out: Path, option: str = "--out") -> None:
    """Raise ArtifactError if a folder is in an artifact, exists and is not empty, or is a link to nothing."""
    from hilsplat.base.ownership import require_outside_artifacts

    require_outside_artifacts(out)
    is_there = out.exists() or out.is_symlink()
    if is_there and not (out.is_dir() and not any(out.iterdir())):
        raise ArtifactError(f"{option} {out} exists", fix="choose a new folder, or remove this one first")


def refuse_options(context: typer.Context, names: Iterable[str], purpose: str) -> None:
    """Raise SettingsError if one of these options was given, because it would be ignored."""
    for parameter in context.command.params:
        source, option = context.get_parameter_source(parameter.name or ""), parameter.opts[0]
        if parameter.name in names and source and source.name == "COMMANDLINE":
            raise SettingsError(f"{option} is for {purpose}", fix=f"use {purpose}, or leave out {option}")


def echo(text: object) -> None:
    """Print to stdout; commands print nothing in any other way, because texts from files may be hostile."""
    typer.echo(visible(text))  # noqa: TID251
