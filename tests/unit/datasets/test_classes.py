"""Lists of classes: their numbers, their nesting, and the companion lists if those are available."""

import csv
import itertools

import pytest

from hilsplat.datasets.classes import replica, scannet, scannet200, waymo
from tests.conftest import PROJECT

SETS = [
    value
    for module in (scannet, scannet200, replica, waymo)
    for value in vars(module).values()
    if hasattr(value, "texts")
]


@pytest.mark.parametrize("classes", SETS, ids=lambda classes: classes.name)
def test_ids_and_texts_are_unique(classes):
    assert len(classes) == len(classes.texts) == len(set(classes.ids)) == len(set(classes.texts))
    assert min(classes.ids) > 0
    assert classes.source
    assert all(text == text.strip() and "-" not in text for text in classes.texts)


def test_scannet_sets_nest():
    sets = [scannet.SCANNET_19, scannet.SCANNET_15, scannet.SCANNET_10]
    assert [len(classes) for classes in sets] == [19, 15, 10]
    for larger, smaller in itertools.pairwise(sets):
        assert set(smaller.ids) < set(larger.ids)
    assert scannet.SCANNET_10.texts == (
        *("wall", "floor", "bed", "chair", "sofa", "table", "door", "window", "bookshelf", "toilet"),
    )
    assert len(scannet.NYU40) == 40
    assert scannet.OPENGAUSSIAN_SCENES[::9] == ("scene0000_00", "scene0645_00")


def test_scannet200_has_its_splits():
    assert len(scannet200.SCANNET200) == 200
    splits = scannet200.splits_of(scannet200.SCANNET200)
    assert [sum(splits[split]) for split in ("head", "common", "tail")] == [66, 68, 66]
    assert max(scannet200.SCANNET200.ids) == 1191
    assert len(scannet200.SCANNET200_INSTANCES) == 198
    assert not {"wall", "floor"} & set(scannet200.SCANNET200_INSTANCES.texts)


def test_replica_sets_differ_by_the_structure():
    assert (len(replica.NAMES), len(replica.REPLICA_51), len(replica.REPLICA_48)) == (101, 51, 48)
    missing = set(replica.REPLICA_51.texts) - set(replica.REPLICA_48.texts)
    assert missing == {"wall", "floor", "ceiling"}
    assert "tv screen" in replica.REPLICA_48.texts
    assert len(replica.SCENES) == 8


def test_waymo_classes_are_1_to_22():
    assert waymo.WAYMO_22.ids == tuple(range(1, 23))
    assert waymo.WAYMO_22.texts[6] == "pedestrian"


def test_classes_equal_the_companion_lists():
    folder = PROJECT.parent / "shared" / "reference"
    if not folder.is_dir():
        pytest.skip("the companion lists are not beside the checkout (shared/reference)")

    def listed(name):
        with (folder / name).open(encoding="utf-8", newline="") as stream:
            return list(csv.DictReader(stream))

    nyu40 = listed("nyu40_classes.csv")
    assert {int(row["nyu40id"]): row["query_name"] for row in nyu40} == scannet.NYU40
    sets = {"in19": scannet.SCANNET_19, "in15": scannet.SCANNET_15, "in10": scannet.SCANNET_10}
    for column, classes in sets.items():
        assert tuple(int(row["nyu40id"]) for row in nyu40 if row[column] == "1") == classes.ids
    two_hundred = [(int(row["id"]), row["name"], row["split"]) for row in listed("scannet200_classes.csv")]
    assert tuple(two_hundred) == scannet200.CLASSES
    rows = [row for row in listed("replica_classes.csv") if row["id"] != "0"]
    assert {int(row["id"]): row["name"] for row in rows} == replica.NAMES
    opennerf = sorted((int(row["opennerf_index"]), int(row["id"])) for row in rows if row["opennerf_index"])
    assert tuple(label for _, label in opennerf) == replica.EVALUATED_51
    assert tuple(int(row["id"]) for row in rows if row["in48"] == "1") == replica.REPLICA_48.ids
    labelled = [row for row in listed("waymo_semseg_classes.csv") if row["id"] != "0"]
    expected = [(int(row["id"]), row["suggested_prompt"]) for row in labelled]
    assert expected == list(zip(waymo.WAYMO_22.ids, waymo.WAYMO_22.texts, strict=True))
