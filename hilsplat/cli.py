"""The `hilsplat` command: one subcommand per stage, plus new, query, world show, models, datasets.

A stage here is thin: it reads its settings, takes the lock of its output, calls one function of the
package and writes the provenance. Heavy libraries are imported by the functions, not by this file.
"""

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

# Linear algebra libraries sum in another order for another number of threads. Stages that use
# several cores do so through numba or pools of our own, whose results do not depend on it.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import typer  # noqa: E402

from hilsplat.base.artifacts import output_lock, require_free_space  # noqa: E402
from hilsplat.base.errors import HilsplatError  # noqa: E402

app = typer.Typer(
    help="Photographs in, a 3D Gaussian scene out that answers text queries at three semantic levels.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
world_app = typer.Typer(help="The synthetic world.", no_args_is_help=True)
models_app = typer.Typer(help="Model folders (SAM, CLIP).", no_args_is_help=True)
datasets_app = typer.Typer(
    help="Benchmarks: layouts, licences, and what is there of them.", no_args_is_help=True
)
app.add_typer(world_app, name="world")
app.add_typer(models_app, name="models")
cache_app = typer.Typer(help="Caches of finished views.", invoke_without_command=True)
langsplat_app = typer.Typer(help="LangSplat's files of masks and CLIP vectors.", no_args_is_help=True)
app.add_typer(datasets_app, name="datasets")
app.add_typer(cache_app, name="cache")
app.add_typer(langsplat_app, name="langsplat")

PathIn = Annotated[Path, typer.Option(help="input", show_default=False)]
PathOut = Annotated[Path, typer.Option(help="output; written atomically", show_default=False)]
Settings = Annotated[str, typer.Option(help="the stage's settings as JSON; missing keys take their defaults")]
Threads = Annotated[int, typer.Option(min=1, help="threads; results do not depend on it")]
Seed = Annotated[int, typer.Option(min=0, help="seed of everything random")]
Log = Annotated[Path | None, typer.Option(help="also write the log to this file")]
Cache = Annotated[Path, typer.Option(help="folder of finished views, for resuming")]

DEFAULT_CACHE = Path("results/.cache")
MIN_FREE_MIB = 200.0
"""A stage does not begin with less free space than this."""

STAGE_MODULES: dict[str, str] = {
    "world": "hilsplat.world.stage",
    "source": "hilsplat.datasets.sources",
    "poses": "hilsplat.scene.poses",
    "gaussians": "hilsplat.splat.fit",
    "masks": "hilsplat.segment.stage",
    "truth_masks": "hilsplat.datasets.truth_masks",
    "tree": "hilsplat.segment.tree_stage",
    "clip": "hilsplat.language.clip_stage",
    "langsplat": "hilsplat.language.langsplat_files",
    "contributions": "hilsplat.language.contributions",
    "semantic_tree": "hilsplat.language.semantic_tree",
    "autoencoder": "hilsplat.language.autoencoder",
    "language": "hilsplat.language.field",
    "reference": "hilsplat.language.reference",
    "method": "hilsplat.methods.stage",
    "evaluate": "hilsplat.evaluate.stage",
    "tables": "hilsplat.evaluate.tables.build",
    "efficiency": "hilsplat.evaluate.efficiency",
    "figures": "hilsplat.evaluate.figures",
    "comparison": "hilsplat.evaluate.comparison",
    "sweep": "hilsplat.evaluate.sweep_plot",
    "consistency": "hilsplat.evaluate.world_consistency",
    "tree_truth": "hilsplat.evaluate.tree_truth",
    "models": "hilsplat.world.tiny.train",
}
"""Module of each stage, whose import closure is the stage's code (see `base.code_hash`)."""


def main() -> None:
    """Run the command; a mistake a user can fix is told in a sentence, without a traceback."""
    try:
        app()
    except HilsplatError as error:
        logging.getLogger("hilsplat").error("%s", error)
        sys.exit(1)


def start_logging(log: Path | None) -> None:
    """Send log records to the terminal (short) and, where given, to a file (with times)."""
    root = logging.getLogger()
    root.setLevel(logging.INFO)
    root.handlers.clear()
    terminal = logging.StreamHandler(sys.stderr)
    terminal.setFormatter(logging.Formatter("%(message)s"))
    root.addHandler(terminal)
    if log is not None:
        log.parent.mkdir(parents=True, exist_ok=True)
        file = logging.FileHandler(log, mode="w", encoding="utf-8")
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        root.addHandler(file)
    for noisy in ("matplotlib", "numba", "PIL", "fontTools"):
        logging.getLogger(noisy).setLevel(logging.WARNING)


@contextmanager
def stage(
    name: str,
    out: Path,
    log: Path | None,
    *,
    settings: Any = None,
    seed: int | None = None,
    threads: int = 1,
    inputs: dict[str, Path] | None = None,
) -> Iterator[None]:
    """Everything around a stage's one function call: log, lock, disk space, provenance."""
    from hilsplat.base.code_hash import code_hash
    from hilsplat.base.provenance import write_provenance

    start_logging(log)
    os.environ["NUMBA_NUM_THREADS"] = str(max(threads, int(os.environ.get("NUMBA_NUM_THREADS", "1"))))
    try:
        for what, path in (inputs or {}).items():
            if not path.exists():
                raise HilsplatError(
                    f"{name}: input {what} is missing: {path}", fix="run the stage that writes it"
                )
        require_free_space(out.parent, MIN_FREE_MIB)
        with output_lock(out):
            yield
            write_provenance(
                out,
                stage=name,
                code=code_hash(STAGE_MODULES[name]),
                command=["hilsplat", *sys.argv[1:]],
                settings=settings.model_dump(mode="json") if settings is not None else {},
                seed=seed,
                inputs=inputs or {},
            )
    except HilsplatError:
        raise
    except Exception:  # a mistake of ours: the traceback belongs into the log
        logging.getLogger("hilsplat").exception("%s failed on %s", name, out)
        sys.exit(1)


def _section(name: str, text: str) -> Any:
    from hilsplat.settings import parse_section

    return parse_section(name, text)


@app.callback(invoke_without_command=True)
def version(
    show: Annotated[bool, typer.Option("--version", help="print the version and exit")] = False,
) -> None:
    """Print the version, where asked."""
    if show:
        from hilsplat.base.provenance import library_versions

        typer.echo(f"hilsplat {library_versions()['hilsplat']}")
        raise typer.Exit


@world_app.command("make")
def world_make(
    source: Annotated[str, typer.Option(help="what to make, as world:KIND:SEED")],
    out: PathOut,
    settings: Settings = "{}",
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Make a synthetic scene: images, and the truth that only evaluate reads."""
    section = _section("world", settings)
    with stage("world", out, log, settings=section, threads=threads):
        from hilsplat.world.stage import run_world

        run_world(source, section, out, threads)


@app.command()
def poses(
    images: PathIn,
    out: PathOut,
    name: Annotated[str, typer.Option(help="dataset/scene, for messages")] = "scene",
    unit: Annotated[str, typer.Option(help="what one length unit is: metre or arbitrary")] = "arbitrary",
    render: Annotated[bool, typer.Option(help="the images are renders: an ideal pinhole lens")] = False,
    settings: Settings = "{}",
    seed: Seed = 0,
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Find the cameras of photographs (or import a COLMAP model or transforms.json)."""
    section = _section("poses", settings)
    with stage("poses", out, log, settings=section, seed=seed, threads=threads, inputs={"images": images}):
        from hilsplat.scene.poses import run_poses

        run_poses(images, out, name, unit, render, section, seed, threads)


@app.command()
def gaussians(
    scene: PathIn,
    out: PathOut,
    report: Annotated[Path, typer.Option(help="folder of the fit's report")],
    settings: Settings = "{}",
    brought: Annotated[
        Path | None, typer.Option(help="somebody's 3DGS PLY in the source's coordinates; skips the fit")
    ] = None,
    cache: Cache = DEFAULT_CACHE,
    seed: Seed = 0,
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Fit 3D Gaussians to the training views, or take somebody's; the JSON beside them holds coordinates."""
    section = _section("gaussians", settings)
    inputs = {"scene": scene, **({"brought": brought} if brought else {})}
    with stage("gaussians", out, log, settings=section, seed=seed, threads=threads, inputs=inputs):
        from hilsplat.splat.fit import run_gaussians

        run_gaussians(scene, out, report, cache, section, seed, threads, brought)


@app.command()
def masks(
    scene: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    truth: Annotated[
        Path | None, typer.Option(help="truth folder; for the segmenter truth-perturbed alone")
    ] = None,
    perturb: Annotated[str, typer.Option(help="faults of truth-perturbed as JSON")] = "{}",
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Segment each training view at three levels."""
    section = _section("masks", settings)
    if section.segmenter == "truth-perturbed":
        _masks_from_truth(scene, truth, out, section, _section("perturb", perturb), threads, log)
        return
    if truth is not None:
        raise HilsplatError(
            f"masks: the segmenter {section.segmenter} must not see the truth",
            found=f"--truth {truth}",
            fix="leave --truth out, or set masks.segmenter: truth-perturbed, a diagnostic",
        )
    with stage("masks", out, log, settings=section, threads=threads, inputs={"scene": scene}):
        from hilsplat.segment.stage import run_masks

        run_masks(scene, out, cache, section, threads)


def _masks_from_truth(
    scene: Path, truth: Path | None, out: Path, section: Any, faults: Any, threads: int, log: Path | None
) -> None:
    """The diagnostic segmenter, a stage of its own in provenance and code."""
    if truth is None:
        raise HilsplatError(
            "masks: the segmenter truth-perturbed needs the true labels of a synthetic scene",
            expected="--truth results/<dataset>/<scene>/world/truth",
            fix="name the folder, or take masks.segmenter: sam or graph",
        )
    inputs = {"scene": scene, "truth": truth}
    with stage("truth_masks", out, log, settings=faults, seed=faults.seed, threads=threads, inputs=inputs):
        from hilsplat.datasets.truth_masks import run_truth_masks

        run_truth_masks(scene, truth, out, faults, section.min_area_px, threads)


@app.command()
def tree(masks: PathIn, out: PathOut, settings: Settings = "{}", log: Log = None) -> None:
    """Find the parent of each mask (coverage tree of each view)."""
    section = _section("tree", settings)
    with stage("tree", out, log, settings=section, inputs={"masks": masks}):
        from hilsplat.segment.tree_stage import run_tree

        run_tree(masks, out, section)


@app.command("show-masks")
def show_masks(
    scene: PathIn,
    masks: PathIn,
    out: Annotated[Path, typer.Option(help="PNG to write; trees go beside it")] = Path("masks.png"),
    tree: Annotated[Path | None, typer.Option(help="what the tree stage wrote; draws the trees too")] = None,
    view: Annotated[str | None, typer.Option(help="view name; default: the middle one")] = None,
) -> None:
    """Write a picture of a view's masks at three levels, and of its coverage trees."""
    start_logging(None)
    from hilsplat.segment.pictures import masks_overview

    typer.echo(f"wrote {out}, view {masks_overview(scene, masks, out, view, tree)}")


@app.command()
def clip(
    scene: PathIn,
    masks: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Embed each mask with CLIP."""
    section = _section("clip", settings)
    inputs = {"scene": scene, "masks": masks}
    with stage("clip", out, log, settings=section, threads=threads, inputs=inputs):
        from hilsplat.language.clip_stage import run_clip

        run_clip(scene, masks, out, cache, section, threads)


@app.command()
def contributions(
    scene: PathIn,
    gaussians: PathIn,
    masks: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Weights of each Gaussian in each mask, from one pass over the views."""
    section = _section("contributions", settings)
    inputs = {"scene": scene, "gaussians": gaussians, "masks": masks}
    with stage("contributions", out, log, settings=section, threads=threads, inputs=inputs):
        from hilsplat.language.contributions import run_contributions

        run_contributions(scene, gaussians, masks, out, cache, section, threads)


@app.command("semantic-tree")
def semantic_tree(
    contributions: PathIn,
    masks: PathIn,
    clip: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Link the masks of all views into nodes at three levels."""
    section = _section("semantic_tree", settings)
    inputs = {"contributions": contributions, "masks": masks, "clip": clip}
    with stage("semantic_tree", out, log, settings=section, threads=threads, inputs=inputs):
        from hilsplat.language.semantic_tree import run_semantic_tree

        run_semantic_tree(contributions, masks, clip, out, section, threads)


@app.command()
def autoencoder(
    clip: PathIn,
    semantic_tree: PathIn,
    contributions: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    seed: Seed = 0,
    log: Log = None,
) -> None:
    """Train the scene's autoencoder of CLIP vectors and encode the masks."""
    section = _section("autoencoder", settings)
    inputs = {"clip": clip, "semantic_tree": semantic_tree, "contributions": contributions}
    with stage("autoencoder", out, log, settings=section, seed=seed, inputs=inputs):
        from hilsplat.language.autoencoder import run_autoencoder

        run_autoencoder(clip, semantic_tree, contributions, out, section, seed)


@app.command()
def language(
    contributions: PathIn,
    tree: PathIn,
    autoencoder: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    seed: Seed = 0,
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Train the language field: regression, L_h, L_ins and L_part over three levels."""
    section = _section("language", settings)
    inputs = {"contributions": contributions, "tree": tree, "autoencoder": autoencoder}
    with stage("language", out, log, settings=section, seed=seed, threads=threads, inputs=inputs):
        from hilsplat.language.field import run_language

        run_language(contributions, tree, autoencoder, out, section, seed, threads)


@app.command("language-reference")
def language_reference(
    scene: PathIn,
    gaussians: PathIn,
    masks: PathIn,
    contributions: PathIn,
    autoencoder: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    device: Annotated[str, typer.Option(help="what rasterises: auto, cpu or cuda")] = "auto",
    seed: Seed = 0,
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Train a field by rendering one random view per step: what the solver is compared with; slow."""
    section = _section("reference", settings)
    inputs = {
        "scene": scene,
        "gaussians": gaussians,
        "masks": masks,
        "contributions": contributions,
        "autoencoder": autoencoder,
    }
    with stage("reference", out, log, settings=section, seed=seed, threads=threads, inputs=inputs):
        from hilsplat.language.reference import run_reference

        run_reference(
            scene, gaussians, masks, contributions, autoencoder, out, section, device, seed, threads
        )


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
    log: Log = None,
) -> None:
    """Let a baseline write the language field: langsplat, lifted (settings: name)."""
    section = _section("method", settings)
    inputs = {"scene": scene, "gaussians": gaussians, "masks": masks}
    inputs |= {"contributions": contributions, "autoencoder": autoencoder}
    with stage("method", out, log, settings=section, seed=seed, threads=threads, inputs=inputs):
        from hilsplat.methods.method import MethodInputs
        from hilsplat.methods.stage import run_method

        parts = MethodInputs(scene, gaussians, masks, contributions, autoencoder, threads)
        run_method(parts, out, section, seed)


@app.command()
def evaluate(
    scene: PathIn,
    gaussians: PathIn,
    semantic_tree: PathIn,
    language: PathIn,
    autoencoder: PathIn,
    clip: PathIn,
    masks: PathIn,
    out: PathOut,
    dataset: Annotated[str, typer.Option(help="data set, for the rows")],
    name: Annotated[str, typer.Option(help="scene, for the rows")],
    truth: Annotated[Path | None, typer.Option(help="annotations of a synthetic scene")] = None,
    labels: Annotated[
        list[str] | None, typer.Option(help="or labels of published data sets, as lerf_ovs/figurines")
    ] = None,
    data_root: Annotated[Path, typer.Option(help="folder of the data sets' folders")] = Path(),
    kind: Annotated[
        str, typer.Option(help="kind of a synthetic scene, tabletop, room or street: what it stands in for")
    ] = "",
    variant: Annotated[str, typer.Option(help="variant, for the rows")] = "default",
    settings: Settings = "{}",
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Ask every annotated text in every test view, or every labelled one, and score the answers."""
    section = _section("evaluate", settings)
    inputs = {
        "scene": scene,
        **({"truth": truth} if truth else {}),
        "gaussians": gaussians,
        "semantic_tree": semantic_tree,
        "language": language,
        "autoencoder": autoencoder,
        "clip": clip,
        "masks": masks,
    }
    with stage("evaluate", out, log, settings=section, threads=threads, inputs=inputs):
        from hilsplat.evaluate.asked import Asked
        from hilsplat.evaluate.stage import run_evaluate

        run_evaluate(
            labels=[Asked.open(name, data_root) for name in labels or ()],
            asked=Asked.of_world(kind),
            scene_folder=scene,
            truth=truth,
            gaussians=gaussians,
            semantic_tree=semantic_tree,
            language=language,
            autoencoder=autoencoder,
            clip_folder=clip,
            masks_folder=masks,
            out=out,
            settings=section,
            dataset=dataset,
            scene=name,
            variant=variant,
            threads=threads,
        )


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
    with stage("tables", out, log, inputs=inputs):
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
    language: PathIn,
    autoencoder: PathIn,
    out: Annotated[Path, typer.Option(help="panel PNG; registration.png and fit.png go beside it")],
    truth: Annotated[Path | None, typer.Option(help="truth folder, where the scene has one")] = None,
    labels: Annotated[str, typer.Option(help="or a labelled scene, as lerf_ovs/figurines")] = "",
    data_root: Annotated[Path, typer.Option(help="folder of the data sets' folders")] = Path(),
    queries: Annotated[str, typer.Option(help="JSON list of texts, where the scene has no labels")] = "[]",
    settings: Settings = "{}",
    evaluate: Settings = "{}",
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Draw a scene's panel: photograph, masks, field, relevancy, answers, truth."""
    import json
    import shutil

    from hilsplat.base.artifacts import atomic_path

    section, protocol = _section("figures", settings), _section("evaluate", evaluate)
    inputs = {"scene": scene, "gaussians": gaussians, "masks": masks, "language": language}
    with stage("figures", out, log, settings=section, threads=threads, inputs=inputs):
        from hilsplat.datasets.registry import open_labelled
        from hilsplat.evaluate.figures import run_figures

        for source, name in (
            (scene / "registration.png", "registration.png"),
            (fit / "test_views.png", "fit.png"),
        ):
            with atomic_path(out.with_name(name)) as temporary:
                shutil.copyfile(source, temporary)
        run_figures(
            scene_folder=scene,
            truth=truth,
            masks_folder=masks,
            gaussians=gaussians,
            semantic_tree=semantic_tree,
            language=language,
            autoencoder=autoencoder,
            clip_folder=clip,
            out=out,
            settings=section,
            evaluate=protocol,
            queries=json.loads(queries),
            threads=threads,
            labels=open_labelled(labels, data_root) if labels else None,
        )


@app.command()
def comparison(
    folder: Annotated[Path, typer.Option(help="results/<dataset>/<scene>, finished", show_default=False)],
    variants: Annotated[str, typer.Option(help="JSON list of variants that are compared")],
    out: Annotated[Path, typer.Option(help="PNG; views.png, features.png and PDFs are written beside it")],
    names: Annotated[str, typer.Option(help="JSON: how figures name a variant")] = "{}",
    truth: Annotated[Path | None, typer.Option(help="truth folder, where the scene has one")] = None,
    labels: Annotated[str, typer.Option(help="or a labelled scene, as lerf_ovs/figurines")] = "",
    data_root: Annotated[Path, typer.Option(help="folder of the data sets' folders")] = Path(),
    queries: Annotated[str, typer.Option(help="JSON list of texts, where the scene has no labels")] = "[]",
    settings: Settings = "{}",
    evaluate: Settings = "{}",
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Draw queries by method, one query over four views, and features at three levels."""
    import json

    section, protocol = _section("figures", settings), _section("evaluate", evaluate)
    with stage("comparison", out, log, settings=section, threads=threads):
        from hilsplat.datasets.registry import open_labelled
        from hilsplat.evaluate.comparison import run_comparison

        run_comparison(
            folder,
            json.loads(variants),
            json.loads(names),
            out,
            section,
            protocol,
            truth=truth,
            labels=open_labelled(labels, data_root) if labels else None,
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
        from hilsplat.evaluate.sweep_plot import run_sweep_plot

        run_sweep_plot(name, table, out)


@app.command()
def efficiency(
    results: Annotated[Path, typer.Option(help="results folder")] = Path("results"),
    out: Annotated[Path, typer.Option(help="the CSV; .md beside it")] = Path("results/efficiency.csv"),
) -> None:
    """Print where the time went, from the benchmark files of a run."""
    start_logging(None)
    from hilsplat.evaluate.efficiency import run_efficiency

    typer.echo(run_efficiency(results, out))


@app.command()
def new(
    name: Annotated[str, typer.Argument(help="name of the scene: letters, digits, . _ -")],
    photos: Annotated[Path, typer.Argument(help="folder of photographs")],
    sheet: Annotated[Path, typer.Option(help="scene sheet")] = Path("config/scenes.tsv"),
) -> None:
    """Add a folder of photographs to the scene sheet and tell what was found."""
    start_logging(None)
    from hilsplat.scene.photos import add_scene

    report = add_scene(sheet, name, photos)
    typer.echo(str(report))
    typer.echo(
        f"\nadded photos/{name} to {sheet}. Next:\n"
        f"  snakemake --cores 2 --config 'groups=[photos]' 'only=[{name}]'\n"
        f"  hilsplat query photos/{name} 'bear nose'"
    )


@app.command()
def query(
    scene: Annotated[str, typer.Argument(help="dataset/scene, such as photos/bear")],
    text: Annotated[
        str, typer.Argument(help="what to look for; 'bear > nose' searches a nose inside a bear")
    ],
    level: Annotated[str, typer.Option(help="auto, whole, part or subpart")] = "auto",
    variant: Annotated[str, typer.Option(help="variant whose files answer")] = "default",
    results: Annotated[Path, typer.Option(help="results folder")] = Path("results"),
    views: Annotated[int, typer.Option(min=1, max=8, help="views in the panel")] = 3,
    answerer: Annotated[str, typer.Option(help="tree, or field: the paper's")] = "tree",
    out: Annotated[
        Path | None, typer.Option(help="folder of panel.png and selection.ply; default: beside the scene")
    ] = None,
    threads: Threads = 2,
) -> None:
    """Ask a finished scene for a text: score, level, position, box, views; a panel PNG and a PLY."""
    start_logging(None)
    from hilsplat.evaluate.query_panel import answer

    typer.echo(
        answer(
            results / scene,
            text,
            level=level,
            variant=variant,
            views=views,
            answerer=answerer,
            out=out,
            threads=threads,
        )
    )


@app.command()
def export(
    scene: Annotated[str, typer.Argument(help="dataset/scene, such as photos/bear")],
    variant: Annotated[str, typer.Option(help="variant whose tree is written")] = "default",
    results: Annotated[Path, typer.Option(help="results folder")] = Path("results"),
    out: Annotated[Path | None, typer.Option(help="folder to write; default: beside the scene")] = None,
    threads: Threads = 2,
) -> None:
    """Write the semantic tree of a finished scene: JSON, a PLY with nodes per Gaussian, a picture."""
    start_logging(None)
    from hilsplat.evaluate.tree_picture import export_tree

    folder = results / scene
    typer.echo(export_tree(folder, variant, out or folder / "export" / variant, threads))


@app.command()
def settings(
    schema: Annotated[bool, typer.Option(help="print the JSON schema of the configuration instead")] = False,
) -> None:
    """Print every knob: default, unit, range, origin."""
    import json

    from hilsplat.settings import config_schema, knob_table

    typer.echo(json.dumps(config_schema(), indent=1) if schema else knob_table())


@world_app.command("show")
def world_show(
    scene: Annotated[str, typer.Argument(help="dataset/scene of a synthetic scene that was made")],
    results: Annotated[Path, typer.Option(help="results folder")] = Path("results"),
    out: Annotated[Path | None, typer.Option(help="PNG to write; default: beside the scene")] = None,
) -> None:
    """Write a contact sheet: views, labels by level, the tree with its texts."""
    start_logging(None)
    from hilsplat.world.sheet import show_world

    target = out or results / scene / "world.png"
    show_world(results / scene / "world", target)
    typer.echo(f"wrote {target}")


@world_app.command("classes")
def world_classes(
    out: Annotated[Path, typer.Option(help="PNG to write")] = Path("world_classes.png"),
) -> None:
    """Write a picture of one object of each class of the table."""
    start_logging(None)
    from hilsplat.world.gallery import draw_classes

    draw_classes(out)
    typer.echo(f"wrote {out}")


@world_app.command("gallery")
def world_gallery(
    kind: Annotated[str, typer.Argument(help="kind of scene: tabletop, room or street")],
    seeds: Annotated[list[int], typer.Argument(help="seeds of the scenes")],
    out: Annotated[Path | None, typer.Option(help="PNG to write; default: world_KIND.png")] = None,
) -> None:
    """Write a picture of some scenes, a view of each with its true labels by level."""
    start_logging(None)
    from hilsplat.world.gallery import draw_scenes

    target = out or Path(f"world_{kind}.png")
    draw_scenes(kind, seeds, target)
    typer.echo(f"wrote {target}")


@world_app.command("inconsistency")
def world_inconsistency(
    scene: Annotated[str, typer.Argument(help="dataset/scene of a synthetic scene that has masks")],
    variant: Annotated[str, typer.Option(help="variant whose masks are measured")] = "default",
    results: Annotated[Path, typer.Option(help="results folder")] = Path("results"),
    neighbours: Annotated[int, typer.Option(min=1, help="nearest views that each view is compared with")] = 2,
    out: Annotated[Path | None, typer.Option(help="CSV to write; default: beside the masks")] = None,
) -> None:
    """Measure how often a surface point gets other masks in the next view, with exact geometry."""
    truth, masks_folder = results / scene / "world" / "truth", results / scene / variant / "masks"
    target = out or masks_folder.with_name("consistency.csv")
    with stage("consistency", target, None, inputs={"truth": truth, "masks": masks_folder}):
        from hilsplat.evaluate.world_consistency import run_consistency

        table = run_consistency(truth, masks_folder, target, neighbours)
    typer.echo(table)


@world_app.command("tree")
def world_tree(
    scene: Annotated[str, typer.Argument(help="dataset/scene of a synthetic scene that has a tree")],
    variant: Annotated[str, typer.Option(help="variant whose tree is measured")] = "default",
    results: Annotated[Path, typer.Option(help="results folder")] = Path("results"),
    out: Annotated[Path | None, typer.Option(help="CSV to write; default: beside the tree")] = None,
    threads: Threads = 2,
) -> None:
    """Measure the 3D semantic tree against the true nodes: matches, purity, parents."""
    folder = results / scene
    semantic_tree, truth = folder / variant / "semantic_tree", folder / "world" / "truth"
    target = out or semantic_tree.with_name("tree_truth.csv")
    with stage("tree_truth", target, None, inputs={"truth": truth, "semantic_tree": semantic_tree}):
        from hilsplat.evaluate.tree_truth import run_tree_truth

        table = run_tree_truth(
            folder / "scene", folder / "gaussians.ply", semantic_tree, truth, target, threads
        )
    typer.echo(table)


@models_app.command("check")
def models_check(folder: Annotated[Path, typer.Argument(help="model folder")]) -> None:
    """Say what a model folder holds, and time one image."""
    start_logging(None)
    from hilsplat.language.model_check import check_model

    typer.echo(check_model(folder))


@models_app.command("split")
def models_split(folder: Annotated[Path, typer.Argument(help="folder of an exported CLIP")]) -> None:
    """Cut the model.onnx of an exported CLIP into the two networks that are read."""
    start_logging(None)
    from hilsplat.base.clip_split import split_clip

    for path in split_clip(folder):
        typer.echo(f"wrote {path}")


@models_app.command("train")
def models_train(
    out: Annotated[Path, typer.Option(help="folder that holds sam-tiny and clip-tiny")] = Path("models"),
    cache: Annotated[Path, typer.Option(help="views and training states")] = DEFAULT_CACHE / "models",
    settings: Settings = "{}",
    seed: Seed = 0,
    threads: Threads = 2,
    stage: Annotated[list[str] | None, typer.Option(help="render, sam, clip; default: all of them")] = None,
    log: Log = None,
) -> None:
    """Train the small SAM and CLIP on training scenes of the synthetic world.

    A killed training goes on where it was; a finished one goes on when it is asked for more minutes.
    """
    start_logging(log)
    from hilsplat.settings import parse_section
    from hilsplat.world.tiny.train import train_models

    train_models(out, cache, parse_section("training", settings), seed, threads, stage)


@datasets_app.command("list")
def datasets_list(
    data_root: Annotated[Path | None, typer.Option(help="folder of the data sets' folders")] = None,
) -> None:
    """List data sets: citation, licence, layout and, with --data-root, which scenes are there."""
    start_logging(None)
    from hilsplat.datasets.overview import overview

    typer.echo(overview(data_root))


@datasets_app.command("check")
def datasets_check(
    name: Annotated[str, typer.Argument(help="data set, such as lerf_ovs")],
    data_root: Annotated[Path, typer.Option(help="folder of the data sets' folders", show_default=False)],
    scene: Annotated[
        list[str] | None, typer.Option(help="scene to read; default: all that are there")
    ] = None,
) -> None:
    """Read every label of a data set, scene by scene, and say what was found and what is odd."""
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
    data_root: Annotated[Path, typer.Option(help="folder of the data sets' folders", show_default=False)],
    out: PathOut,
    log: Log = None,
) -> None:
    """Write images and poses of such a scene as a folder that `poses` imports."""
    with stage("source", out, log):
        from hilsplat.datasets.sources import export_images

        export_images(name, data_root, out)


@cache_app.callback()
def cache_show(
    context: typer.Context,
    folder: Annotated[Path, typer.Option(help="cache folder")] = DEFAULT_CACHE,
) -> None:
    """Show the size of the caches of finished views."""
    start_logging(None)
    from hilsplat.base.cache import size_table

    context.obj = folder
    if context.invoked_subcommand is None:
        typer.echo(size_table(folder))


@cache_app.command("prune")
def cache_prune(
    context: typer.Context,
    days: Annotated[
        float | None, typer.Option(min=0, help="delete what was not used for so many days")
    ] = None,
    max_mib: Annotated[
        float | None, typer.Option(min=0, help="delete the longest unused until so much is left")
    ] = None,
    stage: Annotated[
        list[str] | None, typer.Option(help="masks, clip, contributions; default: all of them")
    ] = None,
) -> None:
    """Delete finished views; they are computed again where a stage needs them."""
    from hilsplat.base.cache import prune_cache, size_table

    number, freed_mib = prune_cache(context.obj, stage or [], days=days, max_mib=max_mib)
    typer.echo(f"deleted {number} files, {freed_mib:.1f} MiB\n{size_table(context.obj)}")


@langsplat_app.command("read")
def langsplat_read(
    scene: PathIn,
    files: Annotated[Path, typer.Option(help="LangSplat's folder of _s.npy and _f.npy", show_default=False)],
    masks: Annotated[Path, typer.Option(help="masks artifact to write", show_default=False)],
    clip: Annotated[Path, typer.Option(help="clip artifact to write", show_default=False)],
    resize: Annotated[bool, typer.Option(help="take maps of another size, nearest pixel")] = False,
    settings: Annotated[
        str, typer.Option(help="the clip section as JSON: the model that embeds texts")
    ] = "{}",
    log: Log = None,
) -> None:
    """Take masks and CLIP vectors that LangSplat's preprocessing made, in place of masks and clip."""
    section = _section("clip", settings)
    inputs = {"scene": scene, "files": files}
    with stage("langsplat", masks, log, inputs=inputs):
        from hilsplat.language.langsplat_files import read_masks

        read_masks(scene, files, masks, resize)
    with stage("langsplat", clip, log, settings=section, inputs={**inputs, "masks": masks}):
        from hilsplat.language.langsplat_files import read_clip

        read_clip(scene, files, clip, resize, section)


@langsplat_app.command("write")
def langsplat_write(masks: PathIn, clip: PathIn, out: PathOut, log: Log = None) -> None:
    """Write masks and CLIP vectors as LangSplat's preprocessing does."""
    with stage("langsplat", out, log, inputs={"masks": masks, "clip": clip}):
        from hilsplat.language.langsplat_files import write_langsplat

        write_langsplat(masks, clip, out)
