"""The last lines of a run: what exists of each scene, how good it is, and the next command."""

import shlex
from collections.abc import Sequence
from pathlib import Path

from hilsplat.base.artifacts import rebuild_command, run_command
from hilsplat.base.errors import HilsplatError, shorten_list
from hilsplat.base.tables import aligned_table, counted, read_csv
from hilsplat.evaluate.scenes import scene_lines
from hilsplat.evaluate.tables.means import TEXTS
from hilsplat.query.scene_state import SceneState
from hilsplat.scene.finished import command_name, scenes_in
from hilsplat.scene.sheet import SceneRow
from hilsplat.workflow import targets
from hilsplat.workflow.models import doubt_about_photographs
from hilsplat.workflow.plan import Plan

DETAILED, TABLED = 3, 30
"""Maximum number of scenes that are described one by one, and that share a table; reading a labelled scene of
490 files takes 50 ms."""

PSNR_WORDS = ((25.0, "good"), (20.0, "fair"))
"""Lowest PSNR of held-out views, in dB, for each word; below, the fit is poor. The words are ours; 3D
Gaussian Splatting has 23 to 29 dB on its photographs (Kerbl et al. 2023, Tab. 1)."""


def summary(plan: Plan, files: Sequence[str] = ()) -> list[str]:
    """Return the summary of a plan's scenes that have poses; if files were made, only of theirs."""
    existing = set(scenes_in(plan.results))
    rows = [row for row in plan.scenes if row.name in existing]
    if files:
        rows = [row for row in rows if any(file.startswith(f"{plan.path(row)}/") for file in files)]
    if len(rows) > TABLED:
        command = f"hilsplat scenes --results {shlex.quote(str(plan.results))}"
        lines = [f"{len(rows)} scenes have poses; to list them: {command}"]
    elif len(rows) > DETAILED:
        lines = scene_lines(plan.results, [row.name for row in rows])[0]
    else:
        lines = [line for row in rows for line in _scene(plan, row)]
    tables = [path for path in targets.tables(plan) if Path(path).is_file()]
    if tables and any(map(targets.data_of, rows)):
        lines.append(f"tables: {Path(tables[0]).parent}/*.md")
        if not files and (missing := targets.left_out(plan)):
            lines.append(
                f"  without scenes that have scores but are not in this run: {shorten_list(missing)}; "
                "to include them, add their groups to `groups` and run: hilsplat run tables"
            )
    return lines


def _scene(plan: Plan, row: SceneRow) -> list[str]:
    """Return a heading and the facts about one scene, or what is wrong with an artifact."""
    folder, figures = Path(plan.path(row)), plan.results / "figures" / row.name
    name, means = command_name(folder), folder / "scores.csv"
    try:
        scene = SceneState.read(folder)
        scores = read_csv(means, None, rebuild_command(means)) if means.is_file() else []
    except HilsplatError as error:  # the run has succeeded, but an earlier artifact is damaged
        return [f"{row.name}:", *(f"  {line}" for line in str(error).splitlines())]
    counts = ", ".join(f"{number} {level}" for level, number in scene.nodes.items())
    pictures = ", ".join(sorted(path.name for path in figures.glob("*.webp")))
    table = aligned_table([[*scores[0]], *([*cells.values()] for cells in scores)], TEXTS) if scores else []
    uses = f'hilsplat query {name} "..."  or  hilsplat view {name}'
    facts = {
        "poses": _poses(scene),
        "Gaussians": _fit(scene),
        "nodes": f"{counts} ({scene.models})" if counts else "",
        "pictures": f"{pictures} in {figures}" if pictures else "",
        "doubt": "" if row.generated else doubt_about_photographs(plan.stages(row)),
        "scores": f"in %, also in {means.with_suffix('.md')} and {means.name}:" if table else "",
    }
    lines = [f"{what:<10} {fact}" for what, fact in facts.items() if fact] + [f"  {line}" for line in table]
    following = uses if "tree" in scene.state else run_command(folder, scene=row.name)
    lines.append(f"{'next':<10} {following}")
    return [f"{row.name}:", *(f"  {line}" for line in lines)]


def _poses(scene: SceneState) -> str:
    report, (train, test) = scene.poses, scene.views.values()
    error = report.get("mean_reprojection_error_px")
    registered = f"{report.get('registered', train + test)} of {report.get('images', train + test)} views"
    return f"{registered} registered" + ("" if error is None else f"; reprojection error {error:.2f} px")


def _fit(scene: SceneState) -> str:
    """Return the number of Gaussians and their PSNR, with a word if it was measured in held-out views."""
    if not scene.fit:
        return ""
    psnr_db, of_test = scene.fit["psnr_db"], scene.fit["split"] == "test"
    word = next((word for least, word in PSNR_WORDS if psnr_db >= least), "poor")
    held_out = f"in {counted(scene.views['test'], 'held-out view')}: {word}"
    where = held_out if of_test else "in training views; none is held out"
    return f"{scene.fit['gaussians']}; PSNR {psnr_db:.1f} dB {where}"
