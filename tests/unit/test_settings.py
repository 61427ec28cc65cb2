"""Settings: one default each, errors that name the key, overrides and variants."""

import json
from pathlib import Path
from typing import Any, get_args

import pytest
from jsonschema import Draft202012Validator

from hilsplat.base.errors import SettingsError
from hilsplat.baselines import BASELINES, OURS, TrainedSettings
from hilsplat.configuration import (
    SECTIONS,
    config_schema,
    knob_table,
    merged_config,
    parse_run,
    parse_section,
    read_config,
)
from hilsplat.settings import LARGEST
from hilsplat.stage import Seed


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"feild": {"omega": 2}}, r"feild: unknown key; did you mean 'field'\?"),
        ({"coverage_tree": {"thetaa": 0.5}}, r"coverage_tree\.thetaa: unknown key; did you mean 'theta'\?"),
        ({"coverage_tree": {"theta": 2}}, r"coverage_tree\.theta: Input should be less than 1; found 2"),
        (
            {"variants": {"x": {"coverage_tree": {"theta": 3}}}},
            r"variants\.x\.coverage_tree\.theta: Input should be less than 1",
        ),
        ({"main_variants": ["nope"]}, "variant 'nope' is not defined"),
        ({"queries": {"synthetic": ["mug", " "]}}, r"empty text(.|\n)*queries\.synthetic"),
        ({"data_root": "</script>"}, "data_root: String should match pattern"),
        ({"gaussians": {"iterations": True}}, "YAML reads yes, no, on and off"),
        ({"masks": {"predicted_iou_min": float("inf")}}, r"masks\.predicted_iou_min"),
        ({"masks": {"predicted_iou_min": float("nan")}}, r"masks\.predicted_iou_min"),
        ({"masks": {"graph_scales": [float("-inf")] * 3}}, r"masks\.graph_scales"),
        ({"method": {"name": "lifted", "steps": 1}}, r"method\.steps: unknown key; one of name"),
        (
            {"variants": {"x": {"method": {"name": "opengaussian", "codebok": [1, 1]}}}},
            r"variants\.x\.method\.codebok: unknown key; did you mean 'codebook'\?",
        ),
        ({"evaluate": {"canonical": []}}, r"evaluate\.canonical"),
        ({"evaluate": {"canonical": ["object", " "]}}, r"evaluate\.canonical"),
        ({"labels": {"default": "a\0b"}}, "null byte"),
        ({"seed": 2**31}, "less than or equal to 2000000000"),
        ({"poses": {"single_camera": True}}, "YAML reads yes, no, on and off"),
        ({"masks": {"points_per_batch": True}}, "YAML reads yes, no, on and off"),
    ],
)
def test_a_configuration_that_cannot_be_used_is_refused_with_its_place(
    config: dict[str, Any], message: str
) -> None:
    with pytest.raises(SettingsError, match=message):
        parse_run(config)


@pytest.mark.parametrize("name", ["$(touch PWNED)", "a b", "../up", "-rf", "a;b", ""])
@pytest.mark.parametrize("where", ["variants", "groups"])
def test_names_that_a_shell_or_a_folder_could_misread_are_refused(where: str, name: str) -> None:
    with pytest.raises(SettingsError, match="cannot be the name of a variant or group"):
        parse_run({where: {name: {}} if where == "variants" else [name]})


@pytest.mark.parametrize(
    "name", ["world", "logs", "queries", "export", "scene", "source", "gaussians", "scene.seed1"]
)
def test_a_variant_cannot_have_the_name_of_a_file_in_the_scene_folder(name: str) -> None:
    with pytest.raises(SettingsError, match="is reserved for files"):
        parse_run({"variants": {name: {}}})


@pytest.mark.parametrize("names", [("a", "A"), ("a", "a.seed1"), ("Logs",), ("Default",)])
def test_variants_that_would_share_a_folder_are_refused(names: tuple[str, ...]) -> None:
    with pytest.raises(SettingsError, match="is reserved"):
        parse_run({"variants": {name: {} for name in names}, "seeds": 2})


def test_settings_as_json_are_checked_like_those_of_a_file() -> None:
    assert parse_section("coverage_tree", '{"theta": 0.6}') == SECTIONS["coverage_tree"](theta=0.6)
    for text in ('{"theta": 0.5, "theta": 0.9}', "{", "[" * 100_000):
        with pytest.raises(SettingsError, match="coverage_tree: the settings are not valid JSON"):
            parse_section("coverage_tree", text)


