"""Inputs, parameters and targets that the rules take from the plan of a run."""

import functools
import json
import re
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest

from hilsplat.base.errors import HilsplatError, SceneError, SettingsError
from hilsplat.configuration import merged_config, parse_run
from hilsplat.scene.sheet import read_sheet
from hilsplat.settings import MasksSettings, PosesSettings
from hilsplat.stage import PathOut, Registry
from hilsplat.stages import all_stages, stage_of
from hilsplat.workflow import targets
from hilsplat.workflow.models import models_of_photographs, settings_of_photographs
from hilsplat.workflow.plan import UNCOMPARED, Plan, any_of, without_scene
from tests.conftest import PROJECT
from tests.unit.artifact_changes import write_record
from tests.unit.models.test_store import write_model
from tests.unit.workflow.plans import BENCHMARK, Job, plan_of, write_sheet

ROWS = (
    *BENCHMARK,
    "rooms room benchmark world:room:1 metre",
    "lerf figurines lerf data:lerf_ovs/figurines arbitrary",
    "photos desk photos desk arbitrary",
)
NETWORK = {"code": "network", "latent": 3}
VARIANTS = {
    "theta": {"coverage_tree": {"theta": 0.6}},
    "omega": {"field": {"omega": 5.0}},
    "network": {"autoencoder": NETWORK},
    "lifted": {"method": {"name": "lifted"}},
    "truth": {"masks": {"segmenter": "truth-perturbed"}},
    "own": {"autoencoder": {"targets": "mask"}},
}


def variants_in(paths: list[str]) -> list[str]:
    return [path.split("/")[3] for path in paths]


def plan(folder: Path, **config: object) -> Plan:
    (folder / "desk").mkdir(exist_ok=True)
    (folder / "desk/1.jpg").touch()
    return plan_of(folder, ROWS, **{"variants": VARIANTS, "main_variants": ["default", *VARIANTS], **config})


def test_scenes_of_the_groups_are_run_and_missing_data_is_named(tmp_path):
    found = plan(tmp_path, groups=["benchmark", "lerf"])
    assert [row.name for row in found.scenes] == ["synthetic/one", "synthetic/two", "rooms/room"]
    assert found.absent == {"lerf/figurines": "data_root is not set"}
    assert targets.absent(found, "lerf") == ["lerf (figurines): data_root is not set."]
    assert targets.absent(found, "replica") == []


def test_a_wrong_data_root_is_reported_in_one_line_per_data_set(tmp_path):
    rows = [
        f"{data} {name} {data} data:{data}/{name} metre" for data in ("lerf", "3d_ovs") for name in "abcde"
    ]
    with pytest.raises(SettingsError) as caught:
        plan_of(tmp_path, tuple(rows), groups=["lerf", "3d_ovs"], data_root="/none")
    assert [line.strip() for line in str(caught.value).splitlines() if "is skipped" in line] == [
        f"{data} (a, b, c and 2 more) is skipped: data_root /none is not a folder"
        for data in ("lerf", "3d_ovs")
    ]


def test_segments_of_waymo_are_run_without_a_row(tmp_path):
    groups = ["benchmark", "waymo"]
    none = plan(tmp_path, groups=groups, data_root=str(tmp_path))
    assert f"waymo: no labelled segment was found in {tmp_path}." in targets.absent(none, "waymo")
    file = tmp_path / "waymo/validation/lidar_segmentation/one.parquet"
    file.parent.mkdir(parents=True)
    file.touch()
    found = plan(tmp_path, groups=groups, data_root=str(tmp_path))
    row = found.rows[-1]
    assert (row.name, row.group, row.unit, row.source) == ("waymo/one", "waymo", "metre", "data:waymo/one")
    assert "incomplete" in found.absent["waymo/one"]  # the test has no other component


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"groups": ["ci"]}, r"no scenes to run(.|\n)*such as (.|\n)*rooms/room"),
        ({"variants": {"lifted": {"method": {"name": "magic"}}}}, "method 'magic' is unknown"),
        ({"variants": {"in-no-table": {"method": {"name": "magic"}}}}, "method 'magic' is unknown"),
        (
            {"variants": {"x": {"poses": {"mapper": "global"}}}},
            r"variants\.x\.poses: variants share this section",
        ),
    ],
)
def test_a_configuration_without_scenes_or_with_an_impossible_variant_is_refused(tmp_path, config, message):
    variants = {**VARIANTS, **config.get("variants", {})}
    with pytest.raises(HilsplatError, match=message):
        plan(tmp_path, main_variants=list(VARIANTS), **{**config, "variants": variants})


