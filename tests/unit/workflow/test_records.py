"""Artifacts compared with their provenance, and provenance compared with a plan."""

import json
import os
import shutil
from pathlib import Path

import pytest

from hilsplat.base.artifacts import RUN, provenance_path, write_json
from hilsplat.base.atomic import lock_path, output_lock
from hilsplat.base.errors import ArtifactError
from hilsplat.base.lineage import Inputs, write_provenance
from hilsplat.models.store import model_digest
from hilsplat.stages import stage_of
from hilsplat.workflow.records import DAMAGED, Records, outdated, verify
from tests.unit.workflow.plans import BENCHMARK, Job, plan_of

FOLDER = Path("results/synthetic/one/default")
MASKS, TREE = FOLDER / "masks", FOLDER / "coverage_tree"


def write(artifact: Path, text: str = "one", *options: str, stage: str = "", **inputs: Path) -> None:
    """Write an artifact and its record as the plan makes it."""
    plan, stage = plan_of(Path(), BENCHMARK[:1]), stage_of(stage or artifact.name)
    for name in ("a.npz", "b.npz"):
        artifact.mkdir(parents=True, exist_ok=True)
        (artifact / name).write_text(text)
    write_provenance(
        artifact,
        stage=stage.name,
        code=stage.code_digest(),
        command=["hilsplat", stage.name, *options, "--out", str(artifact)],
        settings={name: json.loads(plan.settings(name, Job())) for name in stage.sections.values()},
        seed=0 if "seed" in stage.hints else None,
        inputs=Inputs("masks", inputs),
    )


