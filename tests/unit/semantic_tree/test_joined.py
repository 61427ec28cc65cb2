"""Queries of two joined blocks of a long shelf give the same answers as queries of the whole scene."""

import os
import shlex
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.base.artifacts import read_index, write_index, write_json
from hilsplat.base.errors import HilsplatError
from hilsplat.base.images import write_png
from hilsplat.base.levels import LEVELS
from hilsplat.cli.main import app
from hilsplat.query.language_scene import open_scene
from hilsplat.scene.blocks import BLOCKS, Blocks
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import index_entry
from hilsplat.semantic_tree.joined import same_nodes
from hilsplat.splat.coordinates import move_gaussians, write_coordinates
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.ply import save_ply
from tests.unit.evaluate.builders import cameras_of, masks_of
from tests.unit.finished_desk import WORDS, painted, plate, run_stage, write_colour_clip

HEIGHT, LENGTH, WINDOW, STEP = 24, 120, 48, 6
REGIONS = (
    # name, level, rows, columns, colour; a region is painted over those before it
    ("wall", 1, (0, 24), (0, 120), (90, 90, 90)),
    ("mug", 1, (2, 22), (6, 30), (250, 0, 0)),
    ("handle", 2, (6, 16), (10, 20), (40, 220, 0)),
    ("rim", 3, (6, 9), (10, 20), (250, 250, 0)),
    ("book", 1, (4, 20), (42, 74), (0, 0, 250)),  # across the border
    ("label", 2, (6, 12), (52, 68), (0, 250, 0)),
    ("pen", 2, (20, 23), (70, 80), (0, 120, 120)),
    ("mug 2", 1, (2, 22), (86, 106), (250, 20, 0)),
    ("handle 2", 2, (6, 16), (90, 100), (20, 220, 0)),
)
"""A shelf: a pixel of its picture is a Gaussian, and each view is a window of the picture."""
PICTURE = painted(REGIONS, (HEIGHT, LENGTH))

BORDER = 58
OTHERWISE = {"pen": (56, 80)}  # columns of masks that differ in the first block, which reach over the border

