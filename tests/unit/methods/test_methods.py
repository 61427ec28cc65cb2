"""Every baseline on small scenes: what it finds, and repeated fits; registry and stage."""

import csv
import functools
import inspect
import json
import re
import sys
import tomllib
import types
from dataclasses import dataclass, replace
from functools import cache
from importlib import metadata

import numpy as np
import pytest
import torch
import yaml

from hilsplat import baselines
from hilsplat.base import plugins
from hilsplat.base.errors import ArtifactError, HilsplatError, SettingsError
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.plugins import load
from hilsplat.baselines import BASELINES, OURS, MethodSettings, method_of, own_settings
from hilsplat.configuration import config_schema, knob_table, parse_run, parse_section
from hilsplat.contributions.compositing import normalised_weights
from hilsplat.field.code import LanguageField, LinearCode
from hilsplat.methods import laga, method
from hilsplat.methods.method import MethodInputs
from hilsplat.scene.cameras import Camera
from hilsplat.stages import stage_of
from tests.conftest import PROJECT
from tests.unit import two_boxes_world as boxes

pytestmark = pytest.mark.filterwarnings("error")  # such as the mean of an empty array
EVERY, LARGE = tuple(range(len(boxes.REGIONS))), (0, 1, 2, 3, 5, 6)
"""LARGE lacks part "B top", which covers too little of its box to be distinguished from the rest."""
FITS = {
    # method: settings, regions that it finds, least share of a region's Gaussians with its code
    "dr_splat": ({}, EVERY, 0.8),
    "gaussian_grouping": ({"steps": 100}, EVERY, 0.8),
    "hi_lsplat": (
        {"weight_clustering": 0.1, "weight_instance": 1e-4, "weight_part": 1e-4, "min_mask_px": 4},
        EVERY,
        0.8,
    ),
    "laga": ({}, EVERY, 0.8),
    "langsplat": ({}, EVERY, 0.8),
    "langsplat_v2": ({}, EVERY, 0.8),
    "legaussians": ({"rate": 0.02}, EVERY, 0.8),
    "lifted": ({}, EVERY, 0.8),
    "occam": ({}, EVERY, 0.8),
    "omniseg3d": ({"thresholds": (0.05, 0.4, 0.7)}, LARGE, 0.6),
    "opengaussian": ({}, EVERY, 0.8),
    "saga": ({}, (0, 1, 2, 3), 0.6),
    "vch": ({"steps": 100, "thresholds": (0.8, 0.5, 0.3)}, LARGE, 0.6),  # a third of "A top" is a subpart
}


@dataclass(frozen=True)
class BoxesInputs(MethodInputs):
    """Inputs from the world with two boxes; the code of a region is one-hot."""

    world: boxes.TwoBoxes | None = None

    @property
    def latents(self):
        return np.eye(len(boxes.REGIONS), dtype=np.float32)[np.concatenate(list(self.world.regions.values()))]

    def linear_code(self, method):
        return LinearCode(
            np.full(len(boxes.REGIONS), 0.1, np.float32), np.eye(len(boxes.REGIONS), dtype=np.float32)
        )

    def view_weights(self, view, step=1):
        return normalised_weights(boxes.two_boxes_weights(self.world.views.index(view)))

    def view_camera(self, view):
        ahead = np.eye(4)
        ahead[:3, 3] = self.world.views.index(view), 0, 1
        return Camera(
            view, ahead, np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]), (boxes.HEIGHT, boxes.WIDTH)
        )


@pytest.fixture(scope="module")
def inputs_of(tmp_path_factory):
    """A cached function that builds inputs with masks of the given regions in each view."""

    @cache
    def inputs_of(regions=boxes.ONE_DROPPED):
        with pytest.MonkeyPatch.context() as monkeypatch:
            world = boxes.build_two_boxes(tmp_path_factory.mktemp("boxes"), monkeypatch, regions)
            folders = world.scene, world.ply, world.masks, boxes.build_contributions(world), world.folder
            return BoxesInputs(*folders, world.coverage_tree, world=world)

    return inputs_of


