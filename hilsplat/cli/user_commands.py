"""Commands that query a finished scene, check results and machine, and print all settings."""

import gc
import glob
from pathlib import Path
from typing import Annotated

import typer

from hilsplat.base.errors import SettingsError
from hilsplat.cli.apps import app
from hilsplat.cli.stage import Results, Threads, start_logging

SceneName = Annotated[
    str,
    typer.Argument(help="scene in the results folder, such as desk or photos/desk, or a path to its folder"),
]


@app.command()
def query(
    scene: SceneName,
    text: Annotated[
        str,
        typer.Argument(
            help="what to look for; 'mug > handle' finds handles of mugs, 'bear > head > nose' the nose on a "
            "bear's head"
        ),
    ],
    level: Annotated[
        str,
        typer.Option(help="level of the answers (of a path: of its last text): auto, whole, part, subpart"),
    ] = "auto",
    variant: Annotated[str, typer.Option(help="variant whose files answer")] = "default",
    results: Results = Path("results"),
    views: Annotated[int, typer.Option(min=1, max=8, help="views in the panel")] = 3,
    answerer: Annotated[
        str, typer.Option(help="tree: nodes of the semantic tree answer; field: the paper's language field")
    ] = "tree",
    view: Annotated[str | None, typer.Option(help="find only what this view shows, such as 000.png")] = None,
    threshold: Annotated[
        float | None,
        typer.Option(help="least score of an answer, between 0 and 1; default: the answers near the best"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="folder for panel.png and selection.ply; default: queries/TEXT in the scene's folder"
        ),
    ] = None,
    threads: Threads = 2,
) -> None:
    """Find the objects or parts that match a text in a finished scene.

    Prints score, level, position, size and best views of each answer; writes a picture (panel.png) and the
    answers' Gaussians (selection.ply).
    """
    start_logging()
    gc.disable()  # garbage collection would take a tenth of the two seconds
    try:
        from hilsplat.query.answer import answer

        for found in answer(
            scene_folder(scene, results),
            text,
            level=level,
            variant=variant,
            views=views,
            answerer=answerer,
            view=view,
            threshold=threshold,
            out=out,
            threads=threads,
        ):
            typer.echo(found)
    finally:
        gc.enable()


def scene_folder(scene: str, results: Path) -> Path:
    """Return the folder of a scene, given as a name, as dataset/scene, or as a path.

    Raises:
        SettingsError: several data sets have a scene of this name.
    """
    named, path = results / scene, Path(scene)
    if "/" not in scene:
        found = sorted(folder.parent for folder in results.glob(f"*/{glob.escape(scene)}/scene"))
        if len(found) > 1:
            raise SettingsError(
                f"{scene!r} names several scenes",
                expected=f"one of {', '.join(f'{folder.parent.name}/{scene}' for folder in found)}",
            )
        if found:
            return found[0]
    return path if path.is_dir() and not named.is_dir() else named


@app.command()
def verify(
    results: Annotated[Path, typer.Argument(help="results folder, or a copy of it")] = Path("results"),
) -> None:
    """Check every digest of a results folder, and print the Snakemake command that repairs it."""
    start_logging()
    from hilsplat.workflow.records import verify

    report, is_whole = verify(results)
    typer.echo(report)
    if not is_whole:
        raise typer.Exit(1)


@app.command()
def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="print a list of findings as JSON")] = False,
) -> None:
    """Check this machine: libraries, GPU, models, disk, memory. The exit status is 1 if there is a fault."""
    import json
    from dataclasses import asdict

    from hilsplat.workflow.doctor import examine

    findings = []
    for finding in examine():
        findings.append(asdict(finding))
        if not as_json:
            typer.echo(f"{finding.state:<5}  {finding.check:<14} {finding.found}")
            if finding.fix:
                typer.echo(f"       {'':<14} -> {finding.fix}")
    if as_json:
        typer.echo(json.dumps(findings, indent=1))
    if any(finding["state"] == "fault" for finding in findings):
        raise typer.Exit(1)


@app.command()
def settings(
    schema: Annotated[
        bool, typer.Option(help="print the JSON schema of the configuration, for editors")
    ] = False,
) -> None:
    """Print every setting: default, choices or range, unit, origin, meaning."""
    import json

    from hilsplat.configuration import config_schema, knob_table

    typer.echo(json.dumps(config_schema(), indent=1) if schema else knob_table())
