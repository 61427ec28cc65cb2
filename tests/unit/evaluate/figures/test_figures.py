"""Figures: panels of a scene, the comparison of methods, and plots of sweeps."""

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text
from PIL import Image

from hilsplat.base.artifacts import write_index
from hilsplat.base.errors import ArtifactError, SettingsError
from hilsplat.base.levels import Level
from hilsplat.evaluate.figures import comparison
from hilsplat.evaluate.figures.panel import annotated_rows, draw_panel, free_rows, shown_truths
from hilsplat.evaluate.figures.sweep_plot import draw_sweep, read_curves, run_sweep_plot
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from hilsplat.query.answer import report, views_of
from hilsplat.query.pictures import ANSWER_RGB, TRUTH_RGB, outline, paint_answer, save_figure
from hilsplat.query.query_panel import query_panel
from hilsplat.settings import EvaluateSettings, FiguresSettings
from tests.unit.assembled_scene import GivenClip
from tests.unit.evaluate.builders import box
from tests.unit.evaluate.conftest import encode_texts

EVALUATE = EvaluateSettings()


@pytest.fixture
def rows(block_world):
    truths = shown_truths(block_world.scene, block_world.folder / "truth", "", Path(), EVALUATE)
    return truths, annotated_rows(truths, FiguresSettings(queries_per_level=1))


# --- panels ---------------------------------------------------------------------------------------


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


def test_largest_text_of_each_level_is_shown_first(rows):
    truths, first = rows
    assert [(row.text, int(row.level)) for row in first] == [("bear", 1), ("head", 2), ("nose", 3)]
    assert first[2].path == ("bear", "head", "nose")
    # two of whole and part, the only one of subpart
    assert len(annotated_rows(truths, FiguresSettings())) == 5


@pytest.mark.parametrize("texts", [["bear", "bear > head"], []])
def test_panel_without_annotations_shows_given_texts_below_the_overview(block_world, tmp_path, texts):
    rows = free_rows(block_world.answers, texts, FiguresSettings())
    paths = [(("bear",), "000.png"), (("bear", "head"), "000.png")]
    assert [(row.path, row.view) for row in rows] == paths[: len(texts)]
    figure = draw_panel(block_world.answers, block_world.folder / "masks", rows, EVALUATE)
    save_figure(figure, tmp_path / "panel.png")
    assert (tmp_path / "panel.png").stat().st_size > 10_000


def test_without_an_annotated_level_the_field_answers_at_its_own_level_not_the_trees(block_world, rows):
    real = block_world.answers
    at_subpart = partial(real.select, level=Level.SUBPART)
    answers = SimpleNamespace(
        **{name: getattr(real, name) for name in ("scene", "views", "field", "caution")},
        select=lambda path, level, view: at_subpart(path, view=view),
    )
    bear = replace(rows[1][0], level=None)
    panel = draw_panel(answers, block_world.folder / "masks", [bear], EVALUATE)
    (title,) = [title for axes in panel.axes if (title := axes.get_title()).startswith("field: IoU")]
    assert float(title.split()[-1]) > 0.9
    framed = [axes.get_title() for axes in panel.axes if axes.title.get_fontweight() == "bold"]
    assert [title.split(":")[0] for title in framed] == ["relevancy, whole"]


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


def test_long_texts_stay_inside_the_pictures(block_world, rows, tmp_path, monkeypatch):
    text = " ".join(["unicorn"] * 30)
    drawn = []
    monkeypatch.setattr("hilsplat.query.query_panel.save_figure", lambda figure, out: drawn.append(figure))
    query_panel(block_world.answers, text, block_world.answers.select(text), ["000.png"], tmp_path / "x.png")
    shown = [replace(row, text=text, truth=None) for row in rows[1]]
    drawn.append(comparison.draw_methods(block_world.scene, block_world.answers.views.image, [], shown))
    for figure in drawn:
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        width, height = canvas.get_width_height()
        texts = [each for each in figure.findobj(Text) if each.get_text()]
        assert any("unicorn unicorn" in each.get_text() for each in texts)
        for extent in (each.get_window_extent(canvas.get_renderer()) for each in texts):
            assert min(extent.p0) >= 0 and extent.x1 <= width and extent.y1 <= height


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


# --- methods and sweeps ---------------------------------------------------------------------------


