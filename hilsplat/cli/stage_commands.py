"""One command per stage, from poses to figures; `hilsplat.workflow.stages` names each stage's function."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from hilsplat.base.artifacts import provenance_path
from hilsplat.base.errors import HilsplatError, SettingsError
from hilsplat.cli.scene_commands import POSES_HELP
from hilsplat.cli.stage import (
    DEFAULT_CACHE,
    Cache,
    DataRoot,
    Memory,
    PathIn,
    PathOut,
    Results,
    Seed,
    Settings,
    Threads,
    app,
    echo,
    json_option,
    model_input,
    section_of,
    stage,
)
from hilsplat.models.store import AUTO

Features = Annotated[Path | None, typer.Option(help="folder of LangSplat's _s.npy and _f.npy files")]
Truth = Annotated[Path | None, typer.Option(help="annotations of a synthetic scene")]
LabelledScene = Annotated[str, typer.Option(help="labelled scene, such as lerf_ovs/figurines")]
EvaluateSection = Annotated[str, typer.Option(help="evaluate settings as JSON")]
Kind = Annotated[str, typer.Option(help="kind of a synthetic scene: tabletop, room or street")]
Queries = Annotated[str, typer.Option(help="JSON list of queries, for a scene without labels")]


@app.command("poses")
def find_poses(
    images: PathIn,
    out: PathOut,
    name: Annotated[str, typer.Option(help="name of the scene in messages, as dataset/scene")] = "scene",
    unit: Annotated[str, typer.Option(help="unit of length: metre or arbitrary")] = "arbitrary",
    render: Annotated[bool, typer.Option(help="treat the images as renders with an ideal lens")] = False,
    poses: Annotated[Path | None, typer.Option(help=POSES_HELP)] = None,
    settings: Settings = "{}",
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Compute the camera poses of photographs, or import a COLMAP model or transforms.json."""
    from hilsplat.datasets.sources import photo_files

    section = section_of("poses", settings)
    is_own = any(provenance_path(place).is_file() for place in (images, images.parent))
    read = photo_files(images, poses) if images.is_dir() and not is_own else images
    with stage("poses", out, settings=section, seed=seed, inputs={"images": read}) as run:
        run(images, out, name, unit, render, section, seed, threads, poses)


