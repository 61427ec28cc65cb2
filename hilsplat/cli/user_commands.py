"""What people ask of a finished scene, and the manual of the settings."""

from pathlib import Path
from typing import Annotated

import typer

from hilsplat.cli.apps import app
from hilsplat.cli.stage import (
    Threads,
    start_logging,
)


@app.command()
def query(
    scene: Annotated[str, typer.Argument(help="dataset/scene, such as photos/bear")],
    text: Annotated[
        str,
        typer.Argument(
            help="what to look for; 'bear > nose' is a nose of a bear, 'bear > head > nose' one of its head"
        ),
    ],
    level: Annotated[
        str, typer.Option(help="auto, whole, part or subpart: where (the last of) the text is searched")
    ] = "auto",
    variant: Annotated[str, typer.Option(help="variant whose files answer")] = "default",
    results: Annotated[Path, typer.Option(help="results folder")] = Path("results"),
    views: Annotated[int, typer.Option(min=1, max=8, help="views in the panel")] = 3,
    answerer: Annotated[str, typer.Option(help="tree, or field: the paper's")] = "tree",
    view: Annotated[
        str | None, typer.Option(help="ask only for what this view shows, such as 000.png")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="folder of panel.png and selection.ply; default: queries/TEXT in the scene's folder"
        ),
    ] = None,
    device: Annotated[str, typer.Option(help="cpu or cuda: where the field is looked up")] = "cpu",
    threads: Threads = 2,
) -> None:
    """Ask a finished scene for a text: score, level, position, box, views; a panel PNG and a PLY."""
    start_logging(None)
    from hilsplat.query.answer import answer

    typer.echo(
        answer(
            results / scene,
            text,
            level=level,
            variant=variant,
            views=views,
            answerer=answerer,
            view=view,
            out=out,
            device=device,
            threads=threads,
        )
    )


@app.command()
def export(
    scene: Annotated[str, typer.Argument(help="dataset/scene, such as photos/bear")],
    variant: Annotated[str, typer.Option(help="variant whose tree is written")] = "default",
    results: Annotated[Path, typer.Option(help="results folder")] = Path("results"),
    out: Annotated[
        Path | None, typer.Option(help="folder to write; default: export/VARIANT in the scene's folder")
    ] = None,
    threads: Threads = 2,
) -> None:
    """Write the semantic tree of a finished scene: JSON, a PLY with nodes per Gaussian, a picture."""
    start_logging(None)
    from hilsplat.query.tree_picture import export_tree

    folder = results / scene
    typer.echo(export_tree(folder, variant, out or folder / "export" / variant, threads))


@app.command()
def settings(
    schema: Annotated[
        bool, typer.Option(help="print the JSON schema of the configuration, for editors")
    ] = False,
) -> None:
    """Print every knob: default, unit, range, origin."""
    import json

    from hilsplat.configuration import config_schema, knob_table

    typer.echo(json.dumps(config_schema(), indent=1) if schema else knob_table())
