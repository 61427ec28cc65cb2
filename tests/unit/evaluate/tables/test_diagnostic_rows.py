"""Rows and pictures built on masks from true labels cannot be taken for results."""

import shutil

from hilsplat.base.artifacts import write_index
from hilsplat.evaluate.figures.panel import draw_panel
from hilsplat.segment.origin import made_from_truth, masks_label
from hilsplat.settings import EvaluateSettings
from tests.unit.evaluate.tables.test_tables import built, score

TRUE_MASKS = "truth-perturbed (merge 0.2)"


def hierarchy(tmp_path, *rows) -> tuple[list[dict[str, str]], str]:
    """The CSV's measured rows and the Markdown of a table from (masks, value, variant)."""
    scores = [score("iou", value, masks=masks, variant=variant) for masks, value, variant in rows]
    found, forms = built(tmp_path, "hierarchy", scores, {"default": "hilsplat", "bad-masks": "hilsplat"})
    return [row for row in found if row["kind"] != "reported"], forms[".md"]


def test_a_row_with_true_masks_says_so_and_is_ranked_with_nothing(tmp_path):
    usual = [("sam-tiny", 0.5, "default"), ("sam-tiny", 0.4, "omega-2")]
    rows, text = hierarchy(tmp_path, *usual, (TRUE_MASKS, 0.9, "bad-masks"))
    assert [(row["method"], row["masks"]) for row in rows] == [
        ("hilsplat (tree)", "sam-tiny"),
        ("omega-2, tree", "sam-tiny"),
        ("diagnostic, true masks: hilsplat, tree", TRUE_MASKS),
    ]
    assert "They are not results" in text
    stand_in = text.split("synthetic stand-in (tables")[1]
    assert "**50.0**" in stand_in
    assert " 90.0 " in stand_in
    assert "**90.0**" not in stand_in
    _, text = hierarchy(tmp_path, *usual)
    assert "true masks" not in text
    assert "true labels" not in text


def test_masks_are_named_after_the_model_the_segmenter_or_their_label(block_world, tmp_path):
    assert masks_label(block_world.folder / "masks") == "sam-tiny"
    write_index(tmp_path, {}, segmenter="graph", model=None)
    assert masks_label(tmp_path) == "graph"
    write_index(tmp_path, {}, segmenter="truth-perturbed", model=None, label=TRUE_MASKS)
    assert masks_label(tmp_path) == TRUE_MASKS
    assert made_from_truth(TRUE_MASKS)
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
