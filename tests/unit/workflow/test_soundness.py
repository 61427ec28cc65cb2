"""Artifacts that are not what their provenance says, or not what the plan wants."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from hilsplat.base.artifacts import lock_path, output_lock, provenance_path
from hilsplat.base.provenance import write_provenance
from hilsplat.workflow.soundness import Wanted, unsound
from hilsplat.workflow.stages import stage_code

SETTINGS = {"theta": 0.9}
MASKS = Wanted(Path("results/d/s/default/masks"), "results/d/s/default/masks", "masks", {}, None)
TREE = Wanted(
    Path("results/d/s/default/coverage_tree"),
    "results/d/s/default/coverage_tree",
    "coverage_tree",
    SETTINGS,
    7,
)


def write(wanted: Wanted, text: str = "one", **inputs: Path) -> None:
    for name in ("a.npz", "b.npz"):
        wanted.artifact.mkdir(parents=True, exist_ok=True)
        (wanted.artifact / name).write_text(text)
    record(wanted, **inputs)


def record(wanted: Wanted, **inputs: Path) -> None:
    write_provenance(
        wanted.artifact,
        stage=wanted.stage,
        code=stage_code(wanted.stage),
        command=["hilsplat"],
        settings=wanted.settings,
        seed=wanted.seed,
        inputs=inputs,
    )


@pytest.fixture
def made(tmp_path, monkeypatch):
    """Masks, and a tree made from them."""
    monkeypatch.chdir(tmp_path)
    write(MASKS)
    write(TREE, masks=MASKS.artifact)
    return tmp_path


def doubts(*wanted: Wanted, **more: bool) -> dict[str, str]:
    found = unsound(wanted or (MASKS, TREE), Path("results/.cache"), **more)
    return {Path(path).name: reason for path, reason in found.items()}


def test_what_was_made_as_planned_is_sound(made):
    assert doubts() == {}


def test_what_was_not_made_is_left_to_snakemake(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert doubts() == {}


@pytest.mark.parametrize(
    ("wanted", "reason"),
    [
        (replace(TREE, settings={"theta": 0.6}), "made with theta 0.9, and the configuration says 0.6"),
        (replace(TREE, settings={**SETTINGS, "new": 1}), "made with new None"),
        (replace(TREE, seed=8), "made with seed 7, and the configuration says 8"),
        (replace(TREE, stage="clip"), "stage coverage_tree made it, not clip"),
    ],
)
def test_other_settings_are_told(made, wanted, reason):
    assert reason in doubts(MASKS, wanted)["coverage_tree"]
    assert doubts(MASKS, wanted, compare_settings=False) == {}


def test_other_code_is_told(made):
    path = provenance_path(TREE.artifact)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"code": "0" * 64}))
    assert doubts() == {"coverage_tree": "other code made it"}


def test_a_file_that_is_gone_or_cut_is_told(made):
    (MASKS.artifact / "b.npz").write_text("longer")
    (TREE.artifact / "a.npz").unlink()
    assert doubts() == {
        "masks": "b.npz is not as it was written",
        "coverage_tree": "a.npz is missing in coverage_tree",
    }


def test_a_folder_that_is_gone_is_told_as_long_as_something_tells_of_it(made):
    for file in MASKS.artifact.iterdir():
        file.unlink()
    MASKS.artifact.rmdir()
    assert doubts() == {"masks": "masks is missing"}
    provenance_path(MASKS.artifact).unlink()
    assert doubts() == {"masks": "it is missing, and results/d/s/default/coverage_tree was made from it"}


@pytest.mark.parametrize("text", ["", "{", "[]", '{"stage": 3}', "[" * 100_000])
def test_a_damaged_provenance_is_told(made, text):
    provenance_path(TREE.artifact).write_text(text)
    assert doubts() == {"coverage_tree": "its provenance is damaged"}


def test_an_artifact_without_provenance_is_told(made):
    provenance_path(TREE.artifact).unlink()
    assert doubts() == {"coverage_tree": "it has no provenance"}


def test_what_was_made_from_other_inputs_is_told(made):
    write(MASKS, "two")
    assert doubts() == {"coverage_tree": "it was made from another results/d/s/default/masks"}
    assert doubts(compare_inputs=False) == {}


def test_a_writer_that_did_not_reach_its_end_has_every_byte_read(made):
    """It may have replaced one of several outputs by another of the same size."""
    (MASKS.artifact / "a.npz").write_text("two")
    assert doubts() == {}, "sizes agree, and bytes are for `hilsplat verify`"
    with pytest.raises(KeyboardInterrupt), output_lock(MASKS.artifact):
        raise KeyboardInterrupt
    assert doubts() == {"masks": "masks is not as it was written"}
    (MASKS.artifact / "a.npz").write_text("one")
    assert doubts() == {}, "it had not replaced anything"
    with output_lock(MASKS.artifact):
        pass
    assert lock_path(MASKS.artifact).read_text() == ""


def test_imports_by_hand_have_no_settings_of_the_plan(made):
    imported = replace(MASKS, stage="langsplat")
    write(imported)
    write(TREE, masks=MASKS.artifact)
    assert doubts(replace(MASKS, settings={"model": "x"}), TREE) == {}
    (MASKS.artifact / "a.npz").unlink()
    assert doubts() == {"masks": "a.npz is missing in masks"}


def test_another_model_in_the_same_folder_is_told(made):
    Path("models/m").mkdir(parents=True)
    Path("models/m/a.onnx").write_text("1")
    write(MASKS, model=Path("models/m"))
    write(TREE, masks=MASKS.artifact)
    assert doubts() == {}
    from hilsplat.workflow.model_digests import model_digest

    model_digest.cache_clear()  # as in another process
    Path("models/m/a.onnx").write_text("22")
    assert doubts() == {"masks": "it was made from another models/m"}