@app.command()
def gaussians(
    scene: PathIn,
    out: PathOut,
    report: Annotated[Path, typer.Option(help="folder for the fit's report")],
    settings: Settings = "{}",
    existing: Annotated[Path | None, typer.Option(help="3DGS PLY, in the source's coordinates")] = None,
    dataparser: Annotated[
        Path | None, typer.Option(help="dataparser_transforms.json, for a PLY in nerfstudio's coordinates")
    ] = None,
    transforms: Annotated[Path | None, typer.Option(help="transforms.json, for --dataparser")] = None,
    cache: Cache = DEFAULT_CACHE,
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Fit 3D Gaussians to the training views, or use your own; a JSON file records their coordinates."""
    section = section_of("gaussians", settings)
    inputs = {"scene": scene, "existing": existing, "dataparser": dataparser, "transforms": transforms}
    beside = (out.with_suffix(".json"), report)
    with stage("gaussians", out, settings=section, seed=seed, inputs=inputs, beside=beside) as run:
        run(scene, out, report, cache, section, seed, threads, existing, dataparser, transforms)


@app.command()
def masks(
    scene: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    truth: Annotated[Path | None, typer.Option(help="ground truth, only for truth-perturbed")] = None,
    gaussians: Annotated[Path | None, typer.Option(help="PLY, for key views and guided prompts")] = None,
    key_masks: Annotated[Path | None, typer.Option(help="masks of the key views, for guided prompts")] = None,
    semantic_tree: Annotated[Path | None, typer.Option(help="tree of key views, for guided prompts")] = None,
    perturb: Annotated[str, typer.Option(help="faults for truth-perturbed, as JSON")] = "{}",
    features: Features = None,
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
    memory: Memory = None,
) -> None:
    """Segment each training view at three levels."""
    section = section_of("masks", settings)
    is_diagnostic = section.segmenter == "truth-perturbed"
    if is_diagnostic and truth is None:
        raise HilsplatError(
            "masks: the segmenter truth-perturbed needs a synthetic scene's ground-truth labels",
            expected="--truth results/<dataset>/<scene>/world/truth",
            fix="pass this option, or set masks.segmenter to sam or graph",
        )
    if truth is not None and not is_diagnostic:
        raise HilsplatError(
            f"masks: the segmenter {section.segmenter} must not use the ground truth",
            found=f"--truth {truth}",
            fix="omit --truth, or, for diagnosis only, set masks.segmenter to truth-perturbed",
        )
    if is_diagnostic:
        faults = section_of("perturb", perturb)
        read, both = {"scene": scene, "truth": truth}, {"masks": section, "perturb": faults}
        with stage("truth_masks", out, settings=both, seed=faults.seed, inputs=read) as run:
            run(scene, truth, out, faults, section.min_area_px, threads)
        return
    if features is not None:
        with stage("langsplat", out, inputs={"scene": scene, "features": features}) as files:
            files.read_masks(scene, features, out)
        return
    inputs = {"scene": scene, **(model_input(section) if section.segmenter == "sam" else {})}
    if section.key_views < 1:
        if gaussians is None:
            raise HilsplatError(
                "masks: selecting key views requires the Gaussians",
                expected="--gaussians results/<dataset>/<scene>/gaussians.ply",
                fix="pass this option, or set masks.key_views to 1",
            )
        inputs |= {"gaussians": gaussians}
        with stage("key_masks", out, settings=section, inputs=inputs) as run:
            run(scene, gaussians, out, cache, section, threads, memory)
        return
    if gaussians and key_masks and semantic_tree:
        inputs |= {"gaussians": gaussians, "key_masks": key_masks, "semantic_tree": semantic_tree}
        with stage("guided_masks", out, settings=section, inputs=inputs) as run:
            run(scene, gaussians, key_masks, semantic_tree, out, cache, section, threads, memory)
        return
    with stage("masks", out, settings=section, inputs=inputs) as run:
        run(scene, out, cache, section, threads, memory)


@app.command("coverage-tree")
def coverage_tree(masks: PathIn, out: PathOut, settings: Settings = "{}") -> None:
    """Compute each view's coverage tree: the parent of each mask."""
    section = section_of("coverage_tree", settings)
    with stage("coverage_tree", out, settings=section, inputs={"masks": masks}) as run:
        run(masks, out, section)


@app.command("show-masks")
def show_masks(
    scene: PathIn,
    masks: PathIn,
    out: Annotated[Path, typer.Option(help="PNG to write, with the trees beside it")] = Path("masks.png"),
    coverage_tree: Annotated[Path | None, typer.Option(help="coverage trees to draw as well")] = None,
    view: Annotated[str | None, typer.Option(help="name of the view; default: the middle one")] = None,
) -> None:
    """Draw a view's masks at three levels, and its coverage trees."""
    from hilsplat.segment.pictures import masks_overview

    echo(f"wrote {out}, view {masks_overview(scene, masks, out, view, coverage_tree)}")


@app.command()
def names(
    semantic_tree: PathIn,
    clip: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    evaluate: EvaluateSection = "{}",
    cache: Cache = DEFAULT_CACHE,
) -> None:
    """Name the nodes of a semantic tree from a vocabulary."""
    query, protocol = section_of("query", settings), section_of("evaluate", evaluate)
    own = None if query.vocabulary == AUTO else Path(query.vocabulary)
    inputs = {"semantic_tree": semantic_tree, "clip": clip, "vocabulary": own}
    both = {"query": query, "evaluate": protocol}
    with stage("names", out, settings=both, inputs=inputs) as run:
        run(semantic_tree, clip, out, cache, query, protocol)


@app.command()
def clip(
    scene: PathIn,
    masks: PathIn,
    out: PathOut,
    semantic_tree: Annotated[
        Path | None, typer.Option(help="tree whose nodes select the crops; default: embed every mask")
    ] = None,
    settings: Settings = "{}",
    features: Features = None,
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
    memory: Memory = None,
) -> None:
    """Embed the best crops of each node, or every mask, with CLIP."""
    section = section_of("clip", settings)
    inputs = {"scene": scene, "masks": masks, **model_input(section), "semantic_tree": semantic_tree}
    if features is not None:
        with stage("langsplat", out, settings=section, inputs={**inputs, "features": features}) as files:
            files.read_clip(scene, features, out, section)
        return
    with stage("clip", out, settings=section, inputs=inputs) as run:
        run(scene, masks, semantic_tree, out, cache, section, threads, memory)


@app.command()
def contributions(
    scene: PathIn,
    gaussians: PathIn,
    masks: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
) -> None:
    """Compute the weight of each Gaussian in each mask, in one pass over the views."""
    section = section_of("contributions", settings)
    inputs = {"scene": scene, "gaussians": gaussians, "masks": masks}
    with stage("contributions", out, settings=section, inputs=inputs) as run:
        run(scene, gaussians, masks, out, cache, section, threads)


@app.command("semantic-tree")
def semantic_tree(
    contributions: PathIn,
    masks: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    coverage_tree: Annotated[Path | None, typer.Option(help="coverage trees, for evidence: features")] = None,
    field_settings: Annotated[str, typer.Option(help="field settings, for evidence: features")] = "{}",
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Compute nodes at three levels, by linking masks across views or clustering Gaussians by features."""
    section = section_of("semantic_tree", settings)
    inputs = {"contributions": contributions, "masks": masks, "coverage_tree": coverage_tree}
    if (section.evidence == "features") != (coverage_tree is not None):
        raise SettingsError(
            "semantic_tree.evidence and the options do not match",
            expected="--coverage-tree if evidence is features, and no --coverage-tree otherwise",
        )
    if coverage_tree is None:
        with stage("semantic_tree", out, settings=section, inputs=inputs) as run:
            run(contributions, masks, out, section, threads)
        return
    of_field = section_of("field", field_settings)
    both = {"semantic_tree": section, "field": of_field}
    with stage("feature_tree", out, settings=both, seed=seed, inputs=inputs) as run:
        run(contributions, masks, coverage_tree, out, section, of_field, seed, threads)


@app.command()
def autoencoder(
    clip: PathIn,
    semantic_tree: PathIn,
    contributions: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    seed: Seed = 0,
) -> None:
    """Fit the compression of a scene's CLIP vectors (PCA or autoencoder), and encode the masks."""
    section = section_of("autoencoder", settings)
    inputs = {"clip": clip, "semantic_tree": semantic_tree, "contributions": contributions}
    with stage("autoencoder", out, settings=section, seed=seed, inputs=inputs) as run:
        run(clip, semantic_tree, contributions, out, section, seed)


@app.command()
def field(
    contributions: PathIn,
    coverage_tree: PathIn,
    autoencoder: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    scene: Annotated[Path | None, typer.Option(help="posed scene, for trainer: literal")] = None,
    gaussians: Annotated[Path | None, typer.Option(help="3DGS PLY, for trainer: literal")] = None,
    masks: Annotated[Path | None, typer.Option(help="masks of the views, for trainer: literal")] = None,
    start: Annotated[Path | None, typer.Option(help="initial field, for start: langsplat")] = None,
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Solve for the language field: regression, L_h, L_ins and L_part over three levels."""
    section = section_of("field", settings)
    inputs = {"contributions": contributions, "coverage_tree": coverage_tree, "autoencoder": autoencoder}
    optional = {"scene": scene, "gaussians": gaussians, "masks": masks, "start": start}
    own_seed = seed if section.is_random else None
    rendered = (scene, gaussians, masks) if scene and gaussians and masks else None
    with stage("field", out, settings=section, seed=own_seed, inputs={**inputs, **optional}) as run:
        run(contributions, coverage_tree, autoencoder, out, section, threads, seed, rendered, start)


@app.command()
def method(
    scene: PathIn,
    gaussians: PathIn,
    masks: PathIn,
    contributions: PathIn,
    autoencoder: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Compute the language field with the baseline selected in the settings."""
    from hilsplat.baselines import method_of
    from hilsplat.methods.method import MethodInputs

    section = section_of("method", settings)
    inputs = {"scene": scene, "gaussians": gaussians, "masks": masks}
    inputs |= {"contributions": contributions, "autoencoder": autoencoder}
    plugins = (method_of(section.name).fit,)
    parts = MethodInputs(scene, gaussians, masks, contributions, autoencoder, threads)
    with stage("method", out, settings=section, seed=seed, inputs=inputs, plugins=plugins) as run:
        run(parts, out, section, seed)


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
    dataset: Annotated[str, typer.Option(help="data set to record in the scores")],
    name: Annotated[str, typer.Option(help="scene to record in the scores")],
    truth: Truth = None,
    labels: Annotated[list[str] | None, typer.Option(help="labels, such as lerf_ovs/figurines")] = None,
    data_root: DataRoot = Path(),
    kind: Kind = "",
    variant: Annotated[str, typer.Option(help="variant to record in the scores")] = "default",
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
    with stage("evaluate", out, settings=section, inputs=inputs, plugins=readers, beside=beside) as run:
        run(parts, out, section, **named, **against, threads=threads)


@app.command("evaluate-files")
def evaluate_files(
    predictions: Annotated[Path, typer.Argument(help="folder of masks or point labels from any program")],
    out: PathOut,
    method: Annotated[str, typer.Option(help="name of the program, for the tables")],
    labels: Annotated[str, typer.Option(help="labels of a data set, such as lerf_ovs/figurines")] = "",
    data_root: DataRoot = Path(),
    truth: Truth = None,
    scene: Annotated[Path | None, typer.Option(help="synthetic scene that lists the test views")] = None,
    kind: Kind = "",
    dataset: Annotated[str, typer.Option(help="data set to record for a synthetic scene")] = "synthetic",
    name: Annotated[str, typer.Option(help="name to record for a synthetic scene")] = "",
    min_region_px: Annotated[
        int | None, typer.Option(min=1, help="minimum area of a scored region in a synthetic scene")
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
    absent: Annotated[list[str] | None, typer.Option(help="an entry that was not measured, and why")] = None,
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
    with stage("figures", out, settings=both, inputs=inputs, plugins=readers, beside=beside) as run:
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
    """Draw a comparison of variants: queries by method, one query in four views, features at three levels."""
    section, protocol = section_of("figures", settings), section_of("evaluate", evaluate)
    compared, named = json_option("--variants", variants, list), json_option("--names", names, dict)
    texts, both = json_option("--queries", queries, list), {"figures": section, "evaluate": protocol}
    against: dict[str, Any] = {"truth": truth, "labels": labels, "data_root": data_root}
    read, readers = _truth_inputs(**against)
    inputs = {f"scores of {variant}": folder / variant / "scores.csv" for variant in compared} | read
    beside = (out.with_name("views.png"), out.with_name("features.png"))
    with stage("comparison", out, settings=both, inputs=inputs, plugins=readers, beside=beside) as run:
        run(folder, compared, named, out, section, protocol, **against, queries=texts, threads=threads)


@app.command()
def sweep(
    name: Annotated[str, typer.Argument(help="theta or omega")],
    table: Annotated[Path, typer.Option(help="CSV of the table")],
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

    echo(run_efficiency(results, out))
