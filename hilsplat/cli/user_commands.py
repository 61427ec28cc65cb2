"""Commands that use a finished scene, check results or the machine, or print all settings."""

import json
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from hilsplat.base.errors import SettingsError
from hilsplat.cli.common import Results, app, echo, refuse_options, require_new_folder
from hilsplat.stage import DataRoot, Threads

SceneName = Annotated[str, typer.Argument(help="scene in results/, such as desk or photos/desk, or its path")]


@app.command()
def query(
    context: typer.Context,
    scene: SceneName,
    text: Annotated[
        list[str] | None, typer.Argument(help="what to look for; 'bear > nose' finds the noses of bears")
    ] = None,
    all_scenes: Annotated[
        bool, typer.Option("--all", help="rank all finished scenes: --all TEXT, or --all 'photos/*' TEXT")
    ] = False,
    limit: Annotated[int, typer.Option(min=1, help="with --all: maximum number of scenes")] = 10,
    as_json: Annotated[bool, typer.Option("--json", help="with --all: print the answers as JSON")] = False,
    level: Annotated[str, typer.Option(help="level of the answers: auto, whole, part, subpart")] = "auto",
    variant: Annotated[str, typer.Option(help="variant to query")] = "default",
    results: Results = Path("results"),
    views: Annotated[int, typer.Option(min=1, max=8, help="number of views in the panel")] = 3,
    answerer: Annotated[
        str, typer.Option(help="tree: nodes of the semantic tree; field: the paper's language field")
    ] = "tree",
    view: Annotated[str | None, typer.Option(help="search only in this view, such as 000.png")] = None,
    threshold: Annotated[
        float | None, typer.Option(help="minimum score of an answer, 0 to 1; default: near the best score")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="folder; default: queries/TEXT in the scene's folder")
    ] = None,
    masks: Annotated[
        Path | None, typer.Option(help="new folder for masks of the answer in all views: PNG and COCO")
    ] = None,
    spz: Annotated[
        bool, typer.Option("--spz", help="write selection.spz, too: compressed Gaussians")
    ] = False,
    threads: Threads = 2,
) -> None:
    """Find the objects or parts that match a text in a finished scene.

    Prints the score, level, position, size and best views of each answer. Writes a picture (panel.png) and
    the answers' Gaussians (selection.ply). With --all, prints the best answer of each of the best scenes.
    """
    if all_scenes:
        of_one = ("out", "masks", "spz", "view", "views", "answerer", "threads")
        refuse_options(context, of_one, "one scene, without --all")
        from hilsplat.query.scenes import open_scenes, report_of

        pattern, wanted = (scene, " ".join(text)) if text else ("*", scene)
        scenes = open_scenes(results, pattern, variant)
        hits = scenes.query(wanted, level, threshold=threshold, limit=limit)
        rows = [hit.as_json() for hit in hits]
        echo(json.dumps(rows, indent=1) if as_json else report_of(scenes, wanted, hits, level))
        return
    refuse_options(context, ("limit", "as_json"), "--all")
    folder = scene_folder(scene, results)
    if not text:
        fix = f"hilsplat query {shlex.quote(scene)} TEXT"
        raise SettingsError(f"there is no text to search for in {scene}", fix=fix)
    if masks is not None:
        require_new_folder(masks, "--masks")
    from hilsplat.query.answer import answer

    for line in answer(
        folder,
        " ".join(text),
        level=level,
        variant=variant,
        views=views,
        answerer=answerer,
        view=view,
        threshold=threshold,
        out=out,
        masks=masks,
        spz=spz,
        threads=threads,
    ):
        echo(line)


def scene_folder(scene: str, results: Path, variant: str = "") -> Path:
    """Return the folder of a scene (name, dataset/scene or path).

    Raises:
        ArtifactError: there is no such scene or, if given, variant; the message lists those that exist.
        SettingsError: the name is ambiguous.
    """
    from hilsplat.scene.finished import holds_scenes, require_scene_folder, require_variant, scenes_in

    matching = [name for name in scenes_in(results) if scene in (name, name.partition("/")[2])]
    if len(matching) > 1:
        expected = f"one of {', '.join(matching)}"
        raise SettingsError(f"{scene!r} matches several scenes", expected=expected)
    named = results / (matching[0] if matching else scene)
    folder = Path(scene) if not named.is_dir() and holds_scenes(Path(scene)) else named
    require_scene_folder(folder)
    if variant:
        require_variant(folder, variant)
    return folder


