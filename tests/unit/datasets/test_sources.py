"""Published data sets at the start of the workflow: which are missing, and which files label a scene."""

from pathlib import Path

import pytest

from hilsplat.base.errors import SceneError
from hilsplat.datasets.registry import open_labels
from hilsplat.datasets.sources import (
    absence,
    export_images,
    image_files,
    is_exported,
    label_files,
    label_sets,
    published,
    unlisted,
)


def touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")


@pytest.fixture
def root(tmp_path) -> Path:
    """LERF-OVS and Hi-LERF of one scene, 3D-OVS of one, ScanNet of one."""
    touch(
        tmp_path / "lerf_ovs/figurines/images/frame_00041.jpg",
        tmp_path / "lerf_ovs/figurines/sparse/0/cameras.bin",
        tmp_path / "lerf_ovs/label/figurines/frame_00041.json",
        tmp_path / "hi_lerf/label/figurines/frame_00041.json",
        tmp_path / "3d_ovs/bed/images/00.jpg",
        tmp_path / "3d_ovs/bed/sparse/0/cameras.bin",
        tmp_path / "3d_ovs/bed/segmentations/classes.txt",
        tmp_path / "3d_ovs/bed/segmentations/00/banana.png",
    )
    return tmp_path


def test_only_known_data_sets_are_published_ones():
    assert published("data:lerf_ovs/figurines") == ("lerf_ovs", "figurines")
    assert published("data:desk/mine") is None
    assert published("world:tabletop:201") is None
    assert published("lerf_ovs/figurines") is None


def test_a_source_that_cannot_be_used_has_a_reason_in_one_line(root):
    for usable in ("data:lerf_ovs/figurines", "world:tabletop:201"):
        assert absence(usable, str(root)) is None
    assert absence("data:lerf_ovs/figurines", "") == "data_root is not set"
    assert absence("data:desk/mine", str(root)) == f"{root / 'desk/mine'} is missing"
    (root / "lerf_ovs/figurines/sparse").rename(root / "aside")
    reason = absence("data:lerf_ovs/figurines", str(root))
    assert "incomplete" in reason and "sparse" in reason and "\n" not in reason


def test_segments_on_disk_without_a_row_are_listed(root):
    for segment in ("one", "two"):
        touch(root / f"waymo/validation/lidar_segmentation/{segment}.parquet")
    sources = {"data:waymo/one", "data:lerf_ovs/figurines"}
    assert unlisted(sources, ["lerf", "waymo"], str(root)) == ["waymo/two"]
    assert unlisted(sources, ["lerf"], str(root)) == unlisted(sources, ["waymo"], "") == []


def test_a_scene_is_scored_against_all_labels_on_its_images(root):
    both = ("lerf_ovs/figurines", "hi_lerf/figurines")
    assert label_sets("data:lerf_ovs/figurines", str(root), "lerf/figurines") == both
    assert label_sets("data:3d_ovs/bed", str(root), "3d_ovs/bed") == ("3d_ovs/bed",)
    assert label_sets("data:lerf_ovs/ramen", str(root), "lerf/ramen") == ()


def test_label_files_are_those_that_only_evaluation_reads(root):
    label, masks = root / "lerf_ovs/label/figurines/frame_00041.json", root / "3d_ovs/bed/segmentations"
    assert label_files("lerf_ovs/figurines", str(root)) == (label,)
    assert label_files("3d_ovs/bed", str(root)) == (masks / "00/banana.png", masks / "classes.txt")


def test_scenes_with_labelled_points_are_exported_first(root):
    scan = root / "scannet/scans/scene0000_00"
    touch(scan / "color/0.jpg", scan / "pose/0.txt", scan / "scene0000_00.aggregation.json")
    assert is_exported("data:scannet/scene0000_00")
    assert not is_exported("data:lerf_ovs/figurines")
    files = image_files("data:scannet/scene0000_00", str(root))
    assert files == (scan / "color/0.jpg", scan / "pose/0.txt")  # labels are read by evaluation alone


def test_images_in_a_folder_need_no_export_and_labels_need_a_scene(root, monkeypatch):
    with pytest.raises(SceneError, match="names no scene"):
        open_labels("scannet", Path())
    monkeypatch.setattr("hilsplat.datasets.sources.open_labels", lambda *_: object())
    with pytest.raises(SceneError, match="needs no export"):
        export_images("lerf_ovs/figurines", root, root / "out")
