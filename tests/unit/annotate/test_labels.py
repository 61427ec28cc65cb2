"""Annotations of a view: children are cut to their parents, and only the last version is replaced."""

import json

import numpy as np
import pytest

from hilsplat.annotate.labels import Label, cut_to_parents, known_labels, label_path, traced, write_labels
from hilsplat.base.errors import SettingsError
from hilsplat.datasets.images.hi import regions_of
from hilsplat.datasets.images.isat import read_isat
from hilsplat.scene.cameras import Cameras, Photo
from hilsplat.web.file_changes import NO_FILE, version_of
from tests.unit.annotate.label_files import read_labels

SIZE = (30, 40)


def box(x0: int, y0: int, x1: int, y1: int) -> list[list[tuple[int, int]]]:
    """Polygon of the pixels from (x0, y0) to (x1, y1), both included."""
    return [[(x0, y0), (x1, y0), (x1, y1), (x0, y1)]]


def label(number: int, level: int, parent: int | None, polygons, text: str = "", **more) -> Label:
    return Label(
        id=number, level=level, parent=parent, text=text or f"thing {number}", polygons=polygons, **more
    )


def test_children_are_cut_to_their_parents_down_to_subparts_and_keep_their_vertices_inside():
    whole, part = label(1, 1, None, box(5, 5, 20, 20)), label(2, 2, 1, box(0, 10, 12, 29))
    subpart = label(3, 3, 2, box(8, 18, 39, 25))
    cut = cut_to_parents([subpart, part, whole], SIZE)
    assert [each.id for each in cut] == [3, 2, 1]
    subpart_mask, part_mask, whole_mask = (each.mask(SIZE) for each in cut)
    np.testing.assert_array_equal(part_mask, part.mask(SIZE) & whole.mask(SIZE))
    np.testing.assert_array_equal(subpart_mask, subpart.mask(SIZE) & part_mask)
    np.testing.assert_array_equal(whole_mask, whole.mask(SIZE))
    given = [label(1, 1, None, [[(3, 3), (20, 4), (9, 22)]]), label(2, 2, 1, [[(8, 6), (10, 6), (9, 9)]])]
    assert cut_to_parents(given, SIZE) == given
    once = cut_to_parents([label(1, 1, None, box(5, 5, 9, 9)), label(2, 2, 1, box(0, 0, 7, 7))], SIZE)
    assert cut_to_parents(once, SIZE) == once
    ring = np.zeros(SIZE, bool)
    ring[4:26, 4:36] = True
    ring[10:20, 12:28] = False
    cut = cut_to_parents([label(1, 1, None, traced(ring)), label(2, 2, 1, box(0, 8, 39, 22))], SIZE)
    np.testing.assert_array_equal(cut[1].mask(SIZE), ring & label(2, 2, 1, box(0, 8, 39, 22)).mask(SIZE))


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ([label(1, 1, None, box(0, 0, 4, 4)), label(2, 2, 1, box(6, 6, 9, 9))], "entirely outside 'thing 1'"),
        ([label(1, 1, None, box(0, 0, 4, 4)), label(2, 3, 1, box(0, 0, 4, 4))], "expected  a part"),
        ([label(1, 1, None, box(0, 0, 4, 4)), label(2, 1, 1, box(0, 0, 4, 4))], "none: it is a whole"),
        ([label(2, 2, 7, box(0, 0, 4, 4))], "no such thing in this photograph"),
        ([label(1, 1, None, box(0, 0, 4, 4)), label(1, 1, None, box(0, 0, 4, 4))], "id 1 occurs twice"),
        ([label(1, 1, None, box(50, 50, 60, 60))], "no pixels inside the photograph"),
    ],
)
def test_invalid_labels_are_refused(labels, message):
    with pytest.raises(SettingsError, match=message):
        cut_to_parents(labels, SIZE)


def test_a_written_file_is_read_back_and_scored_without_proposals(tmp_path):
    path = tmp_path / "desk/DSC_1.json"
    given = [
        label(1, 1, None, box(5, 5, 20, 20), "mug"),
        label(2, 2, 1, box(6, 6, 9, 9), "Henkel „links“", origin="edited"),
        label(5, 2, 1, box(10, 6, 12, 9), "rim", origin="proposed"),
    ]
    version = write_labels(path, "DSC_1.png", SIZE, given, NO_FILE)
    assert version == version_of(path) and read_labels(path) == given
    warnings: list[str] = []
    regions = regions_of(read_isat(path), warnings)
    assert [region.path for region in regions] == [("mug",), ("mug", "Henkel „links“")]
    assert warnings == ["DSC_1.json: ignored 1 unaccepted proposal(s)"]
    first = path.read_bytes()
    write_labels(path, "DSC_1.png", SIZE, given[::-1], version)
    assert path.read_bytes() == first  # the order of drawing does not matter
    assert write_labels(path, "DSC_1.png", SIZE, [], version) == NO_FILE and not path.exists()
    shared = path.with_name("shared.json")
    path.symlink_to(shared)
    write_labels(path, "DSC_1.png", SIZE, given, NO_FILE)
    assert path.is_symlink() and shared.is_file()


