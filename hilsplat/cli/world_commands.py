"""Commands for the synthetic world: make and show scenes, and measure masks and trees against their truth."""

from pathlib import Path
from typing import Annotated

import typer

from hilsplat.cli.apps import world_app
from hilsplat.cli.stage import PathOut, Results, Settings, Threads, section_of, stage, start_logging

SceneWithMasks = Annotated[str, typer.Argument(help="dataset/scene of a synthetic scene that has masks")]
MeasuredMasks = Annotated[str, typer.Option(help="variant whose masks to measure")]
NEIGHBOURS = 2
"""Number of nearest views that each view is compared with."""


@world_app.command("make")
def world_make(
    source: Annotated[str, typer.Option(help="scene to make, as world:KIND:SEED")],
    out: PathOut,
    settings: Settings = "{}",
    threads: Threads = 1,
) -> None:
    """Make a synthetic scene: images, and the truth that only evaluate reads."""
    section = section_of("world", settings)
    beside = (out / "images", out / "truth")
    with stage("world", out, settings=section, threads=threads, beside=beside):
        from hilsplat.world.stage import run_world

        run_world(source, section, out, threads)


@world_app.command("show")
def world_show(
    scene: Annotated[str, typer.Argument(help="dataset/scene of a synthetic scene that was made")],
    results: Results = Path("results"),
) -> None:
    """Draw a contact sheet beside the scene: views, labels by level, the tree with its texts."""
    start_logging()
    from hilsplat.world.sheet import show_world

    target = results / scene / "world.png"
    show_world(results / scene / "world", target)
    typer.echo(f"wrote {target}")


@world_app.command("classes")
def world_classes(
    out: Annotated[Path, typer.Option(help="PNG to write")] = Path("world_classes.png"),
) -> None:
    """Draw one object of each class."""
    start_logging()
    from hilsplat.world.gallery import draw_classes

    draw_classes(out)
    typer.echo(f"wrote {out}")


@world_app.command("gallery")
def world_gallery(
    kind: Annotated[str, typer.Argument(help="kind of scene: tabletop, room or street")],
    seeds: Annotated[list[int], typer.Argument(help="seeds of the scenes")],
) -> None:
    """Draw one view of each scene, with its true labels by level, as world_KIND.png."""
    start_logging()
    from hilsplat.world.gallery import draw_scenes

    target = Path(f"world_{kind}.png")
    draw_scenes(kind, seeds, target)
    typer.echo(f"wrote {target}")


@world_app.command("inconsistency")
def world_inconsistency(
    scene: SceneWithMasks, variant: MeasuredMasks = "default", results: Results = Path("results")
) -> None:
    """Measure with exact geometry how often a surface point has different masks in the two nearest views.

    Writes consistency.csv beside the masks.
    """
    truth, masks_folder = results / scene / "world" / "truth", results / scene / variant / "masks"
    target = masks_folder.with_name("consistency.csv")
    with stage("consistency", target, inputs={"truth": truth, "masks": masks_folder}):
        from hilsplat.evaluate.diagnostics.world_consistency import run_consistency

        table = run_consistency(truth, masks_folder, target, NEIGHBOURS)
    typer.echo(table)


@world_app.command("masks")
def world_masks(
    scene: SceneWithMasks,
    variant: MeasuredMasks = "default",
    results: Results = Path("results"),
    out: Annotated[
        Path | None,
        typer.Option(help="PNG to write, with a CSV and a PDF beside it; default: beside the masks"),
    ] = None,
) -> None:
    """Measure masks against the true regions by level, and draw where they fail."""
    folder = results / scene
    truth, masks_folder = folder / "world" / "truth", folder / variant / "masks"
    target = out or masks_folder.with_name("masks_truth.png")
    inputs = {"scene": folder / "scene", "truth": truth, "masks": masks_folder}
    with stage("mask_truth", target, inputs=inputs, beside=(target.with_suffix(".csv"),)):
        from hilsplat.evaluate.diagnostics.mask_truth import run_mask_truth

        table = run_mask_truth(folder / "scene", truth, masks_folder, target)
    typer.echo(table)


@world_app.command("semantic-tree")
def world_tree(
    scene: Annotated[str, typer.Argument(help="dataset/scene of a synthetic scene that has a tree")],
    variant: Annotated[str, typer.Option(help="variant whose tree to measure")] = "default",
    results: Results = Path("results"),
    threads: Threads = 2,
) -> None:
    """Measure the 3D semantic tree against the true nodes: matches, purity, parents.

    Writes tree_truth.csv beside the tree.
    """
    folder = results / scene
    semantic_tree, truth = folder / variant / "semantic_tree", folder / "world" / "truth"
    target = semantic_tree.with_name("tree_truth.csv")
    inputs = {
        "scene": folder / "scene",
        "gaussians": folder / "gaussians.ply",
        "truth": truth,
        "semantic_tree": semantic_tree,
    }
    with stage("tree_truth", target, inputs=inputs):
        from hilsplat.evaluate.diagnostics.tree_truth import run_tree_truth

        table = run_tree_truth(inputs["scene"], inputs["gaussians"], semantic_tree, truth, target, threads)
    typer.echo(table)
