"""Damaged mask and camera files raise an error that names them; they never crash or give other masks."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hilsplat.base.artifacts import read_npz, write_index, write_npy, write_npz
from hilsplat.base.errors import ArtifactError, HilsplatError
from hilsplat.embed.vectors import mask_embeddings
from hilsplat.scene.cameras import Cameras
from hilsplat.segment.digests import index_entry
from hilsplat.segment.masks import HierarchicalMasks
from tests.unit.artifact_changes import change_index

FEW = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def some_masks() -> HierarchicalMasks:
    rng = np.random.default_rng(3)
    dense = rng.random((4, 9, 7)) < 0.4
    dense[:, 4, 3] = True
    scores = np.linspace(0.5, 0.9, 4).astype(np.float32)
    return HierarchicalMasks.from_dense(dense, np.array([1, 2, 3, 3], np.uint8), scores, scores)


def some_cameras() -> Cameras:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = range(3)
    K = np.tile(np.diag([30.0, 30, 1]), (3, 1, 1))
    return Cameras(("a.png", "b.png", "c.png"), poses, K, np.full((3, 2), (24, 36), np.int32))


def damages(names: list[str]):
    """Draw a change of one array in an archive."""
    kind = st.sampled_from(["drop", "shape", "dtype", "value", "cut", "add"])
    return st.tuples(st.sampled_from(names), kind, st.integers(0, 10_000), st.integers(-(2**40), 2**40))


def damaged(arrays: dict[str, np.ndarray], damage: tuple[str, str, int, int]) -> dict[str, np.ndarray]:
    name, kind, place, value = damage
    array = arrays[name].copy()
    if kind == "drop":
        return {other: arrays[other] for other in arrays if other != name}
    if kind == "add":
        return {**arrays, "more": array}
    if kind == "shape":
        array = array[..., None]
    elif kind == "dtype":
        other = {"i": np.float64, "u": np.float64, "U": np.bytes_}.get(array.dtype.kind, np.int16)
        array = array.astype([other, np.str_][place % 2])
    elif kind == "cut":
        array = array[: place % max(len(array), 1)]
    elif array.dtype.kind in "iu":
        array.reshape(-1)[place % array.size] = np.int64(value).astype(array.dtype)
    elif array.dtype.kind == "f":
        array.reshape(-1)[place % array.size] = [np.nan, np.inf, -np.inf, float(value)][place % 4]
    return {**arrays, name: array}


def same(found, whole) -> bool:
    return all(np.array_equal(getattr(found, name), getattr(whole, name)) for name in vars(whole))


@FEW
@given(damage=damages([*some_masks().arrays()]))
def test_damaged_masks(damage, tmp_path):
    whole = some_masks()
    write_npz(tmp_path / "view.npz", **damaged(whole.arrays(), damage))
    try:
        found = HierarchicalMasks.load(tmp_path / "view.npz")
    except HilsplatError as error:
        assert "view.npz" in str(error)
        return
    for other in ("predicted_iou", "stability"):  # any score in the valid range is accepted
        if damage[0] == other and damage[1] == "value":
            return
    if damage[:2] == ("level", "value"):
        assert set(found.level.tolist()) <= {1, 2, 3}
        return
    assert same(found, whole), damage


@FEW
@given(damage=damages(["names", "cam_from_world", "K", "size_hw"]))
def test_damaged_cameras(damage, tmp_path):
    whole = some_cameras()
    whole.save(tmp_path / "cameras.npz")
    write_npz(tmp_path / "cameras.npz", **damaged(read_npz(tmp_path / "cameras.npz"), damage))
    try:
        found = Cameras.load(tmp_path / "cameras.npz")
    except HilsplatError as error:
        assert "cameras.npz" in str(error)
        return
    if damage[1] == "value":  # other numbers are accepted if they are valid for a camera
        assert np.isfinite(found.cam_from_world).all() and (found.size_hw > 0).all()
        return
    assert same(found, whole), damage


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("level", lambda values: values + 8, "level cannot be right"),
        ("offsets", lambda values: values[::-1].copy(), "offsets cannot be right"),
        ("offsets", lambda values: values + 2**40, "offsets cannot be right"),
        ("runs", lambda values: values * 1000, "runs cannot be right"),
        ("runs", lambda values: values[:, None], "runs cannot be used"),
        ("area_px", lambda values: values + 1, "area_px cannot be right"),
        ("box_xyxy", lambda values: values + 1, "box_xyxy cannot be right"),
        ("predicted_iou", lambda values: values * np.nan, "predicted_iou cannot be right"),
    ],
)
def test_each_array_of_masks_is_checked(tmp_path: Path, name, change, words):
    arrays = some_masks().arrays()
    write_npz(tmp_path / "view.npz", **{**arrays, name: change(arrays[name])})
    with pytest.raises(ArtifactError, match=words):
        HierarchicalMasks.load(tmp_path / "view.npz")


@pytest.mark.parametrize("fault", [np.nan, np.inf, 0.5])
def test_clip_vectors_are_of_length_one(tmp_path, fault):
    masks, clip = tmp_path / "masks", tmp_path / "clip"
    entry = {"a.png": index_entry(some_masks())}
    vectors = np.eye(4, 6, dtype=np.float16)
    write_npy(clip / "a.png.npy", vectors)
    for folder in (masks, clip):
        write_index(folder, entry, scene="a/b")
    assert mask_embeddings(clip, masks).shape == (4, 6)
    vectors[2] *= fault
    write_npy(clip / "a.png.npy", vectors)
    change_index(clip)
    with pytest.raises(ArtifactError, match=r"1 CLIP vectors of a\.png"):
        mask_embeddings(clip, masks)
