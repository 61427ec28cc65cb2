"""The registry, the search for data sets, and the `hilsplat datasets` command."""

import pytest
from typer.testing import CliRunner

from hilsplat.base.errors import SceneError
from hilsplat.cli.main import app
from hilsplat.datasets.published import FRAMES, PAIRS, PROMPTS
from hilsplat.datasets.registry import DATASETS, dataset_of
from tests.unit.datasets.writers.labelled import write_lerf_ovs


@pytest.fixture
def data_root(tmp_path, true_world):
    """One scene of LERF-OVS, `figurines`."""
    write_lerf_ovs(true_world, tmp_path / "data" / "lerf_ovs", "figurines", ["001.png"])
    return tmp_path / "data"


@pytest.mark.parametrize("dataset", DATASETS.values(), ids=DATASETS)
def test_every_data_set_is_described(dataset):
    assert DATASETS[dataset.name] is dataset and dataset.labels in ("images", "points")
    for text in (dataset.title, dataset.licence, dataset.terms, dataset.citation, dataset.layout):
        assert text.strip()
    assert dataset.folder and all(map(dataset.required, dataset.scenes))
    assert dataset.scenes or dataset.name in ("waymo", "annotated")  # all that are there


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(SceneError, match=r"'lerf' is unknown\n.*lerf_ovs, lerf_mask, 3d_ovs, hi_lerf"):
        dataset_of("lerf")


def test_published_lists_have_the_published_counts():
    assert sum(map(len, FRAMES["lerf_ovs"].values())) == 22
    for name, num_scenes, num_frames in (("3d_ovs", 10, 5), ("hi_lerf", 4, 10), ("hi_3dovs", 10, 6)):
        assert [len(views) for views in FRAMES[name].values()] == [num_frames] * num_scenes
    assert [len(texts) for texts in PROMPTS["lerf_mask"].values()] == [7, 6, 10]
    assert PAIRS.keys() == FRAMES["lerf_ovs"].keys()
    assert not any("." in text for texts in PROMPTS["lerf_mask"].values() for text in texts)
    for scene, frames in FRAMES["lerf_ovs"].items():
        assert set(frames) < set(FRAMES["hi_lerf"][scene])


def test_a_folder_one_level_too_deep_is_detected(data_root):
    inner = data_root / "lerf_ovs" / "LERF-OVS"
    (data_root / "lerf_ovs").rename(data_root / "moved")
    inner.parent.mkdir()
    (data_root / "moved").rename(inner)
    with pytest.raises(SceneError, match=r"one level too deep.*\n.*\n.*its scenes in .*LERF-OVS\n.*move"):
        DATASETS["lerf_ovs"].locate(data_root)


@pytest.mark.parametrize(
    ("dataset", "place", "message"),
    [
        ("lerf_ovs", "data/lerf_ovs", "is the folder of LERF-OVS itself"),
        ("lerf_ovs", ".", "set data_root to .*/data$"),
        ("lerf_mask", "data", r"LERF-Mask is not below .*\n.*\n.*lerf_ovs"),
    ],
)
def test_a_wrong_data_root_is_detected(data_root, dataset, place, message):
    with pytest.raises(SceneError, match=message):
        DATASETS[dataset].locate(data_root.parent / place)


def test_the_images_of_another_data_set_do_not_make_hi_lerf_present(data_root):
    (data_root / "hi_lerf").mkdir()
    with pytest.raises(SceneError, match="Hi-LERF is not below"):
        DATASETS["hi_lerf"].locate(data_root)


def run(*words):
    """The command's exit code and output."""
    result = CliRunner().invoke(app, ["datasets", *map(str, words)])
    return result.exit_code, result.output


def test_the_command_lists_data_sets_and_what_is_there(data_root):
    code, output = run("list")
    assert code == 0 and "found" not in output
    for dataset in DATASETS.values():
        assert f"{dataset.name}: {dataset.title}" in output and dataset.licence in output
    code, output = run("list", "--data-root", data_root)
    assert code == 0
    assert f"found     figurines (in {data_root / 'lerf_ovs'})" in output
    assert "missing   ramen: ramen/images, ramen/sparse, label/ramen" in output


def test_the_command_checks_scenes_and_reports_one_that_cannot_be_read(data_root):
    code, output = run("check", "lerf_ovs", "--data-root", data_root)
    assert code == 0
    assert "lerf_ovs: missing: ramen, teatime, waldo_kitchen" in output
    (data_root / "lerf_ovs" / "ramen" / "images").mkdir(parents=True)
    code, output = run("check", "lerf_ovs", "--data-root", data_root)
    assert code == 1
    assert "lerf_ovs/ramen: cannot be read\n  scene ramen of LERF-OVS is incomplete" in output
    assert "also ramen/sparse, label/ramen" in output
    assert "lerf_ovs/figurines: images: 4, labelled views: 1, regions: 5" in output
    assert "warning   published frames without label: frame_00041" in output