def test_installed_configurations_find_their_scenes_beside_a_sheet_of_photographs(tmp_path):
    photographs = ("photos desk photos world:room:9 metre",)
    found = plan_of(tmp_path, photographs, only=["table-1", "desk"])
    assert [row.name for row in found.scenes] == ["photos/desk", "synthetic/table-1"]
    with pytest.raises(SceneError, match=r"no scene is named 'table-77'(.|\n)*photos/desk"):
        plan_of(tmp_path, photographs, only=["table-77"])


def test_a_variant_may_change_what_only_a_stage_of_a_plugin_reads(tmp_path, monkeypatch):
    def report(settings: PosesSettings, out: PathOut) -> None: ...

    monkeypatch.setitem(all_stages(), "report", Registry().stage()(report))
    found = plan(tmp_path, variants={"x": {"poses": {"mapper": "global"}}}, main_variants=["x"])
    assert found.run.stages("x").poses.mapper == "global"


def test_only_random_variants_are_repeated_per_seed(tmp_path):
    variants = {**VARIANTS, "langsplat": {"method": {"name": "langsplat"}}}
    found = plan(tmp_path, variants=variants, seeds=3, overrides={"synthetic/two": {"autoencoder": NETWORK}})
    one, two = found.rows[:2]
    seeded = functools.partial(found.seeded, table="main_variants")
    assert seeded("default", one) == ["default"]
    assert seeded("langsplat", one) == ["langsplat", "langsplat.seed1", "langsplat.seed2"]
    assert len(seeded("default", two)) == 3
    assert [found.run.seed_of(name) for name in seeded("network", one)] == [0, 1, 2]


def test_the_ablation_has_its_own_number_of_seeds(tmp_path):
    own = {"ablation_variants": ["network"], "ablation_seeds": 3}
    found = plan(tmp_path, main_variants=["network"], **own)
    of_scene = [path for path in targets.scores(found, "ablation") if "/one/" in path]
    assert variants_in(of_scene) == ["network", "network.seed1", "network.seed2"]
    assert set(variants_in(targets.scores(found, "hierarchy"))) == {"network"}
    assert found.run.all_seeds("omega") == ["omega"]


@pytest.mark.parametrize("run_wide", [{}, {"masks": {"theta": 0.85}}])  # levels by head have no theta
def test_levels_by_the_tree_share_the_code_of_levels_by_head_with_the_same_seed(tmp_path, run_wide):
    own = {**NETWORK, "targets": "mask"}
    by_tree = {"masks": {"levels": "tree"}, "contributions": {"keep": "none"}}
    variants = {
        "head": {"autoencoder": own, "method": {"name": "langsplat"}},
        "tree": {"autoencoder": own, **by_tree},
        "theta": {"autoencoder": own, **by_tree, "coverage_tree": {"theta": 0.7}},
        "linked": {"autoencoder": own, **by_tree, "semantic_tree": {"min_views": 2}},
        "crops": {"autoencoder": own, **by_tree, "clip": {"crops": "nodes"}},
        "alone": {"autoencoder": {**own, "latent": 4}, **by_tree},
        "nodes": {"autoencoder": NETWORK, **by_tree},
    }
    found = plan(tmp_path, variants=variants, main_variants=["default"], seeds=2, **run_wide)
    codes = {name: found.first_code(Job(variant=name)) for name in (*variants, "tree.seed1")}
    assert {name: variants_in(paths) for name, paths in codes.items()} == {
        **{name: [] for name in ("head", "alone", "nodes", "crops")},
        **{name: ["head"] for name in ("tree", "theta", "linked")},
        "tree.seed1": ["head.seed1"],
    }


def test_two_rows_of_one_published_scene_are_refused_because_their_scores_would_be_merged(tmp_path):
    for part in ("figurines/images", "figurines/sparse", "label/figurines"):
        (tmp_path / "data/lerf_ovs" / part).mkdir(parents=True)
    rows = [f"{row} lerf data:lerf_ovs/figurines arbitrary" for row in ("lerf figurines", "mine figurines")]
    of_data = {"groups": ["lerf"], "data_root": str(tmp_path / "data")}
    plan_of(tmp_path, rows=(*rows,), only=["mine/figurines"], **of_data)
    with pytest.raises(SettingsError, match=r"lerf/figurines and mine/figurines are the same scene"):
        plan_of(tmp_path, rows=(*rows,), **of_data)


