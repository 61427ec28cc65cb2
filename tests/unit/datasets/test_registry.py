"""The registry, the search for data sets, the workflow's queries at its start, and the `datasets` command."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hilsplat.base.errors import SceneError
from hilsplat.base.images import write_png
from hilsplat.cli.main import app
from hilsplat.datasets import sources
from hilsplat.datasets.published import FRAMES, PAIRS, PROMPTS
from hilsplat.datasets.registry import DATASETS, dataset_of, open_labels
from hilsplat.evaluate.protocols.cards import card_of
from tests.conftest import PROJECT
from tests.unit.datasets.writers.labelled import write_lerf_ovs


def touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")


KINDS = (("frame", "jpg"), ("depth", "png"))  # of NICE-SLAM's renderings


@pytest.fixture
def root(tmp_path) -> Path:
    """One scene of LERF-OVS and Hi-LERF, and one of 3D-OVS; their files are not readable."""
    root = tmp_path / "data"
    touch(
        root / "lerf_ovs/figurines/images/frame_00041.jpg",
        root / "lerf_ovs/figurines/sparse/0/cameras.bin",
        root / "lerf_ovs/label/figurines/frame_00041.json",
        root / "hi_lerf/label/figurines/frame_00041.json",
        root / "3d_ovs/bed/images/00.jpg",
        root / "3d_ovs/bed/sparse/0/cameras.bin",
        root / "3d_ovs/bed/segmentations/classes.txt",
        root / "3d_ovs/bed/segmentations/00/banana.png",
    )
    return root


def test_published_lists_have_the_published_counts():
    assert sum(map(len, FRAMES["lerf_ovs"].values())) == 22
    for name, num_scenes, num_frames in (("3d_ovs", 10, 5), ("hi_lerf", 4, 10), ("hi_3dovs", 10, 6)):
        assert [len(views) for views in FRAMES[name].values()] == [num_frames] * num_scenes
    assert [len(texts) for texts in PROMPTS["lerf_mask"].values()] == [7, 6, 10]
    assert PAIRS.keys() == FRAMES["lerf_ovs"].keys()
    assert not any("." in text for texts in PROMPTS["lerf_mask"].values() for text in texts)
    for scene, frames in FRAMES["lerf_ovs"].items():
        assert set(frames) < set(FRAMES["hi_lerf"][scene])


@pytest.mark.parametrize(
    ("dataset", "place", "message"),
    [
        ("lerf_ovs", "data/lerf_ovs", "wrong place.*fix       rename it to lerf_ovs if necessary, and set"),
        ("lerf_ovs", ".", "wrong place.*set data_root to .*/data$"),
        ("lerf_ovs", "deep", "wrong place.*found     .*deep/lerf_ovs/LERF-OVS\n.*move its contents to"),
        ("lerf_mask", "data", r"does not contain LERF-Mask\n.*\n.*3d_ovs, hi_lerf, lerf_ovs"),
        ("hi_3dovs", "data", "does not contain Hi-3DOVS"),  # although its images, those of 3D-OVS, exist
    ],
)
def test_a_wrong_data_root_is_detected(root, dataset, place, message):
    if place == "deep":
        shutil.copytree(root / "lerf_ovs", root.parent / "deep/lerf_ovs/LERF-OVS")
    with pytest.raises(SceneError, match=f"(?s){message}"):
        DATASETS[dataset].locate(root.parent / place)


def run(*words):
    """The command's exit code and output."""
    result = CliRunner().invoke(app, ["datasets", *map(str, words)])
    return result.exit_code, result.output


def test_the_command_lists_data_sets_and_their_scenes(root):
    listed = run("list")[1]
    assert "found" not in listed
    assert "get it    https://huggingface.co/mqye/Gaussian-Grouping, folder data/lerf_mask" in listed
    code, output = run("list", "--data-root", root)
    assert code == 0
    for name, dataset in DATASETS.items():
        assert dataset.name == name and all(map(dataset.required, dataset.scenes))
        assert bool(dataset.scenes) == (name not in ("waymo", "annotated"))
        assert f"{name}: {dataset.title}, labels on {dataset.labels}" in output
        for text in (dataset.licence, dataset.terms, dataset.citation, dataset.layout.splitlines()[0]):
            assert text.strip() and text in output
    assert f"found     figurines (in {root / 'lerf_ovs'})" in output
    assert "missing   ramen: ramen/images, ramen/sparse, label/ramen" in output


def test_the_command_checks_scenes_and_reports_one_that_cannot_be_read(tmp_path, true_world):
    write_lerf_ovs(true_world, tmp_path / "lerf_ovs", "figurines", ["001.png"])
    code, output = run("check", "lerf_ovs", "--data-root", tmp_path)
    assert code == 0
    assert "lerf_ovs: missing: ramen, teatime, waldo_kitchen" in output
    (tmp_path / "lerf_ovs" / "ramen" / "images").mkdir(parents=True)
    code, output = run("check", "lerf_ovs", "--data-root", tmp_path)
    assert code == 1
    assert "lerf_ovs/ramen: cannot be read\n  scene ramen of LERF-OVS is incomplete" in output
    assert "also ramen/sparse, label/ramen" in output
    assert "lerf_ovs/figurines: images: 4, labelled views: 1, regions: 5" in output
    assert "warning   published frames that have no label: frame_00041" in output


