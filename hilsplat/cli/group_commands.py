"""Command groups: the synthetic world, model folders, caches, and published data sets."""

from pathlib import Path
from typing import Annotated

import typer

from hilsplat.cli.stage import (
    DEFAULT_CACHE,
    DataRoot,
    PathOut,
    Results,
    Settings,
    Threads,
    cache_app,
    datasets_app,
    echo,
    models_app,
    section_of,
    stage,
    world_app,
)

SceneWithMasks = Annotated[str, typer.Argument(help="synthetic scene that has masks, as dataset/scene")]
MeasuredMasks = Annotated[str, typer.Option(help="variant whose masks are measured")]
NEIGHBOURS = 2  # number of nearest views that each view is compared with


@world_app.command("make")
def world_make(
    source: Annotated[str, typer.Option(help="scene to make, as world:KIND:SEED")],
    out: PathOut,
    settings: Settings = "{}",
    threads: Threads = 1,
) -> None:
    """Make a synthetic scene: images, and ground truth for evaluation only."""
    section = section_of("world", settings)
    with stage("world", out / "images", settings=section, beside=(out / "truth",)) as run:
        run(source, section, out, threads)


@world_app.command("show")
def world_show(
    scene: Annotated[str, typer.Argument(help="finished synthetic scene, as dataset/scene")],
    results: Results = Path("results"),
) -> None:
    """Write a contact sheet to world.png: views, labels by level, and the tree with its texts."""
    from hilsplat_world.pictures import show_world

    target = results / scene / "world.png"
    show_world(results / scene / "world", target)
    echo(f"wrote {target}")


@world_app.command("inconsistency")
def world_inconsistency(
    scene: SceneWithMasks, variant: MeasuredMasks = "default", results: Results = Path("results")
) -> None:
    """Measure, using exact geometry, how often a surface point has different masks in neighbouring views.

    Writes consistency.csv beside the masks.
    """
    truth, masks_folder = results / scene / "world" / "truth", results / scene / variant / "masks"
    target = masks_folder.with_name("consistency.csv")
    with stage("consistency", target, inputs={"truth": truth, "masks": masks_folder}) as run:
        table = run(truth, masks_folder, target, NEIGHBOURS)
    echo(table)


@world_app.command("masks")
def world_masks(
    scene: SceneWithMasks,
    variant: MeasuredMasks = "default",
    results: Results = Path("results"),
    out: Annotated[Path | None, typer.Option(help="PNG, CSV and PDF; default: beside the masks")] = None,
) -> None:
    """Compare masks with ground-truth regions at each level, and draw the errors."""
    folder = results / scene
    truth, masks_folder = folder / "world" / "truth", folder / variant / "masks"
    target = out or masks_folder.with_name("masks_truth.png")
    inputs = {"scene": folder / "scene", "truth": truth, "masks": masks_folder}
    with stage("mask_truth", target, inputs=inputs, beside=(target.with_suffix(".csv"),)) as run:
        table = run(folder / "scene", truth, masks_folder, target)
    echo(table)


@world_app.command("semantic-tree")
def world_tree(
    scene: Annotated[str, typer.Argument(help="synthetic scene that has a tree, as dataset/scene")],
    variant: Annotated[str, typer.Option(help="variant whose tree is measured")] = "default",
    results: Results = Path("results"),
    threads: Threads = 2,
) -> None:
    """Compare the 3D semantic tree with the ground-truth nodes: matches, purity, parents.

    Writes tree_truth.csv beside the tree.
    """
    folder = results / scene
    semantic_tree, truth = folder / variant / "semantic_tree", folder / "world" / "truth"
    target = semantic_tree.with_name("tree_truth.csv")
    posed, ply = folder / "scene", folder / "gaussians.ply"
    inputs = {"scene": posed, "gaussians": ply, "truth": truth, "semantic_tree": semantic_tree}
    with stage("tree_truth", target, inputs=inputs) as run:
        table = run(posed, ply, semantic_tree, truth, target, threads)
    echo(table)


@models_app.command("get")
def models_get(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            help="names from `hilsplat models list`, or owner/name on the hub; default: the recommended pair"
        ),
    ] = None,
    revision: Annotated[
        str | None,
        typer.Option(help="branch, tag or commit; default: the pinned commit of a released model, else main"),
    ] = None,
    variant: Annotated[str, typer.Option(help="precision: quantized, fp16, int8, ...; default: full")] = "",
    out: Annotated[
        Path | None, typer.Option(help="models folder; default: HILSPLAT_MODELS, or the user's data folder")
    ] = None,
) -> None:
    """Download released models from the model hub, and check them.

    An interrupted download resumes where it stopped. HF_ENDPOINT, HF_HOME, HF_TOKEN, HF_HUB_OFFLINE and the
    usual proxy variables are respected.
    """
    from hilsplat.hub.get import get_models

    echo(get_models(names or (), out, revision, variant))


