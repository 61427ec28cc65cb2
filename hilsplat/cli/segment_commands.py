"""Commands for masks and coverage trees."""

from pathlib import Path
from typing import Annotated, Any

import typer

from hilsplat.base.errors import HilsplatError
from hilsplat.cli.apps import app
from hilsplat.cli.stage import (
    DEFAULT_CACHE,
    Cache,
    Memory,
    PathIn,
    PathOut,
    Settings,
    Threads,
    model_input,
    section_of,
    stage,
    start_logging,
)


@app.command()
def masks(
    scene: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    truth: Annotated[
        Path | None, typer.Option(help="truth folder, for the segmenter truth-perturbed only")
    ] = None,
    gaussians: Annotated[
        Path | None, typer.Option(help="PLY for key views (masks.key_views below 1) or guided prompts")
    ] = None,
    key_masks: Annotated[
        Path | None, typer.Option(help="masks of the key views, for masks.prompts: guided")
    ] = None,
    semantic_tree: Annotated[
        Path | None, typer.Option(help="tree of the key views, for masks.prompts: guided")
    ] = None,
    perturb: Annotated[str, typer.Option(help="faults of truth-perturbed, as JSON")] = "{}",
    features: Annotated[
        Path | None, typer.Option(help="LangSplat's folder of _s.npy and _f.npy: take its masks instead")
    ] = None,
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
    memory: Memory = None,
) -> None:
    """Segment each training view at three levels."""
    section = section_of("masks", settings)
    if section.segmenter == "truth-perturbed":
        _masks_from_truth(scene, truth, out, section, section_of("perturb", perturb), threads)
        return
    if truth is not None:
        raise HilsplatError(
            f"masks: the segmenter {section.segmenter} must not see the truth",
            found=f"--truth {truth}",
            fix="leave out --truth, or set masks.segmenter: truth-perturbed, a diagnostic",
        )
    if features is not None:
        with stage("langsplat", out, inputs={"scene": scene, "features": features}):
            from hilsplat.embed.langsplat_files import read_masks

            read_masks(scene, features, out)
        return
    inputs = {"scene": scene, **(model_input(section) if section.segmenter == "sam" else {})}
    if section.key_views < 1:
        if gaussians is None:
            raise HilsplatError(
                "masks: the Gaussians choose the key views",
                expected="--gaussians results/<dataset>/<scene>/gaussians.ply",
                fix="name the PLY, or set masks.key_views: 1",
            )
        inputs |= {"gaussians": gaussians}
        with stage("key_masks", out, settings=section, threads=threads, inputs=inputs):
            from hilsplat.contributions.key_views import run_key_masks

            run_key_masks(scene, gaussians, out, cache, section, threads, memory)
        return
    if gaussians and key_masks and semantic_tree:
        inputs |= {"gaussians": gaussians, "key_masks": key_masks, "semantic_tree": semantic_tree}
        with stage("guided_masks", out, settings=section, threads=threads, inputs=inputs):
            from hilsplat.semantic_tree.guided_masks import run_guided_masks

            run_guided_masks(scene, gaussians, key_masks, semantic_tree, out, cache, section, threads, memory)
        return
    with stage("masks", out, settings=section, threads=threads, inputs=inputs):
        from hilsplat.segment.stage import run_masks

        run_masks(scene, out, cache, section, threads, memory)


def _masks_from_truth(
    scene: Path, truth: Path | None, out: Path, section: Any, faults: Any, threads: int
) -> None:
    """Run the diagnostic segmenter, which is a separate stage in provenance and code."""
    if truth is None:
        raise HilsplatError(
            "masks: the segmenter truth-perturbed needs the true labels of a synthetic scene",
            expected="--truth results/<dataset>/<scene>/world/truth",
            fix="name the folder, or choose masks.segmenter: sam or graph",
        )
    inputs = {"scene": scene, "truth": truth}
    recorded = {"masks": section, "perturb": faults}
    with stage("truth_masks", out, settings=recorded, seed=faults.seed, threads=threads, inputs=inputs):
        from hilsplat.world.truth_masks import run_truth_masks

        run_truth_masks(scene, truth, out, faults, section.min_area_px, threads)


@app.command("coverage-tree")
def coverage_tree(masks: PathIn, out: PathOut, settings: Settings = "{}") -> None:
    """Compute the parent of each mask: the coverage tree of each view."""
    section = section_of("coverage_tree", settings)
    with stage("coverage_tree", out, settings=section, inputs={"masks": masks}):
        from hilsplat.segment.coverage_stage import run_coverage_tree

        run_coverage_tree(masks, out, section)


@app.command("show-masks")
def show_masks(
    scene: PathIn,
    masks: PathIn,
    out: Annotated[Path, typer.Option(help="PNG to write, with the trees beside it")] = Path("masks.png"),
    coverage_tree: Annotated[
        Path | None, typer.Option(help="output of the coverage_tree stage, to draw the trees too")
    ] = None,
    view: Annotated[str | None, typer.Option(help="name of the view; default: the middle one")] = None,
) -> None:
    """Draw a view's masks at three levels, and its coverage trees."""
    start_logging()
    from hilsplat.segment.pictures import masks_overview

    typer.echo(f"wrote {out}, view {masks_overview(scene, masks, out, view, coverage_tree)}")
