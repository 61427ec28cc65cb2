"""The pipeline on one page: every stage in the order of the data flow.

A stage's parameters are its inputs (paths of artifacts, named like these), settings and options; `out` is its
output. Where several stages can make one artifact, `when` decides, and the first match counts. To add a
stage, write its function in a module, a definition here, and a rule (docs/extending.md).

Stages of plugins, such as those of the synthetic world, come from entry points of the group
`hilsplat.stages`. Modules of stages are imported when a stage runs.
"""

import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer

from hilsplat import settings as of
from hilsplat.base.artifacts import provenance_path
from hilsplat.base.errors import HilsplatError
from hilsplat.base.plugins import entry_points, name_clash
from hilsplat.baselines import OURS, MethodSettings, method_of
from hilsplat.datasets.registry import DATASETS, readers_of
from hilsplat.models.store import AUTO
from hilsplat.stage import (
    DEFAULT_CACHE,
    Cache,
    DataRoot,
    Memory,
    PathIn,
    PathOut,
    Reads,
    Registry,
    Role,
    Seed,
    Stage,
    Threads,
)

Report = Annotated[Path, typer.Option(help="folder for the fit's report"), Role.OUTPUT]
Truth = Annotated[Path | None, typer.Option(help="annotations of a generated scene"), Role.INPUT]
Source = Annotated[str, typer.Option(help="source of a generated scene, such as world:tabletop:201")]
LabelledScene = Annotated[str, typer.Option(help="labelled scene, such as lerf_ovs/figurines")]
LabelSets = Annotated[list[str] | None, typer.Option(help="labels, such as lerf_ovs/figurines")]
Queries = Annotated[list[str], typer.Option(help="JSON list of queries, if there are no labels"), Role.JSON]
Names = Annotated[dict[str, str], typer.Option(help="JSON: variant -> its name in tables"), Role.JSON]
POSES_HELP = "COLMAP model or transforms.json, or its folder; none: compute poses; default: use any found"

PIPELINE = Registry()
stage = PIPELINE.stage


# ---- photographs to Gaussians --------------------------------------------------------------------


def _source_files(arguments: Mapping[str, Any]) -> Reads:
    from hilsplat.datasets.sources import image_files
    from hilsplat.scene.sheet import DATA_PREFIX

    files = image_files(f"{DATA_PREFIX}{arguments['name']}", str(arguments["data_root"]))
    return Reads({"files": files}, readers_of([arguments["name"]]))


@stage(command="datasets export", scope="scene", reads=_source_files)
def source(
    name: Annotated[str, typer.Argument(help="scene with labelled points, such as scannet/scene0000_00")],
    data_root: DataRoot,
    out: PathOut,
) -> None:
    """Write the images and poses of a scene to a folder that the poses command can import."""
    from hilsplat.datasets.sources import export_images

    export_images(name, data_root, out)


def _photographs(arguments: Mapping[str, Any]) -> Reads:
    """Return the files that are read, because a folder of photographs may contain anything else."""
    from hilsplat.scene.layouts import photo_files

    images, named = arguments["images"], arguments["poses"]
    is_artifact = any(provenance_path(path).is_file() for path in (images, images.parent))
    return Reads({"images": photo_files(images, named)} if images.is_dir() and not is_artifact else {})


