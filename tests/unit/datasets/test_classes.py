"""Lists of classes: their numbers, their nesting, and the companion lists if those are available."""

import csv

import pytest

from hilsplat.datasets import classes as lists
from tests.conftest import PROJECT

SETS = [classes for sets in lists.LABELLINGS.values() for classes in sets]


@pytest.mark.parametrize("classes", SETS, ids=[classes.name for classes in SETS])
def test_ids_and_texts_are_unique(classes):
    assert len(classes) == len(classes.texts) == len(set(classes.ids)) == len(set(classes.texts))
    assert min(classes.ids) > 0
    assert all(text == text.strip() and "-" not in text for text in classes.texts)


def test_subsets_lack_the_classes_that_their_sources_exclude():
    assert list(map(len, SETS)) == [19, 15, 10, 200, 198, 51, 48, 22]
    assert set(lists.SCANNET_10.ids) < set(lists.SCANNET_15.ids) < set(lists.SCANNET_19.ids)
    ten = ("wall", "floor", "bed", "chair", "sofa", "table", "door", "window", "bookshelf", "toilet")
    assert lists.SCANNET_10.texts == ten
    assert set(lists.SCANNET200.texts) - set(lists.SCANNET200_INSTANCES.texts) == {"wall", "floor"}
    assert set(lists.REPLICA_51.texts) - set(lists.REPLICA_48.texts) == {"wall", "floor", "ceiling"}
    head_common_tail = [sum(members) for members in lists.splits_of(lists.SCANNET200).values()]
    assert head_common_tail == [66, 68, 66]
    assert lists.WAYMO_22.ids == tuple(range(1, 23)) and lists.WAYMO_22.texts[6] == "pedestrian"


def test_classes_equal_the_companion_lists():
    folder = PROJECT.parent / "shared" / "reference"
    if not folder.is_dir():
        pytest.skip("the companion lists are not beside the checkout (shared/reference)")

    def listed(name):
        with (folder / name).open(encoding="utf-8", newline="") as stream:
            return list(csv.DictReader(stream))

    nyu40 = listed("nyu40_classes.csv")
    assert {int(row["nyu40id"]): row["query_name"] for row in nyu40} == lists.NYU40
    for column, classes in (
        ("in19", lists.SCANNET_19),
        ("in15", lists.SCANNET_15),
        ("in10", lists.SCANNET_10),
    ):
        assert tuple(int(row["nyu40id"]) for row in nyu40 if row[column] == "1") == classes.ids
    two_hundred = [(int(row["id"]), row["name"], row["split"]) for row in listed("scannet200_classes.csv")]
    assert tuple(two_hundred) == lists.CLASSES
    rows = [row for row in listed("replica_classes.csv") if row["id"] != "0"]
    assert {int(row["id"]): row["name"] for row in rows} == lists.REPLICA_NAMES
    opennerf = sorted((int(row["opennerf_index"]), int(row["id"])) for row in rows if row["opennerf_index"])
    assert tuple(label for _, label in opennerf) == lists.REPLICA_EVALUATED_51
    assert tuple(int(row["id"]) for row in rows if row["in48"] == "1") == lists.REPLICA_48.ids
    labelled = [row for row in listed("waymo_semseg_classes.csv") if row["id"] != "0"]
    expected = [(int(row["id"]), row["suggested_prompt"]) for row in labelled]
    assert expected == list(zip(lists.WAYMO_22.ids, lists.WAYMO_22.texts, strict=True))
