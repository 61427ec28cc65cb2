"""The diagnostic segmenter reproduces true regions, is deterministic, and runs only on request."""

import numpy as np
import pytest

from hilsplat.base.artifacts import (
    provenance_path,
    read_index,
    read_json,
    sha256_of_path,
    write_index,
    write_json,
)
from hilsplat.base.errors import ArtifactError, HilsplatError, MisalignedArtifactError, SettingsError
from hilsplat.base.images import write_png
from hilsplat.base.levels import LEVELS, Level
from hilsplat.cli import stage as around
from hilsplat.cli import stage_commands
from hilsplat.datasets.synthetic.hierarchy import AnnotatedNode, write_hierarchy
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.scene import Scene
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.settings import PerturbSettings
from hilsplat.world.truth_masks import FAULTS, faults_label, run_truth_masks

NAMES = ("000.png", "001.png", "002.png")
SIZE = (24, 40)
NODES = (
    AnnotatedNode(0, 1, -1, "bear"),
    AnnotatedNode(1, 2, 0, "head"),
    AnnotatedNode(2, 2, 0, "body"),
    AnnotatedNode(3, 3, 1, "nose"),
    AnnotatedNode(4, 1, -1, "table"),
)
EXACT = PerturbSettings(
    **{fault: (0, 0, 0) if fault.startswith("missing") else 0 for fault in FAULTS}, score_noise=0
)


def labels_of(view: int) -> dict[Level, np.ndarray]:
    """Labels of a bear of 12 x 20 px on a table; its head is the left half; each view shifts it by 1 px."""
    labels = np.full((3, *SIZE), -1, np.int32)
    left = 6 + view
    labels[0] = 4
    labels[0, 6:18, left : left + 20] = 0
    labels[1, 6:18, left : left + 10] = 1
    labels[1, 6:18, left + 10 : left + 20] = 2
    labels[2, 9:12, left + 2 : left + 6] = 3
    return {level: labels[level.index] for level in LEVELS}


@pytest.fixture
def world(tmp_path):
    """A posed scene, its last view for testing, and its truth."""
    cameras = Cameras(
        NAMES, np.tile(np.eye(4), (3, 1, 1)), np.tile(np.eye(3), (3, 1, 1)), np.tile(np.int32(SIZE), (3, 1))
    )
    for name in NAMES:
        write_png(tmp_path / "scene" / "images" / name, np.zeros((*SIZE, 3), np.uint8))
    split = dict.fromkeys(NAMES, "train") | {NAMES[-1]: "test"}
    points, colours = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    Scene(tmp_path / "scene", "synthetic/bear", "metre", cameras, split, points, colours, np.eye(4)).save()
    labels = {name: labels_of(view) for view, name in enumerate(NAMES)}
    write_hierarchy(tmp_path / "truth", NODES, labels, dict.fromkeys(NAMES, range(4)))
    write_json(tmp_path / "truth" / "scene.json", {"background": [4]})
    write_index(tmp_path / "truth", {name: {} for name in NAMES})
    return tmp_path


def make(world, out="masks", settings=EXACT, threads=1, min_area_px=1):
    run_truth_masks(world / "scene", world / "truth", world / out, settings, min_area_px, threads)
    return world / out


def test_without_faults_every_true_region_of_every_training_view_is_a_mask(world):
    folder = make(world)
    index = read_index(folder)
    assert list(index["views"]) == ["000.png", "001.png"]
    for view, name in enumerate(NAMES[:2]):
        masks = HierarchicalMasks.load(folder / f"{name}.npz")
        for level in LEVELS:
            of_level = labels_of(view)[level]
            expected = {(of_level == node).tobytes() for node in np.unique(of_level) if node >= 0}
            assert {mask.tobytes() for mask in masks.dense(masks.rows_of(level))} == expected
        assert (masks.predicted_iou == 1).all()
        assert index["views"][name]["whole"] == 2
        assert not any(index["views"][name]["faults"].values())


def test_the_index_records_segmenter_and_faults(world):
    index = read_index(make(world, settings=PerturbSettings(merge=0.5, seed=7)))
    assert (index["segmenter"], index["model"]) == ("truth-perturbed", None)
    assert index["label"] == "truth-perturbed (seed 7, merge 0.5)"
    assert index["perturb"]["merge"] == 0.5


def test_the_same_faults_give_the_same_bytes_on_any_number_of_threads(world):
    settings = PerturbSettings(merge=0.5, split=0.5, boundary_px=2.0)
    digests = {
        sha256_of_path(make(world, f"masks-{run}", settings, threads))
        for run, threads in enumerate((1, 3, 1))
    }
    assert len(digests) == 1
    other = make(world, "masks-other", settings.model_copy(update={"seed": 1}))
    assert sha256_of_path(other) not in digests


def test_labels_list_non_default_settings():
    assert faults_label(PerturbSettings()) == "truth-perturbed"
    assert faults_label(EXACT) == "truth-perturbed (exact)"
    assert faults_label(PerturbSettings(missing=(0, 0, 0.5))) == "truth-perturbed (missing 0/0/0.5)"


def test_all_fault_settings_are_in_the_list_of_faults():
    settings = PerturbSettings.model_fields.keys()
    about_faults = {"seed", "background", "boundary_smooth_px", "systematic_share", "score_noise"}
    assert settings - about_faults == set(FAULTS)


def test_label_images_of_the_wrong_size_are_refused(world):
    for level in LEVELS:
        write_png(world / "truth" / "labels" / f"001.png.{level.label}.png", np.zeros((12, 20), np.uint16))
    with pytest.raises(MisalignedArtifactError, match=r"view 001\.png(.|\n)*24 x 40(.|\n)*12 x 20"):
        make(world)
    assert not (world / "masks").exists()


def test_an_incomplete_truth_folder_is_refused(world):
    (world / "truth" / "index.json").unlink()
    with pytest.raises(ArtifactError, match="truth is missing or incomplete"):
        make(world)


def test_probabilities_above_1_are_refused():
    from hilsplat.configuration import parse_section

    with pytest.raises(SettingsError, match=r"perturb\.missing\.2: Input should be less than or equal to 1"):
        parse_section("perturb", '{"missing": [0, 0, 2]}')


@pytest.fixture
def command(world, monkeypatch):
    """The subcommand `hilsplat masks` without its logging."""
    monkeypatch.setattr(around, "start_logging", lambda *_, **__: None)
    return lambda **options: stage_commands.masks(scene=world / "scene", out=world / "out", **options)


def test_the_command_requires_the_truth_and_records_it(world, command):
    asked = '{"segmenter": "truth-perturbed", "min_area_px": 1}'
    with pytest.raises(HilsplatError, match=r"needs a synthetic scene(.|\n)*--truth results"):
        command(settings=asked)
    command(settings=asked, truth=world / "truth", perturb='{"seed": 3}')
    record = read_json(provenance_path(world / "out"))
    assert record["stage"] == "truth_masks"
    assert record["settings"]["perturb"]["seed"] == record["seed"] == 3
    assert set(record["inputs"]) == {"scene", "truth"}


@pytest.mark.parametrize("segmenter", ["sam", "graph"])
def test_other_segmenters_refuse_the_truth(world, command, segmenter):
    with pytest.raises(HilsplatError, match=f"the segmenter {segmenter} must not use the ground truth"):
        command(settings=f'{{"segmenter": "{segmenter}"}}', truth=world / "truth")
    assert not (world / "out").exists()
