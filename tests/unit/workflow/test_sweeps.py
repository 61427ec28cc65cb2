"""What a sweep adds to a run of the shipped configuration: its own stages and later, nothing before."""

from collections import Counter
from pathlib import Path

import pytest

from hilsplat.configuration import merged_config
from hilsplat.methods.registry import OURS
from hilsplat.workflow import targets
from hilsplat.workflow.plan import Plan
from hilsplat.workflow.scene_data import of_variant

LISTS = ("main", "theta", "omega", "pruning", "ablation", "component")
BY_LEVELS = ("masks", "coverage_tree", "contributions", "semantic_tree", "clip", "autoencoder")
"""Stages that run again for masks of other levels."""


def jobs(seeds: int = 1, **variants: str) -> Counter[str]:
    """Return the number of jobs of each stage in a run of one scene; `variants` are those of each table."""
    named = {"main": "default", **variants}
    lists = {f"{name}_variants": named.get(name, "").split() for name in LISTS}
    plan = Plan({**merged_config([]), "only": ["table-1"], "seeds": seeds, **lists})
    [row] = plan.scenes
    listed = {name for names in lists.values() for name in names}
    rows = [of_variant(row, name) for first in listed for name in plan.seeded(first, row)]
    owners = {stage: {plan.shared_variant(stage, job) for job in rows} for stage in (*BY_LEVELS, "field")}
    baselines = {name for name in owners["field"] if plan.stages_of(name).method.name != OURS}
    fields = owners["field"] - baselines
    starts = {Path(path).parent.name for name in fields for path in plan.first_field(of_variant(row, name))}
    counted = {stage: len(owners[stage]) for stage in BY_LEVELS}
    counted |= {"field": len(fields), "method": len(baselines | starts), "evaluate": len(rows)}
    plots = [path for path in targets.default(plan) if "sweep-" in path]
    return Counter(**counted, table=len(targets.tables(plan)), sweep_plot=len(plots))


@pytest.fixture(scope="module")
def base() -> Counter[str]:
    """Jobs of a run without sweeps."""
    return jobs()


def test_without_sweeps_every_stage_runs_once(base):
    stages = (*BY_LEVELS, "field", "evaluate")
    assert {stage: base[stage] for stage in stages} == dict.fromkeys(stages, 1)
    assert base["table"] == 12  # sweeps and ablation without variants have none


@pytest.mark.parametrize(
    ("config", "added"),
    [
        # theta decides the levels of masks, so each value has its own; Omega's rows share all but the field
        (
            {"theta": "theta-0.6 theta-0.7 theta-0.8 paper-tree"},
            {**dict.fromkeys((*BY_LEVELS, "field", "evaluate"), 4), "table": 1, "sweep_plot": 1},
        ),
        (
            {"omega": "omega-2 omega-10 omega-100 omega-1000"},
            {**dict.fromkeys(BY_LEVELS, 1), "field": 4, "evaluate": 4, "table": 1, "sweep_plot": 1},
        ),
        ({"pruning": "default pruned"}, {"field": 1, "evaluate": 1, "table": 2}),
        (
            {"component": "no-hierarchy clustering clustering-part default all-losses"},
            {"field": 4, "evaluate": 4, "table": 1},
        ),
        # d = 3 needs its own autoencoder, which both share; baselines write the field by another rule
        ({"ablation": "regression paper"}, {"autoencoder": 1, "field": 2, "evaluate": 2, "table": 1}),
        ({"main": "default langsplat lifted"}, {"autoencoder": 2, "method": 2, "evaluate": 2}),
        # LangSplat has levels by head; the other rows share all but the field
        (
            {"ablation": "langsplat initial-2d paper-hc paper-instance paper-part paper-tree"},
            {
                **dict.fromkeys(BY_LEVELS, 1),
                "autoencoder": 2,
                "field": 4,
                "method": 2,
                "evaluate": 6,
                "table": 1,
            },
        ),
        # only what is random is repeated: PCA and our solver are not
        ({"seeds": 3}, {}),
        ({"seeds": 3, "main": "default paper"}, {"autoencoder": 3, "field": 3, "evaluate": 3}),
        ({"seeds": 3, "main": "default lifted langsplat"}, {"autoencoder": 4, "method": 4, "evaluate": 4}),
    ],
)
def test_a_sweep_adds_only_its_own_and_later_stages(base, config, added):
    swept = jobs(**config)
    assert swept - base == Counter(added)
    assert not base - swept
