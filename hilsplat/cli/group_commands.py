"""Command groups: model folders, caches, published data sets, and blocks of a large scene."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from hilsplat.cli.common import (
    Results,
    blocks_app,
    cache_app,
    datasets_app,
    echo,
    models_app,
    refuse_options,
    require_new_folder,
)
from hilsplat.cli.user_commands import SceneName, scene_folder
from hilsplat.stage import DEFAULT_CACHE, DataRoot, Threads
from hilsplat.stages import joined, label_fits, names


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
    context: typer.Context,
    folder: Annotated[Path | None, typer.Argument(help="model folder; default: all installed models")] = None,
    variant: Annotated[str, typer.Option(help="suffix of the network files, such as fp16")] = "",
) -> None:
    """Describe one model or all installed models, and measure the time per image."""
    from hilsplat.embed.model_check import check_model, check_models

    if folder is None:
        refuse_options(context, ("variant",), "one folder")
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
            help="cache to prune, such as masks or clip; gaussians: fit checkpoints, kept for a day; "
            "default: all caches, including gaussians only if --days is given"
        ),
    ] = None,
) -> None:
    """Delete unfinished files of killed jobs and, if a limit is given, cache entries (recomputed on use)."""
    from hilsplat.base.cache import prune_cache, size_table

    if days is None and max_mib is None:
        refuse_options(context, ("stage",), "--days or --max-mib")
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


@datasets_app.command("fits")
def datasets_fits(
    scene: SceneName,
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
    from hilsplat.scene.finished import FinishedScene
    from hilsplat.scene.scene import Scene

    parts = FinishedScene.locate(scene_folder(scene, results), variant).parts
    posed, tree, target = parts.scene, parts.semantic_tree, parts.semantic_tree.with_name("label_fits.csv")
    name = labels or f"annotated/{Scene.load(posed).name}"
    echo(label_fits(posed, parts.gaussians, parts.masks, tree, target, name, data_root, threads))


@blocks_app.command("split")
def blocks_split(
    scene: SceneName,
    blocks: Annotated[int, typer.Option(min=2, help="number of blocks")],
    out: Annotated[Path | None, typer.Option(help="new folder; default: blocks/SCENE")] = None,
    share: Annotated[
        float,
        typer.Option(min=0.01, max=1, help="lend a view to each block in which it sees at least this share"),
    ] = 0.2,
    results: Results = Path("results"),
) -> None:
    """Split a posed scene into overlapping blocks of views, to be run as separate scenes.

    Writes a folder of posed images for each block, and blocks.json for `hilsplat blocks join`.
    """
    from hilsplat.scene.blocks import split_scene
    from hilsplat.scene.scene import Scene

    opened = Scene.load(scene_folder(scene, results) / "scene")
    out = out or Path("blocks", opened.name.split("/")[-1])
    require_new_folder(out)
    for name, block in split_scene(opened, out, blocks, share).blocks.items():
        echo(f"{name}: {len(block.owned)} views, {len(block.borrowed)} more of other blocks")
        echo(f"  hilsplat new {name} {shlex.quote(str(out / name))}")


@blocks_app.command("join")
def blocks_join(
    folder: Annotated[Path, typer.Argument(help="folder that `hilsplat blocks split` wrote")],
    results: Results = Path("results"),
) -> None:
    """Join the finished blocks of a scene to a scene that accepts queries, in RESULTS/joined."""
    from hilsplat.base.lineage import read_provenance
    from hilsplat.scene.blocks import Blocks
    from hilsplat.scene.finished import FinishedScene
    from hilsplat.settings import QuerySettings

    described = Blocks.load(folder)
    scene = results / described.scene / "scene"
    finished = [FinishedScene.locate(scene_folder(name, results)) for name in described.blocks]
    name = scene.parent.name
    out = results / "joined" / name / "default"
    joined(folder, scene, [block.folder for block in finished], out / "semantic_tree")
    record = read_provenance(finished[0].folder / "default" / "names")
    queries = QuerySettings(**(record.settings["query"] if record else {}))
    cache, evaluate = results / DEFAULT_CACHE.name, finished[0].evaluate_settings()
    names(out / "semantic_tree", out / "clip", out / "names", queries, evaluate, cache)
    echo(
        f"joined {len(finished)} blocks:\n  hilsplat query joined/{name} TEXT\n  hilsplat view joined/{name}"
    )
