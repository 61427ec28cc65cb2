"""Slips in a configuration that would change nothing, or something else, are refused."""

from pathlib import Path

import pytest

from hilsplat.base.errors import SettingsError
from hilsplat.configuration import parse_run, read_config


def written(folder: Path, text: str) -> Path:
    (folder / "my.yaml").write_text(text)
    return folder / "my.yaml"


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("seed: 1\nfield:\n  latent: 4\n  latent: 8\n", r"line 4, column 3(.|\n)*'latent' is there twice"),
        ("seed: 1\nseed: 2\n", r"line 2, column 1(.|\n)*'seed' is there twice"),
    ],
)
def test_a_key_that_is_there_twice(tmp_path, text, place):
    with pytest.raises(SettingsError, match=place):
        read_config(written(tmp_path, text))


def test_merged_keys_may_be_there_again(tmp_path):
    text = "one: &one {a: 1, b: 2}\ntwo:\n  <<: *one\n  a: 3\n"
    assert read_config(written(tmp_path, text))["two"] == {"a": 3, "b": 2}


@pytest.mark.parametrize(
    "config",
    [
        {"gaussians": {"iterations": True}},
        {"seed": False},
        {"poses": {"single_camera": True}},
        {"masks": {"precision": True}},
        {"variants": {"quick": {"field": {"iterations": True}}}},
    ],
)
def test_truth_values_are_no_numbers_and_no_words(config):
    with pytest.raises(SettingsError, match="YAML reads yes, no, on and off"):
        parse_run(config)


@pytest.mark.parametrize("name", ["world", "logs", "queries", "export", "scene", "gaussians", "scene.seed1"])
def test_a_variant_has_no_name_of_a_folder_of_the_scene(name):
    with pytest.raises(SettingsError, match="has files of this name"):
        parse_run({"variants": {name: {}}})


def test_a_query_has_a_text():
    with pytest.raises(SettingsError, match=r"queries\.synthetic: a text is empty"):
        parse_run({"queries": {"synthetic": ["mug", " "]}})
