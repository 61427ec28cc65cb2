"""Masks, coverage trees, CLIP vectors, and the files of LangSplat."""

from pathlib import Path
from typing import Annotated, Any

import typer

from hilsplat.base.errors import HilsplatError
from hilsplat.cli.apps import app, langsplat_app
from hilsplat.cli.stage import (
    DEFAULT_CACHE,
    Cache,
    Log,
    PathIn,
    PathOut,
    Settings,
    Threads,
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
        Path | None, typer.Option(help="truth folder; for the segmenter truth-perturbed alone")
    ] = None,
    perturb: Annotated[str, typer.Option(help="faults of truth-perturbed as JSON")] = "{}",
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
    log: Log = None,
) -> None:
    """Segment each training view at three levels."""
    section = section_of("masks", settings)
    if section.segmenter == "truth-perturbed":
        _masks_from_truth(scene, truth, out, section, section_of("perturb", perturb), threads, log)
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
    section = section_of("tree", settings)
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
    section = section_of("clip", settings)
    inputs = {"scene": scene, "masks": masks}
    with stage("clip", out, log, settings=section, threads=threads, inputs=inputs):
        from hilsplat.language.clip_stage import run_clip

        run_clip(scene, masks, out, cache, section, threads)


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
    section = section_of("clip", settings)
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