def views_of(*names: str, photos: dict[str, Photo] | None = None) -> Cameras:
    n = len(names)
    K = np.array([[30.0, 0, SIZE[1] / 2], [0, 30, SIZE[0] / 2], [0, 0, 1]])
    sizes = np.full((n, 2), SIZE, np.int32)
    return Cameras(names, np.tile(np.eye(4), (n, 1, 1)), np.tile(K, (n, 1, 1)), sizes, photos or {})


def isat(name: str, size_hw: tuple[int, int], things: list[dict], **more) -> str:
    info = {"name": name, "width": size_hw[1], "height": size_hw[0], "note": "desk"}
    return json.dumps({"info": info, "objects": things, **more})


def test_regions_outside_the_view_survive_a_change_and_the_removal_of_all_others(tmp_path):
    photo = Photo("PINHOLE", (30, 30, 40, 20), (40, 80))  # the view is its middle
    cameras = views_of("a.png", photos={"a.png": photo})
    keys = {"level": 1, "parent": None}
    lamp = {"id": 1, **keys, "category": "corner lamp", "segmentation": [[0, 0], [4, 0], [4, 4]]}
    table = {"id": 2, **keys, "category": "table", "segmentation": [[0, 20], [50, 20], [50, 39], [0, 39]]}
    path = tmp_path / "a.json"
    path.write_text(before := isat("a.png", photo.size_hw, [lamp, table]))
    (shown,) = known_labels(tmp_path, cameras, cameras.names)["a.png"]
    assert shown.text == "table"
    new = label(3, 1, None, box(1, 1, 5, 5))
    version = write_labels(path, "a.png", SIZE, [shown, new], version_of(path))
    assert read_labels(path) == [shown, new]
    assert json.loads(path.read_text())["original"] == json.loads(before)
    version = write_labels(path, "a.png", SIZE, [new], version)
    write_labels(path, "a.png", SIZE, [], version)
    assert json.loads(path.read_text())["original"] == json.loads(before)
    assert regions_of(read_isat(path), []) == ()


def test_keys_of_other_programs_survive_a_change(tmp_path):
    path = tmp_path / "a.json"
    keys = {"level": 1, "parent": None, "segmentation": box(2, 2, 9, 9), "bbox": [2, 2, 9, 9]}
    things = [{"id": n, "category": "mug", **keys, "note": f"by hand {n}"} for n in (1, 2)]
    path.write_text(isat("a.png", SIZE, things, author="me"))
    second = read_labels(path)[1]
    moved = second.model_copy(update={"polygons": box(20, 20, 29, 29)})
    write_labels(path, "a.png", SIZE, [moved], version_of(path))
    content = json.loads(path.read_text())
    assert (content["author"], content["info"]["note"]) == ("me", "desk")
    assert [(thing["id"], thing["note"]) for thing in content["objects"]] == [(2, "by hand 2")]
    assert read_isat(path).warnings == ()  # such as about a box of the old outline
    assert read_labels(path) == [moved]


def test_labels_without_levels_are_wholes_with_the_ids_of_the_same_objects(tmp_path):
    def things(*texts: str) -> list[dict]:
        shape = {"group": 1, "segmentation": box(2, 2, 9, 9)[0]}
        return [{"category": text, **shape} for text in texts]

    (tmp_path / "a.json").write_text(isat("a.jpg", SIZE, things("mug", "cup", "mug")))
    (tmp_path / "b.json").write_text(isat("b.jpg", SIZE, things("Cup", "lamp")))
    cameras = views_of("a.jpg", "b.jpg", "c.jpg")
    lamp = label(1, 1, None, box(0, 0, 5, 5), "lamp")
    write_labels(
        label_path(tmp_path, "c.jpg"), "c.jpg", SIZE, [lamp, label(2, 2, 1, box(1, 1, 3, 3))], NO_FILE
    )
    texts: dict[int, str] = {}
    known = known_labels(tmp_path, cameras, cameras.names, texts)
    found = {view: [(each.text, each.id, each.level) for each in labels] for view, labels in known.items()}
    assert found == {
        "a.jpg": [("mug", 3, 1), ("cup", 4, 1), ("mug", 5, 1)],
        "b.jpg": [("Cup", 4, 1), ("lamp", 1, 1)],
        "c.jpg": [("lamp", 1, 1), ("thing 2", 2, 2)],
    }
    # the page draws a new object, and keeps the ids of the others
    new = [*known["c.jpg"], label(6, 1, None, box(9, 9, 20, 20), "plate")]
    write_labels(tmp_path / "c.json", "c.jpg", SIZE, new, version_of(tmp_path / "c.json"))
    known["c.jpg"] = new
    assert known_labels(tmp_path, cameras, cameras.names, texts) == known
    before = json.loads((tmp_path / "a.json").read_text())
    write_labels(tmp_path / "a.json", "a.jpg", SIZE, known["a.jpg"], version_of(tmp_path / "a.json"))
    assert json.loads((tmp_path / "a.json").read_text())["original"] == before
    assert known_labels(tmp_path, cameras, cameras.names) == known


def test_a_region_can_be_anywhere_in_the_widest_photograph():
    corners = [(32_700, 2), (32_767, 2), (32_767, 5), (32_700, 5)]
    label = Label(id=1, level=1, text="mug", polygons=[corners])
    expected = np.zeros((8, 32_768), bool)
    expected[2:6, 32_700:] = True
    np.testing.assert_array_equal(label.mask((8, 32_768)), expected)
