"""Settings: one default per knob, errors that name the key, shared variants."""

import json
from pathlib import Path

import pytest
import yaml
from jsonschema import Draft202012Validator
from snakemake.utils import update_config

from hilsplat.base.errors import SettingsError
from hilsplat.configuration import SECTIONS, config_schema, knob_table, parse_run, parse_section


def load(project: Path, name: str) -> dict:
    """A configuration file laid over config.yaml, as `snakemake --configfile` does."""
    config = yaml.safe_load((project / "config" / "config.yaml").read_text())
    update_config(config, yaml.safe_load((project / "config" / name).read_text()))
    return config


@pytest.mark.parametrize("name", ["config.yaml", "paper.yaml", "ci.yaml", "comparison.yaml"])
def test_shipped_configurations_are_valid(project: Path, name: str) -> None:
    parse_run(load(project, name))


def test_a_misspelt_key_is_named_with_the_likely_one() -> None:
    with pytest.raises(SettingsError, match=r"coverage_tree\.thetaa: unknown key; did you mean 'theta'\?"):
        parse_run({"coverage_tree": {"thetaa": 0.5}})


def test_a_misspelt_section_is_named() -> None:
    with pytest.raises(SettingsError, match=r"feild: unknown key; did you mean 'field'\?"):
        parse_run({"feild": {"omega": 2}})


def test_a_value_out_of_range_is_named_with_place_and_value() -> None:
    with pytest.raises(SettingsError, match=r"coverage_tree\.theta: Input should be less than 1; found 2"):
        parse_run({"coverage_tree": {"theta": 2}})


def test_a_variant_may_not_change_what_all_variants_share() -> None:
    with pytest.raises(SettingsError, match=r"variants\.x\.poses: a variant cannot change this section"):
        parse_run({"variants": {"x": {"poses": {"mapper": "global"}}}})


def test_errors_inside_variants_name_the_variant() -> None:
    with pytest.raises(
        SettingsError, match=r"variants\.x\.coverage_tree\.theta: Input should be less than 1"
    ):
        parse_run({"variants": {"x": {"coverage_tree": {"theta": 3}}}})


@pytest.mark.parametrize("name", ["$(touch PWNED)", "a b", "../up", "-rf", "a;b", ""])
@pytest.mark.parametrize("where", ["variants", "groups"])
def test_names_that_a_shell_or_a_folder_could_misread_are_refused(where: str, name: str) -> None:
    with pytest.raises(SettingsError, match="cannot be the name of a variant or group"):
        parse_run({where: {name: {}} if where == "variants" else [name]})


def test_an_unknown_variant_is_named() -> None:
    with pytest.raises(SettingsError, match="variant 'nope' is not defined"):
        parse_run({"main_variants": ["nope"]})


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


def test_only_what_holds_something_random_is_repeated_per_seed() -> None:
    network = {"autoencoder": {"code": "network"}}
    run = parse_run(
        {
            "seeds": 3,
            "variants": {
                "network": network,
                "langsplat": {"method": {"name": "langsplat"}},
                "lifted": {"method": {"name": "lifted"}},
            },
            "overrides": {"photos": network},
        }
    )
    assert run.seeded("default") == ["default"]
    assert run.seeded("lifted") == ["lifted"]
    assert run.seeded("network") == ["network", "network.seed1", "network.seed2"]
    assert run.seeded("langsplat") == ["langsplat", "langsplat.seed1", "langsplat.seed2"]
    assert len(run.seeded("default", scopes=("photos",))) == 3
    assert [run.seed_of(name) for name in run.seeded("network")] == [0, 1, 2]
    assert not run.stages("langsplat").depends_on_seed("autoencoder")
    assert run.stages("langsplat").depends_on_seed("field")
    assert not run.stages("network").depends_on_seed("semantic_tree")


def test_every_knob_has_description_and_origin() -> None:
    for section, model in SECTIONS.items():
        for name, field in model.model_fields.items():
            assert field.description, f"{section}.{name}"
            assert field.json_schema_extra["origin"], f"{section}.{name}"


def test_the_manual_names_the_choices_or_the_range_of_a_knob() -> None:
    manual = knob_table()
    assert "poses.mapper = 'incremental'  (incremental|global; origin: COLMAP)" in manual
    assert "poses.test_every = 8  (>= 0; views; origin: 3DGS)" in manual


def test_the_schema_for_editors_takes_the_shipped_configuration_and_refuses_a_misspelt_key(
    project: Path,
) -> None:
    validator = Draft202012Validator(json.loads(json.dumps(config_schema())))
    config = yaml.safe_load((project / "config" / "config.yaml").read_text())
    validator.validate(config)
    config["coverage_tree"]["thetaa"] = 0.9
    (error,) = validator.iter_errors(config)
    assert "thetaa" in error.message


def test_sections_round_trip_through_json() -> None:
    for name, model in SECTIONS.items():
        section = model()
        assert parse_section(name, section.model_dump_json()) == section


def test_the_paper_configuration_holds_the_papers_numbers(project: Path) -> None:
    run = parse_run(load(project, "paper.yaml"))
    stages = run.stages("paper")
    assert stages.gaussians.iterations == 30_000
    assert stages.masks.points_per_side == 32
    assert (stages.coverage_tree.theta, stages.field.omega) == (0.9, 10)
    assert (stages.field.weight_instance, stages.field.weight_part) == (1e-6, 1e-5)
    assert stages.autoencoder.latent == 3


def test_a_single_name_stands_for_a_list_of_one():
    run = parse_run({"only": "desk", "groups": "photos"})
    assert (run.only, run.groups) == (("desk",), ("photos",))
