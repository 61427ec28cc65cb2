"""Command that exports a scene for other programs."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from hilsplat.base.errors import ArtifactError
from hilsplat.cli.apps import app
from hilsplat.cli.stage import DataRoot, Results, Threads, start_logging
from hilsplat.cli.user_commands import SceneName, scene_folder


class Form(StrEnum):
    """Export formats of a scene."""

    TREE = "tree"
    PLY = "ply"
    COLMAP = "colmap"
    NERFSTUDIO = "nerfstudio"
    LANGSPLAT = "langsplat"
    LABELS = "labels"


@app.command()
def export(
    scene: SceneName,
    form: Annotated[
        Form,
        typer.Option(
            "--as",
            help="tree: nodes as JSON, picture and PLY; ply: a 3DGS PLY; colmap: images and sparse/0; "
            "nerfstudio: images and transforms.json; langsplat: as colmap, with PLY and language_features; "
            "labels: the scene's annotations as those of LERF-OVS",
        ),
    ] = Form.TREE,
    variant: Annotated[str, typer.Option(help="variant, for tree and langsplat")] = "default",
    results: Results = Path("results"),
    data_root: DataRoot = Path(),
    out: Annotated[
        Path | None, typer.Option(help="new folder; default: export/FORM in the scene's folder, replaced")
    ] = None,
    threads: Threads = 2,
) -> None:
    """Write a scene for other programs: tree, Gaussians, poses, LangSplat's features, or labels.

    Poses and Gaussians are in the coordinates of the scene's source.
    """
    start_logging()
    folder = scene_folder(scene, results)
    if out is not None and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ArtifactError(f"--out {out} exists", fix="name a new folder, or remove it first")
    name = form.value if variant == "default" else f"{form.value}-{variant}"
    typer.echo(_write(form, folder, out or folder / "export" / name, variant, data_root, threads))


def _write(form: Form, folder: Path, out: Path, variant: str, data_root: Path, threads: int) -> str:
    """Write an export, and return a human-readable summary."""
    from hilsplat.scene.scene import Scene

    if form is Form.TREE:
        from hilsplat.query.tree_picture import export_tree

        return export_tree(folder, variant, out, threads)
    if form is Form.PLY:
        from hilsplat.splat.coordinates import write_source_ply

        number = write_source_ply(folder / "gaussians.ply", out / "point_cloud.ply")
        return f"wrote {number} Gaussians to {out / 'point_cloud.ply'}"
    opened = Scene.load(folder / "scene")
    views = len(opened.cameras)
    if form is Form.COLMAP:
        from hilsplat.scene.exporting import write_colmap

        write_colmap(opened, out)
        return f"wrote images and sparse/0 of {views} views to {out}"
    if form is Form.NERFSTUDIO:
        from hilsplat.scene.exporting import write_nerfstudio

        write_nerfstudio(opened, out)
        return f"wrote images, transforms.json and points.ply of {views} views to {out}"
    if form is Form.LANGSPLAT:
        from hilsplat.embed.langsplat_export import export_langsplat
        from hilsplat.scene.finished import FinishedScene

        parts = FinishedScene.locate(folder, variant).parts
        export_langsplat(opened, parts.masks, parts.clip, parts.gaussians, out)
        return f"wrote images, sparse/0, point_cloud.ply and language_features of {views} views to {out}"
    from hilsplat.annotate.exporting import export_labels

    number = export_labels(opened, folder, data_root, out)
    return f"wrote labels of {number} views to {out}"
