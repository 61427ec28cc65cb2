"""Commands for scores, tables and figures."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from hilsplat.cli.stage import (
    DataRoot,
    PathIn,
    PathOut,
    Results,
    Settings,
    Threads,
    app,
    json_option,
    section_of,
    stage,
)

Truth = Annotated[Path | None, typer.Option(help="annotations of a synthetic scene")]
LabelledScene = Annotated[str, typer.Option(help="or a labelled scene, such as lerf_ovs/figurines")]
EvaluateSection = Annotated[str, typer.Option(help="settings of evaluate, as JSON")]
Kind = Annotated[str, typer.Option(help="kind of a synthetic scene: tabletop, room or street")]
Queries = Annotated[str, typer.Option(help="JSON list of queries, for a scene without labels")]


def _truth_inputs(
    truth: Path | None, labels: str | Sequence[str], data_root: Path
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the annotations and label files that a stage scores against, and the readers of the labels."""
    from hilsplat.datasets.registry import readers_of
    from hilsplat.datasets.sources import label_files

    named = [labels] if isinstance(labels, str) else labels
    files = {f"labels {name}": label_files(name, str(data_root)) for name in named if name}
    return {"truth": truth, **files}, readers_of(named)


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
    dataset: Annotated[str, typer.Option(help="data set named in the scores")],
    name: Annotated[str, typer.Option(help="scene named in the scores")],
    truth: Truth = None,
    labels: Annotated[
        list[str] | None, typer.Option(help="or labels of published data sets, such as lerf_ovs/figurines")
    ] = None,
    data_root: DataRoot = Path(),
    kind: Kind = "",
    variant: Annotated[str, typer.Option(help="variant named in the scores")] = "default",
    settings: Settings = "{}",
    threads: Threads = 1,
) -> None:
    """Query every annotated text in every test view, or every labelled view, and score the answers."""
    from hilsplat.scene.finished import SceneParts

    section = section_of("evaluate", settings)
    parts = SceneParts(scene, gaussians, semantic_tree, field, autoencoder, clip, masks)
    against: dict[str, Any] = {"truth": truth, "labels": labels or (), "data_root": data_root}
    named = {"dataset": dataset, "scene": name, "variant": variant, "kind": kind}
    read, readers = _truth_inputs(**against)
    inputs = {**parts.as_inputs(), **read}
    beside = (out.with_name("times.csv"), out.with_name("instances.npz"))
    with stage(
        "evaluate", out, settings=section, threads=threads, inputs=inputs, plugins=readers, beside=beside
    ) as run:
        run(parts, out, section, **named, **against, threads=threads)


@app.command("evaluate-files")
def evaluate_files(
    predictions: Annotated[Path, typer.Argument(help="folder of masks or point labels from any program")],
    out: PathOut,
    method: Annotated[str, typer.Option(help="name of the program in the tables")],
    labels: Annotated[str, typer.Option(help="labels of a data set, such as lerf_ovs/figurines")] = "",
    data_root: DataRoot = Path(),
    truth: Truth = None,
    scene: Annotated[
        Path | None, typer.Option(help="posed scene of a synthetic scene, which lists the test views")
    ] = None,
    kind: Kind = "",
    dataset: Annotated[str, typer.Option(help="data set of a synthetic scene in the scores")] = "synthetic",
    name: Annotated[str, typer.Option(help="name of a synthetic scene in the scores")] = "",
    min_region_px: Annotated[
        int | None, typer.Option(min=1, help="smaller regions of a synthetic scene are not scored")
    ] = None,
) -> None:
    """Score masks or point labels written by any program, under the same protocols."""
    against: dict[str, Any] = {"truth": truth, "labels": labels, "data_root": data_root}
    named = {"method": method, "kind": kind, "dataset": dataset, "name": name}
    read, readers = _truth_inputs(**against)
    inputs = {"predictions": predictions, **read, "scene": scene}
    with stage("evaluate_files", out, inputs=inputs, plugins=readers) as run:
        run(predictions, out, **named, **against, scene=scene, min_region_px=min_region_px)