@app.command("show-masks")
def show_masks(
    scene: Annotated[Path, typer.Option(help="posed scene")],
    masks: Annotated[Path, typer.Option(help="masks of the views")],
    out: Annotated[Path, typer.Option(help="PNG to write, with the trees beside it")] = Path("masks.png"),
    coverage_tree: Annotated[Path | None, typer.Option(help="coverage trees to draw as well")] = None,
    view: Annotated[str | None, typer.Option(help="name of the view; default: the middle one")] = None,
) -> None:
    """Draw a view's masks at three levels, and its coverage trees."""
    from hilsplat.segment.pictures import masks_overview

    echo(f"wrote {out}, view {masks_overview(scene, masks, out, view, coverage_tree)}")


@app.command()
def scenes(
    pattern: Annotated[str, typer.Argument(help="scenes to list, such as 'photos/*'")] = "*",
    results: Results = Path("results"),
    out: Annotated[Path | None, typer.Option(help="CSV to write as well")] = None,
) -> None:
    """Print a table of all scenes: state, views, PSNR, IoU, size, date, models; the CSV has more columns."""
    from hilsplat.evaluate.scenes import run_scenes

    echo(run_scenes(results, pattern, out))


@app.command()
def verify(
    results: Annotated[Path, typer.Argument(help="results folder, or a copy of it")] = Path("results"),
) -> None:
    """Check all digests in a results folder, and print the command that repairs it."""
    from hilsplat.workflow.records import verify

    report, is_whole = verify(results)
    echo(report)
    if not is_whole:
        raise typer.Exit(1)


@app.command()
def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="print the findings as a JSON list")] = False,
) -> None:
    """Check this machine: libraries, GPU, models, disk, memory. The exit status is 1 if there is a fault."""
    from hilsplat.workflow.doctor import examine

    findings = []
    for finding in examine():
        findings.append(asdict(finding))
        if not as_json:
            echo(f"{finding.state:<5}  {finding.check:<14} {finding.found}")
            if finding.fix:
                echo(f"       {'':<14} -> {finding.fix}")
    if as_json:
        echo(json.dumps(findings, indent=1))
    if any(finding["state"] == "fault" for finding in findings):
        raise typer.Exit(1)


@app.command()
def settings(
    schema: Annotated[bool, typer.Option(help="print the configuration's JSON schema, for editors")] = False,
) -> None:
    """Print every setting: default, choices or range, unit, origin, meaning."""
    from hilsplat.configuration import config_schema, knob_table

    echo(json.dumps(config_schema(), indent=1) if schema else knob_table())


@app.command()
def export(
    context: typer.Context,
    scene: SceneName,
    form: Annotated[
        Literal["tree", "ply", "colmap", "nerfstudio", "langsplat", "labels"],
        typer.Option(
            "--as",
            help="tree: nodes as JSON, picture and PLY; ply: a 3DGS PLY; colmap: images and sparse/0; "
            "nerfstudio: images and transforms.json; langsplat: colmap plus PLY and language_features; "
            "labels: the scene's annotations in LERF-OVS format",
        ),
    ] = "tree",
    variant: Annotated[
        str, typer.Option(help="variant, for tree, langsplat, --only, --without, --clean")
    ] = "default",
    results: Results = Path("results"),
    data_root: DataRoot = Path(),
    out: Annotated[
        Path | None, typer.Option(help="new folder; default: export/FORM in the scene's folder (overwritten)")
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(help="with --as ply: write only what matches a query, or a node's number; repeatable"),
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option(help="with --as ply: leave out what matches a query, or a node's number; repeatable"),
    ] = None,
    clean: Annotated[
        bool, typer.Option("--clean", help="with --as ply: leave out Gaussians of no node, such as floaters")
    ] = False,
    threads: Threads = 2,
) -> None:
    """Write a scene for other programs: tree, Gaussians, poses, LangSplat's features, or labels.

    Poses and Gaussians are in the coordinates of the scene's source.
    """
    from hilsplat.base.ownership import replaced_folder

    crop = {"only": only or [], "without": without or [], "clean": clean}
    if form != "ply":
        refuse_options(context, crop, "--as ply")
    if form != "labels":
        refuse_options(context, ("data_root",), "--as labels")
    if form not in ("tree", "langsplat") and not any(crop.values()):
        refuse_options(context, ("variant",), "--as tree, --as langsplat, --only, --without or --clean")
    folder = scene_folder(scene, results)
    if out is not None:
        require_new_folder(out)
        echo(_export(folder, form, variant, data_root, out, crop, threads))
        return
    out = folder / "export" / (form if variant == "default" else f"{form}-{variant}")
    with replaced_folder(out) as temporary:
        text = _export(folder, form, variant, data_root, temporary, crop, threads)
    echo(text.replace(str(temporary), str(out)))


