"""Commands from photographs to Gaussians: new, poses, gaussians."""

from pathlib import Path
from typing import Annotated

import typer

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
    start_logging,
)

POSES_HELP = (
    "a COLMAP model, a transforms.json, or a folder with either; none: structure from motion; default: the "
    "poses in the folder"
)


@app.command()
def new(
    name: Annotated[str, typer.Argument(help="name of the scene: letters, digits, . _ -")],
    photos: Annotated[
        Path, typer.Argument(help="folder of photographs or videos, a video, or a zip of photographs")
    ],
    sheet: Annotated[Path, typer.Option(help="scene sheet")] = Path("config/scenes.tsv"),
    frames: Annotated[int, typer.Option(min=3, max=1000, help="most frames taken from videos")] = 60,
    poses: Annotated[Path | None, typer.Option(help=POSES_HELP)] = None,
    gaussians: Annotated[
        Path | None,
        typer.Option(help="a 3DGS PLY instead of a fit; none: fit; default: what 3DGS left in the folder"),
    ] = None,
    features: Annotated[
        Path | None,
        typer.Option(
            help="LangSplat's language_features instead of SAM and CLIP; none: compute them; default: "
            "those in the folder"
        ),
    ] = None,
    labels: Annotated[
        Path | None,
        typer.Option(help="LERF-OVS's label files, for scores; none; default: those beside the scene"),
    ] = None,
) -> None:
    """Add photographs, a video, or a scene of COLMAP, 3DGS, nerfstudio or LangSplat to the scene sheet.

    Reports what was found, what is used, and what is likely to fail.
    """
    start_logging()
    from hilsplat.photos.add import add_scene
    from hilsplat.scene.sheet import read_sheet
    from hilsplat.workflow.models import models_of_photographs

    report = add_scene(
        sheet, name, photos, frames=frames, poses=poses, gaussians=gaussians, features=features, labels=labels
    )
    following = f"  hilsplat run {name}\n  hilsplat query {name} 'bear nose'"
    typer.echo(f"{report}\n\nadded photos/{name} to {sheet}. Next:\n{following}")
    features = read_sheet(sheet, checked_groups=())[-1].features
    for line in models_of_photographs(sheet.with_name("config.yaml"), name, features):
        typer.echo(line)


@app.command("poses")
def find_poses(
    images: PathIn,
    out: PathOut,
    name: Annotated[str, typer.Option(help="dataset/scene, for messages")] = "scene",
    unit: Annotated[str, typer.Option(help="unit of length: metre or arbitrary")] = "arbitrary",
    render: Annotated[bool, typer.Option(help="the images are renders: an ideal pinhole lens")] = False,
    poses: Annotated[Path | None, typer.Option(help=POSES_HELP)] = None,
    settings: Settings = "{}",
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Compute the camera poses of photographs, or import a COLMAP model or transforms.json."""
    section = section_of("poses", settings)
    inputs = {"images": images, **({"poses": poses} if poses and poses.exists() else {})}
    with stage("poses", out, settings=section, seed=seed, threads=threads, inputs=inputs):
        from hilsplat.scene.poses import run_poses

        run_poses(images, out, name, unit, render, section, seed, threads, poses)


@app.command()
def gaussians(
    scene: PathIn,
    out: PathOut,
    report: Annotated[Path, typer.Option(help="folder for the fit's report")],
    settings: Settings = "{}",
    existing: Annotated[
        Path | None,
        typer.Option(help="a 3DGS PLY of your own, in the source's coordinates; replaces the fit"),
    ] = None,
    dataparser: Annotated[
        Path | None,
        typer.Option(help="nerfstudio's dataparser_transforms.json, if that PLY is in its coordinates"),
    ] = None,
    transforms: Annotated[
        Path | None, typer.Option(help="the transforms.json with the source's poses, for --dataparser")
    ] = None,
    cache: Cache = DEFAULT_CACHE,
    seed: Seed = 0,
    threads: Threads = 1,
) -> None:
    """Fit 3D Gaussians to the training views, or use your own; a JSON file records their coordinates."""
    section = section_of("gaussians", settings)
    optional = {"existing": existing, "dataparser": dataparser, "transforms": transforms}
    inputs = {"scene": scene, **{name: path for name, path in optional.items() if path}}
    beside = (out.with_suffix(".json"), report)
    with stage(
        "gaussians",
        out,
        settings=section,
        seed=seed,
        threads=threads,
        inputs=inputs,
        beside=beside,
        device=section.device,
    ):
        from hilsplat.splat.fit import run_gaussians

        run_gaussians(scene, out, report, cache, section, seed, threads, existing, dataparser, transforms)
