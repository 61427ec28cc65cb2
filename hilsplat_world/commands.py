"""Commands of the synthetic world that are not stages."""

from pathlib import Path
from typing import Annotated

import typer

from hilsplat.cli.common import Results, echo
from hilsplat.cli.user_commands import SceneName, scene_folder
from hilsplat.stage import Threads
from hilsplat_world.stages import consistency, mask_truth, tree_truth

app = typer.Typer(help="Make and inspect scenes of the synthetic world.", no_args_is_help=True)

MeasuredVariant = Annotated[str, typer.Option(help="variant that is measured")]


@app.command("show")
def show(scene: SceneName, results: Results = Path("results")) -> None:
    """Write a contact sheet to world.png: views, labels by level, and the tree with its texts."""
    from hilsplat_world.pictures import show_world

    folder = scene_folder(scene, results)
    target = folder / "world.png"
    show_world(folder / "world", target)
    echo(f"wrote {target}")


@app.command("inconsistency")
def inconsistency(
    scene: SceneName, variant: MeasuredVariant = "default", results: Results = Path("results")
) -> None:
    """Measure, using exact geometry, how often a surface point has different masks in neighbouring views.

    Writes consistency.csv beside the masks.
    """
    folder = scene_folder(scene, results)
    measured = folder / variant
    echo(consistency(folder / "world/truth", measured / "masks", measured / "consistency.csv"))


@app.command("masks")
def masks(
    scene: SceneName,
    variant: MeasuredVariant = "default",
    results: Results = Path("results"),
    out: Annotated[Path | None, typer.Option(help="PNG, CSV and PDF; default: beside the masks")] = None,
) -> None:
    """Compare masks with ground-truth regions at each level, and draw the errors."""
    folder = scene_folder(scene, results)
    target = out or folder / variant / "masks_truth.png"
    echo(mask_truth(folder / "scene", folder / "world/truth", folder / variant / "masks", target))


@app.command("semantic-tree")
def semantic_tree(
    scene: SceneName,
    variant: MeasuredVariant = "default",
    results: Results = Path("results"),
    threads: Threads = 2,
) -> None:
    """Compare the 3D semantic tree with the ground-truth nodes: matches, purity, parents.

    Writes tree_truth.csv beside the tree.
    """
    folder = scene_folder(scene, results)
    ply, truth, tree = folder / "gaussians.ply", folder / "world/truth", folder / variant / "semantic_tree"
    echo(tree_truth(folder / "scene", ply, truth, tree, tree.with_name("tree_truth.csv"), threads))
