"""Commands for CLIP vectors of masks and names of nodes."""

from pathlib import Path
from typing import Annotated

import typer

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
)
from hilsplat.models.store import AUTO


@app.command()
def names(
    semantic_tree: PathIn,
    clip: PathIn,
    out: PathOut,
    settings: Settings = "{}",
    evaluate: Annotated[str, typer.Option(help="settings of evaluate as JSON")] = "{}",
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
) -> None:
    """Name the nodes of a semantic tree from a vocabulary."""
    sections = {"query": section_of("query", settings), "evaluate": section_of("evaluate", evaluate)}
    inputs = {"semantic_tree": semantic_tree, "clip": clip}
    if (own := sections["query"].vocabulary) != AUTO:
        inputs["vocabulary"] = Path(own)
    with stage("names", out, settings=sections, threads=threads, inputs=inputs):
        from hilsplat.query.node_names import run_names

        run_names(semantic_tree, clip, out, cache, sections["query"], sections["evaluate"], threads)


@app.command()
def clip(
    scene: PathIn,
    masks: PathIn,
    out: PathOut,
    semantic_tree: Annotated[
        Path | None, typer.Option(help="embed only the crops that show its nodes best; default: every mask")
    ] = None,
    settings: Settings = "{}",
    features: Annotated[
        Path | None, typer.Option(help="LangSplat's folder of _s.npy and _f.npy: take its vectors instead")
    ] = None,
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
    memory: Memory = None,
) -> None:
    """Embed the crops that show each node best, or every mask, with CLIP."""
    section = section_of("clip", settings)
    inputs = {"scene": scene, "masks": masks, **model_input(section)}
    inputs |= {"semantic_tree": semantic_tree} if semantic_tree else {}
    if features is not None:
        with stage("langsplat", out, settings=section, inputs={**inputs, "features": features}):
            from hilsplat.embed.langsplat_files import read_clip

            read_clip(scene, features, out, section)
        return
    with stage("clip", out, settings=section, threads=threads, inputs=inputs):
        from hilsplat.embed.stage import run_clip

        run_clip(scene, masks, semantic_tree, out, cache, section, threads, memory)
