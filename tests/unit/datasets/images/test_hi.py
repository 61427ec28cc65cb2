"""Hi-LERF and Hi-3DOVS: levels, parents, and what is reported rather than refused."""

import json

import numpy as np
import pytest

from hilsplat.base.errors import SceneError
from hilsplat.base.levels import Level
from hilsplat.datasets.images.hi import HI_3DOVS, HI_LERF
from tests.unit.datasets.writers.labelled import LERF_STEMS, OVS_STEMS, write_hi


@pytest.fixture
def root(tmp_path, true_world):
    """The small world as scene `ramen` of Hi-LERF, its second and fourth view labelled."""
    views = ["001.png", "003.png"]
    write_hi(true_world, tmp_path / "hi_lerf", tmp_path / "lerf_ovs", "ramen", views, LERF_STEMS)
    return tmp_path / "hi_lerf"


def edit(root, change, frame="frame_00002"):
    """Change the objects of a label file in place."""
    path = root / "label" / "ramen" / f"{frame}.json"
    content = json.loads(path.read_text())
    change({thing["id"]: thing for thing in content["objects"]}, content["objects"])
    path.write_text(json.dumps(content))


def test_a_written_world_is_read_back_equal(true_world, root):
    scene = HI_LERF.open(root, "ramen")
    assert list(scene.views) == ["frame_00002.png", "frame_00004.png"]
    nodes = true_world.annotations.nodes
    for name, view in (("001.png", "frame_00002.png"), ("003.png", "frame_00004.png")):
        shown = true_world.annotations.views[name]
        assert len(scene.views[view]) == len(shown)
        for region, node in zip(scene.views[view], shown, strict=True):
            assert (region.text, region.level) == (nodes[node].text, Level(nodes[node].level))
            assert region.path == true_world.annotations.path_of(node)
            assert np.array_equal(region.mask(), true_world.mask(name, [node]))
            rows, columns = np.nonzero(region.mask())
            assert region.boxes().tolist() == [[columns.min(), rows.min(), columns.max(), rows.max()]]
    assert not any("parent" in line for line in scene.warnings)


def test_hi_3dovs_takes_images_of_3d_ovs(tmp_path, true_world):
    write_hi(true_world, tmp_path / "hi_3dovs", tmp_path / "3d_ovs", "bed", ["001.png"], OVS_STEMS)
    scene = HI_3DOVS.open(tmp_path / "hi_3dovs", "bed")
    assert scene.images["01.png"] == tmp_path / "3d_ovs" / "bed" / "images" / "01.jpg"
    assert HI_3DOVS.check(tmp_path / "hi_3dovs", "bed").facts["posed views"] == 4
    assert "published frames without label: 06.png, 11.png, 20.png, 28.png, 36.png" in scene.warnings


def test_listed_frames_without_image_or_label_are_reported(root):
    (root.parent / "lerf_ovs" / "ramen" / "images" / "frame_00004.jpg").unlink()
    scene = HI_LERF.open(root, "ramen")
    assert list(scene.views) == ["frame_00002.png"]
    reported = "; ".join(scene.warnings)
    assert "frame_00004.json has no image" in reported
    assert "published frames without image: frame_00006.png, frame_00024.png" in reported
    assert "published frames without label: frame_00006.png, frame_00024.png" in reported


def test_an_invalid_parent_is_reported(root):
    def change(by_id, _):
        by_id[1]["parent"] = 99
        by_id[4]["parent"] = 0  # a subpart below a whole

    edit(root, change)
    scene = HI_LERF.open(root, "ramen")
    reported = "; ".join(scene.warnings)
    assert "frame_00002.json, id 1 (head): its parent 99 does not exist" in reported
    assert "id 4 (nose), level 3: its parent 0 is of level 1" in reported
    paths = {region.text: region.path for region in scene.views["frame_00002.png"]}
    assert paths["head"] == ("head",) and paths["nose"] == ("nose",) and paths["paw"] == ("bear", "paw")


def test_a_child_outside_its_parent_is_reported_with_its_share(root):
    def change(by_id, _):
        # The nose of 3 x 2 px (columns 9 to 11, rows 8 and 9) now begins in rows 10 and 11, the last of
        # the head, and continues for two rows below it.
        by_id[4]["segmentation"] = [[9, 10], [11, 10], [11, 13], [9, 13]]
        by_id[4].pop("bbox")

    edit(root, change)
    reported = "; ".join(HI_LERF.open(root, "ramen").warnings)
    assert "id 4 (nose): 50.0% of its area is outside its parent 1 (head)" in reported


def test_one_percent_outside_is_rasterisation(root):
    def change(by_id, objects):
        square = [[0, 0], [9, 0], [9, 9], [0, 9]]
        wide = [[0, 0], [10, 0], [10, 9], [0, 9]]
        common = {"bbox": None, "iscrowd": False}
        objects.append(
            {"id": 90, "level": 1, "parent": None, "category": "a", "segmentation": square, **common}
        )
        pieces = [[[0, 0], [9, 0], [9, 9], [0, 9]], [[10, 0], [10, 0], [10, 0]]]  # 101 px, one outside
        objects.append(
            {"id": 91, "level": 2, "parent": 90, "category": "b", "segmentation": pieces, **common}
        )
        objects.append({"id": 92, "level": 2, "parent": 90, "category": "c", "segmentation": wide, **common})

    edit(root, change)
    reported = [line for line in HI_LERF.open(root, "ramen").warnings if "outside its parent" in line]
    assert reported == ["frame_00002.json, id 92 (c): 9.1% of its area is outside its parent 90 (a)"]


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("id", 0, r"object 1 \(head\): id cannot be used"),
        ("id", "1", r"object 1 \(head\): id cannot be used\n.*\n.*'1'"),
        ("level", 4, r"object 1 \(head\): level cannot be used"),
        ("level", None, r"plain LERF-OVS labels have no levels"),
        ("level", True, r"object 1 \(head\): level cannot be used"),
    ],
)
def test_unusable_ids_and_levels_are_refused(root, key, value, message):
    edit(root, lambda by_id, _: by_id[1].update({key: value}))
    with pytest.raises(SceneError, match=message):
        HI_LERF.open(root, "ramen")


def test_missing_images_of_the_other_data_set_are_named(root):
    (root.parent / "lerf_ovs").rename(root.parent / "lerf")
    with pytest.raises(SceneError, match=r"also ../lerf_ovs/ramen/images"):
        HI_LERF.open(root, "ramen")
