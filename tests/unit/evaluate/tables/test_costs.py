"""Time and memory of rows and stages, from the records that the workflow writes beside its artifacts."""

import csv
import json
import math
import shutil

import pytest

from hilsplat.base.artifacts import provenance_path, read_json
from hilsplat.base.errors import ArtifactError
from hilsplat.evaluate.costs import read_costs, run_efficiency, write_times
from hilsplat.evaluate.scores import write_scores
from hilsplat.evaluate.tables.build import published_values, run_table
from tests.conftest import PROJECT
from tests.unit.artifact_changes import write_record
from tests.unit.evaluate.builders import score


def record(folder, stage, seconds, mib, cpu_time=None):
    """A benchmark file as Snakemake writes it."""
    path = folder / "benchmarks" / f"{stage}.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"s": seconds, "cpu_time": cpu_time or seconds, "max_rss": mib}) + "\n")


STAGES = {"masks": 60, "coverage_tree": 6, "clip": 54, "contributions": 30, "semantic_tree": 6}
STAGES |= {"autoencoder": 12}


@pytest.fixture
def scene(tmp_path):
    """Scores of two variants; the second has a field of its own and shares the rest."""
    folder = tmp_path / "results" / "synthetic" / "table-1"
    default, other = folder / "default", folder / "omega-2"
    for stage, seconds in STAGES.items():
        record(default, stage, seconds, 512)
    shared = {name: {"path": str(default / name)} for name in STAGES}
    for variant, seconds, mib in ((default, 12, 1024), (other, 72, 2048)):
        record(variant, "field", seconds, mib)
        scores, field = variant / "scores.csv", variant / "field.safetensors"
        write_scores(scores, [score("iou", 0.5, scene="table-1", variant=variant.name, method="field")])
        read = {name: shared[name] for name in ("masks", "clip", "semantic_tree", "autoencoder")}
        write_record(scores, inputs={**read, "field": {"path": str(field)}})
        of_field = {name: shared[name] for name in ("coverage_tree", "contributions", "autoencoder")}
        write_record(field, inputs=of_field)
        write_times(scores, "synthetic", "table-1", variant.name, {"field": 0.25})
    return [default / "scores.csv", other / "scores.csv"]


def test_shared_stages_count_in_full_and_own_ones_alone(scene):
    first, second = read_costs(scene)
    assert (first.prepare_s, first.train_s, first.peak_mib) == (120, 60, 1024)
    assert (second.prepare_s, second.train_s, second.peak_mib) == (120, 120, 2048)
    assert first.query_s == {"field": 0.25}


def test_missing_records_and_unread_stages(scene, tmp_path):
    field = scene[0].with_name("field.safetensors")
    inputs = read_json(provenance_path(field))["inputs"]
    del inputs["coverage_tree"]
    write_record(field, inputs=inputs)
    assert read_costs(scene)[0].prepare_s == 114  # a stage that nothing read costs nothing
    (scene[0].parent / "benchmarks" / "contributions.jsonl").unlink()
    assert math.isnan(read_costs(scene)[0].peak_mib)  # the job may have needed the most memory
    record(scene[0].parent, "contributions", 30, 512)
    (scene[0].parent / "benchmarks" / "masks.jsonl").unlink()
    first, _ = read_costs(scene)
    assert math.isnan(first.prepare_s) and first.unrecorded == ("masks",)
    assert first.train_s == 60
    for name, is_told in (("cost-seconds", True), ("cost", False)):
        run_table(name, scene, PROJECT / published_values(name), {}, tmp_path / f"{name}.csv")
        text = (tmp_path / f"{name}.md").read_text()
        assert ("Not measured: masks of synthetic/table-1, whose benchmark files" in text) is is_told
    scene[0].with_name("times.csv").unlink()
    with pytest.raises(ArtifactError, match=r"times\.csv is missing"):
        read_costs(scene)


@pytest.mark.parametrize(
    ("table", "columns"),
    [
        ("cost", {"Training (min)": ["1.00", "2.00"], "table-1 query (s)": ["0.25", "0.25"]}),
        ("efficiency", {"Memory (GB)": ["1.00", "2.00"], "Hi-LERF mIoU": ["50.00", "50.00"]}),
        ("pruning", {"Query (s)": ["0.25", "0.25"]}),
    ],
)
def test_only_tables_of_seconds_change_with_what_the_jobs_took(scene, tmp_path, table, columns):
    def built(name):
        out = tmp_path / f"{name}.csv"
        run_table(name, scene, PROJECT / published_values(name), {"omega-2": "Omega = 2"}, out)
        return {kind: out.with_suffix(kind).read_text() for kind in (".csv", ".md", ".tex", ".html")}

    def measured(forms):
        rows = csv.DictReader(forms[".csv"].splitlines())
        return [row for row in rows if row["kind"] != "reported"]

    before, timed = built(table), built(f"{table}-seconds")
    rows = measured(timed)
    assert [row["method"] for row in rows] == ["hilsplat (field)", "Omega = 2"]
    assert {column: [row[column] for row in rows] for column in columns} == columns
    assert "main memory" in timed[".md"] and f"{table}-seconds" in before[".md"]
    quality = [row["Hi-LERF mIoU"] for row in measured(before)]
    assert quality == ([] if table == "cost" else ["50.00", "50.00"])
    for path in scene:
        write_times(path, "synthetic", "table-1", path.parent.name, {"field": 0.75})
        for record_path in path.parent.glob("benchmarks/*.jsonl"):
            record(path.parent, record_path.stem, 600, 4096)
    assert built(table) == before
    assert all(timed[kind] != content for kind, content in built(f"{table}-seconds").items())