def test_imported_masks_get_the_levels_of_the_variant_and_need_no_model(tmp_path):
    variants = {"main_variants": ["default"], "variants": {"tree": {"masks": {"levels": "tree"}}}}
    sheet = write_sheet(
        tmp_path / "config/scenes.tsv", (*BENCHMARK, f"photos desk photos x arbitrary {tmp_path}")
    )
    sheet.write_text(sheet.read_text().replace("\tunit\n", "\tunit\tfeatures\n"))
    found = Plan({"scenes": str(sheet), **variants, "coverage_tree": {"theta": 0.7}})
    jobs = [Job("photos", "desk", variant) for variant in ("default", "tree")]
    levels = [MasksSettings.model_validate_json(found.settings("masks", job)) for job in jobs]
    assert [(each.levels, each.uses_model) for each in levels] == [("head", False), ("tree", False)]
    assert levels[1].theta == 0.7
    values = found.params("imported_masks")["settings"](jobs[1])
    assert found.settings("masks", jobs[1], UNCOMPARED) in values  # as `workflow.records` expects
    first, other = (found.identity("clip", variant, (), True) for variant in ("default", "tree"))
    assert first != other and first.stages == other.stages == ("imported_clip", "imported_masks")


def test_photographs_that_you_annotated_are_scored_without_replacing_the_tables(tmp_path):
    alone = targets.default(plan(tmp_path, groups=["photos"], data_root=str(tmp_path)))
    file = tmp_path / "annotated/photos/desk/1.json"
    file.parent.mkdir(parents=True)
    file.write_text("{}")
    found = plan(tmp_path, groups=["photos"], data_root=str(tmp_path))
    job = Job("photos", "desk")
    assert targets.default(found) == [*alone, "results/photos/desk/scores.md"]
    assert targets.compared_means(found, job) == ["results/photos/desk/default/scores.csv"]
    assert found.data.label_files(job) == [str(file)] and str(file) not in found.data.image_files(job)
    assert found.data.labels(found.row(job)) == ("annotated/photos/desk",)
    assert found.data.label_readers(job) == ("hilsplat.datasets.images.hi:ANNOTATED",)
    both = plan(tmp_path, groups=["photos", "benchmark"], data_root=str(tmp_path))
    assert "results/tables/lerf.csv" in targets.default(both)
    assert not any("desk" in path for path in targets.scores(both, "lerf"))


def test_the_folder_of_data_sets_counts_for_scenes_that_read_it(tmp_path):
    (tmp_path / "annotated/photos/desk").mkdir(parents=True)
    (tmp_path / "annotated/photos/desk/1.json").write_text("{}")
    roots = {str(tmp_path): True, str(tmp_path / "other"): False}
    plans = [plan(tmp_path, groups=["photos", "benchmark"], data_root=root) for root in roots]
    for name in ("evaluate", "figures"):
        for job, is_read in ((Job(), False), (Job("photos", "desk"), True)):
            here, moved = (each.params(name)["settings"](job) for each in plans)
            assert (here == moved) is not is_read and ("--data-root" in here) is is_read


@pytest.mark.parametrize("stage", ["gaussians", "masks", "clip", "contributions"])
def test_another_device_changes_the_command_but_reruns_nothing(tmp_path, stage):
    files, outputs = SimpleNamespace(), SimpleNamespace(out="results/synthetic/one/default/x", report="r")
    by_device = [plan(tmp_path, **{stage: {"device": device}}).params(stage) for device in ("auto", "cpu")]
    commands = [params["command"](Job(), files, outputs) for params in by_device]
    assert ['"device":"auto"' in command for command in commands] == [True, False]
    assert '"device":"cpu"' in commands[1]
    for name in ("settings", "code"):
        auto, cpu = (params[name](Job()) for params in by_device)
        assert auto == cpu


@pytest.mark.parametrize(
    ("stage", "variant", "owner"),
    [
        ("masks", "theta", "default"),
        ("coverage_tree", "theta", "theta"),
        ("contributions", "theta", "default"),
        ("autoencoder", "theta", "default"),
        ("field", "theta", "theta"),
        ("autoencoder", "omega", "default"),
        ("field", "omega", "omega"),
        ("autoencoder", "network", "network"),
        ("autoencoder", "network.seed1", "network.seed1"),
        ("semantic_tree", "network.seed1", "default"),
        ("field", "lifted", "lifted"),
        ("autoencoder", "lifted", "default"),
        ("masks", "truth", "truth"),
        ("semantic_tree", "own", "default"),
        ("clip", "own", "own"),
    ],
)
def test_a_variant_shares_stages_up_to_the_first_that_it_changes(tmp_path, stage, variant, owner):
    found = plan(tmp_path, seeds=2)
    assert found.shared_variant(stage, Job(variant=variant)) == owner


def test_shared_files_keep_their_path_when_the_tables_change(tmp_path, monkeypatch):
    variants = {**VARIANTS, "langsplat": {"autoencoder": NETWORK, "method": {"name": "langsplat"}}}
    found = plan(tmp_path, main_variants=["langsplat"], variants=variants)
    job = Job(variant="langsplat")
    code = "results/synthetic/one/network/autoencoder"
    assert found.shared_path("autoencoder", job) == code
    monkeypatch.chdir(tmp_path)
    Path(code).mkdir(parents=True)
    assert found.artifacts(found.row(job)) == [Path(code)]
    assert "results/synthetic/one/network/scores.csv" not in targets.default(found)


