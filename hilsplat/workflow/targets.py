"""Targets of a run: tables, their scores, and pictures."""

from hilsplat.base.errors import shorten_list
from hilsplat.datasets.generators import GENERATORS
from hilsplat.datasets.registry import DATASETS
from hilsplat.datasets.sources import published
from hilsplat.evaluate.tables.kinds import TABLES
from hilsplat.scene.sheet import SceneRow
from hilsplat.workflow.plan import Plan
from hilsplat.workflow.scene_data import Job, of_variant

PICTURES = {
    "panel": "queries",
    "registration": "camera poses",
    "fit": "3D Gaussians",
    "masks": "masks against the truth",
    "comparison": "queries by method",
    "views": "one query in several views",
    "features": "features at three levels",
}
"""Picture of a scene -> its title in the report."""


def scores(plan: Plan, table: str, name: str = "scores.csv") -> list[str]:
    """Return a table's score files, or the files `name` beside them; sweeps use `sweep_scenes`, if set."""
    kind = TABLES[table]
    rows = [row for row in labelled(plan) if table in tables_of(row)]
    if kind.variants != "main_variants" and plan.run.sweep_scenes:
        rows = [row for row in rows if row.scene in plan.run.sweep_scenes]
    return [
        plan.path(row, variant, name)
        for row in rows
        for first in getattr(plan.run, kind.variants)
        for variant in plan.seeded(first, row, kind.variants)
    ]


def absent(plan: Plan, table: str) -> list[str]:
    """Return a sentence about each of a table's data sets that has unmeasured scenes."""
    by_dataset: dict[str, list[tuple[str, str]]] = {}
    sources = {data_of(row) for row in plan.rows}
    for row in plan.rows:
        reason = plan.data.absence(row)
        names = published(row.source)
        if names and table in DATASETS[names[0]].tables and reason is not None:
            by_dataset.setdefault(row.dataset, []).append((row.scene, reason))
    sentences = [
        f"{name}: no labelled segment was found in {plan.run.data_root or 'data_root, which is not set'}."
        for name in DATASETS
        if name in plan.run.groups and table in DATASETS[name].tables and name not in sources
    ]
    for dataset, scenes in by_dataset.items():
        reasons = {reason for _, reason in scenes}
        others = "" if len(reasons) == 1 else " The other scenes cannot be read either."
        listed = shorten_list([scene for scene, _ in scenes])
        sentences.append(f"{dataset} ({listed}): {scenes[0][1]}.{others}")
    return sentences


def labelled(plan: Plan) -> list[SceneRow]:
    """Return the scenes with annotations or labels, which can be scored."""
    return [row for row in plan.scenes if row.generated or plan.data.labels(row)]


def data_of(row: SceneRow) -> str:
    """Return the name of a scene's data in tables: its kind of generated scene, or its published data set."""
    if row.generated:
        return row.generated.kind
    names = published(row.source)
    return names[0] if names else ""


def tables_of(row: SceneRow) -> tuple[str, ...]:
    """Return the names of the tables that show a scene with published or generated labels."""
    if row.generated:
        return GENERATORS[row.generated.generator].kinds[row.generated.kind].tables
    names = published(row.source)
    return DATASETS[names[0]].tables if names else ()


def tables(plan: Plan) -> list[str]:
    """Return every table with variants to compare; each contains the paper's rows and measured rows."""
    return [
        f"{plan.run.results}/tables/{name}.csv"
        for name, kind in TABLES.items()
        if getattr(plan.run, kind.variants)
    ]


def default(plan: Plan) -> list[str]:
    """Return all pictures, vectors of key views, mean scores, tables and plots.

    Tables and plots need a benchmark scene in the run. A run of photographs would otherwise replace a
    benchmark's tables with tables of reported rows only.
    """
    plots = [
        f"{plan.run.results}/figures/sweep-{name}.png"
        for name in ("theta", "omega")
        if getattr(plan.run, TABLES[name].variants)
    ]
    early = [row for row in plan.scenes if plan.first_answer(of_variant(row, "default"))]
    answers = [plan.of_key_views("clip")(row) for row in early]
    means = [plan.path(row, "scores.md") for row in labelled(plan)]
    has_tables = any(data_of(row) for row in labelled(plan))
    return [*figures(plan), *answers, *means, *(tables(plan) + plots if has_tables else [])]


def compared_means(plan: Plan, job: Job) -> list[str]:
    """Return the input of `score_means`: the scores of `default` and, if comparable, of LangSplat.

    A scene with LangSplat's features is compared with LangSplat on the same Gaussians, masks and vectors.
    """
    others = [of_variant(job, name) for name in plan.run.main_variants if plan.row(job).features]
    names = [other.variant for other in others if plan.stages(other).method.name == "langsplat"]
    return [plan.path(job, name, "scores.csv") for name in dict.fromkeys(["default", *names])]


def figures(plan: Plan) -> list[str]:
    """Return panels, node names, masks against ground truth and, for sweep scenes, method comparisons."""
    paths = []
    for row in plan.scenes:
        # a scene of the user's may have the name of a benchmark scene
        in_sweeps = bool(data_of(row)) and row.scene in plan.run.sweep_scenes
        compared = in_sweeps or not plan.run.sweep_scenes
        generated = GENERATORS[row.generated.generator].pictures if row.generated else ()
        pictures = ["panel", *generated, *(["comparison"] if compared else [])]
        paths += [f"{plan.run.results}/figures/{row.name}/{picture}.webp" for picture in pictures]
        paths.append(plan.path(row, "default/names"))
    return paths
