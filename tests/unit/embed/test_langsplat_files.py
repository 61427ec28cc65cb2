"""LangSplat's files: exported files are read back, and files of other programs are checked."""

from pathlib import Path

import numpy as np
import pytest

from hilsplat.base.artifacts import read_index, read_npy, write_index
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.base.images import read_image
from hilsplat.embed.clip import ClipModel
from hilsplat.embed.langsplat_export import maps_of, write_langsplat
from hilsplat.embed.langsplat_files import read_clip, read_masks, read_view
from hilsplat.segment.digests import digest_of, index_entry
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.settings import ClipSettings
from tests.unit.segment.handmade import pack, save_scene

SIZE = (6, 8)


def nested() -> HierarchicalMasks:
    """A whole, in it a part, in that two subparts."""
    dense = np.zeros((4, *SIZE), bool)
    dense[0, 1:, 1:7] = True
    dense[1, 2:5, 2:6] = True
    dense[2, 2, 2] = dense[3, 4, 3:5] = True
    masks = pack(dense, [1, 2, 3, 3])
    return masks.take(masks.content_order())


def unit_rows(number: int) -> np.ndarray:
    vectors = np.random.default_rng(number).normal(size=(number, 512))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float16)


@pytest.fixture
def ours(tmp_path) -> tuple[Path, Path]:
    """Folders of masks and vectors of two views."""
    masks = nested()
    names = ("a.png", "b.png")
    (tmp_path / "clip").mkdir()
    for name in names:
        masks.save(tmp_path / "masks" / f"{name}.npz")
        np.save(tmp_path / "clip" / f"{name}.npy", unit_rows(4))
    for folder in ("masks", "clip"):
        write_index(tmp_path / folder, dict.fromkeys(names, index_entry(masks)), scene="set/scene")
    return tmp_path / "masks", tmp_path / "clip"


@pytest.fixture
def scene(tmp_path) -> Path:
    """A posed scene of two noisy training views."""
    images = np.random.default_rng(0).integers(0, 255, (2, *SIZE, 3), np.uint8)
    return save_scene(tmp_path / "scene", {"a.png": images[0], "b.png": images[1]})


def test_maps_by_hand():
    maps, rows = maps_of(nested())
    assert maps.dtype == np.float32
    # default: all four masks, the small ones on top; then s, m, l, rows counted through
    assert rows.tolist() == [0, 1, 2, 3, 2, 3, 1, 0]
    # the larger subpart comes first
    assert (maps[0, 1, 1], maps[0, 3, 3], maps[0, 4, 3], maps[1, 4, 3], maps[1, 2, 2]) == (0, 1, 2, 4, 5)
    assert (set(np.unique(maps[2])), set(np.unique(maps[3])), maps[3, 0, 0]) == ({-1, 6}, {-1, 7}, -1)


def test_exported_files_are_read_back(ours, scene, tmp_path):
    write_langsplat(*ours, tmp_path / "files")
    names = sorted(path.name for path in (tmp_path / "files").glob("*.npy"))
    assert names == ["a_f.npy", "a_s.npy", "b_f.npy", "b_s.npy"]
    maps, vectors = (np.load(tmp_path / "files" / f"a_{kind}.npy", allow_pickle=False) for kind in "sf")
    assert (maps.shape, maps.dtype, vectors.shape, vectors.dtype) == ((4, *SIZE), "f4", (8, 512), "f4")
    read_masks(scene, tmp_path / "files", tmp_path / "again")
    found = HierarchicalMasks.load(tmp_path / "again" / "a.png.npz")
    # masks of a level do not overlap here, so nothing was painted over
    for name in ("runs", "offsets", "level", "area_px", "box_xyxy"):
        np.testing.assert_array_equal(getattr(found, name), getattr(nested(), name), err_msg=name)
    assert read_index(tmp_path / "again")["views"]["a.png"] == index_entry(found)
    _, clip = read_view(tmp_path / "files", "a.png", SIZE)
    np.testing.assert_allclose(clip.astype(float), unit_rows(4).astype(float), atol=1e-3)


