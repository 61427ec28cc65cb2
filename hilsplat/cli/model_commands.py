"""Model folders: check, split, train."""

from pathlib import Path
from typing import Annotated

import typer

from hilsplat.cli.apps import models_app
from hilsplat.cli.stage import (
    DEFAULT_CACHE,
    Log,
    Seed,
    Settings,
    Threads,
    section_of,
    start_logging,
)


@models_app.command("check")
def models_check(
    folder: Annotated[Path, typer.Argument(help="model folder")],
    variant: Annotated[str, typer.Option(help="ending of the networks' names, such as fp16")] = "",
) -> None:
    """Describe a model folder, and time one image."""
    start_logging(None)
    from hilsplat.embed.model_check import check_model

    typer.echo(check_model(folder, variant))


@models_app.command("split")
def models_split(folder: Annotated[Path, typer.Argument(help="folder of an exported CLIP")]) -> None:
    """Split the model.onnx of an exported CLIP into its image and text networks."""
    start_logging(None)
    from hilsplat.base.clip_split import split_clip

    for path in split_clip(folder):
        typer.echo(f"wrote {path}")


@models_app.command("train")
def models_train(
    out: Annotated[Path, typer.Option(help="folder for sam-tiny and clip-tiny")] = Path("models"),
    cache: Annotated[Path, typer.Option(help="folder for rendered views and training states")] = DEFAULT_CACHE
    / "models",
    settings: Settings = "{}",
    seed: Seed = 0,
    threads: Threads = 2,
    stage: Annotated[
        list[str] | None, typer.Option(help="step to run: render, sam or clip; default: all")
    ] = None,
    log: Log = None,
) -> None:
    """Train the small SAM and CLIP on training scenes of the synthetic world.

    Training resumes after a kill, and continues if a finished one is given more minutes.
    """
    start_logging(log)
    from hilsplat.world.tiny.train import train_models

    train_models(out, cache, section_of("training", settings), seed, threads, stage)