def test_levels_by_the_tree_take_the_theta_of_the_tree(tmp_path):
    by_tree = {"masks": {"levels": "tree"}, "coverage_tree": {"theta": 0.7}}
    found = plan(tmp_path, variants={**VARIANTS, "levels": by_tree}, main_variants=["default"])
    for name, theta in (("default", None), ("theta", None), ("levels", 0.7)):
        assert json.loads(found.settings("masks", Job(variant=name)))["theta"] == theta
    assert found.shared_variant("masks", Job(variant="levels")) == "levels"
    assert found.masks_priority(Job(variant="levels")) < found.masks_priority(Job())  # cached by then


def test_inputs_of_a_field_that_continues_langsplats(tmp_path):
    shared, own = {"autoencoder": NETWORK}, {"autoencoder": {**NETWORK, "targets": "mask"}}
    by_tree = {"masks": {"levels": "tree"}}
    variants = {
        "paper": {**shared, "method": {"name": "hi_lsplat"}},
        "langsplat": {**shared, "method": {"name": "langsplat"}},
        "on": {**shared, "field": {"start": "langsplat"}},
        "alone": {"field": {"start": "langsplat"}},
        "tree": {**by_tree, **own, "contributions": {"keep": "none"}, "method": {"name": "langsplat"}},
        "on-tree": {**by_tree, **own, "field": {"start": "langsplat"}},
    }
    found = plan(tmp_path, variants=variants, main_variants=["default"], seeds=2)
    # LangSplat needs no pairs of Gaussians, which don't change the code of the masks' own vectors.
    assert variants_in(found.first_field(Job(variant="on-tree.seed1"))) == ["tree.seed1"]
    on = Job(variant="on.seed1")
    assert found.first_field(on) == ["results/synthetic/one/langsplat.seed1/field.safetensors"]
    assert found.first_field(Job()) == []
    field = stage_of("field")
    assert (found.seed(field, on), found.seed(field, Job())) == (1, 0)
    with pytest.raises(SettingsError, match=r"no variant has method\.name langsplat with the same"):
        found.first_field(Job(variant="alone"))


def test_an_override_of_one_scene_changes_what_it_shares(tmp_path):
    found = plan(tmp_path, overrides={"synthetic/two": {"coverage_tree": {"theta": 0.6}}})
    shared = functools.partial(found.shared_path, "field")
    assert shared(Job(variant="theta")).split("/")[3] == "theta"
    assert shared(Job("synthetic", "two", "theta")).split("/")[3] == "default"
    assert json.loads(found.settings("coverage_tree", Job("synthetic", "two")))["theta"] == 0.6


def test_a_comparison_reads_each_shared_artifact_once(tmp_path):
    found, job = plan(tmp_path, main_variants=["default", "theta", "network"]), Job()
    compared = found.compared("masks", "field")
    assert compared["masks"](job) == ["results/synthetic/one/default/masks"]
    assert variants_in(compared["field"](job)) == ["default", "theta", "network"]
    assert variants_in(found.compared_scores(job)) == ["default", "theta", "network"]


def test_variants_differ_in_the_method_of_the_field_and_in_the_crops(tmp_path):
    found = plan(tmp_path)
    assert found.crops_tree(Job()) == ["results/synthetic/one/default/semantic_tree"]
    assert found.crops_tree(Job(variant="own")) == [], "every mask is embedded"
    for name, is_ours in (("lifted", False), ("omega", True)):
        path = f"synthetic/one/{name}/field.safetensors"
        assert bool(re.match(found.jobs_of("field"), path)) == is_ours
        assert bool(re.match(found.jobs_of("method"), path)) == (not is_ours)
    assert found.baseline(Job(variant="lifted")) == ("hilsplat.methods.lifted:fit",)


def test_true_labels_make_masks_only_for_the_diagnostic_segmenter(tmp_path):
    found = plan(tmp_path)
    truth = Job(variant="truth")
    assert found.kind("masks", Job()).name == "masks" and found.kind("masks", truth).name == "truth_masks"
    assert found.data.required_truth(truth) == ["results/synthetic/one/world/truth"]
    inputs = SimpleNamespace(scene="inner/scene", truth="inner/results/synthetic/one/world/truth")
    outputs = SimpleNamespace(out="inner/results/synthetic/one/truth/masks")
    command = found.params("truth_masks")["command"](truth, inputs, outputs)
    assert command.startswith("world perturb --settings '{") and " --perturb '{" in command
    assert command.endswith(" --scene inner/scene --truth inner/results/synthetic/one/world/truth")
    with pytest.raises(SettingsError, match="photos/desk: masks"):
        found.data.required_truth(Job("photos", "desk", "truth"))


