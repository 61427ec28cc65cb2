"""LangSplat's files: exported files are read back, and files of other programs are checked."""

from pathlib import Path

import numpy as np
import pytest

from hilsplat.base.artifacts import read_index, read_npy, write_index
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.base.images import read_image
from hilsplat.embed.clip import ClipModel
from hilsplat.embed.langsplat_export import maps_of, write_langsplat
from hilsplat.embed.langsplat_files import read_view, run_imported_clip, run_imported_masks
from hilsplat.scene.cameras import Camera
from hilsplat.segment.digests import digest_of, index_entry
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.settings import ClipSettings, MasksSettings
from tests.unit.segment.handmade import assert_equal_masks, pack, save_scene

SIZE = (6, 8)


def camera(size_hw: tuple[int, int], name: str = "a.png") -> Camera:
    return Camera(name, np.eye(4), np.eye(3), size_hw)


def nested() -> HierarchicalMasks:
    """A whole, in it a part, in that two subparts."""
    dense = np.zeros((4, *SIZE), bool)
    dense[0, 1:, 1:7] = True
    dense[1, 2:5, 2:6] = True
    dense[2, 2, 2] = dense[3, 4, 3:5] = True
    masks = pack(dense, [1, 2, 3, 3])
    return masks.take(masks.content_order())


@pytest.fixture
def scene(tmp_path) -> Path:
    """A posed scene of two noisy training views."""
    images = np.random.default_rng(0).integers(0, 255, (2, *SIZE, 3), np.uint8)
    return save_scene(tmp_path / "scene", {"a.png": images[0], "b.png": images[1]})


@pytest.fixture(scope="module")
def model(project) -> ClipModel:
    return ClipModel.load(project / "models/clip-tiny")


@pytest.fixture
def ours(tmp_path, scene, model) -> tuple[Path, Path]:
    """Folders of masks and vectors of two views."""
    masks = nested()
    names = ("a.png", "b.png")
    (tmp_path / "clip").mkdir()
    for name in names:
        masks.save(tmp_path / "masks" / f"{name}.npz")
        image = read_image(scene / "images" / name)
        vectors = model.embed_masks(image, masks, ClipSettings(crop="langsplat"))
        np.save(tmp_path / "clip" / f"{name}.npy", vectors)
    for folder in ("masks", "clip"):
        write_index(tmp_path / folder, dict.fromkeys(names, index_entry(masks)), scene="set/scene")
    return tmp_path / "masks", tmp_path / "clip"


@pytest.fixture
def files(ours, tmp_path) -> Path:
    write_langsplat(*ours, tmp_path / "files")
    return tmp_path / "files"


def test_maps_by_hand():
    maps, rows = maps_of(nested())
    assert maps.dtype == np.float32
    # default: all four masks, the small ones on top; then s, m, l, rows counted through
    assert rows.tolist() == [0, 1, 2, 3, 2, 3, 1, 0]
    # the larger subpart comes first
    assert (maps[0, 1, 1], maps[0, 3, 3], maps[0, 4, 3], maps[1, 4, 3], maps[1, 2, 2]) == (0, 1, 2, 4, 5)
    assert (set(np.unique(maps[2])), set(np.unique(maps[3])), maps[3, 0, 0]) == ({-1, 6}, {-1, 7}, -1)


@pytest.mark.parametrize(
    ("order", "levels"),
    [([0, 1, 2, 3], MasksSettings(levels="head")), ([0, 3, 2, 1], MasksSettings(levels="tree", theta=0.9))],
    ids=["levels of the maps", "subparts in the map of wholes, levels by the tree"],
)
def test_exported_files_are_read_back(ours, files, scene, model, tmp_path, order, levels):
    maps, vectors = (np.load(files / f"a_{kind}.npy", allow_pickle=False) for kind in "sf")
    assert (maps.shape, maps.dtype) == ((4, *SIZE), np.float32)
    assert (vectors.shape, vectors.dtype) == ((8, model.width), np.float32)
    np.save(files / "a_f.npy", 3 * vectors)  # lengths are normalised
    for path in files.glob("*_s.npy"):
        np.save(path, np.load(path)[order])
    run_imported_masks(scene, files, tmp_path / "masks again", levels)
    found = HierarchicalMasks.load(tmp_path / "masks again" / "a.png.npz")
    assert_equal_masks(found, nested())  # masks of a level do not overlap, so nothing was painted over
    assert read_index(tmp_path / "masks again")["views"]["a.png"] == index_entry(found)
    settings = ClipSettings(model=str(model.model.folder))
    run_imported_clip(scene, files, tmp_path / "clip again", settings, levels)
    index = read_index(tmp_path / "clip again")
    assert (index["dim"], index["model"]) == (model.width, settings.model)
    assert index["views"]["a.png"] == {"masks_sha256": digest_of(found), "masks": 4}
    again = read_npy(tmp_path / "clip again" / "a.png.npy").astype(float)
    np.testing.assert_allclose(again, read_npy(ours[1] / "a.png.npy").astype(float), atol=1e-3)


