"""Commands that start a project, add scenes and run the workflow."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from hilsplat.cli.common import app, echo
from hilsplat.stages import POSES_HELP


@app.command()
def init(folder: Annotated[Path, typer.Argument(help="folder of the project")] = Path()) -> None:
    """Write commented config/config.yaml and config/scenes.tsv to edit; they override the installed files."""
    from hilsplat.workflow.run import start_project

    for path in start_project(folder):
        echo(f"wrote {path}")


@app.command("run")
def run_command(
    targets: Annotated[
        list[str] | None,
        typer.Argument(metavar="TARGET", help="scenes (photos/desk, desk or 'photos/*'), tables or files"),
    ] = None,
    config: Annotated[
        list[Path] | None,
        typer.Option(help="file that overrides config/config.yaml, or its name in config/; may be repeated"),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", "-n", help="print jobs, disk space and hours; run nothing")
    ] = False,
    cores: Annotated[int | None, typer.Option("--cores", "-c", min=1, help="CPU cores; default: all")] = None,
    forcerun: Annotated[
        list[str] | None, typer.Option("--forcerun", "-R", help="stage or file to run again; may be repeated")
    ] = None,
    verbose: Annotated[bool, typer.Option("--verbose", help="print all lines of Snakemake")] = False,
    verify: Annotated[
        bool, typer.Option(help="read every byte of earlier results, and rebuild what is damaged")
    ] = False,
) -> None:
    """Run the workflow for everything in the configuration, or only for given scenes, tables or files.

    Rerunning resumes a killed run. Options after -- are passed to Snakemake: hilsplat run -- --retries 2
    """
    from hilsplat.workflow.run import run

    passed = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []
    names = targets or []
    options = ["--dry-run"] if dry_run else []
    options += ["--cores", str(cores)] if cores else []
    options += ["--forcerun", *forcerun] if forcerun else []
    options += ["--verbose"] if verbose else []
    raise typer.Exit(
        run(names[: len(names) - len(passed)], config or [], [*options, *passed], every_byte=verify)
    )


@app.command()
def new(
    name: Annotated[str, typer.Argument(help="name of the scene: letters, digits, . _ -")],
    photos: Annotated[Path, typer.Argument(help="folder of photographs or videos, a video, or a zip file")],
    sheet: Annotated[Path, typer.Option(help="scene sheet")] = Path("config/scenes.tsv"),
    frames: Annotated[int, typer.Option(min=3, max=1000, help="maximum number of video frames")] = 60,
    poses: Annotated[Path | None, typer.Option(help=POSES_HELP)] = None,
    gaussians: Annotated[
        Path | None, typer.Option(help="3DGS PLY; none: fit Gaussians; default: use any 3DGS output found")
    ] = None,
    features: Annotated[
        Path | None, typer.Option(help="LangSplat's features; none: use SAM and CLIP; default: use any found")
    ] = None,
    labels: Annotated[
        Path | None, typer.Option(help="LERF-OVS labels for scoring; none: no labels; default: use any found")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="report what was found and would be used, and add nothing")
    ] = False,
) -> None:
    """Add photographs, a video, or a scene from COLMAP, 3DGS, nerfstudio or LangSplat to the scene sheet.

    Reports what was found, what is used, and what is likely to fail.
    """
    from hilsplat.scene.sheet import DEFAULT_SHEET
    from hilsplat.workflow.models import models_of_photographs, settings_of_photographs
    from hilsplat.workflow.new_scene import add_scene

    settings = settings_of_photographs(sheet.with_name("config.yaml"), name)
    parts = {"poses": poses, "gaussians": gaussians, "features": features, "labels": labels}
    report = add_scene(sheet, name, photos, frames, **parts, settings=settings, dry_run=dry_run)
    if dry_run:
        echo(f"{report}\n\nnothing was added (--dry-run)")
        return
    is_default = sheet.resolve() == DEFAULT_SHEET.resolve()
    setting = "" if is_default else f", with `scenes: {sheet}` in config/config.yaml"
    following = f"  hilsplat run {name}\n  hilsplat query {name} 'bear nose'"
    echo(f"{report}\n\nadded photos/{name} to {sheet}. Next{setting}:\n{following}")
    for line in models_of_photographs(settings, report.columns.get("features")):
        echo(line)
