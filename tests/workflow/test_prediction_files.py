"""Masks that the tiny scene answers with, written as files, get the same scores as in the run."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hilsplat.base.images import write_png
from hilsplat.datasets.synthetic.hierarchy import HierarchyAnnotations
from hilsplat.evaluate.protocols.answers import PackedMasks, Selections
from hilsplat.evaluate.protocols.cards import LEVEL_AUTO, LEVEL_GIVEN
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from hilsplat.evaluate.protocols.views import label_of, measure_view
from hilsplat.query.language_scene import LanguageScene
from tests.workflow.conftest import SCENE, Project

KEY = ["view", "query", "level", "metric"]


def write_answers(folder: Path, scene_folder: Path, method: str) -> None:
    """Masks of the field or the tree in every test view, at each level and at the level they choose."""
    scene = LanguageScene.open(scene_folder)
    annotations = HierarchyAnnotations.load(scene_folder / "world" / "truth")
    settings = scene.settings.model_copy(update={"methods": (method,)})
    auto, given = (label_of(card, method, settings) for card in (LEVEL_AUTO, LEVEL_GIVEN))
    for view in scene.scene.views("test"):
        size_hw = scene.scene.cameras[view].size_hw
        truth = ViewTruth.of(annotations, view, size_hw, settings.min_region_px)
        kept = PackedMasks(size_hw)
        list(measure_view(Selections(scene), truth, view, kept, settings))
        masks = {query.text: kept.get((method, auto, query.text)) for query in truth.categories}
        for query in truth.queries:
            mask = kept.get((method, given, query.text, query.level))
            masks[f"{query.level.label}/{query.text}"] = mask
        for name, mask in masks.items():
            write_png(folder / Path(view).stem / f"{name}.png", mask.astype(np.uint8) * 255)


@pytest.mark.parametrize(("method", "flat"), [("tree", "lerf/tree-nodes"), ("field", "lerf/langsplat")])
def test_answers_written_as_files_have_the_scores_of_the_run(
    finished: Project, tmp_path: Path, method: str, flat: str
) -> None:
    write_answers(tmp_path / "masks", finished.root / SCENE, method)
    out = tmp_path / "scores.csv"
    command = ["hilsplat", "evaluate-files", str(tmp_path / "masks"), "--out", str(out), "--method", "theirs"]
    command += ["--truth", f"{SCENE}/world/truth", "--scene", f"{SCENE}/scene", "--kind", "tabletop"]
    finished.run(*command, "--name", "tiny", "--min-region-px", "30")
    ours = pd.read_csv(finished.root / SCENE / "default" / "scores.csv", dtype=str, keep_default_na=False)
    ours = ours[ours["method"] == method]
    theirs = pd.read_csv(out, dtype=str, keep_default_na=False)
    for own, protocol in (
        (flat, "lerf/langsplat"),
        ("hierarchy/level-given", "hierarchy/level-given"),
        ("lerf-mask/gaussian-grouping", "lerf-mask/gaussian-grouping"),
    ):
        of_masks = ours["metric"].isin(["iou", "boundary_iou"]) | ours["metric"].str.startswith("hc_")
        expected = ours[ours["protocol"].str.startswith(f"{own}@") & of_masks]
        found = theirs[theirs["protocol"].str.startswith(f"{protocol}@")]
        assert len(expected) >= 18, own
        pd.testing.assert_series_equal(
            found.set_index(KEY)["value"].sort_index(), expected.set_index(KEY)["value"].sort_index()
        )
