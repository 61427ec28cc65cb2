"""Commands that start a project and run the workflow."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from hilsplat.cli.apps import app
from hilsplat.cli.stage import start_logging


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(help="folder of the project")] = Path(),
) -> None:
    """Write commented config/config.yaml and config/scenes.tsv to edit; they replace the installed ones."""
    start_logging()
    from hilsplat.workflow.run import start_project

    for path in start_project(folder):
        typer.echo(f"wrote {path}")


@app.command("run")
def run_command(
    targets: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="TARGET",
            help="scenes (photos/desk or desk), rules (tables) or files; default: everything",
            show_default=False,
        ),
    ] = None,
    config: Annotated[
        list[Path] | None,
        typer.Option(help="configuration file that overrides config/config.yaml; may be repeated"),
    ] = None,
) -> None:
    """Run the workflow for everything in the configuration, or for single scenes, tables or files.

    A killed run continues. Options after -- are passed to Snakemake: hilsplat run desk -- --cores 1
    """
    start_logging()
    from hilsplat.workflow.run import run

    options = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []
    names = targets or []
    status = run(names[: len(names) - len(options)], config or [], options)
    raise typer.Exit(status)
