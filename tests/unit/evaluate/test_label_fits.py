"""Masks and nodes against annotated regions, counted by hand on the desk, where one Gaussian is one pixel."""

import csv
from pathlib import Path

import numpy as np
import pytest

from hilsplat.annotate.labels import Label, label_path, traced, write_labels
from hilsplat.base.errors import ArtifactError, SceneError
from hilsplat.base.levels import Level
from hilsplat.cli.main import app
from hilsplat.evaluate.label_fits import masks_of_view, region_fits, run_label_fits
from hilsplat.query.names import NO_FILE
from tests.unit.evaluate.builders import box, masks_of, region_of
from tests.unit.finished_desk import HEIGHT, NUM_VIEWS, SCENE, WIDTH, region_mask


def strip(begin, end):
    """A picture of 1 x 12 pixels with some of them set."""
    return box((0, 1), (begin, end), (1, 12))


def test_levels_are_compared_with_their_own_and_with_all_and_children_with_their_parents():
    mug, rim = strip(0, 8), strip(0, 4)
    regions = [
        (region_of(mug, "mug", Level.WHOLE), mug),
        (region_of(rim, "rim", Level.PART, ("mug", "rim")), rim),
    ]
    found = {
        Level.WHOLE: np.concatenate([strip(0, 4), strip(1, 8)]),
        Level.PART: strip(0, 2),
        Level.SUBPART: np.zeros((0, 12), bool),
    }
    whole, part = region_fits(regions, found)
    assert whole == (Level.WHOLE, (7 / 8, 7 / 8, pytest.approx(np.nan, nan_ok=True)))
    # pixel 1 of the rim's best mask 0..1 is in the mug's 1..7
    assert part == (Level.PART, (2 / 4, 1.0, 1 / 2))


def test_a_view_may_lack_masks_at_a_level(tmp_path):
    masks_of([strip(0, 4), strip(2, 8)], [1, 1]).save(tmp_path / "v.npz")
    shapes = {level: masks.shape for level, masks in masks_of_view(tmp_path / "v.npz").items()}
    assert shapes == {Level.WHOLE: (2, 12), Level.PART: (0, 12), Level.SUBPART: (0, 12)}


def test_a_finished_scene_is_measured_by_level_and_split(desk_project, tmp_path):
    size_hw = 2 * HEIGHT, 2 * (WIDTH + NUM_VIEWS)
    nothing = Label(id=3, level=1, text="pen", polygons=traced(box((1, 2), (1, 2), size_hw)))  # in the view
    proposal = Label(id=1, level=1, text="mug", polygons=[[(0, 0), (9, 0), (0, 9)]], origin="proposed")
    folder = tmp_path / "annotated/photos/desk"
    write_labels(label_path(folder, "002.png"), "002.png", size_hw, [proposal], NO_FILE)
    for number in (1, NUM_VIEWS - 1):  # a training view and the one held out
        view, names = f"{number:03d}.png", ("mug", "handle")
        mug, handle = (region_mask(name, number).repeat(2, 0).repeat(2, 1) for name in names)
        labels = [
            Label(id=1, level=1, text="mug", polygons=traced(mug)),
            Label(id=2, level=2, parent=1, text="handle", polygons=traced(handle)),
        ]
        write_labels(label_path(folder, view), view, size_hw, [*labels, nothing], NO_FILE)
    out = tmp_path / "fits.csv"
    folder = desk_project / SCENE
    variant = folder / "default"
    paths = (folder / "scene", folder / "gaussians.ply", variant / "masks", variant / "semantic_tree")
    run_label_fits(*paths, "annotated/photos/desk", tmp_path, out)
    rows = list(csv.DictReader(out.open()))
    found = {(row["what"].split(",")[0], row["views"], row["level"]) for row in rows}
    places = [("nodes", "held out"), ("nodes", "training"), ("masks", "training")]  # held out: no masks
    assert found == {(*place, level) for place in places for level in ("whole", "part")}
    assert all(row["regions"] == "1" for row in rows)
    assert all(float(row["best_iou"]) > 0.7 and float(row["recall"]) == 1 for row in rows)
    assert all(float(row["any_level_iou"]) >= float(row["best_iou"]) for row in rows)
    assert all(float(row["containment"]) > 0.9 for row in rows if row["level"] == "part")


def test_a_wrong_scene_or_variant_is_refused_and_makes_no_folder(own_desk, monkeypatch):
    monkeypatch.chdir(own_desk.parents[2])
    before = sorted(Path().rglob("*"))
    for words in (["photos/dask"], ["../outside"], ["photos/desk", "--variant", "defalt"]):
        with pytest.raises(ArtifactError):
            app(["datasets", "fits", *words], standalone_mode=False)
    assert sorted(Path().rglob("*")) == before and not Path("outside").exists()
    with pytest.raises(SceneError, match=r"there are no annotations in annotated(.|\n)*hilsplat annotate"):
        app(["datasets", "fits", "desk"], standalone_mode=False)
