"""Look at a scene and ask it in a browser."""

from pathlib import Path
from typing import Annotated

import typer

from hilsplat.cli.apps import app
from hilsplat.cli.stage import Results, Threads, start_logging
from hilsplat.cli.user_commands import SceneName, scene_folder


@app.command()
def view(
    scene: SceneName,
    variant: Annotated[str, typer.Option(help="variant that answers first")] = "default",
    results: Results = Path("results"),
    port: Annotated[int, typer.Option(min=0, max=65535, help="port of the page; 0: any that is free")] = 0,
    browser: Annotated[bool, typer.Option(help="open the page in a browser")] = True,
    threads: Threads = 2,
) -> None:
    """Fly through a scene in a browser on this machine, and ask it.

    Shows what exists: Gaussians while the run goes, answers as soon as they are there. Ctrl-C ends it.
    """
    start_logging(None)
    from hilsplat.viewer.app import run_view

    folder = scene_folder(scene, results)
    run_view(folder, variant=variant, port=port, browser=browser, threads=threads, told=typer.echo)
