"""Panels of scenes with and without annotations, and the answers drawn in them."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilsplat.base.artifacts import write_index
from hilsplat.evaluate.figures.panel import annotated_rows, draw_panel, free_rows, shown_truths
from hilsplat.query.answer import report, views_of
from hilsplat.query.pictures import ANSWER_RGB, TRUTH_RGB, outline, paint_answer, save_figure
from hilsplat.query.query_panel import query_panel
from hilsplat.settings import EvaluateSettings, FiguresSettings
from tests.unit.assembled_scene import GivenClip
from tests.unit.evaluate.builders import box
from tests.unit.evaluate.conftest import encode_texts

EVALUATE = EvaluateSettings()


def test_answer_is_filled_and_truth_outlined():
    image = np.full((20, 20, 3), 100, np.uint8)
    answer, truth = box((0, 20), (0, 8), (20, 20)), box((0, 20), (12, 18), (20, 20))
    painted = paint_answer(image, answer, truth)
    inside = (0.4 * 100 + 0.6 * np.array(ANSWER_RGB)).astype(np.uint8)
    assert painted[10, 4].tolist() == inside.tolist()
    assert painted[10, 12].tolist() == list(TRUTH_RGB)
    assert painted[10, 15].tolist() == [65, 65, 65]  # outside: 0.25 of the photograph and 0.4 of its grey


def test_outline_runs_inside_the_mask_but_not_along_the_image_border():
    mask = box((0, 6), (2, 6), (6, 6))
    assert np.argwhere(outline(mask)).tolist() == [[row, 2] for row in range(6)]


def rows_of(block_world, **settings):
    truths = shown_truths(block_world.scene, block_world.folder / "truth", "", Path(), EVALUATE)
    return annotated_rows(truths, FiguresSettings(**settings))


def test_largest_text_of_each_level_is_shown_first(block_world):
    rows = rows_of(block_world, queries_per_level=1)
    assert [(row.text, int(row.level)) for row in rows] == [("bear", 1), ("head", 2), ("nose", 3)]
    assert rows[2].path == ("bear", "head", "nose")
    assert len(rows_of(block_world)) == 5  # two of whole and part, the only one of subpart


@pytest.mark.parametrize("texts", [["bear", "bear > head"], []])
def test_panel_without_annotations_shows_given_texts_below_the_overview(block_world, tmp_path, texts):
    rows = free_rows(block_world.answers, texts, FiguresSettings())
    paths = [(("bear",), "000.png"), (("bear", "head"), "000.png")]
    assert [(row.path, row.view) for row in rows] == paths[: len(texts)]
    figure = draw_panel(block_world.answers, block_world.folder / "masks", rows, EVALUATE)
    save_figure(figure, tmp_path / "panel.png")
    assert (tmp_path / "panel.png").stat().st_size > 10_000


def test_a_panel_of_meaningless_answers_or_true_masks_is_marked(block_world, tmp_path):
    answers, masks = block_world.answers, block_world.folder / "masks"
    title = draw_panel(answers, masks, [], EVALUATE).get_suptitle()
    assert "\n" not in title and "true" not in title
    doubtful = draw_panel(replace(answers, clip=GivenClip(encode_texts, True)), masks, [], EVALUATE)
    assert "answers about photographs are meaningless" in doubtful.get_suptitle().replace("\n", " ")
    shutil.copytree(masks, tmp_path / "masks")
    label = "truth-perturbed (merge 0.2)"
    write_index(tmp_path / "masks", {"000.png": {}}, segmenter="truth-perturbed", model=None, label=label)
    figure = draw_panel(answers, tmp_path / "masks", [], EVALUATE)
    assert "masks made from the true labels" in figure.get_suptitle()
    assert f"masks: {label}" in [axes.get_ylabel() for axes in figure.axes]


def test_a_query_is_reported_and_drawn(block_world, tmp_path):
    answers, text = block_world.answers, "bear > head"
    found = answers.select(text)
    assert views_of(answers, answers.hits_of(found, 10), 2) == ["000.png", "001.png"]
    lines = report(answers, text, found).splitlines()
    assert lines[0] == "1 answer to 'bear > head' in synthetic/blocks; lengths in metres"
    assert lines[2].split()[:3] == ["2", "part", "1.00"]
    assert "doubtful" not in lines[-1]
    query_panel(answers, text, found, ["000.png", "001.png"], tmp_path / "panel.png")
    assert (tmp_path / "panel.png").stat().st_size > 10_000


def test_reports_state_what_was_not_found(block_world):
    answers = block_world.answers
    empty = replace(answers.select("bear"), ids=np.zeros(0, np.int64), values=np.zeros(0))
    expected = "nothing in synthetic/blocks matches 'unicorn' at level whole; try --level part"
    assert report(answers, "unicorn", empty).startswith(expected)
    expected = "nothing in view 000.png of synthetic/blocks matches 'unicorn'"
    assert report(answers, "unicorn", empty, "000.png").startswith(expected)
    found = answers.select("bear > head")
    assert "the whole scene was searched" not in report(answers, "bear > head", found)
    outside = report(answers, "bear > head", replace(found, route="fallback"))
    assert "no answer is part of a match for 'bear'" in outside
    found = answers.select("unicorn > head")
    assert found.route == "child"
    last = report(answers, "unicorn > head", found).splitlines()[-1]
    assert last.startswith("doubtful: no node is closer to 'unicorn' than to a generic word")