VIEWS = tuple(f"{view:03d}.png" for view in range((LENGTH - WINDOW) // STEP + 1))
DISTANCE = 30.0


def region_mask(name: str, columns: tuple[int, int] | None = None) -> np.ndarray:
    _, _, rows, own, _ = next(region for region in REGIONS if region[0] == name)
    mask = np.zeros((HEIGHT, LENGTH), bool)
    mask[slice(*rows), slice(*(columns or own))] = True
    return mask


def visible_mask(name: str, columns: tuple[int, int] | None = None) -> np.ndarray:
    """Pixels of a region that no other region of its level covers, (24, 120) bool."""
    number = [region[0] for region in REGIONS].index(name)
    mask = region_mask(name, columns)
    for other in REGIONS[number + 1 :]:
        if other[1] == REGIONS[number][1]:
            mask &= ~region_mask(other[0])
    return mask


def window(picture: np.ndarray, view: str) -> np.ndarray:
    start = VIEWS.index(view) * STEP
    return picture[:, start : start + WINDOW]


def write_whole_scene(folder: Path) -> None:
    poses = np.tile(np.eye(4), (len(VIEWS), 1, 1))
    poses[:, 2, 3] = DISTANCE
    poses[:, 0, 3] = 0.5 - WINDOW / 2 - STEP * np.arange(len(VIEWS))
    poses[:, 1, 3] = 0.5 - HEIGHT / 2
    K = np.array([[DISTANCE, 0, WINDOW / 2], [0, DISTANCE, HEIGHT / 2], [0, 0, 1]])
    for view in VIEWS:
        write_png(folder / "images" / view, np.ascontiguousarray(window(PICTURE, view)))
    points = plate(PICTURE).means[::7]
    split = {view: "test" if view == VIEWS[4] else "train" for view in VIEWS}
    cameras = cameras_of(poses, K, (HEIGHT, WINDOW))
    colours = np.zeros((len(points), 3), np.uint8)
    Scene(folder, "photos/shelf", "arbitrary", cameras, split, points, colours, np.eye(4)).save()
    write_json(folder / "registration.json", {"poses": "given"})


def finish(place: Path) -> None:
    """Make the Gaussians and masks of a perfect fit and segmenter for a posed scene, and run later stages."""
    scene, out = Scene.load(place / "scene"), place / "default"
    gaussians, ply = plate(PICTURE), place / "gaussians.ply"
    starts = [VIEWS.index(view) * STEP for view in scene.views()]
    is_seen = (gaussians.means[:, 0] >= min(starts)) & (gaussians.means[:, 0] < max(starts) + WINDOW)
    seen = Gaussians(*(getattr(gaussians, name)[is_seen] for name in FIELDS))
    save_ply(ply, move_gaussians(seen, scene.scene_from_source))
    write_coordinates(ply, scene, seen, {"kind": "fitted"})
    entries = {}
    for view in scene.views("train"):
        drawn = OTHERWISE if place.name == "shelf-0" else {}
        shown = [(window(visible_mask(name, drawn.get(name)), view), level) for name, level, *_ in REGIONS]
        masks = masks_of(*zip(*[(mask, level) for mask, level in shown if mask.sum() > 20], strict=True))
        masks.save(out / "masks" / f"{view}.npz")
        entries[view] = index_entry(masks)
    identity = {"segmenter": "sam", "model": None, "model_sha256": None}
    write_index(out / "masks", entries, scene=scene.name, **identity)

    names = "masks", "contributions", "semantic_tree", "clip", "names"
    places = {"scene": place / "scene", "gaussians": ply, **{name: out / name for name in names}}
    run, cache = partial(run_stage, places), ("--cache", "results/.cache")
    run("contributions", out / "contributions", "scene", "gaussians", "masks", more=cache)
    run("semantic-tree", out / "semantic_tree", "contributions", "masks")
    model = {"model": "models/colours"}
    run("clip", out / "clip", "scene", "masks", "semantic_tree", settings=model, more=cache)
    run("names", out / "names", "semantic_tree", "clip", more=cache)


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """The shelf as one scene, and joined from two blocks."""
    folder, before = tmp_path_factory.mktemp("shelf"), Path.cwd()
    os.chdir(folder)  # paths in provenance are relative, as the workflow writes them
    try:
        write_colour_clip(folder / "models/colours")
        whole = Path("results/photos/shelf")
        write_whole_scene(whole / "scene")
        finish(whole)
        app(["blocks", "split", "shelf", "--blocks", "2"], standalone_mode=False)
        for name in Blocks.load(Path("blocks/shelf")).blocks:
            out = f"results/photos/{name}/scene"
            app(["poses", "--images", f"blocks/shelf/{name}", "--out", out], standalone_mode=False)
            finish(Path("results/photos") / name)
        app(["blocks", "join", "blocks/shelf"], standalone_mode=False)
        yield folder / "results"
    finally:
        os.chdir(before)


def test_blocks_share_the_views_at_their_border_and_keep_the_split(project):
    blocks = Blocks.load(project.parent / "blocks/shelf").blocks
    assert sorted(view for block in blocks.values() for view in block.owned) == list(VIEWS)
    assert all(block.borrowed for block in blocks.values())
    centres = [block.centre[0] for block in blocks.values()]
    assert np.mean(centres) == pytest.approx(BORDER, abs=1)
    for name, block in blocks.items():
        scene = Scene.load(project / "photos" / name / "scene")
        assert scene.views() == sorted([*block.owned, *block.borrowed])
        assert scene.views("test") == [view for view in scene.views() if view == VIEWS[4]]


def test_the_printed_commands_quote_the_folders_of_blocks(project, monkeypatch, capsys):
    monkeypatch.chdir(project.parent)
    app(["blocks", "split", "photos/shelf", "--blocks", "2", "--out", "my blocks"], standalone_mode=False)
    commands = [line.split("hilsplat new ")[1] for line in capsys.readouterr().out.splitlines()[1::2]]
    folders = {path.name: str(path) for path in Path("my blocks").iterdir() if path.is_dir()}
    assert dict(map(shlex.split, commands)) == folders and len(folders) == 2


def test_a_joined_scene_has_the_nodes_of_the_whole_scene(project):
    whole, joined = (open_scene(project / name) for name in ("photos/shelf", "joined/shelf"))
    assert len(joined.gaussians) == len(whole.gaussians)
    for level in LEVELS:
        assert len(joined.tree.nodes_of(level)) == len(whole.tree.nodes_of(level))
    order = [np.lexsort(scene.gaussians.means.round().T) for scene in (whole, joined)]
    pairs = np.stack(
        [
            scene.tree.node_of_gaussian[rows].ravel()
            for scene, rows in zip((whole, joined), order, strict=True)
        ]
    )
    assert len(np.unique(pairs, axis=1).T) == len(whole.tree) + 1  # and -1


@pytest.mark.parametrize("text", [*WORDS, "mug > handle", "mug > handle > rim"])
def test_a_joined_scene_gives_the_answers_of_the_whole_scene(project, text):
    scenes = [open_scene(project / name) for name in ("photos/shelf", "joined/shelf")]
    answers = [scene.query(text) for scene in scenes]
    assert len(answers[0]) == len(answers[1]) > 0
    for whole, joined in zip(*answers, strict=True):
        assert joined.level == whole.level
        assert joined.score == pytest.approx(whole.score, abs=0.01)
        np.testing.assert_allclose(joined.box, whole.box, atol=1e-3)
    for view in VIEWS:
        masks = [
            scene.views.node_masks(view, [hit.node for hit in hits])
            for scene, hits in zip(scenes, answers, strict=True)
        ]
        both, either = (masks[0] & masks[1]).sum(), (masks[0] | masks[1]).sum()
        assert both >= 0.97 * either or either <= HEIGHT, view  # a column at the edge may be half visible


def with_another_segmenter(project: Path) -> None:
    masks = project / "results/photos/shelf-1/default/masks"
    index = read_index(masks)
    write_index(masks, index.pop("views"), **{**index, "segmenter": "graph"})


def with_other_poses(project: Path) -> None:
    path = project / "blocks/shelf" / BLOCKS
    path.write_text(path.read_text().replace('"cameras_sha256": "', '"cameras_sha256": "0'))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda at: shutil.rmtree(at / "results/photos/shelf-1/default/clip"), "shelf-1 is not finished"),
        (with_another_segmenter, "different models or settings"),
        (with_other_poses, "was not made from"),
    ],
)
def test_blocks_that_do_not_belong_together_are_refused(project, tmp_path, monkeypatch, change, message):
    shutil.copytree(project.parent, tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    change(tmp_path / "copy")
    with pytest.raises(HilsplatError, match=message):
        app(["blocks", "join", "blocks/shelf"], standalone_mode=False)


@pytest.mark.parametrize(
    ("overlap", "areas", "expected"),
    [
        ([(0, 1, 60)], [[100, 0], [60, 0]], [0, 0]),  # 60 of 100
        ([(0, 1, 50)], [[100, 0], [50, 0]], [0, 1]),  # 50 of 100
        ([(0, 1, 60)], [[100, 90], [60, 0]], [0, 0]),  # the second view shows only one of them
        ([(0, 1, 60)], [[100, 90], [60, 90]], [0, 1]),  # 60 of 280
        ([(0, 2, 90), (2, 1, 90)], [[100, 0], [0, 100], [90, 90]], [0, 0, 0]),
    ],
)
def test_nodes_are_one_if_their_masks_overlap_in_most_of_their_union(overlap, areas, expected):
    first, second, px = np.array(overlap).T
    shape = (len(areas), len(areas))
    found = same_nodes(
        sp.csr_matrix((px.astype(float), (first, second)), shape), sp.csr_matrix(np.array(areas, float))
    )
    np.testing.assert_array_equal(found, expected)
