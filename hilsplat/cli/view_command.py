"""Commands that open a scene in a browser, to view and query it or to annotate its photographs."""

from pathlib import Path
from typing import Annotated

import typer

from hilsplat.cli.apps import app
from hilsplat.cli.stage import DataRoot, Results, Threads, start_logging
from hilsplat.cli.user_commands import SceneName, scene_folder

Port = Annotated[int, typer.Option(min=0, max=65535, help="port of the page; 0: any that is free")]
Browser = Annotated[bool, typer.Option(help="open the page in a browser")]


@app.command()
def view(
    scene: SceneName,
    variant: Annotated[str, typer.Option(help="variant that answers first")] = "default",
    results: Results = Path("results"),
    port: Port = 0,
    browser: Browser = True,
    threads: Threads = 2,
) -> None:
    """View and query a scene in a browser on this machine.

    During a run, the page shows the Gaussians, and accepts queries as soon as possible. Press Ctrl-C to stop.
    """
    start_logging()
    from hilsplat.viewer.app import run_view

    folder = scene_folder(scene, results)
    run_view(folder, variant=variant, port=port, browser=browser, threads=threads, on_ready=typer.echo)


@app.command()
def annotate(
    scene: SceneName,
    variant: Annotated[str, typer.Option(help="variant whose masks or nodes are proposed")] = "default",
    results: Results = Path("results"),
    data_root: DataRoot = Path(),
    port: Port = 0,
    browser: Browser = True,
    threads: Threads = 2,
) -> None:
    """Annotate the photographs of a scene, with levels and parents, in a browser on this machine.

    Writes annotated/DATASET/SCENE below the data root after each change; evaluate reads it like any data set.
    """
    start_logging()
    from hilsplat.annotate.app import run_annotate
    from hilsplat.scene.scene import Scene

    folder = scene_folder(scene, results)
    labels = data_root / "annotated" / Scene.load(folder / "scene").name
    run_annotate(
        folder, labels, variant=variant, port=port, browser=browser, threads=threads, on_ready=typer.echo
    )
