"""Commands for contributions, semantic tree, language field and baselines."""

from pathlib import Path
from typing import Annotated

import typer

from hilsplat.base.errors import SettingsError
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
    coverage_tree: Annotated[Path | None, typer.Option(help="for evidence: features")] = None,
    field_settings: Annotated[str, typer.Option(help="section field as JSON, for evidence: features")] = "{}",
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Compute nodes at three levels, by linking masks of all views or clustering Gaussians by features."""
    section = section_of("semantic_tree", settings)
    inputs = {"contributions": contributions, "masks": masks}
    if (section.evidence == "features") != (coverage_tree is not None):
        raise SettingsError(
            "semantic_tree.evidence and the options don't fit together",
            expected="--coverage-tree with evidence: features, and only there",
        )
    if coverage_tree is None:
        with stage("semantic_tree", out, settings=section, threads=threads, inputs=inputs):
            from hilsplat.semantic_tree.build import run_semantic_tree

            run_semantic_tree(contributions, masks, out, section, threads)
        return
    inputs["coverage_tree"] = coverage_tree
    of_field = section_of("field", field_settings)
    both = {"semantic_tree": section, "field": of_field}
    with stage("feature_tree", out, settings=both, seed=seed, threads=threads, inputs=inputs):
        from hilsplat.methods.feature_tree import run_feature_tree

        run_feature_tree(contributions, masks, coverage_tree, out, section, of_field, seed, threads)


@app.command()
def autoencoder(
    clip: PathIn,
    semantic_tree: PathIn,
    contributions: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    seed: Seed = 0,
) -> None:
    """Compute the scene's code of CLIP vectors (PCA or autoencoder) and encode the masks."""
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
    scene: Annotated[Path | None, typer.Option(help="posed scene, for trainer: literal")] = None,
    gaussians: Annotated[Path | None, typer.Option(help="3DGS PLY, for trainer: literal")] = None,
    masks: Annotated[Path | None, typer.Option(help="masks of the views, for trainer: literal")] = None,
    start: Annotated[Path | None, typer.Option(help="first field, for start: langsplat")] = None,
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Solve the language field: regression, L_h, L_ins and L_part over three levels."""
    section = section_of("field", settings)
    inputs = {"contributions": contributions, "coverage_tree": coverage_tree, "autoencoder": autoencoder}
    more = {"scene": scene, "gaussians": gaussians, "masks": masks, "start": start}
    inputs |= {name: path for name, path in more.items() if path is not None}
    own_seed = seed if section.is_random else None
    rendered = (scene, gaussians, masks) if scene and gaussians and masks else None
    with stage("field", out, settings=section, seed=own_seed, threads=threads, inputs=inputs):
        from hilsplat.field.field import run_field

        run_field(contributions, coverage_tree, autoencoder, out, section, threads, seed, rendered, start)


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
    """Compute the language field with a baseline, named in the settings."""
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