def test_a_view_may_have_no_masks(tmp_path):
    np.save(tmp_path / "x_s.npy", np.full((4, 2, 4), -1, np.float32))
    np.save(tmp_path / "x_f.npy", np.zeros((0, 5), np.float32))
    masks, vectors = read_view(tmp_path, "x.y.jpg", camera((2, 4), "x.y.jpg"))
    assert (len(masks), vectors.shape) == (0, (0, 5))


def test_maps_of_another_size_are_resized_and_of_another_shape_refused(files):
    with pytest.raises(MisalignedArtifactError, match=r"12 x 12 px(.|\n)*8 x 6 px"):
        read_view(files, "a.png", camera((12, 12)))
    masks, _ = read_view(files, "a.png", camera((12, 16)))
    np.testing.assert_array_equal(masks.area_px, 4 * nested().area_px)


@pytest.mark.parametrize(
    ("maps", "vectors", "words"),
    [
        (np.zeros((3, 6, 8)), np.zeros((1, 5)), "is not a LangSplat map"),
        (np.full((4, 6, 8), 7.0), np.zeros((7, 5)), "does not match a_f.npy"),
        (np.full((4, 6, 8), 0.5), np.zeros((7, 5)), "does not match a_f.npy"),
        (np.full((4, 6, 8), np.nan), np.zeros((7, 5)), "does not match a_f.npy"),
        (np.zeros((4, 6, 8)), np.full((1, 5), np.inf), "is not an array of vectors"),
        (np.zeros((4, 6, 8)), np.zeros(5), "is not an array of vectors"),
        (np.array([{"a": 1}], dtype=object), np.zeros((1, 5)), "cannot be read"),
    ],
)
def test_invalid_files_are_refused_and_nothing_is_unpickled(tmp_path, maps, vectors, words):
    np.save(tmp_path / "a_s.npy", maps, allow_pickle=True)
    np.save(tmp_path / "a_f.npy", vectors)
    with pytest.raises(ArtifactError, match=words):
        read_view(tmp_path, "a.png", camera(SIZE))


def test_files_of_two_clip_models_are_refused(files, scene, tmp_path):
    np.save(files / "b_f.npy", np.load(files / "b_f.npy")[:, :5])
    with pytest.raises(ArtifactError, match=r"has vectors of 5 and \d+ numbers"):
        run_imported_masks(scene, files, tmp_path / "out")


def test_missing_files_are_reported_and_half_of_the_views_need_them(files, scene, tmp_path, caplog):
    (files / "b_s.npy").unlink()
    run_imported_masks(scene, files, tmp_path / "out")
    assert "1 views are left out: " in caplog.text and "b_s.npy is missing" in caplog.text
    assert list(read_index(tmp_path / "out")["views"]) == ["a.png"]
    (files / "a_s.npy").unlink()
    with pytest.raises(ArtifactError, match=r"only 0 of 2 training views(.|\n)*b_s.npy is missing"):
        run_imported_masks(scene, files, tmp_path / "other")
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(
    ("masks", "clip", "error", "words"),
    [
        (("a.1.png", "a.2.png"), ("a.1.png", "a.2.png"), ArtifactError, r"a.1.png, a.2.png"),
        (("a.png", "b.png"), ("a.png",), MisalignedArtifactError, "was not made from the masks of view b"),
    ],
)
def test_views_of_one_stem_and_vectors_of_other_masks_are_refused(ours, tmp_path, masks, clip, error, words):
    for folder, views in zip(ours, (masks, clip), strict=True):
        write_index(folder, dict.fromkeys(views, index_entry(nested())), scene="set/scene")
    with pytest.raises(error, match=words):
        write_langsplat(*ours, tmp_path / "files")


@pytest.mark.parametrize(
    ("width", "words"),
    [
        (100, r"a_f.npy does not match the CLIP model in"),
        (None, r"were not computed by the CLIP model in(.|\n)*laion2b"),
    ],
)
def test_vectors_of_another_clip_are_refused(files, scene, model, tmp_path, width, words):
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(model.width, model.width)))
    for path in files.glob("*_f.npy"):
        np.save(path, (np.load(path) @ turn).astype(np.float32)[:, :width])
    with pytest.raises(MisalignedArtifactError, match=words):
        run_imported_clip(scene, files, tmp_path / "out", ClipSettings(model=str(model.model.folder)))
    assert not (tmp_path / "out").exists()