@pytest.fixture
def results(tmp_path, monkeypatch) -> Path:
    """Masks made from photographs, and coverage trees made from the masks."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/1.jpg").write_text("x")
    write(MASKS, scene=tmp_path / "photos")
    write(TREE, masks=MASKS)
    return Path("results")


def problems(*, every_byte: bool = False, **config: object) -> dict[str, str]:
    plan = plan_of(Path(), BENCHMARK[:1], **config)
    found = outdated(plan, every_byte=every_byte)
    return {Path(path).name: reason for path, reason in found.items()}


@pytest.mark.parametrize(
    ("config", "reasons"),
    [
        (
            {"coverage_tree": {"theta": 0.6}},
            {"coverage_tree": "it was made with coverage_tree {'theta': 0.9}"},
        ),
        ({"masks": {"segmenter": "truth-perturbed"}}, {"masks": "by stage masks, not truth_masks"}),
        ({"evaluate": {"ancestors": 0.3}}, {}),
        ({"masks": {"device": "cpu"}}, {}),  # the advice of a card without enough memory
    ],
)
def test_other_settings_are_found(results, config, reasons):
    found = problems(**config)
    assert found.keys() == reasons.keys()
    assert all(reason in found[name] for name, reason in reasons.items())


def test_other_options_are_found(results):
    """Snakemake would find them, unless the results were moved to another project, or are shared by two."""
    scene = FOLDER.with_name("scene")
    for options, other in ("metre --render", ""), ("feet --render", "unit"), ("metre", "render"):
        write(scene, "one", "--unit", *options.split(), stage="poses")
        assert problems() == ({"scene": f"it was made with another --{other}"} if other else {})


def test_tables_of_other_variants_or_names_are_found(results):
    table, scores = Path("results/tables/hierarchy.csv"), FOLDER / "scores.csv"
    for path in (table, scores):
        path.parent.mkdir(exist_ok=True)
        path.write_text("")
    stage, labels = stage_of("table"), '{"default": "ours"}'
    command = ["hilsplat", "table", "hierarchy", "--labels", labels, str(scores), "--out", str(table)]
    record = {"stage": "table", "code": stage.code_digest(), "settings": {}, "seed": None}
    write_provenance(table, command=command, inputs=Inputs("table", {"scores": [scores]}), **record)

    def problem(**config: object) -> str:
        plan = plan_of(Path(), BENCHMARK[:1], **config)
        return Records(plan.results, plan, every_byte=False).state(table)[1]

    assert problem(labels={"default": "ours"}) == ""
    assert problem() == "it was made with another --labels"
    for variants in (["default", "low"], ["low"]):
        config = {"main_variants": variants, "variants": {"low": {"masks": {"theta": 0.6}}}}
        assert problem(**config) == "it was made from other scores"


def test_missing_and_cut_files_are_found(results):
    (MASKS / "b.npz").write_text("longer")
    (TREE / "a.npz").unlink()
    assert problems() == {
        "masks": "b.npz was changed after it was written",
        "coverage_tree": "a.npz is missing from coverage_tree",
    }
    shutil.rmtree(MASKS)
    assert problems()["masks"] == "masks is missing"


def test_other_code_and_damaged_provenance_are_found(results):
    path = provenance_path(TREE)
    write_json(path, {**json.loads(path.read_text()), "code": "0" * 64, "seal": None})
    assert problems() == {"coverage_tree": "it was made by different code"}
    for text in ("", "{", "[]", '{"stage": 3}', "[" * 100_000):
        path.write_text(text)
        assert problems() == {"coverage_tree": "its provenance is damaged"}


def test_an_artifact_made_from_other_inputs_is_found(results):
    write(MASKS, "two")
    assert problems() == {"coverage_tree": f"its input masks has changed: {MASKS}"}


def test_every_byte_is_read_after_a_writer_that_did_not_finish(results):
    """It may have replaced one of several outputs by another of the same size."""
    (MASKS / "a.npz").write_text("two")
    os.utime(MASKS / "a.npz", (0, 0))
    assert problems() == {}, "sizes agree, and the file is not newer than its record"
    with pytest.raises(KeyboardInterrupt), output_lock(MASKS):
        raise KeyboardInterrupt
    assert problems()["masks"] == "masks was changed after it was written"
    (MASKS / "a.npz").write_text("one")
    assert problems() == {}, "it had not replaced anything"
    with output_lock(MASKS):
        pass
    assert lock_path(MASKS).read_text() == ""


def test_a_file_that_is_newer_than_its_record_is_read(results):
    (MASKS / "a.npz").write_text("two")
    assert problems()["masks"] == "masks was changed after it was written"
    (MASKS / "a.npz").write_text("one")
    assert problems() == {}


def test_a_flipped_bit_in_a_record_is_found(results):
    path = provenance_path(TREE)
    content = path.read_bytes()
    for place in range(0, len(content), 7):
        changed = bytearray(content)
        changed[place] ^= 1 << place % 7
        path.write_bytes(changed)
        assert Records(Path("results"), every_byte=True).state(TREE)[0] == DAMAGED, place


def test_lists_of_input_files_may_be_empty_and_are_compared_file_by_file(results):
    labels = [Path("photos/1.jpg").resolve()]
    write(MASKS, none=(), labels=labels)
    write(TREE, masks=MASKS)
    assert verify(results)[1]
    labels[0].write_text("other")
    assert f"its input labels has changed: {labels[0]}" in verify(results)[0]


def test_another_model_in_the_same_folder_is_found(results):
    Path("models/m").mkdir(parents=True)
    Path("models/m/a.onnx").write_text("1")
    write(MASKS, model=Path("models/m"))
    write(TREE, masks=MASKS)
    assert problems() == {}
    model_digest.cache_clear()  # as in another process
    Path("models/m/a.onnx").write_text("22")
    assert problems() == {"masks": "its input model has changed: models/m"}


def test_an_artifact_without_a_record_is_found(results):
    assert problems() == {}
    (FOLDER / "semantic_tree").mkdir()
    assert problems() == {"semantic_tree": "it has no provenance"}


@pytest.mark.parametrize("name", ["results", "out/of runs", "/absolute"])
def test_a_moved_folder_is_whole_until_an_input_in_it_is_missing(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    results = Path(name.replace("/absolute", str(tmp_path / "absolute")))
    Path("photos").mkdir()
    Path("photos/1.jpg").touch()
    masks, tree = (results / Path(*path.parts[1:]) for path in (MASKS, TREE))
    write(masks, scene=Path("photos"))
    write(tree, masks=masks)
    shutil.rmtree("photos")
    copy = shutil.copytree(results, tmp_path / "elsewhere/copy")
    assert verify(copy) == (f"2 artifacts in {copy}: 2 whole", True)
    shutil.rmtree(results)
    assert verify(copy)[1]
    missing = copy / masks.relative_to(results)
    shutil.rmtree(missing)
    provenance_path(missing).unlink()
    assert f"its input masks is missing: {missing}" in verify(copy)[0]


def test_verify_reads_every_byte_and_prints_the_repair(results):
    (MASKS / "a.npz").write_text("two")
    report, is_whole = verify(results)
    assert not is_whole
    assert report.splitlines() == [
        f"stale    {TREE}: its input masks has changed: {MASKS}",
        f"damaged  {MASKS}: masks was changed after it was written",
        "2 artifacts in results: 1 stale, 1 damaged",
        "to rebuild them, in the project that made them: hilsplat run --verify",
    ]
    write_json(results / RUN, {"results": ["results"]})
    assert verify(FOLDER)[0].splitlines()[-1] == report.splitlines()[-1], "a folder in it is no target"


def test_verify_finds_a_missing_input_and_damaged_provenance(results):
    shutil.rmtree(MASKS)
    report = verify(results)[0]
    assert "masks is missing" in report and "its input masks is missing" in report
    provenance_path(MASKS).write_text("{")
    assert "its provenance is damaged" in verify(results)[0]
    with pytest.raises(ArtifactError, match="contains no artifacts"):
        verify(Path("photos"))
