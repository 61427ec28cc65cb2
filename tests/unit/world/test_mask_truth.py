"""Masks against true regions, by hand, and the picture of where they fail."""

from functools import partial

import numpy as np

from hilsplat.base.artifacts import write_index
from hilsplat.base.images import read_image
from hilsplat.base.levels import LEVELS, Level
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat_world.diagnostics.mask_truth import ViewFit, fit_of_level, median_and_worst, run_mask_truth
from tests.unit.evaluate.builders import box, masks_of

VIEW = "001.png"
part = partial(box, size_hw=(64, 64))


def found_masks() -> HierarchicalMasks:
    """The bear whole, the lower half of the chest and none of it elsewhere; three quarters of the head."""
    wholes = [part((8, 56), (8, 40)), part((44, 56), (44, 60)), part((0, 4), (0, 4))]
    return masks_of([*wholes, part((8, 24), (12, 30))], [1, 1, 1, 2])


def test_table_and_picture(block_world, tmp_path):
    found_masks().save(tmp_path / "masks" / f"{VIEW}.npz")
    write_index(tmp_path / "masks", {VIEW: {}}, segmenter="graph", model=None)
    out = tmp_path / "masks.webp"
    text = run_mask_truth(block_world.folder / "scene", block_world.folder / "truth", tmp_path / "masks", out)
    rows = out.with_suffix(".csv").read_text().splitlines()
    assert rows[1:] == [  # best IoUs: 1 and 0.5; 0.75 and 0; the nose has only 64 px
        "synthetic/blocks,graph,whole,1,2,0.7500,1.0000,3.0,0.6667",
        "synthetic/blocks,graph,part,1,2,0.3750,0.5000,1.0,1.0000",
        "synthetic/blocks,graph,subpart,1,0,nan,nan,0.0,nan",
    ]
    assert "| graph | whole | 1 | 2 | 0.7500 |" in text
    picture = read_image(out)
    green, red = (0, 104, 55), (165, 0, 38)  # ends of the scale of colours
    for colour in (green, red):
        assert (np.abs(picture.astype(int) - colour).sum(axis=2) < 90).sum() > 100


def test_the_median_and_the_worst_view_are_drawn(block_world):
    perfect = block_world.annotations

    def fits(masks: HierarchicalMasks) -> dict[Level, ViewFit]:
        return {level: fit_of_level(masks, level, perfect.label_image(VIEW, level)) for level in LEVELS}

    good, bad = fits(found_masks()), fits(masks_of([part((0, 4), (0, 4))], [1]))
    assert median_and_worst({"a": good, "b": bad, "c": good}) == ["a", "b"]
    assert median_and_worst({"a": good}) == ["a"]