def test_key_views_are_embedded_before_a_full_size_sam_segments_the_others(tmp_path, monkeypatch):
    for number in range(16):
        (tmp_path / "desk").mkdir(exist_ok=True)
        (tmp_path / f"desk/{number}.jpg").touch()
    variants = {"key-views": {"masks": {"key_views": 0.5}}, "paper": {"autoencoder": {"targets": "mask"}}}
    config = {"groups": ["photos", "benchmark"], "variants": variants, "main_variants": ["default"]}
    found = plan(tmp_path, **config)
    desk, key, one = Job("photos", "desk"), Job("photos", "desk", "key-views"), Job()
    assert not found.first_answer(desk)  # sam-tiny takes seconds

    monkeypatch.setattr(
        "hilsplat.workflow.plan.planned_model", lambda folder: SimpleNamespace(embedded=False)
    )
    assert found.first_answer(desk)
    assert not found.first_answer(key) and not found.first_answer(one)
    assert found.masks_priority(desk) < found.masks_priority(key)
    assert "results/photos/desk/key-views/clip" in targets.default(found)
    assert found.kind("masks", key).name == "key_masks" and found.kind("masks", desk).name == "masks"
    guided = plan(tmp_path, **config, masks={"prompts": "guided"})
    assert guided.kind("masks", desk).name == "guided_masks"
    assert guided.kind("masks", one).name == "masks"
    assert guided.shared_variant("masks", Job("photos", "desk", "paper")) == "default"
    for name, path in (("guided_masks", "photos/desk/default/"), ("key_masks", "photos/desk/key-views/")):
        assert re.match(guided.jobs_of(name), path) and not re.match(guided.jobs_of("masks"), path)
        assert not re.match(guided.jobs_of(name), "synthetic/one/default/")
    assert guided.of_key_views("masks")(desk) == "results/photos/desk/key-views/masks"
    assert not plan(tmp_path, **(config | {"variants": {}})).first_answer(desk)


def test_the_missing_folder_of_another_scene_stops_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "hilsplat.workflow.plan.planned_model", lambda folder: SimpleNamespace(embedded=False)
    )
    rows = (*ROWS, f"photos gone photos {tmp_path / 'gone'} arbitrary")
    (tmp_path / "desk").mkdir()
    (tmp_path / "desk/1.jpg").touch()
    found = plan_of(
        tmp_path, rows, variants={"key-views": {"masks": {"key_views": 0.5}}}, only=["photos/desk"]
    )
    assert [row.name for row in found.scenes] == ["photos/desk"] and found.jobs_of("key_masks")
    with pytest.raises(SceneError, match=r"gone is missing"):
        plan_of(tmp_path, rows, only=["photos/gone"])


@pytest.mark.parametrize("beside", ["input", "images_train", "object_mask", "images_4"])
def test_other_copies_of_photographs_are_not_counted(tmp_path, beside):
    for folder in ("sparse/0", "images", beside):
        (tmp_path / "desk" / folder).mkdir(parents=True)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        (tmp_path / "desk/sparse/0" / name).touch()
    for number in range(4):
        for folder in ("images", beside):
            (tmp_path / f"desk/{folder}/{number}.png").touch()
    found = plan(tmp_path, groups=["photos"])
    assert found.data.num_images(Job("photos", "desk")) == 4


def test_each_photograph_is_an_input_and_hidden_files_are_not(tmp_path):
    (tmp_path / "desk").mkdir()
    (tmp_path / "desk/.hidden").touch()
    (tmp_path / "desk/0.jpg").touch()
    found = plan(tmp_path, groups=["photos"])
    files = found.data.image_files(Job("photos", "desk"))
    assert [Path(file).name for file in files] == ["0.jpg", "1.jpg"]
    outputs = SimpleNamespace(out="results/photos/desk/scene")
    command = found.params("poses")["command"](Job("photos", "desk"), files, outputs)
    assert "--render" not in command and "--poses" not in command
    assert found.data.image_files(Job()) == "results/synthetic/one/world/images"
    assert "--render" in found.params("poses")["settings"](Job())


def test_labels_of_a_published_scene_determine_reader_and_options(tmp_path):
    for part in ("lerf_ovs/figurines/images", "lerf_ovs/figurines/sparse/0", "lerf_ovs/label/figurines"):
        (tmp_path / part).mkdir(parents=True)
    (tmp_path / "lerf_ovs/label/figurines/frame_1.json").touch()
    found = plan(tmp_path, groups=["lerf"], data_root=str(tmp_path))
    job = Job("lerf", "figurines")
    assert found.data.label_readers(job) == ("hilsplat.datasets.images.lerf_ovs:DATASET",)
    assert [Path(file).name for file in found.data.label_files(job)] == ["frame_1.json"]
    assert found.data.labels(found.row(job)) == ("lerf_ovs/figurines",) and found.data.truth(job) == []
    room = Job("rooms", "room")
    assert found.data.truth(room) == ["results/rooms/room/world/truth"]
    assert found.data.generated_source(room) == "world:room:1"
    assert found.data.labels(found.row(room)) == found.data.label_readers(room) == ()