def test_rows_over_part_of_the_scenes_are_compared_only_within_a_scene(scene, tmp_path):
    more = scene[0].parents[2] / "table-2/default/scores.csv"
    shutil.copytree(scene[0].parent, more.parent)
    for stage in STAGES:
        record(more.parent, stage, 0.6, 256)
    write_scores(more, [score("iou", 0.9, scene="table-2", method="field")])
    write_times(more, "synthetic", "table-2", "default", {"field": 0.05})
    out = tmp_path / "cost-seconds.csv"
    for name in ("cost-seconds", "efficiency-seconds"):
        run_table(name, [*scene, more], PROJECT / published_values(name), {}, tmp_path / f"{name}.csv")
    lines = (out.with_suffix(".md")).read_text().splitlines()
    part = next(line for line in lines if line.startswith("| omega-2"))
    assert "| 1 of 2 |" in part and part.count("**") == 2 and "**0.25**" in part  # its scene's query alone
    text = (tmp_path / "efficiency-seconds.md").read_text()
    part = next(line for line in text.splitlines() if line.startswith("| omega-2"))
    assert "| 1 of 2 |" in part and "**" not in part


def test_quality_and_costs_of_a_row_are_of_the_same_scenes(scene, tmp_path):
    more = scene[0].parents[2] / "table-2/default/scores.csv"
    shutil.copytree(scene[0].parent, more.parent)
    write_scores(more, [score("iou", 0.9, scene="table-2", method="field", protocol="lerf/langsplat@2")])
    write_times(more, "synthetic", "table-2", "default", {"field": 0.05})
    run_table(
        "pruning-seconds", [scene[0], more], PROJECT / published_values("pruning"), {}, tmp_path / "p.csv"
    )
    with (tmp_path / "p.csv").open(newline="") as stream:
        row = next(row for row in csv.DictReader(stream) if row["kind"] != "reported")
    assert (row["Hi-LERF mIoU"], row["Query (s)"]) == ("50.00", "0.25")  # not of the scene without levels


def test_seeds_of_a_variant_are_one_row_in_every_table(scene, tmp_path):
    more = scene[1].parents[1] / "omega-2.seed1/scores.csv"
    shutil.copytree(scene[1].parent, more.parent)
    names = {"scene": "table-1", "variant": "omega-2.seed1", "method": "field"}
    write_scores(more, [score("iou", 0.7, **names)])
    write_times(more, "synthetic", "table-1", "omega-2.seed1", {"field": 0.75})
    found = []
    for name in ("cost-seconds", "pruning-seconds"):
        out = tmp_path / f"{name}.csv"
        run_table(name, [*scene, more], PROJECT / published_values(name), {}, out)
        with out.open(newline="") as stream:
            found += [row for row in csv.DictReader(stream) if row["method"].startswith("omega")]
    cost, quality = found
    assert (cost["table-1 query (s)"], quality["Query (s)"]) == ("0.50", "0.50")
    assert (quality["Hi-LERF mIoU"], quality["seeds"]) == ("60.00 ± 14.14", "2")


def test_stages_follow_the_order_of_the_workflow_with_a_total(tmp_path):
    results = tmp_path / "results"
    record(results / "synthetic/one/default", "field", 2.5, 400.0, 2.0)
    record(results / "synthetic/two/default", "field", 1.5, 600.0, 1.0)
    record(results / "synthetic/one", "poses", 10.0, None, "-")
    record(results, "table-lerf", 1.0, 90.0, 0.5)
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
    for number in range(5):
        write_record(results / f"synthetic/one/default/{number}")
    text = run_efficiency(results, tmp_path / "efficiency.csv")
    assert text.endswith(
        "\nThe jobs of 1 of 5 artifacts are not in this table: their benchmark files are missing.\n"
    )


def test_missing_and_damaged_benchmarks_are_named(tmp_path):
    with pytest.raises(ArtifactError, match="run the workflow first"):
        run_efficiency(tmp_path, tmp_path / "x.csv")
    record(tmp_path, "masks", 1, 1)
    (tmp_path / "benchmarks" / "masks.jsonl").write_text("no json\n")
    with pytest.raises(ArtifactError, match=r"masks\.jsonl is not a valid benchmark file"):
        run_efficiency(tmp_path, tmp_path / "x.csv")