def test_levels_have_the_reverse_order_in_the_files(tmp_path):
    maps = np.full((4, 2, 4), -1, np.float32)
    maps[0] = 0  # mixed: left out
    maps[1, 0, 0], maps[2, 0, 1], maps[3, 0, 2] = 1, 2, 3
    np.save(tmp_path / "x_s.npy", maps)
    np.save(tmp_path / "x_f.npy", np.eye(4, 5, dtype=np.float32) * 3)
    masks, vectors = read_view(tmp_path, "x.y.jpg", (2, 4))
    assert masks.level.tolist() == [1, 2, 3]
    assert masks.box_xyxy[:, 0].tolist() == [2, 1, 0]
    np.testing.assert_array_equal(vectors, np.eye(5, dtype=np.float16)[[3, 2, 1]])
    np.save(tmp_path / "x_s.npy", np.full((4, 2, 4), -1, np.float32))
    np.save(tmp_path / "x_f.npy", np.zeros((0, 5), np.float32))
    masks, vectors = read_view(tmp_path, "x.jpg", (2, 4))
    assert (len(masks), vectors.shape) == (0, (0, 5))


def test_maps_of_another_size_are_resized_and_of_another_shape_refused(ours, tmp_path):
    write_langsplat(*ours, tmp_path / "files")
    with pytest.raises(MisalignedArtifactError, match=r"in aspect ratio(.|\n)*\(12, 12\)(.|\n)*\(6, 8\)"):
        read_view(tmp_path / "files", "a.png", (12, 12))
    masks, _ = read_view(tmp_path / "files", "a.png", (12, 16))
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
        read_view(tmp_path, "a.png", SIZE)


def test_missing_files_are_reported_and_half_of_the_views_need_them(ours, scene, tmp_path, caplog):
    write_langsplat(*ours, tmp_path / "files")
    (tmp_path / "files" / "b_s.npy").unlink()
    read_masks(scene, tmp_path / "files", tmp_path / "out")
    assert "lacks the maps of 1 of 2 training views of set/scene: b_s.npy" in caplog.text
    assert list(read_index(tmp_path / "out")["views"]) == ["a.png"]
    (tmp_path / "files" / "a_s.npy").unlink()
    with pytest.raises(ArtifactError, match=r"lacks the maps of 2 of 2 training views(.|\n)*b_s.npy"):
        read_masks(scene, tmp_path / "files", tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_views_that_differ_only_after_a_dot_are_refused(ours, tmp_path):
    for folder in ours:
        write_index(folder, dict.fromkeys(("a.1.png", "a.2.png"), index_entry(nested())), scene="set/scene")
    with pytest.raises(ArtifactError, match=r"a.1.png, a.2.png"):
        write_langsplat(*ours, tmp_path / "files")


def test_vectors_of_other_masks_are_refused(ours, tmp_path):
    write_index(ours[1], {"a.png": index_entry(nested())}, scene="set/scene")
    with pytest.raises(MisalignedArtifactError, match=r"clip .*different masks \(view b\.png\)"):
        write_langsplat(*ours, tmp_path / "files")


@pytest.fixture
def embedded(ours, scene, tmp_path, project) -> ClipModel:
    """LangSplat's files of the scene, with vectors of clip-tiny."""
    model = ClipModel.load(project / "models/clip-tiny")
    for name in ("a.png", "b.png"):
        image = read_image(scene / "images" / name)
        vectors = model.embed_masks(image, nested(), ClipSettings(crop="langsplat"))
        np.save(ours[1] / f"{name}.npy", vectors)
    write_langsplat(*ours, tmp_path / "files")
    return model


def test_vectors_of_the_same_clip_are_accepted(embedded, scene, tmp_path):
    settings = ClipSettings(model=str(embedded.model.folder))
    read_clip(scene, tmp_path / "files", tmp_path / "out", settings)
    index = read_index(tmp_path / "out")
    assert (index["dim"], index["model"]) == (embedded.width, settings.model)
    masks, vectors = read_view(tmp_path / "files", "a.png", SIZE)
    assert index["views"]["a.png"] == {"masks_sha256": digest_of(masks), "masks": 4}
    np.testing.assert_array_equal(read_npy(tmp_path / "out" / "a.png.npy"), vectors)
    np.testing.assert_allclose(np.linalg.norm(vectors.astype(float), axis=1), 1, atol=2e-3)


@pytest.mark.parametrize(
    ("width", "words"),
    [
        (100, r"a_f.npy does not match the CLIP model in"),
        (None, r"were not computed by the CLIP model in(.|\n)*laion2b"),
    ],
)
def test_vectors_of_another_clip_are_refused(embedded, scene, tmp_path, width, words):
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(embedded.width, embedded.width)))
    for path in (tmp_path / "files").glob("*_f.npy"):
        np.save(path, (np.load(path) @ turn).astype(np.float32)[:, :width])
    with pytest.raises(MisalignedArtifactError, match=words):
        read_clip(scene, tmp_path / "files", tmp_path / "out", ClipSettings(model=str(embedded.model.folder)))
    assert not (tmp_path / "out").exists()
