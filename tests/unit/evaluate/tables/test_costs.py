"""Time and memory of rows and stages, from the records that the workflow writes beside its artifacts."""

import csv
import json
import math
import re
import shutil

import pytest

from hilsplat.base.artifacts import provenance_path, read_json
from hilsplat.base.errors import ArtifactError
from hilsplat.base.progress import stage_log
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


def test_times_without_views_from_the_cache_are_named(scene, tmp_path, caplog):
    caplog.set_level("INFO")
    for stage, count in (("masks", 12), ("clip", 0)):
        caplog.clear()
        with stage_log(stage, "synthetic/table-1") as counts:
            counts.update(views=35, from_cache=count)
        log = scene[0].parent / f"logs/{stage}.log"
        log.parent.mkdir(exist_ok=True)
        log.write_text(caplog.text)
    note = "Not measured: the time of views that these jobs read from the cache, as after an interruption: "
    assert f"- {note}masks of synthetic/table-1.\n" in built("cost-seconds", scene, tmp_path)[1][".md"]
    assert note not in built("cost", scene, tmp_path)[1][".md"]


def built(name, scores, folder, labels=None):
    """The rows measured in a table, and the table in every format."""
    out = folder / f"{name}.csv"
    run_table(name, scores, PROJECT / published_values(name), labels or {}, out)
    forms = {kind: out.with_suffix(kind).read_text() for kind in (".csv", ".md", ".tex", ".html")}
    rows = csv.DictReader(forms[".csv"].splitlines())
    return [row for row in rows if row["kind"] != "reported"], forms


def another(scores, scene, variant, value, seconds, **names):
    """A copy of a scene's records under another scene or variant, with a score and a time of its own."""
    more = scores.parents[2] / scene / variant / "scores.csv"
    shutil.copytree(scores.parent, more.parent)
    write_scores(more, [score("iou", value, scene=scene, variant=variant, method="field", **names)])
    write_times(more, "synthetic", scene, variant, {"field": seconds})
    return more


@pytest.mark.parametrize(
    ("table", "columns"),
    [
        ("cost", {"Training (min)": ["1.00", "2.00"], "table-1 query (s)": ["0.25", "0.25"]}),
        ("efficiency", {"Memory (GB)": ["1.00", "2.00"], "Hi-LERF mIoU": ["50.00", "50.00"]}),
        ("pruning", {"Query (s)": ["0.25", "0.25"]}),
    ],
)
def test_only_tables_of_seconds_change_with_what_the_jobs_took(scene, tmp_path, table, columns):
    labels = {"omega-2": "Omega = 2"}
    quality, before = built(table, scene, tmp_path, labels)
    rows, timed = built(f"{table}-seconds", scene, tmp_path, labels)
    assert [row["method"] for row in rows] == ["hilsplat (field)", "Omega = 2"]
    assert {column: [row[column] for row in rows] for column in columns} == columns
    assert "main memory" in timed[".md"] and f"{table}-seconds" in before[".md"]
    assert [row["Hi-LERF mIoU"] for row in quality] == ([] if table == "cost" else ["50.00", "50.00"])
    for path in scene:
        write_times(path, "synthetic", "table-1", path.parent.name, {"field": 0.75})
        for record_path in path.parent.glob("benchmarks/*.jsonl"):
            record(path.parent, record_path.stem, 600, 4096)
    assert built(table, scene, tmp_path, labels)[1] == before
    again = built(f"{table}-seconds", scene, tmp_path, labels)[1]
    assert all(timed[kind] != content for kind, content in again.items())


def test_rows_over_part_of_the_scenes_are_compared_only_within_a_scene(scene, tmp_path):
    more = another(scene[0], "table-2", "default", 0.9, 0.05)
    for stage in STAGES:
        record(more.parent, stage, 0.6, 256)
    for name, best in (("cost-seconds", ["**0.25**"]), ("efficiency-seconds", [])):  # its scene's query alone
        lines = built(name, [*scene, more], tmp_path)[1][".md"].splitlines()
        part = next(line for line in lines if line.startswith("| omega-2"))
        assert "| 1 of 2 |" in part and re.findall(r"\*\*.*?\*\*", part) == best


def test_quality_and_costs_of_a_row_are_of_the_same_scenes(scene, tmp_path):
    more = another(scene[0], "table-2", "default", 0.9, 0.05, protocol="lerf/langsplat@3")
    (row,), _ = built("pruning-seconds", [scene[0], more], tmp_path)
    assert (row["Hi-LERF mIoU"], row["Query (s)"]) == ("50.00", "0.25")  # not of the scene without levels


def test_seeds_of_a_variant_are_one_row_in_every_table(scene, tmp_path):
    files = [*scene, another(scene[1], "table-1", "omega-2.seed1", 0.7, 0.75)]
    cost, quality = (built(name, files, tmp_path)[0][1] for name in ("cost-seconds", "pruning-seconds"))
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
    for damaged in (b"no json\n", b"", b"\xff", b"[]"):
        (tmp_path / "benchmarks" / "masks.jsonl").write_bytes(damaged)
        with pytest.raises(ArtifactError, match=r"masks\.jsonl is not a valid benchmark file"):
            run_efficiency(tmp_path, tmp_path / "x.csv")
