"""The targets of a run: tables, the scores that they are built from, and pictures."""

import shlex
from pathlib import Path

from hilsplat.datasets.registry import DATASETS
from hilsplat.datasets.sources import published
from hilsplat.evaluate.scores import score_summary
from hilsplat.evaluate.tables.build import TABLES
from hilsplat.scene.sheet import SceneRow
from hilsplat.workflow.plan import Plan, some


def scores(plan: Plan, table: str, name: str = "scores.csv") -> list[str]:
    """Return the score files of a table, or files beside them; sweeps use the scenes configured for them."""
    kind = TABLES[table]
    rows = [row for row in labelled(plan) if data_of(row) in kind.data]
    if kind.is_sweep and plan.run.sweep_scenes:
        rows = [row for row in rows if row.scene in plan.run.sweep_scenes]
    return [
        plan.path(row, variant, name)
        for row in rows
        for first in getattr(plan.run, kind.variants)
        for variant in plan.seeded(first, row)
    ]


def absent_options(plan: Plan, table: str) -> str:
    """Options that say which scenes of a table's data sets were not measured."""
    by_dataset: dict[str, list[tuple[str, str]]] = {}
    for row in plan.rows:
        reason = plan.data.absence(row)
        place = published(row.source)
        if place and place[0] in TABLES[table].data and reason is not None:
            by_dataset.setdefault(row.dataset, []).append((row.scene, reason))
    sentences = [
        f"{name}: no labelled segment is below {plan.run.data_root or 'data_root, which is not set'}."
        for name in TABLES[table].data
        if name in plan.run.groups and name in DATASETS and not any(data_of(row) == name for row in plan.rows)
    ]
    for dataset, scenes in by_dataset.items():
        reasons = {reason for _, reason in scenes}
        others = "" if len(reasons) == 1 else " The others cannot be read either."
        listed = some([scene for scene, _ in scenes])
        sentences.append(f"{dataset} ({listed}): {scenes[0][1]}.{others}")
    return " ".join(f"--absent {shlex.quote(sentence)}" for sentence in sentences)


def labelled(plan: Plan) -> list[SceneRow]:
    """Scenes with annotations or labels to be scored against."""
    return [row for row in plan.scenes if row.world or plan.data.labels(row)]


def data_of(row: SceneRow) -> str:
    """A scene's data as tables name it: its kind of synthetic scene, or its published data set."""
    if row.world:
        return row.world[0]
    place = published(row.source)
    return place[0] if place else ""


def tables(plan: Plan) -> list[str]:
    """Every table that has variants to compare, measured on the scenes that there are; all have the
    paper's rows."""
    return [
        f"{plan.run.results}/tables/{name}.csv"
        for name, kind in TABLES.items()
        if getattr(plan.run, kind.variants)
    ]


def default(plan: Plan) -> list[str]:
    """Pictures of every scene, scores of those that you annotated, and tables and plots if the run has a
    scene of theirs.

    A run of photographs would otherwise replace a benchmark's tables by ones of reported rows alone.
    """
    plots = [
        f"{plan.run.results}/figures/sweep-{name}.png"
        for name in ("theta", "omega")
        if getattr(plan.run, TABLES[name].variants)
    ]
    own = [row for row in labelled(plan) if not data_of(row)]
    scores = [path for row in own for path in own_scores(plan, row).values()]
    has_tables = len(labelled(plan)) > len(own)
    return [*figures(plan), *scores, *(tables(plan) + plots if has_tables else [])]


def own_scores(plan: Plan, row: SceneRow) -> dict[str, str]:
    """Return the score files of a scene with your own labels, by the variant's name in tables.

    A scene of LangSplat's features is compared with LangSplat on the same Gaussians, masks and vectors.
    """
    variants = ["default"]
    if row.features:
        variants += [
            name for name in plan.run.main_variants if plan.stages_of(name).method.name == "langsplat"
        ]
    return {
        plan.run.labels.get(name, name): plan.path(row, name, "scores.csv")
        for name in dict.fromkeys(variants)
    }


def summary(plan: Plan) -> list[str]:
    """Return a readable table of scores for each finished scene with your own labels."""
    own = [row for row in labelled(plan) if not data_of(row)]
    return [
        line
        for row in own
        for line in score_summary(
            row.name,
            {name: Path(path) for name, path in own_scores(plan, row).items() if Path(path).is_file()},
        )
    ]


def figures(plan: Plan) -> list[str]:
    """The panel of every scene and the names of its nodes, masks against the truth if it is known, and a
    comparison of methods for the scenes of the sweeps."""
    found = []
    for row in plan.scenes:
        compared = not plan.run.sweep_scenes or row.scene in plan.run.sweep_scenes
        pictures = ["panel", *(["masks"] if row.world else []), *(["comparison"] if compared else [])]
        found += [f"{plan.run.results}/figures/{row.name}/{picture}.png" for picture in pictures]
        found.append(plan.path(row, "default/names"))
    return found
