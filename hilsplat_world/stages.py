"""Stages of the synthetic world: scenes, masks from their ground truth, and diagnostics."""

from pathlib import Path
from typing import Annotated

import typer

from hilsplat.settings import MasksSettings
from hilsplat.stage import PathIn, PathOut, Registry, Role, Threads
from hilsplat_world.settings import PerturbSettings, WorldSettings

PIPELINE = Registry()
stage = PIPELINE.stage


@stage(file="world/images", command="world make", scope="scene", loop="rendered views")
def world(
    source: Annotated[str, typer.Option(help="scene to make, as world:KIND:SEED")],
    out: Annotated[Path, typer.Option(help="folder of images"), Role.OUTPUT],
    truth: Annotated[Path, typer.Option(help="folder of annotations"), Role.OUTPUT],
    settings: WorldSettings,
    threads: Threads = 1,
) -> None:
    """Make a synthetic scene: images, and ground truth for evaluation only."""
    from hilsplat_world.stage import run_world

    run_world(source, settings, out, truth, threads)


@stage(
    artifact="masks",
    command="world perturb",
    when=lambda scene: scene.settings.masks.segmenter == "truth-perturbed",
)
def truth_masks(
    scene: PathIn,
    truth: PathIn,
    out: PathOut,
    settings: MasksSettings,
    perturb: PerturbSettings,
    threads: Threads = 1,
) -> None:
    """Write masks from the ground truth with the faults in the settings, only for diagnosis."""
    from hilsplat_world.truth_masks import run_truth_masks

    run_truth_masks(scene, truth, out, perturb, settings.min_area_px, threads)


@stage(command="world mask-truth", scope="scene", beside=lambda out: (out.with_suffix(".csv"),))
def mask_truth(
    scene: PathIn,
    truth: PathIn,
    masks: PathIn,
    out: Annotated[Path, typer.Option(help="WebP to write, with CSV and PDF beside it"), Role.OUTPUT],
) -> str:
    """Compare masks with ground-truth regions at each level, and draw the errors."""
    from hilsplat_world.diagnostics.mask_truth import run_mask_truth

    return run_mask_truth(scene, truth, masks, out)


@stage(command="", scope="scene")
def consistency(truth: PathIn, masks: PathIn, out: PathOut) -> str:
    """Measure, using exact geometry, how often a surface point has different masks in neighbouring views."""
    from hilsplat_world.diagnostics.world_consistency import run_consistency

    return run_consistency(truth, masks, out)


@stage(command="", scope="scene")
def tree_truth(
    scene: PathIn, gaussians: PathIn, truth: PathIn, semantic_tree: PathIn, out: PathOut, threads: Threads = 2
) -> str:
    """Compare the 3D semantic tree with the ground-truth nodes: matches, purity, parents."""
    from hilsplat_world.diagnostics.tree_truth import run_tree_truth

    return run_tree_truth(scene, gaussians, semantic_tree, truth, out, threads)
