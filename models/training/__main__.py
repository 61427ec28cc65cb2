"""Train the small SAM and CLIP on training scenes of the synthetic world: `python -m models.training`."""

from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError

from hilsplat.base.errors import HilsplatError
from hilsplat.cli.common import start_logging
from hilsplat.configuration import settings_error
from models.training.settings import TrainingSettings
from models.training.train import require_own_models, train_models


def main(
    out: Annotated[Path, typer.Option(help="folder for sam-tiny and clip-tiny")] = Path("results/models"),
    cache: Annotated[Path, typer.Option(help="folder for rendered views and checkpoints")] = Path(
        "results/.cache/models"
    ),
    settings: Annotated[str, typer.Option(help="settings as JSON (models/training/settings.py)")] = "{}",
    seed: Annotated[int, typer.Option(min=0)] = 0,
    threads: Annotated[int, typer.Option(min=1)] = 2,
    stage: Annotated[
        list[str] | None, typer.Option(help="step to run: render, sam or clip; default: all")
    ] = None,
) -> None:
    """Train the small SAM and CLIP on training scenes of the synthetic world.

    An interrupted training resumes, and a finished one continues with a larger budget.
    """
    start_logging(timestamps=True)
    try:
        chosen = TrainingSettings.model_validate_json(settings)
    except ValidationError as error:
        typer.echo(settings_error(error, "training", TrainingSettings), err=True)
        raise typer.Exit(1) from None
    try:
        require_own_models(out)
        train_models(out, cache, chosen, seed, threads, stage)
    except HilsplatError as error:
        typer.echo(error, err=True)
        raise typer.Exit(1) from None


typer.run(main)
