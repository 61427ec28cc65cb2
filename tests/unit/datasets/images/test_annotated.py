"""Own annotations: read like a published data set, without proposals; polygons traced back from pixels."""

import json

import cv2
import numpy as np
import pytest

from hilsplat.base.errors import SceneError
from hilsplat.base.levels import Level
from hilsplat.datasets.images.hi import ANNOTATED
from hilsplat.datasets.images.polygons import fill_polygons, trace_polygons
from hilsplat.datasets.registry import open_labelled
from hilsplat.datasets.sources import label_files, label_sets
from tests.conftest import PROJECT

MUG = {
    "id": 4,
    "level": 1,
    "parent": None,
    "category": "mug",
    "segmentation": [[2, 2], [11, 2], [11, 9], [2, 9]],
}
RIM = {
    "id": 7,
    "level": 2,
    "parent": 4,
    "category": "rim",
    "segmentation": [[[2, 2], [5, 2], [5, 3], [2, 3]]],
}


@pytest.fixture
def root(tmp_path):
    """A data root with one annotated photograph of photos/desk."""
    file = tmp_path / "annotated/photos/desk/DSC_1.json"
    file.parent.mkdir(parents=True)
    info = {"name": "DSC_1.png", "width": 16, "height": 12}
    file.write_text(json.dumps({"info": info, "objects": [MUG, RIM]}))
    return tmp_path


def test_a_scene_is_opened_by_its_two_names(root):
    scene = open_labelled("annotated/photos/desk", root)
    mug, rim = scene.views["DSC_1.png"]
    assert (mug.text, mug.level, mug.path) == ("mug", Level.WHOLE, ("mug",))
    assert (rim.text, rim.level, rim.path) == ("rim", Level.PART, ("mug", "rim"))
    assert np.count_nonzero(mug.mask()) == 80 and np.count_nonzero(rim.mask()) == 8
    assert ANNOTATED.found(root / "annotated") == ("photos/desk",)


def test_what_is_only_proposed_is_no_annotation(root):
    path = root / "annotated/photos/desk/DSC_1.json"
    content = json.loads(path.read_text())
    content["objects"][1]["origin"] = "proposed"
    path.write_text(json.dumps(content))
    scene = open_labelled("annotated/photos/desk", root)
    assert [region.text for region in scene.views["DSC_1.png"]] == ["mug"]
    assert scene.warnings == ("DSC_1.json: proposals not accepted, left out: 1",)


def test_the_workflow_finds_annotations_of_any_scene(root):
    assert label_sets("photos/desk", str(root), "photos/desk") == ("annotated/photos/desk",)
    assert label_sets("photos/desk", str(root), "photos/shelf") == ()
    (file,) = label_files("annotated/photos/desk", str(root))
    assert file.name == "DSC_1.json"


def test_a_scene_without_annotations_is_refused_with_its_folder(root):
    with pytest.raises(SceneError, match=r"also photos/shelf"):
        open_labelled("annotated/photos/shelf", root)


@pytest.mark.parametrize("seed", range(40))
def test_traced_polygons_fill_the_same_pixels(seed):
    rng = np.random.default_rng(seed)
    values = rng.random(rng.integers(1, 40, 2))
    if seed % 2:  # large shapes with holes instead of noise
        values = cv2.GaussianBlur(values, (5, 5), 0).reshape(values.shape)
    mask = values < rng.random()
    polygons = trace_polygons(mask)
    np.testing.assert_array_equal(fill_polygons(polygons, mask.shape), mask)
    areas = [np.count_nonzero(fill_polygons([polygon], mask.shape)) for polygon in polygons]
    assert sum(areas) == np.count_nonzero(mask)  # without common pixels
    assert all(len(polygon) >= 3 for polygon in polygons)


# -- the annotation that the project keeps: photographs of a bedroom, which are not part of it -----------


@pytest.fixture(scope="module")
def bedroom():
    """Ten objects with parts and subparts in four photographs, drawn with `hilsplat annotate`."""
    return open_labelled("annotated/photos/plush_bedroom", PROJECT / "tests")


def test_the_kept_annotation_has_ten_objects_whose_children_are_inside_them(bedroom):
    assert bedroom.warnings == ()
    regions = [region for regions in bedroom.views.values() for region in regions]
    counts = [sum(region.level == level for region in regions) for level in Level]
    assert (len(bedroom.views), counts) == (4, [23, 38, 31])
    wholes = {region.text for region in regions if region.level is Level.WHOLE}
    assert len(wholes) == 10 and {"plush doll", "black piano", "fox plush toy"} < wholes
    for labelled in bedroom.views.values():
        masks = {region.path: np.zeros(region.size_hw, bool) for region in labelled}
        for region in labelled:  # two eyes have one path
            masks[region.path] |= region.mask()
        for path, mask in masks.items():
            assert mask.any() and not (len(path) > 1 and (mask & ~masks[path[:-1]]).any()), path


def test_the_kept_annotation_names_photographs_that_exist(bedroom):
    folder = PROJECT / "photos/plush_bedroom"
    if not folder.is_dir():
        pytest.skip(f"the photographs are not part of the project: {folder} is missing (docs/annotate.md)")
    stems = {path.stem for path in folder.rglob("*.jpg")}
    assert {view.removesuffix(".png") for view in bedroom.views} <= stems
