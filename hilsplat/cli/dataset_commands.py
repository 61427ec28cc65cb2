"""Commands for published data sets: list, check, export, fits."""

from pathlib import Path
from typing import Annotated

import typer

from hilsplat.cli.stage import DataRoot, PathOut, Results, Threads, datasets_app, stage


@datasets_app.command("list")
def datasets_list(
    data_root: Annotated[Path | None, typer.Option(help="folder that holds the data sets")] = None,
) -> None:
    """List the data sets: citation, licence, layout and, with --data-root, the scenes found."""
    from hilsplat.datasets.registry import overview

    typer.echo(overview(data_root))


@datasets_app.command("check")
def datasets_check(
    name: Annotated[str, typer.Argument(help="data set, such as lerf_ovs")],
    data_root: DataRoot,
    scene: Annotated[list[str] | None, typer.Option(help="scene to read; default: all found")] = None,
) -> None:
    """Read all labels of a data set and report what was found and what is wrong, scene by scene."""
    from hilsplat.datasets.registry import check, dataset_of

    report, num_failed = check(dataset_of(name), data_root, scene or ())
    typer.echo(report)
    if num_failed:
        raise typer.Exit(1)


@datasets_app.command("export")
def datasets_export(
    name: Annotated[str, typer.Argument(help="scene with labelled points, such as scannet/scene0000_00")],
    data_root: DataRoot,
    out: PathOut,
) -> None:
    """Write the images and poses of a scene as a folder that `poses` imports."""
    from hilsplat.datasets.registry import readers_of
    from hilsplat.datasets.sources import DATA_PREFIX, image_files

    files = image_files(f"{DATA_PREFIX}{name}", str(data_root))
    with stage("source", out, plugins=readers_of([name]), inputs={"files": files}) as run:
        run(name, data_root, out)


@datasets_app.command("fits")
def datasets_fits(
    scene: Annotated[str, typer.Argument(help="dataset/scene in the results folder that has a tree")],
    labels: Annotated[
        str | None,
        typer.Option(help="labels with levels, such as hi_lerf/figurines; default: your own of this scene"),
    ] = None,
    variant: Annotated[str, typer.Option(help="variant whose masks and tree to measure")] = "default",
    results: Results = Path("results"),
    data_root: DataRoot = Path(),
    threads: Threads = 2,
) -> None:
    """Measure how well masks and nodes fit annotated regions, by level and without any text.

    Writes label_fits.csv beside the tree.
    """
    folder = results / scene
    name, semantic_tree = labels or f"annotated/{scene}", folder / variant / "semantic_tree"
    target = semantic_tree.with_name("label_fits.csv")
    inputs = {
        "scene": folder / "scene",
        "gaussians": folder / "gaussians.ply",
        "masks": folder / variant / "masks",
        "semantic_tree": semantic_tree,
    }
    from hilsplat.datasets.registry import readers_of

    with stage("label_fits", target, inputs=inputs, plugins=readers_of([name])) as run:
        table = run(folder, variant, name, data_root, target, threads)
    typer.echo(table)