def test_tree_and_field_of_an_exact_world_answer_with_the_truth(block_world, rows):
    for method in ("tree", "field"):
        answerer = comparison.Answerer(method, method, block_world.answers)
        for row, mask in zip(rows[1], answerer.masks(rows[1], EVALUATE), strict=True):
            assert np.count_nonzero(mask != row.truth) <= 0.05 * row.truth.size, (method, row.text)


def test_many_methods_are_rows_and_queries_columns(block_world, rows):
    masks = comparison.Answerer("tree", "tree", block_world.answers).masks(rows[1], EVALUATE)
    columns = [comparison.Column(f"method {n}", masks, [], []) for n in range(comparison.MAX_COLUMNS + 1)]
    figure = comparison.draw_methods(block_world.scene, block_world.answers.views.image, columns, rows[1])
    grid = np.array(figure.get_axes()).reshape(len(columns) + 1, len(rows[1]))
    assert [axes.get_ylabel() for axes in grid[:, 0]] == ["", *(column.title for column in columns)]
    assert all("IoU" in axes.get_title() for axes in grid[1:].ravel())
    for axes, row in zip(grid[0], rows[1], strict=True):
        assert axes.get_title().startswith(f"“{row.text}” ({row.level.label})\ntruth")


def test_one_part_is_shown_over_views_and_views_without_truth_fill_up(block_world, rows):
    shown = comparison.over_views(block_world.scene, rows[1], rows[0])
    assert {(row.text, row.level) for row in shown} == {("head", Level.PART)}
    assert [row.view for row in shown] == ["001.png", "000.png"]  # there are two views
    assert shown[1].truth is None


def test_equal_nodes_have_equal_colours_and_other_pixels_are_black(block_world):
    picture = comparison.node_image(block_world.answers, "001.png", Level.WHOLE)
    bear, chest, nothing = picture[20, 20], picture[50, 50], picture[2, 2]
    assert (picture[40, 10] == bear).all()
    assert not (bear == chest).all()
    assert nothing.tolist() == [0, 0, 0]


@pytest.fixture
def compare(block_world, tmp_path, monkeypatch):
    """Function that draws the figures of the block world into a folder; variants are named like a method."""

    def opened(folder, variant, *how):
        methods = (variant,) if variant in ("tree", "field") else EVALUATE.methods
        return replace(block_world.answers, settings=EVALUATE.model_copy(update={"methods": methods}))

    monkeypatch.setattr(comparison, "open_variant", opened)

    def run(name, variants, names, **more):
        out, settings = tmp_path / name / "comparison.webp", FiguresSettings(queries_per_level=1)
        comparison.run_comparison(block_world.folder, variants, names, out, settings, EVALUATE, **more)

    return run


def test_a_variant_shows_the_methods_that_its_settings_evaluate(compare, monkeypatch):
    shown, made = [], comparison.Answerer
    monkeypatch.setattr(comparison, "Answerer", lambda *of: shown.append(of[0]) or made(*of))
    compare("one", ["default", "tree", "field"], {"tree": "my tree"}, queries=["bear"])
    assert shown == ["hilsplat (tree)", "hilsplat (field)", "my tree, tree", "field"]


def test_all_figures_are_written_as_webp_and_pdf_twice_the_same(block_world, tmp_path, compare):
    for name in ("one", "two"):
        compare(name, ["default", "paper"], {"paper": "hilsplat (paper)"}, truth=block_world.folder / "truth")
    for figure in ("comparison", "views", "features"):
        for suffix in (".webp", ".pdf"):
            first, second = ((tmp_path / name / f"{figure}{suffix}").read_bytes() for name in ("one", "two"))
            assert first == second and len(first) > 1000
        with Image.open(tmp_path / "one" / f"{figure}.webp") as picture:
            assert picture.width == 1430


@pytest.mark.parametrize("truths", [{}, {"001.png": partial(ViewTruth.of_regions, [], (64, 64))}])
def test_scenes_without_labelled_regions_show_the_queries_of_the_configuration(compare, monkeypatch, truths):
    drawn = []
    monkeypatch.setattr(comparison, "shown_truths", lambda *how: truths)
    monkeypatch.setattr(comparison, "draw_methods", lambda *of: drawn.append(of[-1]) or None)
    monkeypatch.setattr(comparison, "save_with_pdf", lambda figure, out: None)
    compare("free", ["default"], {}, queries=["bear"])
    assert [(row.text, row.truth) for row in drawn[0]] == [("bear", None)]