def test_a_source_that_cannot_be_used_has_a_reason_in_one_line(root):
    assert sources.published("data:lerf_ovs/figurines") == ("lerf_ovs", "figurines")
    for other in ("data:desk/mine", "world:tabletop:201", "lerf_ovs/figurines"):
        assert sources.published(other) is None
    for usable in ("data:lerf_ovs/figurines", "world:tabletop:201"):
        assert sources.absence(usable, str(root)) is None
    assert sources.absence("data:lerf_ovs/figurines", "") == "data_root is not set"
    assert sources.absence("data:desk/mine", str(root)) == f"{root / 'desk/mine'} is missing"
    (root / "lerf_ovs/figurines/sparse").rename(root / "aside")
    reason = sources.absence("data:lerf_ovs/figurines", str(root))
    assert "incomplete" in reason and "sparse" in reason and "\n" not in reason


def test_segments_on_disk_without_a_row_are_listed(root):
    touch(*(root / f"waymo/validation/lidar_segmentation/{segment}.parquet" for segment in ("one", "two")))
    listed = {"data:waymo/one", "data:lerf_ovs/figurines"}
    assert sources.unlisted(listed, ["lerf", "waymo"], str(root)) == ["waymo/two"]


def test_all_labels_on_a_scenes_images_score_it_and_only_evaluation_reads_them(root):
    both = ("lerf_ovs/figurines", "hi_lerf/figurines")
    assert sources.label_sets("data:lerf_ovs/figurines", str(root), "lerf/figurines") == both
    assert sources.label_sets("data:3d_ovs/bed", str(root), "3d_ovs/bed") == ("3d_ovs/bed",)
    touch(root / "hi_3dovs/label/bed/00.json")
    assert sources.label_sets("data:3d_ovs/bed", str(root), "3d_ovs/bed") == ("3d_ovs/bed", "hi_3dovs/bed")
    assert sources.label_sets("data:lerf_ovs/ramen", str(root), "lerf/ramen") == ()
    label, masks = root / "lerf_ovs/label/figurines/frame_00041.json", root / "3d_ovs/bed/segmentations"
    assert sources.label_files("lerf_ovs/figurines", str(root)) == (label,)
    assert sources.label_files("3d_ovs/bed", str(root)) == (masks / "00/banana.png", masks / "classes.txt")


def test_scenes_with_labelled_points_are_exported_first(root):
    scan = root / "scannet/scans/scene0000_00"
    touch(scan / "color/0.jpg", scan / "pose/0.txt", scan / "scene0000_00.aggregation.json")
    assert sources.is_exported("data:scannet/scene0000_00")
    assert not sources.is_exported("data:lerf_ovs/figurines")
    files = sources.image_files("data:scannet/scene0000_00", str(root))
    assert files == (scan / "color/0.jpg", scan / "pose/0.txt")  # labels are read by evaluation alone


def test_replica_needs_its_renderings_and_counts_frames(root):
    source, room = "data:replica/room_0", root / "replica/room_0"
    touch(room / "habitat/mesh_semantic.ply", room / "habitat/info_semantic.json")
    assert "no rendered sequence" in sources.absence(source, str(root))  # the original release alone
    sequence = root / "replica/room0"
    frames = [
        sequence / f"results/{kind}{number:06}.{ending}" for number in range(3) for kind, ending in KINDS
    ]
    files = {sequence / "traj.txt", root / "replica/cam_params.json", *frames}
    touch(*files)
    assert sources.absence(source, str(root)) is None
    assert set(sources.image_files(source, str(root))) == files
    assert dataset_of("replica").num_images([*files]) == 3
    assert dataset_of("replica").found(root / "replica") == ("room_0",)


def test_unknown_data_sets_missing_scene_names_and_needless_exports_are_refused(root, monkeypatch):
    with pytest.raises(SceneError, match=r"'lerf' is unknown\n.*lerf_ovs, lerf_mask, 3d_ovs, hi_lerf"):
        dataset_of("lerf")
    for name in ("scannet", "3d_ovs/"):
        for reads in (open_labels, sources.label_files):
            with pytest.raises(SceneError, match="does not contain a scene name"):
                reads(name, Path())
    monkeypatch.setattr("hilsplat.datasets.sources.open_labels", lambda *_: object())
    with pytest.raises(SceneError, match="needs no export"):
        sources.export_images("lerf_ovs/figurines", root, root / "out")


def test_the_data_set_of_the_documentation_is_read(tmp_path):
    page = (PROJECT / "docs/extending.md").read_text()
    code = re.search(r"```python\n(# hilsplat/datasets/desk_labels\.py.*?)```", page, re.S)
    names = {"__name__": "desk_labels"}
    exec(code[1], names)
    desk, mug = names["DESK"], np.zeros((6, 8), np.uint8)
    mug[1:4, 2:5] = 255
    write_png(tmp_path / "mine/images/000.png", np.zeros((6, 8, 3), np.uint8))
    with pytest.raises(SceneError, match="also mine/labels"):
        desk.open(tmp_path, "mine")
    write_png(tmp_path / "mine/labels/000/mug.png", np.repeat(mug[..., None], 3, axis=2))
    (region,) = desk.open(tmp_path, "mine").views["000.png"]
    assert region.text == "mug"
    assert np.array_equal(region.mask(), mug > 0)
    assert desk.check(tmp_path, "mine").facts
    assert [card_of(name).name for name in desk.protocols] == list(desk.protocols)
    places = [path for pattern in desk.label_places("mine") for path in tmp_path.glob(pattern)]
    assert tmp_path / "mine/labels/000/mug.png" in places
