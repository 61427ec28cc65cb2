"""Scores, tables and figures."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilsplat.cli.apps import app
from hilsplat.cli.stage import (
    DataRoot,
    Log,
    PathIn,
    PathOut,
    Results,
    Settings,
    Threads,
    section_of,
    stage,
    start_logging,
)

if TYPE_CHECKING:
    from hilsplat.scene.finished import SceneParts

Truth = Annotated[Path | None, typer.Option(help="annotations of a synthetic scene")]
LabelledScene = Annotated[
    str, typer.Option(help="or a scene of a published data set that has labels, such as lerf_ovs/figurines")
]
Queries = Annotated[str, typer.Option(help="JSON list of texts, for a scene without labels")]


@app.command()
def evaluate(
    scene: PathIn,
    gaussians: PathIn,
    semantic_tree: PathIn,
    field: PathIn,
    autoencoder: PathIn,
    clip: PathIn,
    masks: PathIn,
    out: PathOut,
    dataset: Annotated[str, typer.Option(help="data set, for the rows")],
    name: Annotated[str, typer.Option(help="scene, for the rows")],
    truth: Truth = None,
    labels: Annotated[
        list[str] | None, typer.Option(help="or labels of published data sets, such as lerf_ovs/figurines")
    ] = None,
    data_root: DataRoot = Path(),
    kind: Annotated[
        str,
        typer.Option(help="of a synthetic scene: tabletop, room or street; the data sets it stands in for"),
    ] = "",
    variant: Annotated[str, typer.Option(help="variant, for the rows")] = "default",
    settings: Settings = "{}",
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Ask every annotated text in every test view, or every labelled one, and score the answers."""
    section = section_of("evaluate", settings)
    parts = _parts(scene, gaussians, semantic_tree, field, autoencoder, clip, masks)
    inputs = {**parts.as_inputs(), **({"truth": truth} if truth else {})}
    plugins = _readers(labels or ())
    with stage("evaluate", out, log, settings=section, threads=threads, inputs=inputs, plugins=plugins):
        from hilsplat.evaluate.stage import run_evaluate

        run_evaluate(
            parts,
            out,
            section,
            dataset=dataset,
            scene=name,
            variant=variant,
            truth=truth,
            kind=kind,
            labels=labels or (),
            data_root=data_root,
            threads=threads,
        )


def _readers(labels: Sequence[str]) -> tuple[str, ...]:
    from hilsplat.datasets.registry import readers_of

    return readers_of(labels)


def _parts(*paths: Path) -> "SceneParts":
    """The parts of a scene, in the order of `SceneParts`."""
    from hilsplat.scene.finished import SceneParts

    return SceneParts(*paths)


@app.command()
def table(
    name: Annotated[str, typer.Argument(help="table: hierarchy, lerf, ablation, ... (docs/tables.md)")],
    published: PathIn,
    out: Annotated[Path, typer.Option(help="the CSV; .md, .tex and .html are written beside it")],
    scores: Annotated[
        list[Path] | None, typer.Argument(help="scores.csv files of the scenes and variants")
    ] = None,
    labels: Annotated[str, typer.Option(help="JSON: how the table names a variant")] = "{}",
    absent: Annotated[list[str] | None, typer.Option(help="what was not measured, and why")] = None,
    log: Log = None,
) -> None:
    """Build one table of the paper: reported rows, measured rows, stand-in rows."""
    import json

    scores = scores or []
    inputs = {"published": published, **{f"scores {number}": path for number, path in enumerate(scores)}}
    with stage("table", out, log, inputs=inputs):
        from hilsplat.evaluate.tables.build import run_table

        run_table(name, scores, published, json.loads(labels), out, absent or [])


@app.command()
def figures(
    scene: PathIn,
    gaussians: PathIn,
    fit: Annotated[Path, typer.Option(help="report folder of the fit")],
    masks: PathIn,
    clip: PathIn,
    semantic_tree: PathIn,
    field: PathIn,
    autoencoder: PathIn,
    out: Annotated[Path, typer.Option(help="panel PNG; registration.png and fit.png go beside it")],
    truth: Truth = None,
    labels: LabelledScene = "",
    data_root: DataRoot = Path(),
    queries: Queries = "[]",
    settings: Settings = "{}",
    evaluate: Settings = "{}",
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Draw a scene's panel: photograph, masks, field, relevancy, answers, truth."""
    import json

    section, protocol = section_of("figures", settings), section_of("evaluate", evaluate)
    parts = _parts(scene, gaussians, semantic_tree, field, autoencoder, clip, masks)
    inputs = {**parts.as_inputs(), "fit": fit, **({"truth": truth} if truth else {})}
    recorded = {"figures": section, "evaluate": protocol}
    plugins = _readers([labels])
    with stage("figures", out, log, settings=recorded, threads=threads, inputs=inputs, plugins=plugins):
        from hilsplat.evaluate.figures.panel import run_figures

        run_figures(
            parts,
            out,
            section,
            protocol,
            fit=fit,
            truth=truth,
            labels=labels,
            data_root=data_root,
            queries=json.loads(queries),
            threads=threads,
        )


@app.command()
def comparison(
    folder: Annotated[Path, typer.Option(help="results/<dataset>/<scene>, finished", show_default=False)],
    variants: Annotated[str, typer.Option(help="JSON list of variants that are compared")],
    out: Annotated[Path, typer.Option(help="PNG; views.png, features.png and PDFs are written beside it")],
    names: Annotated[str, typer.Option(help="JSON: how figures name a variant")] = "{}",
    truth: Truth = None,
    labels: LabelledScene = "",
    data_root: DataRoot = Path(),
    queries: Queries = "[]",
    settings: Settings = "{}",
    evaluate: Settings = "{}",
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Draw queries by method, one query over four views, and features at three levels."""
    import json

    section, protocol = section_of("figures", settings), section_of("evaluate", evaluate)
    recorded, compared = {"figures": section, "evaluate": protocol}, json.loads(variants)
    inputs = {f"scores of {variant}": folder / variant / "scores.csv" for variant in compared}
    plugins = _readers([labels])
    with stage("comparison", out, log, settings=recorded, threads=threads, inputs=inputs, plugins=plugins):
        from hilsplat.evaluate.figures.comparison import run_comparison

        run_comparison(
            folder,
            compared,
            json.loads(names),
            out,
            section,
            protocol,
            truth=truth,
            labels=labels,
            data_root=data_root,
            queries=json.loads(queries),
            threads=threads,
        )


@app.command()
def sweep(
    name: Annotated[str, typer.Argument(help="theta or omega")],
    table: Annotated[Path, typer.Option(help="the finished CSV of that table")],
    out: Annotated[Path, typer.Option(help="PNG; the PDF is written beside it")],
    log: Log = None,
) -> None:
    """Plot a sweep from its table: the paper's curves, and ours."""
    with stage("sweep", out, log, inputs={"table": table}):
        from hilsplat.evaluate.figures.sweep_plot import run_sweep_plot

        run_sweep_plot(name, table, out)


@app.command()
def efficiency(
    results: Results = Path("results"),
    out: Annotated[Path, typer.Option(help="the CSV; .md beside it")] = Path("results/efficiency.csv"),
) -> None:
    """Print where the time went, from the benchmark files of a run."""
    start_logging(None)
    from hilsplat.evaluate.tables.efficiency import run_efficiency

    typer.echo(run_efficiency(results, out))
