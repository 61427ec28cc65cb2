"""Commands for the caches: views, fit checkpoints, training data of embedded models, model digests."""

from pathlib import Path
from typing import Annotated

import typer

from hilsplat.cli.apps import cache_app
from hilsplat.cli.stage import DEFAULT_CACHE, start_logging


@cache_app.callback()
def cache_show(
    context: typer.Context,
    folder: Annotated[Path, typer.Option(help="cache folder")] = DEFAULT_CACHE,
) -> None:
    """Show the size of each cache."""
    start_logging()
    from hilsplat.base.cache import size_table

    context.obj = folder
    if context.invoked_subcommand is None:
        typer.echo(size_table(folder))


@cache_app.command("prune")
def cache_prune(
    context: typer.Context,
    days: Annotated[
        float | None, typer.Option(min=0, help="delete entries not used for this many days")
    ] = None,
    max_mib: Annotated[
        float | None,
        typer.Option(min=0, help="delete the least recently used entries until this much is left"),
    ] = None,
    stage: Annotated[
        list[str] | None,
        typer.Option(
            help="cache to prune: masks, clip, contributions or gaussians (checkpoints of fits, kept for a "
            "day); default: all, but gaussians only with --days"
        ),
    ] = None,
) -> None:
    """Delete unfinished files of killed jobs and, with a limit, cache entries, which can be recomputed."""
    from hilsplat.base.cache import prune_cache, size_table

    number, freed_mib = prune_cache(context.obj, stage or [], days=days, max_mib=max_mib)
    typer.echo(f"deleted {number} files, {freed_mib:.1f} MiB\n{size_table(context.obj)}")