@app.command()
def table(
    name: Annotated[str, typer.Argument(help="table: hierarchy, lerf, ablation, ... (docs/tables.md)")],
    published: PathIn,
    out: Annotated[Path, typer.Option(help="CSV to write, with .md, .tex and .html files beside it")],
    scores: Annotated[list[Path] | None, typer.Argument(help="scores.csv of each scene and variant")] = None,
    labels: Annotated[str, typer.Option(help="JSON: variant -> its name in the table")] = "{}",
    absent: Annotated[list[str] | None, typer.Option(help="what was not measured, and why")] = None,
) -> None:
    """Build one table of the paper, with reported, measured and stand-in rows."""
    scores = scores or []
    inputs = {"published": published, **{f"scores {number}": path for number, path in enumerate(scores)}}
    beside = tuple(out.with_suffix(ending) for ending in (".md", ".tex", ".html"))
    with stage("table", out, inputs=inputs, beside=beside) as run:
        run(name, scores, published, json_option("--labels", labels, dict), out, absent or [])


@app.command()
def figures(
    scene: PathIn,
    gaussians: PathIn,
    fit: Annotated[Path, typer.Option(help="folder of the fit's report")],
    masks: PathIn,
    clip: PathIn,
    semantic_tree: PathIn,
    field: PathIn,
    autoencoder: PathIn,
    out: Annotated[Path, typer.Option(help="PNG to write, with registration.png and fit.png beside it")],
    truth: Truth = None,
    labels: LabelledScene = "",
    data_root: DataRoot = Path(),
    queries: Queries = "[]",
    settings: Settings = "{}",
    evaluate: EvaluateSection = "{}",
    threads: Threads = 1,
) -> None:
    """Draw the panel of a scene: photograph, masks, field, relevancy, answers, ground truth."""
    from hilsplat.scene.finished import SceneParts

    section, protocol = section_of("figures", settings), section_of("evaluate", evaluate)
    parts = SceneParts(scene, gaussians, semantic_tree, field, autoencoder, clip, masks)
    against: dict[str, Any] = {"truth": truth, "labels": labels, "data_root": data_root}
    read, readers = _truth_inputs(**against)
    inputs, both = {**parts.as_inputs(), "fit": fit, **read}, {"figures": section, "evaluate": protocol}
    beside = (out.with_name("registration.png"), out.with_name("fit.png"))
    texts = json_option("--queries", queries, list)
    with stage(
        "figures", out, settings=both, threads=threads, inputs=inputs, plugins=readers, beside=beside
    ) as run:
        run(parts, out, section, protocol, fit=fit, **against, queries=texts, threads=threads)


@app.command()
def comparison(
    folder: Annotated[Path, typer.Option(help="finished scene, results/<dataset>/<scene>")],
    variants: Annotated[str, typer.Option(help="JSON list of the variants to compare")],
    out: Annotated[Path, typer.Option(help="PNG to write, with views.png, features.png and PDFs beside it")],
    names: Annotated[str, typer.Option(help="JSON: variant -> its name in figures")] = "{}",
    truth: Truth = None,
    labels: LabelledScene = "",
    data_root: DataRoot = Path(),
    queries: Queries = "[]",
    settings: Settings = "{}",
    evaluate: EvaluateSection = "{}",
    threads: Threads = 1,
) -> None:
    """Compare variants: queries by method, one query in four views, features at three levels."""
    section, protocol = section_of("figures", settings), section_of("evaluate", evaluate)
    compared, named = json_option("--variants", variants, list), json_option("--names", names, dict)
    texts, both = json_option("--queries", queries, list), {"figures": section, "evaluate": protocol}
    against: dict[str, Any] = {"truth": truth, "labels": labels, "data_root": data_root}
    read, readers = _truth_inputs(**against)
    inputs = {f"scores of {variant}": folder / variant / "scores.csv" for variant in compared} | read
    beside = (out.with_name("views.png"), out.with_name("features.png"))
    with stage(
        "comparison", out, settings=both, threads=threads, inputs=inputs, plugins=readers, beside=beside
    ) as run:
        run(folder, compared, named, out, section, protocol, **against, queries=texts, threads=threads)


@app.command()
def sweep(
    name: Annotated[str, typer.Argument(help="theta or omega")],
    table: Annotated[Path, typer.Option(help="finished CSV of that table")],
    out: Annotated[Path, typer.Option(help="PNG to write, with a PDF beside it")],
) -> None:
    """Plot a sweep from its table: the paper's curves and ours."""
    with stage("sweep", out, inputs={"table": table}) as run:
        run(name, table, out)


@app.command()
def efficiency(
    results: Results = Path("results"),
    out: Annotated[Path, typer.Option(help="CSV, with .md beside it")] = Path("results/efficiency.csv"),
) -> None:
    """Print the time of each stage, from the benchmark files of a run."""
    from hilsplat.evaluate.tables.costs import run_efficiency

    typer.echo(run_efficiency(results, out))
