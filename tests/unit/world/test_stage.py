"""The world stage writes images for the next stages, and ground truth only for evaluation and pictures."""

from runpy import run_path

import numpy as np
import pytest

from hilsplat.base.artifacts import read_index, read_json
from hilsplat.base.errors import ArtifactError, SceneError
from hilsplat.base.files import list_images
from hilsplat.base.images import read_image
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.lineage import sha256_of_path
from hilsplat.datasets.hierarchy import AnnotatedNode, HierarchyAnnotations
from hilsplat.scene.cameras import Cameras
from hilsplat_world.objects.catalogue import GENERATOR_VERSION, TABLETOP
from hilsplat_world.pictures import show_world, tree_lines
from hilsplat_world.render import label_view
from hilsplat_world.scenes.kinds import build_scene
from hilsplat_world.settings import WorldSettings
from hilsplat_world.stage import parse_source, run_world
from hilsplat_world.truth import annotated_nodes
from tests.conftest import PROJECT

SETTINGS = WorldSettings(views=3, image_px=64, arc_deg=30, objects=3, samples=1)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "world"
    run_world("world:tabletop:100", SETTINGS, folder / "images", folder / "truth", threads=1)
    return folder


def test_the_written_truth_is_that_of_the_scene(world):
    assert [path.name for path in list_images(world / "images")] == ["000.png", "001.png", "002.png"]
    assert read_image(world / "images" / "000.png").shape == (64, 64, 3)
    cameras = Cameras.load(world / "truth" / "cameras.npz")
    truth = HierarchyAnnotations.load(world / "truth")
    scene = build_scene("tabletop", 100, 3)
    assert truth.nodes == scene.nodes
    for name in cameras.names:
        labels = label_view(scene, cameras[name])
        for level in LEVELS:
            assert np.array_equal(truth.label_image(name, level), labels[level.index])
    for folder in ("images", "truth"):
        assert list(read_index(world / folder)["views"]) == list(cameras.names)
    record = read_json(world / "truth" / "scene.json")
    assert (record["kind"], record["seed"], record["split"]) == ("tabletop", 100, "development")
    assert record["generator_version"] == GENERATOR_VERSION
    assert record["objects_asked"] == record["objects_placed"] == len(record["placed"]) == 3
    assert set(record["background"]) == scene.background
    assert all(ids and not scene.background & set(ids) for ids in truth.views.values())


def test_reruns_with_any_number_of_threads_give_the_same_bytes(world, tmp_path):
    run_world(
        "world:tabletop:100", SETTINGS, tmp_path / "again" / "images", tmp_path / "again" / "truth", threads=2
    )
    for folder in ("images", "truth"):
        assert sha256_of_path(world / folder) == sha256_of_path(tmp_path / "again" / folder)


def tree(*rows):
    """Nodes from (level, parent, text)."""
    return tuple(AnnotatedNode(row, *fields) for row, fields in enumerate(rows))


def test_instances_of_a_text_are_annotated_together_or_not_at_all():
    nodes = tree((1, -1, "chair"), (2, 0, "leg"), (2, 0, "leg"), (2, 0, "seat"), (1, -1, "table"))
    labels = np.full((3, 10, 10), -1, np.int32)
    labels[0] = 4
    labels[0, :5] = 0  # 50 px of chair, 50 px of table
    labels[1, 0, :7], labels[1, 1, :4], labels[1, 2, :6] = 1, 2, 3  # legs of 7 and 4 px, seat of 6
    smallest = {Level.WHOLE: 10, Level.PART: 10, Level.SUBPART: 10}
    # The legs have 11 px between them, the seat 6, and the table is background.
    assert annotated_nodes(labels, nodes, {4}, smallest) == (0, 1, 2)


def test_malformed_sources_and_training_seeds_are_refused():
    assert parse_source("world:tabletop:201") == ("tabletop", 201)
    for source in ("tabletop:100", "world:forest:1", "world:tabletop:-1", "world:tabletop"):
        with pytest.raises(SceneError, match=r"expected  world:<kind>:<seed>, where kind is one of: table"):
            parse_source(source)
    with pytest.raises(SceneError, match="that the small models were trained on"):
        parse_source("world:tabletop:1000003")


def test_a_contact_sheet_is_drawn(world, tmp_path):
    show_world(world, tmp_path / "sheet.png")
    assert min(read_image(tmp_path / "sheet.png").shape[:2]) > 400
    with pytest.raises(ArtifactError, match="missing or incomplete"):
        show_world(tmp_path, tmp_path / "sheet.png")


def test_the_manual_lists_all_tabletop_classes():
    text = " ".join((PROJECT / "docs" / "world.md").read_text().split())
    *names, last = TABLETOP
    assert f"The {len(TABLETOP)} classes are {', '.join(names)} and {last}." in text


def test_pictures_of_the_manual_are_drawn(tmp_path):
    script = run_path(str(PROJECT / "docs/draw_world.py"))
    script["draw_scenes"].__globals__["SCENE_PX"] = 64
    script["draw_classes"](tmp_path / "classes.png", ("burger",))
    # The ground and the page are grey.
    colourful = np.ptp(read_image(tmp_path / "classes.png").astype(int), axis=2) > 60
    assert 0.01 < colourful.mean() < 0.2
    script["draw_scenes"]("tabletop", [100], tmp_path / "scenes.png")
    assert (tmp_path / "scenes.png").is_file()


def test_the_tree_lists_a_shared_text_once():
    nodes = tree((1, -1, "chair"), (2, 0, "leg"), (3, 1, "foot"), (2, 0, "leg"), (3, 3, "foot"))
    assert [(depth, node.id) for depth, node in tree_lines(nodes)] == [(0, 0), (1, 1), (2, 2)]
