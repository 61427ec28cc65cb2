"""What a sweep adds to a run, counted in dry runs: its own stages and later, nothing before."""

import re
import sys
from collections import Counter

import pytest

from tests.workflow.conftest import Project, copy_project

LISTS = ("theta", "omega", "pruning", "ablation", "component")
NONE = tuple(f"{name}_variants=[]" for name in LISTS)
MAIN = "main_variants=[default]"
BY_LEVELS = ("masks", "coverage_tree", "contributions", "semantic_tree", "clip", "autoencoder")
"""Rules that run again for masks of other levels."""


@pytest.fixture(scope="module")
def plain(project, tmp_path_factory) -> Project:
    return copy_project(project, tmp_path_factory.mktemp("sweeps") / "project", results=False)


def jobs(project: Project, *config: str) -> Counter:
    """Jobs by rule that a dry run of one scene would run."""
    settings = {setting.partition("=")[0]: setting for setting in (*NONE, MAIN, *config)}
    command = [sys.executable, "-m", "snakemake", "-n", "--cores", "1", "--quiet", "rules"]
    printed = project.run(*command, "--config", "only=[table-1]", *settings.values()).stdout
    table = re.search(r"^job +count\n[- ]+\n(.*?)^total", printed, re.M | re.S)[1]
    return Counter({line.split()[0]: int(line.split()[1]) for line in table.splitlines()})


@pytest.fixture(scope="module")
def base(plain) -> Counter:
    return jobs(plain)


def test_without_sweeps_every_stage_runs_once(base):
    stages = (*BY_LEVELS, "field", "evaluate")
    assert {stage: base[stage] for stage in stages} == dict.fromkeys(stages, 1)
    assert base["table"] == 12  # sweeps and ablation without variants have none


@pytest.mark.parametrize(
    ("config", "added"),
    [
        # theta decides the levels of masks, so each value has its own; Omega's rows share all but the field
        (
            "theta_variants=[theta-0.6,theta-0.7,theta-0.8,paper-tree]",
            {**dict.fromkeys((*BY_LEVELS, "field", "evaluate"), 4), "table": 1, "sweep_plot": 1},
        ),
        (
            "omega_variants=[omega-2,omega-10,omega-100,omega-1000]",
            {**dict.fromkeys(BY_LEVELS, 1), "field": 4, "evaluate": 4, "table": 1, "sweep_plot": 1},
        ),
        ("pruning_variants=[default,pruned]", {"field": 1, "evaluate": 1, "table": 2}),
        (
            "component_variants=[no-hierarchy,clustering,clustering-part,default,all-losses]",
            {"field": 4, "evaluate": 4, "table": 1},
        ),
        # d = 3 needs its own autoencoder, which both share; baselines write the field by another rule
        ("ablation_variants=[regression,paper]", {"autoencoder": 1, "field": 2, "evaluate": 2, "table": 1}),
        ("main_variants=[default,langsplat,lifted]", {"autoencoder": 2, "method": 2, "evaluate": 2}),
        # LangSplat has levels by head; the other rows share all but the field
        (
            "ablation_variants=[langsplat,initial-2d,paper-hc,paper-instance,paper-part,paper-tree]",
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
        ("seeds=3", {}),
        ("seeds=3 main_variants=[default,paper]", {"autoencoder": 3, "field": 3, "evaluate": 3}),
        ("seeds=3 main_variants=[default,lifted,langsplat]", {"autoencoder": 4, "method": 4, "evaluate": 4}),
    ],
)
def test_a_sweep_adds_only_its_own_and_later_stages(plain, base, config, added):
    swept = jobs(plain, *config.split())
    assert swept - base == Counter(added)
    assert not base - swept