def _export(
    folder: Path, form: str, variant: str, data_root: Path, out: Path, crop: dict[str, Any], threads: int
) -> str:
    """Write an export, and return the text to print; `crop` has the arguments of `remaining_rows`."""
    if form == "tree":
        from hilsplat.query.tree_picture import export_tree

        return export_tree(folder, variant, out, threads)
    if form == "ply":
        from hilsplat.splat.coordinates import write_source_ply

        ply, rows, lines = out / "point_cloud.ply", None, list[str]()
        if any(crop.values()):
            from hilsplat.query.cropped import remaining_rows
            from hilsplat.query.language_scene import open_scene

            rows, lines = remaining_rows(open_scene(folder, variant, threads=threads), **crop)
        number = write_source_ply(folder / "gaussians.ply", ply, rows)
        return "\n".join([*lines, f"wrote {number} Gaussians to {ply}"])
    from hilsplat.scene.scene import Scene

    opened = Scene.load(folder / "scene")
    views = len(opened.cameras)
    if form == "labels":
        from hilsplat.annotate.exchange import export_labels

        views, what = export_labels(opened, folder, data_root, out), "labels"
    elif form == "langsplat":
        from hilsplat.embed.langsplat_export import export_langsplat
        from hilsplat.scene.finished import FinishedScene

        parts = FinishedScene.locate(folder, variant).parts
        export_langsplat(opened, parts.masks, parts.clip, parts.gaussians, out)
        what = "images, sparse/0, point_cloud.ply and language_features"
    else:
        from hilsplat.scene.exporting import write_colmap, write_nerfstudio

        is_colmap = form == "colmap"
        what = "images and sparse/0" if is_colmap else "images, transforms.json and points.ply"
        (write_colmap if is_colmap else write_nerfstudio)(opened, out)
    return f"wrote {what} of {views} views to {out}"


Port = Annotated[
    int, typer.Option(min=0, max=65535, help="port of the page; 0: its own, or else any free port")
]
Browser = Annotated[bool, typer.Option(help="open the page in a browser")]


@app.command()
def view(
    scene: SceneName,
    variant: Annotated[str, typer.Option(help="variant to select first")] = "default",
    results: Results = Path("results"),
    port: Port = 0,
    browser: Browser = True,
    threads: Threads = 2,
) -> None:
    """View and query a scene in a browser on this machine.

    During a run, the page shows the Gaussians, and accepts queries as soon as possible. Press Ctrl-C to stop.
    """
    from hilsplat.viewer.app import run_view

    folder = scene_folder(scene, results, variant)
    run_view(folder, variant=variant, port=port, browser=browser, threads=threads, on_ready=echo)


@app.command()
def annotate(
    scene: SceneName,
    variant: Annotated[str, typer.Option(help="variant whose masks or nodes are suggested")] = "default",
    results: Results = Path("results"),
    data_root: DataRoot = Path(),
    port: Port = 0,
    browser: Browser = True,
    threads: Threads = 2,
) -> None:
    """Annotate regions of a scene's photographs, with levels and parents, in a browser on this machine.

    Writes annotated/DATASET/SCENE in the data root after each change; evaluate reads it like any data set.
    """
    from hilsplat.annotate.app import run_annotate
    from hilsplat.scene.scene import Scene

    folder = scene_folder(scene, results, variant)
    labels = data_root / "annotated" / Scene.load(folder / "scene").name
    run_annotate(folder, labels, variant=variant, port=port, browser=browser, threads=threads, on_ready=echo)
