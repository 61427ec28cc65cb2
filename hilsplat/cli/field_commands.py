"""Contributions, semantic tree, language field, baselines."""

from typing import Annotated

import typer

from hilsplat.cli.apps import app
from hilsplat.cli.stage import (
    DEFAULT_CACHE,
    Cache,
    PathIn,
    PathOut,
    Seed,
    Settings,
    Threads,
    section_of,
    stage,
)


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
    with stage("contributions", out, settings=section, threads=threads, inputs=inputs, device=section.device):
        from hilsplat.contributions.stage import run_contributions

        run_contributions(scene, gaussians, masks, out, cache, section, threads)


@app.command("semantic-tree")
def semantic_tree(
    contributions: PathIn,
    masks: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    threads: Threads = 1,
) -> None:
    """Link the masks of all views into nodes at three levels."""
    section = section_of("semantic_tree", settings)
    inputs = {"contributions": contributions, "masks": masks}
    with stage("semantic_tree", out, settings=section, threads=threads, inputs=inputs):
        from hilsplat.semantic_tree.tree import run_semantic_tree

        run_semantic_tree(contributions, masks, out, section, threads)


@app.command()
def autoencoder(
    clip: PathIn,
    semantic_tree: PathIn,
    contributions: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    seed: Seed = 0,
) -> None:
    """Make the scene's code of CLIP vectors (PCA or autoencoder) and encode the masks."""
    section = section_of("autoencoder", settings)
    inputs = {"clip": clip, "semantic_tree": semantic_tree, "contributions": contributions}
    with stage("autoencoder", out, settings=section, seed=seed, inputs=inputs):
        from hilsplat.field.autoencoder import run_autoencoder

        run_autoencoder(clip, semantic_tree, contributions, out, section, seed)


@app.command()
def field(
    contributions: PathIn,
    coverage_tree: PathIn,
    autoencoder: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    threads: Threads = 1,
) -> None:
    """Solve the language field: regression, L_h, L_ins and L_part over three levels."""
    section = section_of("field", settings)
    inputs = {"contributions": contributions, "coverage_tree": coverage_tree, "autoencoder": autoencoder}
    with stage("field", out, settings=section, threads=threads, inputs=inputs):
        from hilsplat.field.field import run_field

        run_field(contributions, coverage_tree, autoencoder, out, section, threads)


@app.command("field-reference")
def field_reference(
    scene: PathIn,
    gaussians: PathIn,
    masks: PathIn,
    contributions: PathIn,
    autoencoder: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    device: Annotated[str, typer.Option(help="rasteriser: auto, cpu or cuda")] = "auto",
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Train a field by rendering one random view per step: the slow reference for the solver."""
    section = section_of("reference", settings)
    inputs = {
        "scene": scene,
        "gaussians": gaussians,
        "masks": masks,
        "contributions": contributions,
        "autoencoder": autoencoder,
    }
    with stage("field_reference", out, settings=section, seed=seed, threads=threads, inputs=inputs):
        from hilsplat.field.reference_trainer import run_reference

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
) -> None:
    """Compute the language field by a baseline (name in the settings)."""
    section = section_of("method", settings)
    inputs = {"scene": scene, "gaussians": gaussians, "masks": masks}
    inputs |= {"contributions": contributions, "autoencoder": autoencoder}
    from hilsplat.methods.method import MethodInputs
    from hilsplat.methods.registry import METHODS

    parts = MethodInputs(scene, gaussians, masks, contributions, autoencoder, threads)
    plugins = (METHODS.places[section.name],) if section.name in METHODS else ()
    with stage("method", out, settings=section, seed=seed, threads=threads, inputs=inputs, plugins=plugins):
        from hilsplat.methods.stage import run_method

        run_method(parts, out, section, seed)
