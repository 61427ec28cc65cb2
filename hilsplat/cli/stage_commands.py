"""One command per stage, from poses to fields; `hilsplat.workflow.stages` names the function of each."""

from pathlib import Path
from typing import Annotated

import typer

from hilsplat.base.errors import HilsplatError, SettingsError
from hilsplat.cli.scene_commands import POSES_HELP
from hilsplat.cli.stage import (
    DEFAULT_CACHE,
    Cache,
    Memory,
    PathIn,
    PathOut,
    Seed,
    Settings,
    Threads,
    app,
    model_input,
    section_of,
    stage,
)
from hilsplat.models.store import AUTO

Features = Annotated[Path | None, typer.Option(help="folder of LangSplat's _s.npy and _f.npy, to import")]


@app.command("poses")
def find_poses(
    images: PathIn,
    out: PathOut,
    name: Annotated[str, typer.Option(help="dataset/scene, for messages")] = "scene",
    unit: Annotated[str, typer.Option(help="unit of length: metre or arbitrary")] = "arbitrary",
    render: Annotated[bool, typer.Option(help="the images are renders, with an ideal lens")] = False,
    poses: Annotated[Path | None, typer.Option(help=POSES_HELP)] = None,
    settings: Settings = "{}",
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Compute the camera poses of photographs, or import a COLMAP model or transforms.json."""
    section = section_of("poses", settings)
    inputs = {"images": images, "poses": poses if poses and poses.exists() else None}
    with stage("poses", out, settings=section, seed=seed, threads=threads, inputs=inputs) as run:
        run(images, out, name, unit, render, section, seed, threads, poses)


@app.command()
def gaussians(
    scene: PathIn,
    out: PathOut,
    report: Annotated[Path, typer.Option(help="folder for the fit's report")],
    settings: Settings = "{}",
    existing: Annotated[Path | None, typer.Option(help="3DGS PLY, in the source's coordinates")] = None,
    dataparser: Annotated[
        Path | None,
        typer.Option(help="dataparser_transforms.json, if the PLY is in nerfstudio's coordinates"),
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
    with stage(
        "gaussians", out, settings=section, seed=seed, threads=threads, inputs=inputs, beside=beside
    ) as run:
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
            fix="omit --truth, or set masks.segmenter to truth-perturbed, a diagnostic",
        )
    if is_diagnostic:
        faults = section_of("perturb", perturb)
        read, both = {"scene": scene, "truth": truth}, {"masks": section, "perturb": faults}
        with stage("truth_masks", out, settings=both, seed=faults.seed, threads=threads, inputs=read) as run:
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
        with stage("key_masks", out, settings=section, threads=threads, inputs=inputs) as run:
            run(scene, gaussians, out, cache, section, threads, memory)
        return
    if gaussians and key_masks and semantic_tree:
        inputs |= {"gaussians": gaussians, "key_masks": key_masks, "semantic_tree": semantic_tree}
        with stage("guided_masks", out, settings=section, threads=threads, inputs=inputs) as run:
            run(scene, gaussians, key_masks, semantic_tree, out, cache, section, threads, memory)
        return
    with stage("masks", out, settings=section, threads=threads, inputs=inputs) as run:
        run(scene, out, cache, section, threads, memory)


@app.command("coverage-tree")
def coverage_tree(masks: PathIn, out: PathOut, settings: Settings = "{}") -> None:
    """Compute the parent of each mask: the coverage tree of each view."""
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

    typer.echo(f"wrote {out}, view {masks_overview(scene, masks, out, view, coverage_tree)}")


@app.command()
def names(
    semantic_tree: PathIn,
    clip: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    evaluate: Annotated[str, typer.Option(help="settings of evaluate, as JSON")] = "{}",
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
) -> None:
    """Name the nodes of a semantic tree from a vocabulary."""
    query, protocol = section_of("query", settings), section_of("evaluate", evaluate)
    own = None if query.vocabulary == AUTO else Path(query.vocabulary)
    inputs = {"semantic_tree": semantic_tree, "clip": clip, "vocabulary": own}
    both = {"query": query, "evaluate": protocol}
    with stage("names", out, settings=both, threads=threads, inputs=inputs) as run:
        run(semantic_tree, clip, out, cache, query, protocol, threads)


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
    """Embed the crops that show each node best, or every mask, with CLIP."""
    section = section_of("clip", settings)
    inputs = {"scene": scene, "masks": masks, **model_input(section), "semantic_tree": semantic_tree}
    if features is not None:
        with stage("langsplat", out, settings=section, inputs={**inputs, "features": features}) as files:
            files.read_clip(scene, features, out, section)
        return
    with stage("clip", out, settings=section, threads=threads, inputs=inputs) as run:
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
    with stage("contributions", out, settings=section, threads=threads, inputs=inputs) as run:
        run(scene, gaussians, masks, out, cache, section, threads)


@app.command("semantic-tree")
def semantic_tree(
    contributions: PathIn,
    masks: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    coverage_tree: Annotated[Path | None, typer.Option(help="with evidence: features")] = None,
    field_settings: Annotated[str, typer.Option(help="settings of field, with evidence: features")] = "{}",
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Compute nodes at three levels, by linking masks of all views or clustering Gaussians by features."""
    section = section_of("semantic_tree", settings)
    inputs = {"contributions": contributions, "masks": masks, "coverage_tree": coverage_tree}
    if (section.evidence == "features") != (coverage_tree is not None):
        raise SettingsError(
            "semantic_tree.evidence and the options do not match",
            expected="--coverage-tree only with evidence: features",
        )
    if coverage_tree is None:
        with stage("semantic_tree", out, settings=section, threads=threads, inputs=inputs) as run:
            run(contributions, masks, out, section, threads)
        return
    of_field = section_of("field", field_settings)
    both = {"semantic_tree": section, "field": of_field}
    with stage("feature_tree", out, settings=both, seed=seed, threads=threads, inputs=inputs) as run:
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
    with stage(
        "field", out, settings=section, seed=own_seed, threads=threads, inputs={**inputs, **optional}
    ) as run:
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
    from hilsplat.methods.method import MethodInputs
    from hilsplat.methods.registry import METHODS

    section = section_of("method", settings)
    inputs = {"scene": scene, "gaussians": gaussians, "masks": masks}
    inputs |= {"contributions": contributions, "autoencoder": autoencoder}
    plugins = (METHODS.places[section.name],) if section.name in METHODS else ()
    parts = MethodInputs(scene, gaussians, masks, contributions, autoencoder, threads)
    with stage(
        "method", out, settings=section, seed=seed, threads=threads, inputs=inputs, plugins=plugins
    ) as run:
        run(parts, out, section, seed)
