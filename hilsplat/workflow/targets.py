"""Targets of a run: tables, their scores, and pictures."""

from contextlib import suppress
from itertools import chain
from pathlib import Path

from hilsplat.base.errors import ArtifactError, shorten_list
from hilsplat.base.lineage import read_provenance
from hilsplat.datasets.generators import GENERATORS
from hilsplat.datasets.registry import ANNOTATED, DATASETS
from hilsplat.datasets.sources import LEVELLED, published
from hilsplat.evaluate.tables.image_tables import averaged_scenes
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
    if kind.has_levels:
        rows = _of_levels(plan, rows, shows_flat="3D-OVS mIoU" in chain(*kind.columns))
    return [
        plan.path(row, variant, name)
        for row in rows
        for first in getattr(plan.run, kind.variants)
        for variant in plan.seeded(first, row, kind.variants)
    ]


def _of_levels(plan: Plan, rows: list[SceneRow], *, shows_flat: bool) -> list[SceneRow]:
    """Return the scenes whose labels may have levels.

    With `shows_flat`, rows of Hi-LERF also have a column of 3D-OVS, and rows of Hi-3DOVS one of LERF
    (`flat_scores`), so these scenes are included if labels of the other data set have levels.
    """
    levelled = {row: _label_sets(plan, row).intersection((*LEVELLED, ANNOTATED)) for row in rows}
    benchmarks = {DATASETS[name].images_of for names in levelled.values() for name in names - {ANNOTATED}}

    def is_beside(row: SceneRow) -> bool:
        return bool(benchmarks - {data_of(row)}) and row.scene in averaged_scenes(data_of(row))

    return [row for row in rows if row.generated or levelled[row] or (shows_flat and is_beside(row))]


def _label_sets(plan: Plan, row: SceneRow) -> set[str]:
    """Return the names of the data sets whose labels a scene has."""
    return {name.partition("/")[0] for name in plan.data.labels(row)}


def absent(plan: Plan, table: str) -> list[str]:
    """Return a sentence about each of a table's data sets that has unmeasured scenes or lacks labels."""
    by_dataset: dict[str, list[tuple[str, str]]] = {}
    for row in plan.rows:
        reason = plan.data.absence(row)
        names = published(row.source)
        if names and table in DATASETS[names[0]].tables and reason is not None:
            by_dataset.setdefault(row.dataset, []).append((row.scene, reason))
    sentences = [
        f"{name}: no labelled segment was found in {plan.run.data_root or 'data_root, which is not set'}."
        for name in _not_found(plan)
        if table in DATASETS[name].tables
    ]
    for dataset, scenes in by_dataset.items():
        reasons = {reason for _, reason in scenes}
        others = "" if len(reasons) == 1 else " The other scenes cannot be read either."
        listed = shorten_list([scene for scene, _ in scenes])
        sentences.append(f"{dataset} ({listed}): {scenes[0][1]}.{others}")
    for data in (DATASETS[name] for name in LEVELLED if TABLES[table].has_levels):
        rows = [row for row in plan.scenes if data_of(row) == data.images_of and table in tables_of(row)]
        if unlabelled := [row.scene for row in rows if data.name not in _label_sets(plan, row)]:
            listed, place = shorten_list(unlabelled), data.root(plan.run.data_root)
            sentences.append(f"{data.name} ({listed}): {place} has no labels with levels.")
    return sentences


def _not_found(plan: Plan) -> list[str]:
    """Return the data sets among the groups that have neither rows in the sheet nor scenes on the disk."""
    sources = {data_of(row) for row in plan.rows}
    return [name for name in DATASETS if name in plan.run.groups and name not in sources]


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


def of_run(plan: Plan) -> list[str]:
    """Return the names of the tables that show this run, list data that it lacks, or have no scores yet.

    The others would lose the measured rows of earlier runs, as would all tables in a run of photographs.
    """
    if not any(data_of(row) for row in labelled(plan)):
        return []
    lacking = {table for row in plan.rows if row.name in plan.absent for table in tables_of(row)}
    if not plan.run.only:
        lacking.update(*(DATASETS[name].tables for name in _not_found(plan)))
    paths = {Path(path).stem: Path(path) for path in tables(plan)}
    return [name for name in paths if name in lacking or scores(plan, name) or not _has_scores(paths[name])]


def _has_scores(table: Path) -> bool:
    """Return whether a table was made from scores."""
    with suppress(ArtifactError):  # its record is damaged
        record = read_provenance(table)
        read = record.inputs.get("scores") if record else None
        return bool(read and read.files)
    return False


def left_out(plan: Plan) -> list[str]:
    """Return the scenes that an earlier run scored and the tables of this run would show but leave out."""
    shown, names = {*of_run(plan)}, {row.name for row in plan.scenes}
    others = [row for row in plan.rows if row.name not in names and shown.intersection(tables_of(row))]
    return [row.name for row in others if any(Path(plan.path(row)).glob("*/scores.csv"))]


def default(plan: Plan) -> list[str]:
    """Return all pictures, vectors of key views, mean scores, and the tables and plots of this run."""
    shown = of_run(plan)
    plots = [f"{plan.run.results}/figures/sweep-{name}.png" for name in ("theta", "omega") if name in shown]
    early = [row for row in plan.scenes if plan.first_answer(of_variant(row, "default"))]
    answers = [plan.of_key_views("clip")(row) for row in early]
    means = [plan.path(row, "scores.md") for row in labelled(plan)]
    of_tables = [path for path in tables(plan) if Path(path).stem in shown]
    return [*figures(plan), *answers, *means, *of_tables, *plots]


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