def test_a_duplicate_key_is_refused_but_a_merged_one_may_be_overridden(tmp_path: Path) -> None:
    (tmp_path / "my.yaml").write_text("seed: 1\nfield:\n  latent: 4\n  latent: 8\n")
    with pytest.raises(SettingsError, match=r"line 4, column 3(.|\n)*'latent' is duplicated"):
        read_config(tmp_path / "my.yaml")
    (tmp_path / "my.yaml").write_text("one: &one {a: 1, b: 2}\ntwo:\n  <<: *one\n  a: 3\n")
    assert read_config(tmp_path / "my.yaml")["two"] == {"a": 3, "b": 2}


def test_overrides_apply_in_order_group_then_scene_then_variant() -> None:
    run = parse_run(
        {
            "overrides": {"g": {"coverage_tree": {"theta": 0.6}}, "d/s": {"coverage_tree": {"theta": 0.7}}},
            "variants": {"v": {"coverage_tree": {"theta": 0.8}}},
        }
    )
    assert run.stages().coverage_tree.theta == 0.9
    assert run.stages(scopes=("g", "d/t")).coverage_tree.theta == 0.6
    assert run.stages(scopes=("g", "d/s")).coverage_tree.theta == 0.7
    assert run.stages("v", scopes=("g", "d/s")).coverage_tree.theta == 0.8


@pytest.mark.parametrize("name", SECTIONS)
def test_a_section_describes_its_settings_and_round_trips_through_json(name: str) -> None:
    for knob, field in SECTIONS[name].model_fields.items():
        assert field.description and field.json_schema_extra["origin"], knob
    section = SECTIONS[name]()
    assert parse_section(name, section.model_dump_json()) == section


def test_the_manual_lists_the_choices_or_the_range_of_a_setting() -> None:
    manual = knob_table()
    assert "poses.mapper = 'incremental'  (incremental|global; origin: COLMAP)" in manual
    assert "poses.test_every = 8  (>= 0; views; origin: 3DGS)" in manual
    assert "method.codebook = (64, 10)" in manual and "    opengaussian: number of groups" in manual


def test_the_schema_for_editors_accepts_the_shipped_configuration_and_refuses_a_misspelt_key(
    project: Path,
) -> None:
    validator = Draft202012Validator(json.loads(json.dumps(config_schema())))
    config = read_config(project / "config/config.yaml")
    validator.validate(config)
    config["coverage_tree"]["thetaa"] = 0.9
    (error,) = validator.iter_errors(config)
    assert "thetaa" in error.message


def test_the_paper_configuration_holds_the_papers_numbers(project: Path) -> None:
    stages = parse_run(merged_config([project / "config/paper.yaml"])).stages("paper")
    assert stages.gaussians.iterations == 30_000
    assert stages.masks.points_per_side == 32
    assert (stages.coverage_tree.theta, stages.method.omega) == (0.9, 10)
    assert (stages.method.weight_instance, stages.method.weight_part) == (1e-6, 1e-5)
    assert stages.autoencoder.latent == 3


def test_a_single_name_is_read_as_a_list() -> None:
    run = parse_run({"only": "desk", "groups": "photos"})
    assert (run.only, run.groups) == (("desk",), ("photos",))


def test_only_our_solver_and_plain_averages_are_independent_of_the_seed() -> None:
    variants = {name: {"method": {"name": name}} for name in (OURS, *BASELINES)}
    run = parse_run({"variants": variants})
    assert {name for name in variants if not run.stages(name).method.is_random} == {OURS, "lifted", "occam"}


def test_stages_accept_the_seeds_of_all_repetitions() -> None:
    run = parse_run({"seed": LARGEST, "seeds": 10})
    option = get_args(Seed)[1]
    assert LARGEST < run.seed_of(run.all_seeds("default")[-1]) <= option.max < 2**31 - 1


def test_a_method_has_its_own_settings() -> None:
    trained = {"method": {"name": "langsplat", "steps": 5}}
    run = parse_run({"overrides": {"g": trained}, "variants": {"v": {"method": {"name": "vch"}}}})
    assert run.stages(scopes=("g",)).method == TrainedSettings(name="langsplat", steps=5)
    vch = run.stages("v", scopes=("g",)).method
    assert (vch.name, vch.steps, vch.rate) == ("vch", 1800, 0.0025)  # not those of a different method
