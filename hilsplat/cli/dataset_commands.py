"""Published data sets: list, check, export."""

from pathlib import Path
from typing import Annotated

import typer

from hilsplat.cli.apps import datasets_app
from hilsplat.cli.stage import (
    DataRoot,
    Log,
    PathOut,
    stage,
    start_logging,
)


@datasets_app.command("list")
def datasets_list(
    data_root: Annotated[Path | None, typer.Option(help="folder that holds the data sets")] = None,
) -> None:
    """List the data sets: citation, licence, layout and, with --data-root, the scenes found."""
    start_logging(None)
    from hilsplat.datasets.overview import overview

    typer.echo(overview(data_root))


@datasets_app.command("check")
def datasets_check(
    name: Annotated[str, typer.Argument(help="data set, such as lerf_ovs")],
    data_root: DataRoot,
    scene: Annotated[list[str] | None, typer.Option(help="scene to read; default: all found")] = None,
) -> None:
    """Read all labels of a data set and report, scene by scene, what was found and what is wrong."""
    start_logging(None)
    from hilsplat.datasets.overview import check
    from hilsplat.datasets.registry import dataset_of

    report, num_failed = check(dataset_of(name), data_root, scene or ())
    typer.echo(report)
    if num_failed:
        raise typer.Exit(1)


@datasets_app.command("export")
def datasets_export(
    name: Annotated[str, typer.Argument(help="scene with labelled points, such as scannet/scene0000_00")],
    data_root: DataRoot,
    out: PathOut,
    log: Log = None,
) -> None:
    """Write the images and poses of a scene as a folder that `poses` imports."""
    from hilsplat.datasets.registry import readers_of

    with stage("source", out, log, plugins=readers_of([name])):
        from hilsplat.datasets.sources import export_images

        export_images(name, data_root, out)