def test_tables_have_their_own_scenes_and_variants(tmp_path):
    found = plan(tmp_path, main_variants=["default"], theta_variants=["theta"], sweep_scenes=["two"], seeds=2)
    assert targets.scores(found, "replica") == ["results/rooms/room/default/scores.csv"]
    assert targets.scores(found, "theta") == ["results/synthetic/two/theta/scores.csv"]
    assert targets.scores(found, "waymo") == []
    with_network = plan(tmp_path, main_variants=["default", "network"], seeds=2)
    assert variants_in(targets.scores(with_network, "replica")) == ["default", "network", "network.seed1"]


OF_BENCHMARKS = (
    *(f"lerf {name} lerf data:lerf_ovs/{name} arbitrary" for name in ("figurines", "ramen")),
    *(f"3d_ovs {name} 3d_ovs data:3d_ovs/{name} arbitrary" for name in ("bed", "snacks")),
    "synthetic one benchmark world:tabletop:1 metre",
    "rooms room benchmark world:room:1 metre",
)


def plan_of_benchmarks(folder: Path, *label_files: str, **config: object) -> Plan:
    """The plan of scenes of LERF and 3D-OVS with their own labels, and with the given label files."""
    places = [
        f"lerf_ovs/{part}"
        for name in ("figurines", "ramen")
        for part in (f"{name}/sparse/0", f"label/{name}")
    ]
    places += [f"lerf_ovs/{name}/images" for name in ("figurines", "ramen")]
    places += [f"3d_ovs/{name}/{part}" for name in ("bed", "snacks") for part in ("images", "segmentations")]
    for place in places:
        (folder / place).mkdir(parents=True, exist_ok=True)
    files = [f"3d_ovs/{name}/segmentations/classes.txt" for name in ("bed", "snacks")]
    for file in (*files, *label_files):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).touch()
    defaults = {"groups": ["lerf", "3d_ovs"], "data_root": str(folder), "main_variants": ["default"]}
    sweeps = {"theta_variants": ["theta"], "pruning_variants": ["omega"]}
    return plan_of(folder, OF_BENCHMARKS, **{"variants": VARIANTS, **defaults, **sweeps, **config})


def test_tables_of_levels_have_the_scenes_whose_labels_have_levels(tmp_path):
    def scenes(found, table):
        return ["/".join(path.split("/")[1:3]) for path in targets.scores(found, table)]

    tables = ("theta", "pruning", "hierarchy")
    found = plan_of_benchmarks(tmp_path, groups=["lerf", "3d_ovs", "benchmark"])
    assert [scenes(found, name) for name in tables[:2]] == [["synthetic/one"]] * 2
    assert scenes(found, "lerf") == ["lerf/figurines", "lerf/ramen", "synthetic/one"]
    assert {line.partition(" has ")[0] for line in targets.absent(found, "theta")} == {
        f"hi_lerf (figurines, ramen): {tmp_path}/hi_lerf",
        f"hi_3dovs (bed, snacks): {tmp_path}/hi_3dovs",
    }
    assert targets.absent(found, "lerf") == []
    own = "annotated/lerf/ramen/1.json"
    assert [scenes(plan_of_benchmarks(tmp_path / "own", own), name) for name in tables] == [
        ["lerf/ramen"]
    ] * 3
    # rows of Hi-LERF have a column of 3D-OVS in sweeps, over scenes that are averaged, but not in pruning
    found = plan_of_benchmarks(tmp_path / "hi", "hi_lerf/label/figurines/1.json")
    of_lerf = ["lerf/figurines"]
    assert [scenes(found, name) for name in tables] == [[*of_lerf, "3d_ovs/bed"], of_lerf, of_lerf]
    assert targets.absent(found, "frames-hi-lerf") == [
        f"hi_lerf (ramen): {tmp_path}/hi/hi_lerf has no labels with levels."
    ]


