"""Values of a model's preprocessor are checked when its folder is opened; published forms are accepted."""

import json
import shutil

import pytest

from hilsplat.base.errors import ModelError
from hilsplat.models.folder import input_side_px, open_model_folder, preprocessing_of
from tests.conftest import PROJECT


@pytest.fixture
def sam(tmp_path):
    return shutil.copytree(PROJECT / "models/sam-tiny", tmp_path / "sam")


LARGEST = r"less than or equal to 4096"
INTEGER, NUMBER = "a valid integer", "a valid number"

BAD = [
    ("size", 100_000, LARGEST),
    ("crop_size", {"height": 100_000, "width": 100_000}, LARGEST),
    ("pad_size", 0, "greater than or equal to 1"),
    ("size", True, INTEGER),
    ("crop_size", "224", INTEGER),
    ("pad_size", [], INTEGER),
    ("size", {"height": 224, "width": 336}, INTEGER),
    ("crop_size", {"shortest_edge": 224, "longest_edge": 448}, INTEGER),
    ("pad_size", {"height": [1] * 10**5}, INTEGER),
    ("image_mean", 0.5, "a valid list"),
    ("image_mean", [0.5], "at least 3 items"),
    ("image_mean", [0.5, 0.5, True], NUMBER),
    ("image_mean", [0.5, 0.5, float("nan")], "finite"),
    ("image_mean", [0.5, 0.5, 1e300], "less than or equal to 255"),
    ("image_std", [1, 1, 1e-300], "greater than or equal to 0.001"),
    ("image_std", [1, 1, float("inf")], "finite"),
    ("rescale_factor", 0, "greater than 0"),
    ("rescale_factor", 255, "less than or equal to 1"),
    ("rescale_factor", "1/255", NUMBER),
    ("resample", 99, "less than or equal to 5"),
    ("do_resize", "false", "a valid boolean"),
]


@pytest.mark.parametrize(("key", "value", "words"), BAD)
def test_values_that_cannot_be_used_are_refused(tmp_path, key, value, words):
    (tmp_path / "preprocessor_config.json").write_text(json.dumps({key: value}))
    with pytest.raises(
        ModelError, match=rf"preprocessor_config.json: {key} is invalid\n  expected  .*{words}"
    ) as told:
        preprocessing_of(tmp_path / "preprocessor_config.json")
    assert "\n  found " in str(told.value) and len(str(told.value)) < 500


@pytest.mark.parametrize("content", ["[]", "3", '"x"', "null", "{", "[" * 10**5])
def test_files_without_settings_are_refused(tmp_path, content):
    (tmp_path / "preprocessor_config.json").write_text(content)
    with pytest.raises(
        ModelError, match=r"preprocessor_config.json(: its content is invalid| cannot be read)"
    ):
        preprocessing_of(tmp_path / "preprocessor_config.json")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"pad_size": 256}, "pad_size is smaller than size"),
        ({"do_pad": False}, "disables do_pad"),
        ({"size": {"longest_edge": 100_000}}, "size is invalid"),
    ],
)
def test_a_folder_with_unusable_values_is_not_opened(sam, change, words):
    path = sam / "preprocessor_config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ModelError, match=words):
        open_model_folder(sam)


@pytest.mark.parametrize(
    ("content", "side"),
    [
        # CLIP of 2021 and of today, SigLIP, SAM 2, and open_clip in two versions, as published
        ({"size": 224, "crop_size": 224, "resample": 3}, 224),
        ({"size": {"shortest_edge": 224}, "crop_size": {"height": 224, "width": 224}}, 224),
        ({"do_convert_rgb": None, "size": {"height": 512, "width": 512}}, 512),
        ({"crop_size": None, "do_pad": None, "size": {"height": 1024, "width": 1024}}, 1024),
        ({"size": [256, 256], "mean": [0.5] * 3, "std": [0.5] * 3, "mode": "RGB"}, 256),
        ({"size": 256, "interpolation": "bicubic", "resize_mode": "shortest"}, 256),
        ({}, None),
    ],
)
def test_published_forms_are_accepted(tmp_path, content, side):
    (tmp_path / "preprocessing.json").write_text(json.dumps(content))
    found = preprocessing_of(tmp_path / "preprocessing.json")
    assert found.get("crop_size", found.get("size")) == side
    assert found.get("image_mean") == content.get("mean")


def test_the_side_of_the_input_is_the_padded_one(sam):
    assert input_side_px(open_model_folder(sam)) == 384
