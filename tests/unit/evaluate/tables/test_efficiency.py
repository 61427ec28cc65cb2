"""Benchmark files become jobs and a table of stages."""

import pytest

from hilsplat.base.errors import ArtifactError
from hilsplat.evaluate.tables.efficiency import run_efficiency


def write(folder, stage, text):
    path = folder / "benchmarks" / f"{stage}.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_stages_follow_the_order_of_the_workflow_with_a_total(tmp_path):
    results = tmp_path / "results"
    write(results / "synthetic/one/default", "field", '{"s": 2.5, "cpu_time": 2.0, "max_rss": 400.0}\n')
    write(results / "synthetic/two/default", "field", '{"s": 1.5, "cpu_time": 1.0, "max_rss": 600.0}\n')
    write(results / "synthetic" / "one", "poses", '{"s": 10.0, "cpu_time": "-", "max_rss": null}\n')
    write(results, "table-lerf", '{"s": 1.0, "cpu_time": 0.5, "max_rss": 90.0}\n')
    text = run_efficiency(results, tmp_path / "efficiency.csv")
    assert text.splitlines()[2:] == [
        "| poses | 1 | 10.0 | 10.0 | 10.0 | 0.0 | 0 |",
        "| field | 2 | 2.0 | 2.5 | 4.0 | 3.0 | 600 |",
        "| table-lerf | 1 | 1.0 | 1.0 | 1.0 | 0.5 | 90 |",
        "| all | 4 | 3.8 | 10.0 | 15.0 | 3.5 | 600 |",
    ]
    lines = (tmp_path / "efficiency.csv").read_text().splitlines()
    assert lines[1] == "poses,synthetic,one,,10.00,0.00,0"
    assert lines[2] == "field,synthetic,one,default,2.50,2.00,400"
    assert (tmp_path / "efficiency.md").read_text() == text


def test_missing_and_damaged_benchmarks_are_named(tmp_path):
    with pytest.raises(ArtifactError, match="run the workflow first"):
        run_efficiency(tmp_path, tmp_path / "x.csv")
    write(tmp_path, "masks", "no json\n")
    with pytest.raises(ArtifactError, match=r"masks\.jsonl is not a valid benchmark file"):
        run_efficiency(tmp_path, tmp_path / "x.csv")
