"""Rows and pictures built on masks from true labels cannot be taken for results."""

import csv
import shutil

from hilsplat.base.artifacts import write_index
from hilsplat.evaluate.figures.panel import draw_panel
from hilsplat.evaluate.scores import Score, write_scores
from hilsplat.evaluate.tables.build import run_table
from hilsplat.segment.origin import made_from_truth, masks_label
from hilsplat.settings import EvaluateSettings
from tests.conftest import PROJECT

PUBLISHED = PROJECT / "config" / "published"
TRUE_MASKS = "truth-perturbed (merge 0.2)"


def score(masks: str, value: float, variant: str = "default") -> Score:
    protocol = "hierarchy/level-given@5"
    return Score(
        "synthetic", "one", variant, masks, "tree", "v.png", "cup", "whole", "iou", protocol, value, 1
    )


def hierarchy(tmp_path, scores) -> tuple[list[dict[str, str]], str]:
    write_scores(tmp_path / "scores.csv", scores)
    out = tmp_path / "hierarchy.csv"
    labels = {"default": "hilsplat", "bad-masks": "hilsplat"}
    run_table("hierarchy", [tmp_path / "scores.csv"], PUBLISHED / "hierarchy.csv", labels, out)
    with out.open(newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["kind"] != "reported"]
    return rows, out.with_suffix(".md").read_text()


def test_a_row_with_true_masks_says_so_beside_its_method_and_its_masks(tmp_path):
    scores = [score("sam-tiny", 0.5), score("sam-tiny", 0.4, "omega-2"), score(TRUE_MASKS, 0.9, "bad-masks")]
    rows, text = hierarchy(tmp_path, scores)
    assert [(row["method"], row["masks"]) for row in rows] == [
        ("hilsplat (tree)", "sam-tiny"),
        ("omega-2, tree", "sam-tiny"),
        ("diagnostic, true masks: hilsplat, tree", TRUE_MASKS),
    ]
    assert "They are not results" in text


def test_a_row_with_true_masks_is_ranked_with_nothing(tmp_path):
    scores = [score("sam-tiny", 0.5), score("sam-tiny", 0.4, "omega-2"), score(TRUE_MASKS, 0.9, "bad-masks")]
    _, text = hierarchy(tmp_path, scores)
    stand_in = text.split("synthetic stand-in (tables")[1]
    assert "**50.0**" in stand_in
    assert " 90.0 " in stand_in
    assert "**90.0**" not in stand_in


def test_tables_without_true_masks_do_not_speak_of_them(tmp_path):
    _, text = hierarchy(tmp_path, [score("sam-tiny", 0.5)])
    assert "true masks" not in text
    assert "true labels" not in text


def test_scores_name_the_label_of_the_masks(tmp_path):
    write_index(tmp_path, {}, segmenter="truth-perturbed", model=None, label=TRUE_MASKS)
    assert masks_label(tmp_path) == TRUE_MASKS
    assert made_from_truth(masks_label(tmp_path))
    assert not any(map(made_from_truth, ("sam-tiny", "graph", "truth")))


def test_a_panel_with_true_masks_says_so(block_world, tmp_path):
    shutil.copytree(block_world.folder / "masks", tmp_path / "masks")
    views = {"000.png": {}}
    write_index(tmp_path / "masks", views, segmenter="truth-perturbed", model=None, label=TRUE_MASKS)
    figure = draw_panel(block_world.answers, tmp_path / "masks", [], EvaluateSettings())
    assert "masks made from the true labels" in figure.get_suptitle()
    labels = [axes.get_ylabel() for part in (figure, *figure.subfigs) for axes in part.axes]
    assert f"masks: {TRUE_MASKS}" in labels
    usual = draw_panel(block_world.answers, block_world.folder / "masks", [], EvaluateSettings())
    assert "true" not in usual.get_suptitle()
