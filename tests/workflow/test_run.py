"""The CI configuration from nothing to tables and figures."""

import pandas as pd

from tests.reference import tiny
from tests.workflow.conftest import SCENE, Project

TABLES = ("hierarchy", "lerf", "3dovs", "ablation", "theta", "omega", "frames-hi-lerf", "frames-hi-3dovs")
TABLES += ("efficiency", "pruning", "cost-seconds", "efficiency-seconds", "pruning-seconds")
OWN = ("components",)  # tables without a row of the paper
REPORTED = ("cost", "replica", "scannet", "waymo")  # tables in which the tiny scene has no row


def test_all_tables_and_figures_are_there(finished: Project) -> None:
    for table in (*TABLES, *OWN, *REPORTED):
        for suffix in ("csv", "md", "tex", "html"):
            assert (finished.root / f"results/tables/{table}.{suffix}").stat().st_size > 0, (table, suffix)
    figures = finished.root / "results/figures"
    for name in ("panel", "comparison", "views", "features"):
        for suffix in (".webp", ".pdf"):
            assert (figures / "synthetic/tiny" / f"{name}{suffix}").stat().st_size > 5_000, name
    assert (figures / "sweep-theta.png").stat().st_size > 5_000


def test_tables_hold_measured_rows_beside_reported_ones(finished: Project) -> None:
    both, measured, reported = {"reported", "synthetic stand-in"}, {"synthetic stand-in"}, {"reported"}
    for tables, kinds in ((TABLES, both), (OWN, measured), (REPORTED, reported)):
        for table in tables:
            rows = pd.read_csv(finished.root / f"results/tables/{table}.csv")
            assert set(rows["kind"]) == kinds, table


def test_answers_and_baselines_have_rows_of_their_own(finished: Project) -> None:
    rows = pd.read_csv(finished.root / "results/tables/hierarchy.csv")
    names = set(rows.loc[rows["kind"] == "synthetic stand-in", "method"])
    tree = {"hilsplat (tree)", "hilsplat (tree, path)", "hilsplat (field)"}
    assert names == {*tree, "hilsplat (paper)", "lifted CLIP, training-free (ours)", "annotations"}
    level_given = rows[(rows["method"] == "hilsplat (tree)") & (rows["protocol"] == "level given")]
    assert level_given["View consistency"].between(0, 100).all()


def test_view_consistency_is_scored_unless_a_variant_leaves_it_out(finished: Project) -> None:
    metrics = {
        variant: set(pd.read_csv(finished.root / SCENE / variant / "scores.csv")["metric"])
        for variant in ("lifted", "regression")
    }
    assert metrics["lifted"] - metrics["regression"] == {"view_consistency"}


def test_the_tiny_scene_reaches_what_was_recorded(finished: Project) -> None:
    moved = list(tiny.differences(tiny.measure(finished.root / SCENE), tiny.recorded()))
    assert not moved, "\n".join([f"{tiny.__name__} says how to record anew", *moved])


def test_a_second_run_does_nothing(copy_of_finished: Project) -> None:
    before = times_of(copy_of_finished)
    again = copy_of_finished.snakemake()
    assert "Nothing to be done" in again.stderr
    assert times_of(copy_of_finished) == before


def times_of(project: Project) -> dict[str, int]:
    """Return the modification time of each file of the results, but not of the cache."""
    files = (path for path in (project.root / "results").rglob("*") if ".cache" not in path.parts)
    return {str(path): path.stat().st_mtime_ns for path in files if path.is_file()}
