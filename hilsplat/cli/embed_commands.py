"""CLIP vectors of masks, and LangSplat's files."""

from pathlib import Path
from typing import Annotated

import typer

from hilsplat.cli.apps import app, langsplat_app
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


@app.command()
def clip(
    scene: PathIn,
    masks: PathIn,
    out: PathOut,
    semantic_tree: Annotated[
        Path | None, typer.Option(help="embed only the crops that show its nodes best; default: every mask")
    ] = None,
    settings: Settings = "{}",
    cache: Cache = DEFAULT_CACHE,
    threads: Threads = 1,
    memory: Memory = None,
) -> None:
    """Embed the crops that show each node best, or every mask, with CLIP."""
    section = section_of("clip", settings)
    inputs = {"scene": scene, "masks": masks, **model_input(section)}
    inputs |= {"semantic_tree": semantic_tree} if semantic_tree else {}
    with stage("clip", out, settings=section, threads=threads, inputs=inputs):
        from hilsplat.embed.stage import run_clip

        run_clip(scene, masks, semantic_tree, out, cache, section, threads, memory)


@langsplat_app.command("read")
def langsplat_read(
    scene: PathIn,
    files: Annotated[Path, typer.Option(help="LangSplat's folder of _s.npy and _f.npy", show_default=False)],
    masks: Annotated[Path, typer.Option(help="masks artifact to write", show_default=False)],
    clip: Annotated[Path, typer.Option(help="clip artifact to write", show_default=False)],
    resize: Annotated[
        bool, typer.Option(help="accept maps of another size and take the nearest pixel")
    ] = False,
    settings: Annotated[str, typer.Option(help="section clip as JSON; its model embeds the texts")] = "{}",
) -> None:
    """Import masks and CLIP vectors from LangSplat's preprocessing, instead of running masks and clip."""
    section = section_of("clip", settings)
    inputs = {"scene": scene, "files": files}
    with stage("langsplat", masks, inputs=inputs):
        from hilsplat.embed.langsplat_files import read_masks

        read_masks(scene, files, masks, resize)
    with stage("langsplat", clip, settings=section, inputs={**inputs, "masks": masks}):
        from hilsplat.embed.langsplat_files import read_clip

        read_clip(scene, files, clip, resize, section)


@langsplat_app.command("write")
def langsplat_write(masks: PathIn, clip: PathIn, out: PathOut) -> None:
    """Write masks and CLIP vectors in the format of LangSplat's preprocessing."""
    with stage("langsplat", out, inputs={"masks": masks, "clip": clip}):
        from hilsplat.embed.langsplat_files import write_langsplat

        write_langsplat(masks, clip, out)
