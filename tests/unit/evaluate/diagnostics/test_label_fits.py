"""Masks and nodes against annotated regions, counted by hand on the desk, where one Gaussian is one pixel."""

import csv

import numpy as np
import pytest

from hilsplat.annotate.labels import Label, label_path, traced, write_labels
from hilsplat.base.levels import Level
from hilsplat.datasets.labelled import LabelledRegion
from hilsplat.evaluate.diagnostics.label_fits import Fits, add_view, run_label_fits
from hilsplat.query.names import NO_FILE
from tests.unit.finished_desk import HEIGHT, NUM_VIEWS, SCENE, WIDTH, build_finished_desk, region_mask

SIZE = (HEIGHT, WIDTH + NUM_VIEWS)


def strip(begin: int, end: int) -> np.ndarray:
    """One row of 12 pixels with some of them set."""
    return (np.arange(12) >= begin) & (np.arange(12) < end)


def test_levels_are_compared_with_their_own_and_with_all_and_children_with_their_parents():
    def region(text, level, path, pixels):
        return LabelledRegion(text, (1, 12), lambda: pixels[None], None, level, path), pixels[None]

    regions = [
        region("mug", Level.WHOLE, ("mug",), strip(0, 8)),
        region("rim", Level.PART, ("mug", "rim"), strip(0, 4)),
    ]
    found = {
        Level.WHOLE: np.stack([strip(0, 4), strip(1, 8)]),
        Level.PART: np.stack([strip(0, 2)]),
        Level.SUBPART: np.zeros((0, 12), bool),
    }
    fits = {level: Fits() for level in Level}
    add_view(fits, regions, found)
    assert fits[Level.WHOLE].best == [7 / 8] and fits[Level.WHOLE].containment == []
    assert fits[Level.PART].best == [2 / 4] and fits[Level.PART].anywhere == [1.0]
    assert fits[Level.PART].containment == [1 / 2]  # pixel 1 of the rim's best mask 0..1 is in the mug's 1..7


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    project = build_finished_desk(tmp_path_factory.mktemp("project"))
    for number in (1, NUM_VIEWS - 1):  # a training view and the one held out
        view = f"{number:03d}.png"
        mug, handle = region_mask("mug", number), region_mask("handle", number)
        labels = [
            Label(id=1, level=1, text="mug", polygons=traced(mug)),
            Label(id=2, level=2, parent=1, text="handle", polygons=traced(handle)),
        ]
        folder = project / "annotated/photos/desk"
        write_labels(label_path(folder, view), view, SIZE, labels, NO_FILE)
    return project


def test_a_finished_scene_is_measured_by_level_and_split(project, tmp_path):
    out = tmp_path / "fits.csv"
    run_label_fits(project / SCENE, "default", "annotated/photos/desk", project, out)
    rows = list(csv.DictReader(out.open()))
    masks = [row for row in rows if row["what"].startswith("masks")]
    nodes = [row for row in rows if row["what"] == "nodes"]
    assert {row["views"] for row in masks} == {"training"}  # held-out views have no masks
    assert {(row["views"], row["level"]) for row in nodes} == {
        (views, level) for views in ("held out", "training") for level in ("whole", "part")
    }
    assert all(row["regions"] == "1" for row in rows)
    assert all(float(row["best_iou"]) > 0.7 and float(row["recall"]) == 1 for row in rows)
    assert all(float(row["any_level_iou"]) >= float(row["best_iou"]) for row in rows)
    assert all(float(row["containment"]) > 0.9 for row in rows if row["level"] == "part")