def test_a_run_of_some_scenes_makes_their_tables_and_names_the_scenes_left_out(tmp_path, monkeypatch):
    def tables(found):
        return [Path(path).stem for path in targets.default(found) if "/tables/" in path]

    monkeypatch.chdir(tmp_path)
    found = plan_of_benchmarks(tmp_path)
    assert "results/figures/sweep-theta.png" in targets.default(found), "a first run makes all tables"
    for path in map(Path, targets.tables(found)):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_record(path, inputs={"scores": {"path": "results", "files": {"results/scores.csv": "0" * 64}}})
    assert tables(found) == ["lerf", "3dovs", "cost", "cost-seconds"]
    assert "results/figures/sweep-theta.png" not in targets.default(found)
    one = plan_of_benchmarks(tmp_path, only=["lerf/ramen"])
    assert tables(one) == ["lerf", "cost", "cost-seconds"]
    assert len(targets.tables(one)) > 10, "the rule `tables` makes all"
    assert {"lerf", "hierarchy", "theta"} <= {*tables(plan_of_benchmarks(tmp_path, groups=["benchmark"]))}
    # A data set of the run that is missing is listed in its table.
    rows = (*OF_BENCHMARKS, "waymo street waymo data:waymo/street metre")
    lacking = {"groups": ["lerf", "waymo"], "data_root": str(tmp_path)}
    assert {"lerf", "waymo"} <= {*tables(plan_of(tmp_path, rows, **lacking))}
    assert "waymo" not in tables(plan_of(tmp_path, rows, **lacking, only=["ramen"]))

    assert targets.left_out(one) == []
    for scene in ("lerf/figurines", "synthetic/one", "rooms/room", "lerf/ramen"):
        file = Path("results", scene, "default/scores.csv")
        file.parent.mkdir(parents=True)
        file.touch()
    assert targets.left_out(one) == ["lerf/figurines", "synthetic/one"]  # rooms have other tables


def test_a_run_of_photographs_leaves_tables_alone(tmp_path):
    assert targets.default(plan(tmp_path, groups=["photos"])) == [
        "results/figures/photos/desk/panel.webp",
        "results/figures/photos/desk/comparison.webp",
        "results/photos/desk/default/names",
    ]
    requested = targets.default(plan(tmp_path, groups=["photos"], sweep_scenes=["desk"]))
    assert not any("comparison" in path for path in requested)  # sweeps are over labelled benchmark scenes
    requested = targets.default(plan(tmp_path, sweep_scenes=["one"], theta_variants=["theta"]))
    assert "results/figures/synthetic/one/comparison.webp" in requested
    assert "results/figures/synthetic/two/comparison.webp" not in requested
    assert "results/figures/synthetic/two/masks.webp" in requested
    assert "results/tables/lerf.csv" in requested and "results/figures/sweep-theta.png" in requested


def test_queries_of_a_scene_come_before_those_of_its_data_set(tmp_path):
    found = plan(tmp_path, queries={"photos": ["cup"], "photos/desk": ["mug"]})
    assert json.loads(found.queries(Job("photos", "desk"))) == ["mug"]
    assert json.loads(found.queries(Job("photos", "other"))) == ["cup"]


def test_names_that_match_no_scene_are_reported(tmp_path):
    config = {
        "sweep_scenes": ["one", "table-1", "former"],
        "overrides": {"photos/gone": {}, "rooms/room": {}},
    }
    found = plan(tmp_path, **config, queries={"photos/gone": ["mug"], "lerf/teatime": ["bear"]}).ignored
    sheet = tmp_path / "config/scenes.tsv"
    assert found == [  # `table-1` and `teatime` are in the installed sheet
        f"the configuration (sweep_scenes) names the scene 'former', which is not in {sheet}; it is ignored",
        f"the configuration (overrides or queries) names the scene 'photos/gone', which is not in {sheet}; "
        "it is ignored",
    ]


LABEL_SETS = ("lerf_ovs", "hi_lerf", "scannet200", "annotated")  # no groups and no data sets


@pytest.mark.parametrize(
    ("where", "name", "message"),
    [
        *(
            (where, name, "(one of|did you mean)")
            for name in LABEL_SETS
            for where in ("groups", "overrides", "queries")
        ),
        ("groups", "bechmark", "did you mean 'benchmark'"),
        ("overrides", "photo", "did you mean 'photos'"),
        ("overrides", "synthetic/tow", "did you mean 'synthetic/two'"),
        ("queries", "foto", "did you mean 'photos'"),
        ("queries", "benchmark", "unknown name"),  # panels take the queries of data sets, not of groups
        ("sweep_scenes", "tabel-2", "did you mean 'table-2'"),
    ],
)
def test_a_name_that_would_have_no_effect_is_refused(where, name, message, tmp_path):
    config = {"groups": ["benchmark", name], "overrides": {name: {}}, "queries": {name: ["mug"]}}
    config["sweep_scenes"] = [name]
    with pytest.raises(SettingsError, match=rf"{where}.*{name}(.|\n)*{message}"):
        plan(tmp_path, **{where: config[where]})


def test_names_of_a_data_set_whose_scenes_are_those_on_the_disk_are_accepted(tmp_path):
    plan(tmp_path, queries={"waymo": ["car"]}, overrides={"waymo": {}})