@models_app.command("list")
def models_list() -> None:
    """List released and installed models, with size, licence and use."""
    from hilsplat.models.store import models_table

    echo(models_table())


@models_app.command("check")
def models_check(
    folder: Annotated[Path | None, typer.Argument(help="model folder; default: all installed models")] = None,
    variant: Annotated[str, typer.Option(help="suffix of the network files, such as fp16")] = "",
) -> None:
    """Describe one model or all installed models, and measure the time per image."""
    from hilsplat.embed.model_check import check_model, check_models

    text, num_failed = (check_model(folder, variant), 0) if folder is not None else check_models()
    echo(text)
    if num_failed:
        raise typer.Exit(1)


@models_app.command("split")
def models_split(folder: Annotated[Path, typer.Argument(help="folder of an exported CLIP model")]) -> None:
    """Split the model.onnx of an exported CLIP model into its image and text networks."""
    from hilsplat.models.onnx_graph import split_clip

    for path in split_clip(folder):
        echo(f"wrote {path}")


@cache_app.callback()
def cache_show(
    context: typer.Context, folder: Annotated[Path, typer.Option(help="cache folder")] = DEFAULT_CACHE
) -> None:
    """Show the size of each cache."""
    from hilsplat.base.cache import size_table

    context.obj = folder
    if context.invoked_subcommand is None:
        echo(size_table(folder))


@cache_app.command("prune")
def cache_prune(
    context: typer.Context,
    days: Annotated[float | None, typer.Option(min=0, help="delete entries unused for N days")] = None,
    max_mib: Annotated[
        float | None, typer.Option(min=0, help="delete least recently used entries until N MiB remain")
    ] = None,
    stage: Annotated[
        list[str] | None,
        typer.Option(
            help="cache to prune: masks, clip, contributions or gaussians (fit checkpoints, kept for at "
            "least a day); default: all caches, including gaussians only if --days is given"
        ),
    ] = None,
) -> None:
    """Delete unfinished files of killed jobs and, if a limit is given, cache entries (recomputed on use)."""
    from hilsplat.base.cache import prune_cache, size_table

    number, freed_mib = prune_cache(context.obj, stage or [], days=days, max_mib=max_mib)
    echo(f"deleted {number} files, {freed_mib:.1f} MiB\n{size_table(context.obj)}")


@datasets_app.command("list")
def datasets_list(
    data_root: Annotated[Path | None, typer.Option(help="folder of the data sets")] = None,
) -> None:
    """List the data sets: citation, licence, layout and, with --data-root, the scenes found."""
    from hilsplat.datasets.registry import overview

    echo(overview(data_root))


@datasets_app.command("check")
def datasets_check(
    name: Annotated[str, typer.Argument(help="data set, such as lerf_ovs")],
    data_root: DataRoot,
    scene: Annotated[list[str] | None, typer.Option(help="scene to read; default: all found")] = None,
) -> None:
    """Read all labels of a data set, and report the contents and any problems of each scene."""
    from hilsplat.datasets.registry import check, dataset_of

    report, num_failed = check(dataset_of(name), data_root, scene or ())
    echo(report)
    if num_failed:
        raise typer.Exit(1)


@datasets_app.command("export")
def datasets_export(
    name: Annotated[str, typer.Argument(help="scene with labelled points, such as scannet/scene0000_00")],
    data_root: DataRoot,
    out: PathOut,
) -> None:
    """Write the images and poses of a scene to a folder that the poses command can import."""
    from hilsplat.datasets.registry import readers_of
    from hilsplat.datasets.sources import DATA_PREFIX, image_files

    files = image_files(f"{DATA_PREFIX}{name}", str(data_root))
    with stage("source", out, plugins=readers_of([name]), inputs={"files": files}) as run:
        run(name, data_root, out)


@datasets_app.command("fits")
def datasets_fits(
    scene: Annotated[str, typer.Argument(help="scene with a tree in the results folder, as dataset/scene")],
    labels: Annotated[
        str | None, typer.Option(help="labels with levels, such as hi_lerf/figurines; default: your own")
    ] = None,
    variant: Annotated[str, typer.Option(help="variant whose masks and tree are measured")] = "default",
    results: Results = Path("results"),
    data_root: DataRoot = Path(),
    threads: Threads = 2,
) -> None:
    """Measure how well masks and nodes fit annotated regions, by level and without queries.

    Writes label_fits.csv beside the tree.
    """
    folder = results / scene
    name, semantic_tree = labels or f"annotated/{scene}", folder / variant / "semantic_tree"
    target = semantic_tree.with_name("label_fits.csv")
    inputs = {"scene": folder / "scene", "gaussians": folder / "gaussians.ply"}
    inputs |= {"masks": folder / variant / "masks", "semantic_tree": semantic_tree}
    from hilsplat.datasets.registry import readers_of

    with stage("label_fits", target, inputs=inputs, plugins=readers_of([name])) as run:
        table = run(folder, variant, name, data_root, target, threads)
    echo(table)
