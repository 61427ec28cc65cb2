"""Commands for model folders: get, list, check, split."""

from pathlib import Path
from typing import Annotated

import typer

from hilsplat.cli.apps import models_app
from hilsplat.cli.stage import start_logging


@models_app.command("get")
def models_get(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            help="names of `hilsplat models list`, or owner/name on the hub; default: the recommended pair",
            show_default=False,
        ),
    ] = None,
    revision: Annotated[str | None, typer.Option(help="branch, tag or commit of the repository")] = None,
    variant: Annotated[
        str, typer.Option(help="networks of another precision: quantized, fp16, int8, ...; default: full")
    ] = "",
    out: Annotated[
        Path | None,
        typer.Option(
            help="folder of the models; default: HILSPLAT_MODELS, or the data folder of the user, which all "
            "projects share",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Fetch released models from the model hub and check them.

    An interrupted download resumes where it stopped. HF_ENDPOINT, HF_HOME, HF_TOKEN, HF_HUB_OFFLINE and the
    usual proxy variables are respected.
    """
    start_logging()
    from hilsplat.hub.get import get_models

    typer.echo(get_models(names or (), out, revision, variant))


@models_app.command("list")
def models_list() -> None:
    """List released and installed models, with size, licence and use."""
    start_logging()
    from hilsplat.hub.overview import models_table

    typer.echo(models_table())


@models_app.command("check")
def models_check(
    folder: Annotated[Path | None, typer.Argument(help="model folder; default: all that are here")] = None,
    variant: Annotated[str, typer.Option(help="ending of the networks' names, such as fp16")] = "",
) -> None:
    """Describe a model folder, or all installed ones, and time one image."""
    start_logging()
    from hilsplat.embed.model_check import check_model
    from hilsplat.hub.overview import check_models

    text, num_failed = (check_model(folder, variant), 0) if folder is not None else check_models()
    typer.echo(text)
    if num_failed:
        raise typer.Exit(1)


@models_app.command("split")
def models_split(folder: Annotated[Path, typer.Argument(help="folder of an exported CLIP")]) -> None:
    """Split the model.onnx of an exported CLIP into its image and text networks."""
    start_logging()
    from hilsplat.models.clip_split import split_clip

    for path in split_clip(folder):
        typer.echo(f"wrote {path}")