@pytest.mark.parametrize("path", sorted((PROJECT / "config").glob("*.yaml")), ids=lambda path: path.name)
def test_every_name_in_a_shipped_configuration_matches_a_scene(path):
    run = parse_run(merged_config([path]))
    assert without_scene(run, read_sheet(PROJECT / "config/scenes.tsv", ())) == []


def test_a_segmenter_without_weights_and_a_missing_model_have_no_digest(tmp_path):
    found = plan(tmp_path, masks={"segmenter": "graph"}, clip={"model": str(tmp_path / "none")})
    assert found.model("masks")(Job()) == "none"
    assert found.model("clip")(Job()) == f"{tmp_path}/none is missing"


OF_PHOTOGRAPHS = {"photos": {"masks": {"segmenter": "auto", "model": "auto"}, "clip": {"model": "auto"}}}


def test_a_run_names_its_models_and_warns_if_answers_are_meaningless(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_model(Path("models/sam-tiny"), "sam", embedded=True)
    write_model(Path("models/clip-tiny"), "clip", embedded=True)
    config = {"groups": ["benchmark", "photos"], "overrides": OF_PHOTOGRAPHS}
    drawn, photo, doubt = plan(tmp_path, **config).model_lines()
    assert drawn == "synthetic/one, synthetic/two, rooms/room: masks by sam-tiny; text queries by clip-tiny"
    assert photo.startswith("photos/desk: masks by the graph segmenter")
    assert "text queries by clip-tiny" in photo
    assert "answers about photographs are meaningless" in doubt and "hilsplat models get" in doubt
    own = tmp_path / "config/config.yaml"
    own.write_text(json.dumps({"overrides": OF_PHOTOGRAPHS}))
    assert models_of_photographs(settings_of_photographs(own, "desk")) == [
        photo.removeprefix("photos/desk: "),
        doubt,
    ]
    write_model(Path("models/clip-vit-base-patch16"), "clip")
    write_model(Path("models/sam-vit-base"), "sam")
    line = "masks by sam-vit-base; text queries by clip-vit-base-patch16"
    assert plan(tmp_path, **config).model_lines()[1:] == [f"photos/desk: {line}"]
    for file in (own, tmp_path / "nowhere.yaml"):  # the installed one
        assert models_of_photographs(settings_of_photographs(file, "desk")) == [line]


def test_commands_quote_what_they_contain(tmp_path):
    found = plan(tmp_path, query={"vocabulary": "it's; rm -rf.txt"})
    inputs = SimpleNamespace(semantic_tree="a b", clip="$(c)")
    command = found.params("names")["command"](
        Job(), inputs, SimpleNamespace(out="results/synthetic/one/default/names")
    )
    words = shlex.split(command)
    assert words[0] == "names"
    assert words[words.index("--semantic-tree") :][:4] == ["--semantic-tree", "a b", "--clip", "$(c)"]
    assert json.loads(words[words.index("--settings") + 1])["vocabulary"] == "it's; rm -rf.txt"
    assert words[words.index("--cache") + 1] == "results/.cache"


@pytest.mark.parametrize(
    "names",
    [
        [],
        ["a"],
        ["table-1", "table-10", "table-2", "tab"],
        ["a.b", "a-b", "axb", "x[1]", "^", "]", "-"],
        [f"scene{number:04d}_{take:02d}" for number in range(0, 3000, 7) for take in range(3)],
    ],
)
def test_a_pattern_of_names_matches_exactly_these(names):
    pattern = any_of(names)
    others = {name[:-1] for name in names} | {f"{name}0" for name in names} | {"a_b", "scene", "", "["}
    for name in others | {*names}:
        assert bool(re.fullmatch(pattern, name)) == (name in names), name
    assert len(pattern) <= len(re.escape("|".join(names))) + 4


def test_patterns_of_wildcards_do_not_grow_with_the_scenes_but_reject_results_of_others(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    rows = [
        f"synthetic scene{number * 7919 % 10**6:06d} benchmark world:room:1 metre" for number in range(300)
    ]
    for name in ("old", "scene000000"):
        Path(f"results/synthetic/{name}").mkdir(parents=True)
    found = plan_of(tmp_path, rows, variants=VARIANTS, main_variants=["default", *VARIANTS])
    for pattern in (found.datasets(), found.jobs_of("field"), found.jobs_of("masks")):
        assert len(pattern) < 500
        assert re.match(pattern, "synthetic/scene000000/default/field.safetensors")
        assert not re.match(pattern, "synthetic/old/default/field.safetensors")
    with pytest.raises(SettingsError, match=r"no scene is named 'synthetic/scene00000'(.|\n)*scene000000'\?"):
        found.row(Job("synthetic", "scene00000"))
