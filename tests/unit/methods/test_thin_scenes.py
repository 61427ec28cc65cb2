"""Every method on scenes with little in them (a level without masks, one view), and the knobs it reads."""

import re
from functools import cache

import numpy as np
import pytest

from hilsplat.base.levels import LEVELS
from hilsplat.methods.registry import METHODS, OURS, method_of
from hilsplat.settings import MethodSettings
from tests.unit.methods.two_boxes_inputs import two_boxes_inputs
from tests.unit.two_boxes_world import REGIONS, build_contributions, build_two_boxes

pytestmark = pytest.mark.filterwarnings("error")  # such as the mean of nothing
EVERY = tuple(range(len(REGIONS)))


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    """Features of a method on the world with masks of the given regions in each view, which is made once."""

    @cache
    def inputs_of(regions):
        with pytest.MonkeyPatch.context() as monkeypatch:
            world = build_two_boxes(tmp_path_factory.mktemp("thin"), monkeypatch, regions)
            return two_boxes_inputs(world, build_contributions(world))

    def fit(name, regions, kind=MethodSettings):
        settings = kind(name=name, steps=30, rate=0.05, pixel_step=1, codebook=(2, 2))
        features = method_of(name).fit(inputs_of(regions), settings, 0)
        assert np.isfinite(features).all()
        return features

    return fit


def without(level):
    """Every region that is not of a level."""
    return tuple(row for row in EVERY if REGIONS[row][1] != int(level))


THIN = {
    **{f"no {level.label}": (without(level),) * 6 for level in LEVELS},
    "a single view": (EVERY,),
    "a single mask of each level": ((0, 2, 5),) * 6,
    "a single mask of a single view": ((0,),),
}


@pytest.mark.parametrize("regions", THIN.values(), ids=THIN)
@pytest.mark.parametrize("name", sorted(METHODS))
def test_levels_with_masks_get_features_and_the_others_zeros(fit, name, regions):
    present = {REGIONS[row][1] for view in regions for row in view}
    assert fit(name, regions).any(axis=(0, 2)).tolist() == [int(level) in present for level in LEVELS]


def readers(description):
    """Methods that the text of a knob names, or all but those before its colon."""
    if description.startswith("all but "):
        spared = description.removeprefix("all but ").partition(":")[0].split(", ")
        assert set(spared) <= {OURS, *METHODS}
        return set(METHODS) - set(spared)
    return {name for name in METHODS if re.search(rf"\b{name}\b", description)}


@pytest.mark.parametrize("name", sorted(METHODS))
def test_knobs_name_the_methods_that_read_them(fit, name):
    read = set()

    class Watched(MethodSettings):
        def __getattribute__(self, key):
            read.add(key)
            return super().__getattribute__(key)

    fit(name, (EVERY,) * 6, Watched)
    knobs = MethodSettings.model_fields.items()
    own = {knob for knob, field in knobs if knob != "name" and name in readers(field.description)}
    assert (read & MethodSettings.model_fields.keys()) - {"name"} == own