@stage(artifact="scene", scope="scene", reads=_photographs)
def poses(
    images: PathIn,
    out: PathOut,
    settings: of.PosesSettings,
    name: Annotated[str, typer.Option(help="name of the scene in messages, as dataset/scene")] = "scene",
    unit: Annotated[str, typer.Option(help="unit of length: metre or arbitrary")] = "arbitrary",
    render: Annotated[bool, typer.Option(help="treat the images as renders with an ideal lens")] = False,
    poses: Annotated[Path | None, typer.Option(help=POSES_HELP)] = None,
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Compute the camera poses of photographs, or import a COLMAP model or transforms.json."""
    from hilsplat.scene.poses import run_poses

    run_poses(images, out, name, unit, render, settings, seed, threads, poses)


@stage(file="gaussians.ply", scope="scene", loop="fit steps", beside=lambda out: (out.with_suffix(".json"),))
def gaussians(
    scene: PathIn,
    out: PathOut,
    report: Report,
    settings: of.GaussiansSettings,
    existing: Annotated[
        Path | None, typer.Option(help="3DGS PLY, in the source's coordinates"), Role.INPUT
    ] = None,
    dataparser: Annotated[
        Path | None,
        typer.Option(help="dataparser_transforms.json, for a PLY in nerfstudio's coordinates"),
        Role.INPUT,
    ] = None,
    transforms: Annotated[
        Path | None, typer.Option(help="transforms.json, for --dataparser"), Role.INPUT
    ] = None,
    cache: Cache = DEFAULT_CACHE,
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Fit 3D Gaussians to the training views, or use your own; a JSON file records their coordinates."""
    from hilsplat.splat.fit import run_gaussians

    run_gaussians(scene, out, report, cache, settings, seed, threads, existing, dataparser, transforms)


# ---- masks, and their trees in each view ---------------------------------------------------------


@stage(artifact="masks", when=lambda scene: scene.is_imported)
def imported_masks(scene: PathIn, features: PathIn, out: PathOut, settings: of.MasksSettings) -> None:
    """Import LangSplat's masks, a folder of _s.npy and _f.npy files; only levels and theta apply."""
    from hilsplat.embed.langsplat_files import run_imported_masks

    run_imported_masks(scene, features, out, settings)


@stage(artifact="masks", loop="masks of views", when=lambda scene: scene.settings.masks.key_views < 1)
def key_masks(
    scene: PathIn,
    gaussians: PathIn,
    out: PathOut,
    settings: of.MasksSettings,
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
    memory: Memory = None,
) -> None:
    """Segment the key views, which together see every Gaussian often enough."""
    from hilsplat.contributions.key_views import key_views
    from hilsplat.scene.scene import Scene
    from hilsplat.segment.stage import run_masks

    views = key_views(Scene.load(scene), gaussians, settings.key_views, threads)
    run_masks(scene, out, cache, settings, threads, memory, views)


@stage(
    artifact="masks",
    loop="masks of views",
    when=lambda scene: scene.is_refined and scene.settings.masks.prompts == "guided",
)
def guided_masks(
    scene: PathIn,
    gaussians: PathIn,
    key_masks: PathIn,
    key_tree: PathIn,
    out: PathOut,
    settings: of.MasksSettings,
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
    memory: Memory = None,
) -> None:
    """Segment the other views with prompts that the masks and the tree of the key views suggest."""
    from hilsplat.semantic_tree.guided_masks import run_guided_masks

    run_guided_masks(scene, gaussians, key_masks, key_tree, out, cache, settings, threads, memory)


@stage(loop="masks of views")
def masks(
    scene: PathIn,
    out: PathOut,
    settings: of.MasksSettings,
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
    memory: Memory = None,
) -> None:
    """Segment each training view at three levels."""
    from hilsplat.segment.stage import run_masks

    run_masks(scene, out, cache, settings, threads, memory)


@stage()
def coverage_tree(masks: PathIn, out: PathOut, settings: of.CoverageTreeSettings) -> None:
    """Compute each view's coverage tree: the parent of each mask."""
    from hilsplat.segment.coverage import run_coverage_tree

    run_coverage_tree(masks, out, settings)


# ---- the tree of nodes in 3D, and its vectors ----------------------------------------------------


@stage(loop="contributions of views")
def contributions(
    scene: PathIn,
    gaussians: PathIn,
    masks: PathIn,
    out: PathOut,
    settings: of.ContributionsSettings,
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
    memory: Memory = None,
) -> None:
    """Compute the weight of each Gaussian in each mask, in one pass over the views."""
    from hilsplat.contributions.stage import run_contributions

    run_contributions(scene, gaussians, masks, out, cache, settings, threads, memory)


@stage(artifact="semantic_tree", when=lambda scene: scene.settings.semantic_tree.evidence == "features")
def feature_tree(
    contributions: PathIn,
    masks: PathIn,
    coverage_tree: PathIn,
    out: PathOut,
    settings: of.SemanticTreeSettings,
    field_settings: of.FieldSettings,
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Compute nodes at three levels, by clustering Gaussians by features."""
    from hilsplat.methods.feature_tree import run_feature_tree

    run_feature_tree(contributions, masks, coverage_tree, out, settings, field_settings, seed, threads)


@stage()
def semantic_tree(
    contributions: PathIn,
    masks: PathIn,
    out: PathOut,
    settings: of.SemanticTreeSettings,
    threads: Threads = 1,
    memory: Memory = None,
) -> None:
    """Compute nodes at three levels, by linking masks across views."""
    from hilsplat.semantic_tree.build import run_semantic_tree

    run_semantic_tree(contributions, masks, out, settings, threads, memory_mib=memory)


@stage(artifact="clip", when=lambda scene: scene.is_imported)
def imported_clip(
    scene: PathIn,
    masks: PathIn,
    features: PathIn,
    out: PathOut,
    settings: of.ClipSettings,
    levels: of.MasksSettings,
) -> None:
    """Import LangSplat's CLIP vectors, a folder of _s.npy and _f.npy files."""
    from hilsplat.embed.langsplat_files import run_imported_clip

    run_imported_clip(scene, features, out, settings, levels)


@stage(loop="CLIP of views")
def clip(
    scene: PathIn,
    masks: PathIn,
    out: PathOut,
    settings: of.ClipSettings,
    semantic_tree: Annotated[
        Path | None,
        typer.Option(help="tree whose nodes select the crops; default: embed every mask"),
        Role.INPUT,
    ] = None,
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
    memory: Memory = None,
) -> None:
    """Embed the best crops of each node, or every mask, with CLIP."""
    from hilsplat.embed.stage import run_clip

    run_clip(scene, masks, semantic_tree, out, cache, settings, threads, memory)


def _vocabulary(arguments: Mapping[str, Any]) -> Reads:
    named = arguments["settings"].vocabulary
    return Reads({} if named == AUTO else {"vocabulary": Path(named)})


@stage(reads=_vocabulary)
def names(
    semantic_tree: PathIn,
    clip: PathIn,
    out: PathOut,
    settings: of.QuerySettings,
    evaluate: of.EvaluateSettings,
    cache: Cache = DEFAULT_CACHE,
) -> None:
    """Name the nodes of a semantic tree from a vocabulary."""
    from hilsplat.query.node_names import run_names

    run_names(semantic_tree, clip, out, cache, settings, evaluate)


def _blocks(arguments: Mapping[str, Any]) -> Reads:
    from hilsplat.scene.blocks import BLOCKS
    from hilsplat.semantic_tree.joined import inputs_of

    files = {folder.name: inputs_of(folder) for folder in arguments["finished"]}
    return Reads({BLOCKS: arguments["blocks"] / BLOCKS, **files})


@stage(
    command="",
    file="semantic_tree",
    loop="shared views",
    reads=_blocks,
    beside=lambda out: (
        *(out.parent.parent / name for name in ("scene", "gaussians.ply", "gaussians.json")),
        *(out.with_name(name) for name in ("masks", "clip")),
    ),
)
def joined(blocks: Path, scene: PathIn, finished: Sequence[Path], out: PathOut) -> None:
    """Join the finished blocks of a scene: Gaussians, masks, vectors and nodes."""
    from hilsplat.semantic_tree.joined import run_joined

    run_joined(blocks, scene, finished, out)


# ---- the language field --------------------------------------------------------------------------


@stage()
def autoencoder(
    clip: PathIn,
    semantic_tree: PathIn,
    contributions: PathIn,
    out: PathOut,
    settings: of.AutoencoderSettings,
    code: Annotated[
        Path | None, typer.Option(help="output of this stage whose code encodes the masks"), Role.INPUT
    ] = None,
    seed: Seed = 0,
) -> None:
    """Fit the compression of a scene's CLIP vectors (PCA or autoencoder), and encode the masks."""
    from hilsplat.field.autoencoder import run_autoencoder

    run_autoencoder(clip, semantic_tree, contributions, out, settings, seed, code)


def _baseline(arguments: Mapping[str, Any]) -> Reads:
    return Reads(plugins=(method_of(arguments["settings"].name).fit,))


@stage(
    artifact="field",
    file="field.safetensors",
    when=lambda scene: scene.settings.method.name != OURS,
    reads=_baseline,
)
def method(
    scene: PathIn,
    gaussians: PathIn,
    masks: PathIn,
    contributions: PathIn,
    autoencoder: PathIn,
    coverage_tree: PathIn,
    out: PathOut,
    settings: MethodSettings,
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Compute the language field with the baseline selected in the settings."""
    from hilsplat.methods.method import MethodInputs, run_method

    inputs = MethodInputs(scene, gaussians, masks, contributions, autoencoder, coverage_tree, threads)
    run_method(inputs, out, settings, seed)


@stage(file="field.safetensors")
def field(
    contributions: PathIn,
    coverage_tree: PathIn,
    autoencoder: PathIn,
    out: PathOut,
    settings: of.FieldSettings,
    start: Annotated[
        Path | None, typer.Option(help="initial field, for start: langsplat"), Role.INPUT
    ] = None,
    seed: Seed = 0,
    threads: Threads = 1,
    memory: Memory = None,
) -> None:
    """Solve for the language field: regression, L_h, L_ins and L_part over three levels."""
    from hilsplat.field.field import run_field

    run_field(contributions, coverage_tree, autoencoder, out, settings, threads, seed, start, memory)


# ---- evaluation, the only stages that read annotations -------------------------------------------


def _labels(arguments: Mapping[str, Any]) -> Reads:
    from hilsplat.datasets.sources import label_files

    labels = arguments["labels"] or ()
    named = [labels] if isinstance(labels, str) else list(labels)
    files = {f"labels {name}": label_files(name, str(arguments["data_root"])) for name in named}
    return Reads(files, readers_of([*named, arguments.get("source", "")]))


@stage(
    file="scores.csv",
    loop="views scored",
    reads=_labels,
    beside=lambda out: (out.with_name("times.csv"), out.with_name("instances.npz")),
)
def evaluate(
    scene: PathIn,
    gaussians: PathIn,
    semantic_tree: PathIn,
    field: PathIn,
    autoencoder: PathIn,
    clip: PathIn,
    masks: PathIn,
    out: PathOut,
    settings: of.EvaluateSettings,
    dataset: Annotated[str, typer.Option(help="data set to record in the scores")],
    name: Annotated[str, typer.Option(help="scene to record in the scores")],
    variant: Annotated[str, typer.Option(help="variant to record in the scores")] = "default",
    truth: Truth = None,
    source: Source = "",
    labels: LabelSets = None,
    data_root: DataRoot = Path(),
    threads: Threads = 1,
) -> None:
    """Query every annotated text in every test view, or every labelled view, and score the answers."""
    from hilsplat.evaluate.stage import run_evaluate
    from hilsplat.scene.finished import SceneParts

    run_evaluate(
        SceneParts(scene, gaussians, semantic_tree, field, autoencoder, clip, masks),
        out,
        settings,
        dataset=dataset,
        scene=name,
        variant=variant,
        truth=truth,
        source=source,
        labels=labels or (),
        data_root=data_root,
        threads=threads,
    )


@stage(scope="scene", file="scores.md", beside=lambda out: (out.with_suffix(".csv"),))
def score_means(
    scores: Annotated[list[Path], typer.Argument(help="scores.csv of each variant"), Role.INPUT],
    out: Annotated[Path, typer.Option(help="Markdown to write, with a CSV beside it"), Role.OUTPUT],
    names: Names,
) -> None:
    """Average a scene's scores by method and protocol."""
    from hilsplat.evaluate.tables.means import run_score_means

    run_score_means(scores, names, out)


@stage(scope="run", reads=_labels, beside=lambda out: (out.with_suffix(".instances.npz"),))
def evaluate_files(
    predictions: Annotated[
        Path, typer.Argument(help="folder of masks or point labels from any program"), Role.INPUT
    ],
    out: PathOut,
    method: Annotated[str, typer.Option(help="name of the program, for the tables")],
    labels: LabelledScene = "",
    data_root: DataRoot = Path(),
    truth: Truth = None,
    scene: Annotated[
        Path | None, typer.Option(help="generated scene that lists the test views"), Role.INPUT
    ] = None,
    source: Source = "",
    dataset: Annotated[str, typer.Option(help="data set to record for a generated scene")] = "synthetic",
    name: Annotated[str, typer.Option(help="name to record for a generated scene")] = "",
    min_region_px: Annotated[
        int | None, typer.Option(min=1, help="minimum area of a scored region in a generated scene")
    ] = None,
) -> str:
    """Score masks or point labels written by any program, and print the mean under each protocol."""
    from hilsplat.evaluate.files_stage import run_evaluate_files

    return run_evaluate_files(
        predictions,
        out,
        method=method,
        labels=labels,
        data_root=data_root,
        truth=truth,
        scene=scene,
        source=source,
        dataset=dataset,
        name=name,
        min_region_px=min_region_px,
    )


@stage(command="", reads=_labels)
def label_fits(
    scene: PathIn,
    gaussians: PathIn,
    masks: PathIn,
    semantic_tree: PathIn,
    out: PathOut,
    labels: LabelledScene,
    data_root: DataRoot = Path(),
    threads: Threads = 2,
) -> str:
    """Measure how well masks and nodes fit annotated regions, by level and without queries."""
    from hilsplat.evaluate.label_fits import run_label_fits

    return run_label_fits(scene, gaussians, masks, semantic_tree, labels, data_root, out, threads)


# ---- tables and pictures -------------------------------------------------------------------------


@stage(
    scope="run",
    reads=lambda arguments: Reads(plugins=readers_of(DATASETS)),  # their lists of scenes
    beside=lambda out: tuple(map(out.with_suffix, (".md", ".tex", ".html"))),
)
def table(
    name: Annotated[str, typer.Argument(help="table: hierarchy, lerf, ablation, ... (docs/tables.md)")],
    published: PathIn,
    out: Annotated[
        Path, typer.Option(help="CSV to write, with .md, .tex and .html files beside it"), Role.OUTPUT
    ],
    labels: Names,
    scores: Annotated[
        list[Path] | None, typer.Argument(help="scores.csv of each scene and variant"), Role.INPUT
    ] = None,
    absent: Annotated[list[str] | None, typer.Option(help="an entry that was not measured, and why")] = None,
) -> None:
    """Build one table of the paper, with reported, measured and stand-in rows."""
    from hilsplat.evaluate.tables.build import run_table

    run_table(name, scores or [], published, labels, out, absent or [])


@stage(
    scope="scene",
    reads=_labels,
    beside=lambda out: (out.with_name("registration.webp"), out.with_name("fit.webp")),
)
def figures(
    scene: PathIn,
    gaussians: PathIn,
    fit: Annotated[Path, typer.Option(help="folder of the fit's report"), Role.INPUT],
    masks: PathIn,
    clip: PathIn,
    semantic_tree: PathIn,
    field: PathIn,
    autoencoder: PathIn,
    out: Annotated[
        Path, typer.Option(help="WebP to write, with registration.webp and fit.webp beside it"), Role.OUTPUT
    ],
    settings: of.FiguresSettings,
    evaluate: of.EvaluateSettings,
    queries: Queries,
    truth: Truth = None,
    labels: LabelledScene = "",
    data_root: DataRoot = Path(),
    threads: Threads = 1,
) -> None:
    """Draw the panel of a scene: photograph, masks, field, relevancy, answers, ground truth."""
    from hilsplat.evaluate.figures.panel import run_figures
    from hilsplat.scene.finished import SceneParts

    run_figures(
        SceneParts(scene, gaussians, semantic_tree, field, autoencoder, clip, masks),
        out,
        settings,
        evaluate,
        fit=fit,
        truth=truth,
        labels=labels,
        data_root=data_root,
        queries=queries,
        threads=threads,
    )


@stage(
    scope="scene",
    loop="variants compared",
    reads=_labels,
    beside=lambda out: (out.with_name("views.webp"), out.with_name("features.webp")),
)
def comparison(
    folder: Annotated[Path, typer.Option(help="finished scene, results/<dataset>/<scene>")],
    scores: Annotated[list[Path], typer.Option(help="scores.csv of each variant to compare"), Role.INPUT],
    out: Annotated[
        Path,
        typer.Option(help="WebP to write, with views.webp, features.webp and PDFs beside it"),
        Role.OUTPUT,
    ],
    names: Names,
    settings: of.FiguresSettings,
    evaluate: of.EvaluateSettings,
    queries: Queries,
    truth: Truth = None,
    labels: LabelledScene = "",
    data_root: DataRoot = Path(),
    threads: Threads = 1,
) -> None:
    """Draw a comparison of variants: queries by method, one query in four views, features at three levels."""
    from hilsplat.evaluate.figures.comparison import run_comparison

    run_comparison(
        folder,
        [path.parent.name for path in scores],
        names,
        out,
        settings,
        evaluate,
        truth=truth,
        labels=labels,
        data_root=data_root,
        queries=queries,
        threads=threads,
    )


@stage(scope="run")
def sweep_plot(
    name: Annotated[str, typer.Argument(help="theta or omega")],
    table: Annotated[Path, typer.Option(help="CSV of the table"), Role.INPUT],
    out: Annotated[Path, typer.Option(help="PNG to write, with a PDF beside it"), Role.OUTPUT],
) -> None:
    """Plot a sweep from its table: the paper's curves and ours."""
    from hilsplat.evaluate.figures.sweep_plot import run_sweep_plot

    run_sweep_plot(name, table, out)


@stage(scope="run", beside=lambda out: (out.with_suffix(".md"),))
def efficiency(
    out: Annotated[
        Path,
        typer.Option(help="CSV to write to the results folder of a run, with .md beside it"),
        Role.OUTPUT,
    ] = Path("results/efficiency.csv"),
) -> str:
    """Print the time of each stage, from the benchmark files of a run."""
    from hilsplat.evaluate.costs import run_efficiency

    return run_efficiency(out.parent, out)


def kinds_of(artifact: str) -> list[Stage[..., Any]]:
    """Return the stages that can make an artifact, in the order in which their conditions count."""
    return [stage for stage in all_stages().values() if stage.artifact == artifact]


def family_of(stage: Stage[..., Any]) -> str:
    """Return the name of the stage that makes an artifact if no condition of others holds."""
    return kinds_of(stage.artifact)[-1].name


@cache
def all_stages() -> dict[str, Stage[..., Any]]:
    """Return the stages of plugins and of this module, by name."""
    found, packages = dict[str, Stage[..., Any]](), dict.fromkeys(PIPELINE.stages, "hilsplat")
    for plugin, registry in entry_points("hilsplat.stages", Registry).items():
        for name, stage in registry.stages.items():
            if packages.setdefault(name, plugin) != plugin:
                raise name_clash("hilsplat.stages", name, packages[name], plugin)
            found[name] = stage
    return found | PIPELINE.stages


def stage_of(name: str) -> Stage[..., Any]:
    """Return a stage by name; raise HilsplatError if there is none."""
    if name not in all_stages():
        raise HilsplatError(f"unknown stage {name!r}", expected=f"one of {', '.join(all_stages())}")
    return all_stages()[name]


def stages_of_file(path: Path) -> list[str]:
    """Return the stages that run again after an edit of a file: those that import its module."""
    module = ".".join(path.with_suffix("").parts)
    return [stage.name for stage in all_stages().values() if module in stage.modules()]


if __name__ == "__main__":
    print(*stages_of_file(Path(sys.argv[1])), sep="\n")  # noqa: T201