def test_comparing_no_variants_is_refused(compare):
    with pytest.raises(SettingsError, match="there are no variants to compare"):
        compare("none", [], {})


SWEEP = """kind,data,method,masks,protocol,Hi-LERF mIoU,Hi-LERF HC
reported,LERF,theta = 0.6,,,38.4,56.3
reported,LERF,theta = 0.9,,,39.1,56.9
measured,hi_lerf,theta = 0.6,sam,level given,31.00 ± 0.50,
measured,hi_lerf,theta = 0.9,sam,level given,32.00,
measured,hi_3dovs,theta = 0.6,sam,level given,51.00,
measured,hi_3dovs,theta = 0.9,sam,level given,52.00,
synthetic stand-in,synthetic,hilsplat (field),a,level given,42.10,50.00
synthetic stand-in,synthetic,theta = 0.9,a,level given,42.00,
synthetic stand-in,synthetic,theta = 0.6,a,level given,41.00,
synthetic stand-in,synthetic,"theta = 0.6, by head",a,level given,61.00,
synthetic stand-in,synthetic,"theta = 0.9, by head",a,level given,62.00,
synthetic stand-in,synthetic,"theta = 0.9, by head",b,level given,72.00,
synthetic stand-in,synthetic,theta = 0.9,a,hierarchy/level-given@6 (filter 20),82.00,
"""


def test_a_curve_joins_rows_of_one_data_set_and_reading(tmp_path):
    (tmp_path / "theta.csv").write_text(SWEEP)
    assert read_curves(tmp_path / "theta.csv") == {
        "reported: LERF": {
            "Hi-LERF mIoU": [(0.6, 38.4), (0.9, 39.1)],
            "Hi-LERF HC": [(0.6, 56.3), (0.9, 56.9)],
        },
        "measured: hi_lerf": {"Hi-LERF mIoU, sam": [(0.6, 31.0), (0.9, 32.0)]},
        "measured: hi_3dovs": {"Hi-LERF mIoU, sam": [(0.6, 51.0), (0.9, 52.0)]},
        "synthetic stand-in: synthetic": {
            "Hi-LERF mIoU, a": [(0.9, 42.0), (0.6, 41.0)],
            "Hi-LERF mIoU, by head, a": [(0.6, 61.0), (0.9, 62.0)],
            "Hi-LERF mIoU, by head, b": [(0.9, 72.0)],
            "Hi-LERF mIoU, a, filter 20": [(0.9, 82.0)],
        },
    }
    run_sweep_plot("theta", tmp_path / "theta.csv", tmp_path / "theta.png")
    assert (tmp_path / "theta.pdf").is_file()


def test_a_column_has_the_same_colour_in_every_panel_and_lines_of_its_own_for_more_curves():
    points = [(0.6, 1.0), (0.9, 2.0)]
    reported = {"Hi-LERF mIoU": points, "LERF mIoU": points}
    measured = {"3D-OVS mIoU, sam": points, "LERF mIoU, sam": points, "LERF mIoU, by head, sam": points}
    left, right = draw_sweep("theta", {"reported: LERF": reported, "stand-in": measured}).get_axes()
    (_, one), (other, two, three) = left.get_lines(), right.get_lines()
    assert one.get_color() == two.get_color() == three.get_color() != other.get_color()
    assert two.get_linestyle() != three.get_linestyle()


def test_an_unknown_sweep_is_an_error_that_lists_the_sweeps(tmp_path):
    with pytest.raises(ArtifactError, match="one of theta, omega"):
        run_sweep_plot("lambda", tmp_path / "theta.csv", tmp_path / "x.png")
    with pytest.raises(ArtifactError, match="build the table first"):
        run_sweep_plot("theta", tmp_path / "theta.csv", tmp_path / "x.png")
    (tmp_path / "lerf.csv").write_text("kind,data,method\nmeasured,lerf,hilsplat\n")
    with pytest.raises(ArtifactError, match="rows named like 'theta = "):
        run_sweep_plot("theta", tmp_path / "lerf.csv", tmp_path / "x.png")