def fit_of(name, inputs, **changed):
    """Return the features of a method."""
    settings = {"steps": 150, "rate": 0.05, "pixel_step": 1, "codebook": (2, 2), **FITS[name][0], **changed}
    settings = {key: settings[key] for key in own_settings()[name] if key in settings}
    features = load(method_of(name).fit)(inputs, method_of(name).settings(name=name, **settings), 0)
    assert features.dtype == np.float32 and np.isfinite(features).all()
    return features


@pytest.mark.parametrize("name", BASELINES)
def test_regions_of_every_level_get_their_own_code(inputs_of, monkeypatch, name):
    monkeypatch.setattr(laga, "MIN_MASKS", 3)  # some regions have masks in three of the four views
    features = fit_of(name, inputs_of())
    _, rows, least = FITS[name]
    for row in rows:
        inside = np.flatnonzero(boxes.region_mask(row).ravel())
        own = features[inside, Level(boxes.REGIONS[row][1]).index]
        right = (own.argmax(axis=1) == row) & (own.max(axis=1) > 0.5)
        assert np.mean(right) > least, boxes.REGIONS[row][0]


@pytest.mark.parametrize("name", BASELINES)
def test_fits_are_identical_on_any_number_of_threads(inputs_of, name):
    before, made = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            made.append(fit_of(name, replace(inputs_of(), threads=threads), steps=5))
    finally:
        torch.set_num_threads(before)
    assert made[0].tobytes() == made[1].tobytes()


def test_without_its_losses_the_paper_s_method_is_langsplat(inputs_of):
    none = {"weight_clustering": 0.0, "weight_instance": 0.0, "weight_part": 0.0}
    plain, own = fit_of("langsplat", inputs_of()), functools.partial(fit_of, "hi_lsplat", inputs_of())
    assert own(**none).tobytes() == plain.tobytes()
    for weight in none:
        assert own(**none | {weight: 0.1}).tobytes() != plain.tobytes(), weight


THIN = {
    **{
        f"no {level.label}": (tuple(row for row in EVERY if boxes.REGIONS[row][1] != int(level)),) * 6
        for level in LEVELS
    },
    "a single view": (EVERY,),
    "a single mask of each level": ((0, 2, 5),) * 6,
    "a single mask of a single view": ((0,),),
}


@pytest.mark.parametrize("regions", THIN.values(), ids=THIN)
@pytest.mark.parametrize("name", BASELINES)
def test_levels_with_masks_get_features_and_the_others_zeros(inputs_of, name, regions):
    present = {boxes.REGIONS[row][1] for view in regions for row in view}
    features = fit_of(name, inputs_of(regions), steps=30)
    assert features.any(axis=(0, 2)).tolist() == [int(level) in present for level in LEVELS]


def test_unknown_methods_name_those_that_exist():
    with pytest.raises(SettingsError, match=rf"'langsplatt'.*\n.*one of hilsplat, {', '.join(BASELINES)}"):
        parse_run({"variants": {"x": {"method": {"name": "langsplatt"}}}})
    with pytest.raises(SettingsError, match="is not a baseline"):
        method_of(OURS)


@pytest.mark.parametrize("features", [np.zeros((2, 3, 2)), np.full((2, 3, 1), np.nan)])
def test_a_method_that_returns_no_field_is_refused(tmp_path, monkeypatch, features):
    monkeypatch.setattr(method, "load", lambda place: lambda inputs, settings, seed: features)
    inputs = types.SimpleNamespace(
        scene_folder=tmp_path / "scene",
        contributions=types.SimpleNamespace(num_gaussians=2),
        latents=np.zeros((3, 1), np.float32),
    )
    run_method = inspect.unwrap(method.run_method)  # the inputs here are no MethodInputs
    with pytest.raises(ArtifactError, match="method langsplat did not return a language field"):
        run_method(inputs, tmp_path / "field.safetensors", MethodSettings(name="langsplat"), 0)


@pytest.fixture
def nearest_mask(tmp_path, monkeypatch):
    """The example package of docs/extending.md, as if installed."""
    page = (PROJECT / "docs" / "extending.md").read_text()
    code = re.search(r"```python\n(# nearest_mask/__init__\.py.*?)```", page, re.S)[1]
    points = tomllib.loads(re.search(r"```toml\n(.*?)```", page, re.S)[1])["project"]["entry-points"]
    (tmp_path / "nearest_mask").mkdir()
    (tmp_path / "nearest_mask/__init__.py").write_text(code)
    (tmp_path / "nearest_mask-1.0.dist-info").mkdir()
    lines = [f"{name} = {place}" for name, place in points[baselines.GROUP].items()]
    text = "\n".join([f"[{baselines.GROUP}]", *lines, ""])
    (tmp_path / "nearest_mask-1.0.dist-info/entry_points.txt").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(plugins, "_all_entry_points", metadata.entry_points)
    plugins.entry_points.cache_clear()
    yield tmp_path
    plugins.entry_points.cache_clear()
    sys.modules.pop("nearest_mask", None)


def test_the_package_in_the_documentation_adds_a_method_with_two_settings(inputs_of, nearest_mask):
    run = parse_run({"variants": {"mine": {"method": {"name": "nearest_mask", "min_mass_px": 0.5}}}})
    settings = run.stages("mine").method
    assert (settings.min_mask_px, settings.min_mass_px) == (1, 0.5)
    assert not settings.is_random
    assert "method.min_mass_px" in knob_table() and "min_mass_px" in json.dumps(config_schema())
    with pytest.raises(SettingsError, match=r"method\.min_mas_px: unknown key; did you mean 'min_mass_px'"):
        parse_section("method", '{"name": "nearest_mask", "min_mas_px": 1}')
    stage = stage_of("method")
    assert stage.code_digest((method_of("nearest_mask").fit,)) != stage.code_digest()

    inputs, out = inputs_of(), nearest_mask / "field.safetensors"
    (inputs.autoencoder_folder / "autoencoder.safetensors").touch()
    method.run_method(inputs, out, settings, 0)
    features = LanguageField.load(out).features
    for row in EVERY:
        inside = np.flatnonzero(boxes.region_mask(row).ravel())
        assert (features[inside, Level(boxes.REGIONS[row][1]).index, row] == 1).mean() > 0.8, boxes.REGIONS[
            row
        ][0]


@pytest.mark.parametrize(
    ("code", "problem"),
    [
        ("import no_such_module", "cannot be imported: No module named"),
        ("METHOD = 1 / 0", "cannot be imported: division by zero"),
        ("METHOD = 1", "has the wrong type"),
    ],
)
def test_a_broken_package_is_reported(nearest_mask, code, problem):
    (nearest_mask / "nearest_mask/__init__.py").write_text(code)
    with pytest.raises(HilsplatError, match=f"methods: nearest_mask = nearest_mask:METHOD {problem}"):
        parse_section("method", '{"name": "nearest_mask"}')


def test_methods_of_the_papers_tables_run_or_are_explained_in_the_documentation():
    page = (PROJECT / "docs" / "methods.md").read_text().partition("## Every method of the tables")[2]
    cells = [line.split("|")[1] for line in page.splitlines() if line.startswith("| ")]
    explained = {name.partition(" (")[0].strip() for cell in cells for name in cell.split(",")}
    rows = set()
    for path in sorted((PROJECT / "config" / "published").glob("*.csv")):
        if path.stem not in ("ablation", "omega", "theta", "pruning") and not path.stem.startswith("frames-"):
            with path.open(newline="") as file:
                rows |= {row["method"].rstrip("*").replace("Lseg", "LSeg") for row in csv.DictReader(file)}
    assert rows - {"Hi-LSplat"} - explained == set()


def test_methods_yaml_has_a_variant_of_every_method():
    own, more = (
        yaml.safe_load((PROJECT / f"config/{name}.yaml").read_text()) for name in ("config", "methods")
    )
    names = {**own["variants"], **more["variants"]}
    variants = {name: own["variants"].get(name, {}) | more["variants"].get(name, {}) for name in names}
    listed = {variants.get(name, {}).get("method", {}).get("name", OURS) for name in more["main_variants"]}
    assert listed == {OURS, *BASELINES}
    parse_run(own | more | {"variants": variants, "labels": own["labels"] | more["labels"]})
