"""Damaged artifacts raise an error that names them, or are read as before the damage; nothing crashes."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import hilsplat
from hilsplat.base.artifacts import read_npz, write_index, write_npy, write_npz
from hilsplat.base.errors import ArtifactError, HilsplatError
from hilsplat.contributions.rows import Contributions
from hilsplat.embed.vectors import mask_embeddings
from hilsplat.field.code import LanguageField, load_code, load_latents
from hilsplat.field.contrast import read_parents
from hilsplat.query.node_names import NodeNaming
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import digests_in, index_entry, load_masks
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.semantic_tree.tree import SemanticTree
from tests.damage.mutations import mutated_bytes
from tests.unit.artifact_changes import change_index, flip_bit
from tests.unit.finished_desk import SCENE


def flattened(found: Any) -> list[np.ndarray]:
    """Return all arrays, numbers and texts in an object, for comparison."""
    if isinstance(found, np.ndarray):
        return [found]
    if isinstance(found, Path) or callable(found) or found is None:
        return []
    if isinstance(found, dict):
        return [each for key in sorted(found, key=str) for each in flattened(found[key])]
    if isinstance(found, list | tuple):
        return [each for part in found for each in flattened(part)]
    if hasattr(found, "__dict__"):
        return flattened({key: value for key, value in vars(found).items() if not key.startswith("__")})
    return [np.asarray(found)]


def equal(one: Any, other: Any) -> bool:
    """Return whether two objects have equal content."""
    pairs = flattened(one), flattened(other)
    return len(pairs[0]) == len(pairs[1]) and all(map(np.array_equal, *pairs))


def _masks(folder: Path) -> Any:
    masks = folder / "default/masks"
    return [load_masks(masks, view, digests_in(masks)) for view in digests_in(masks)]


def _scene(folder: Path) -> Any:
    scene = Scene.load(folder / "scene")
    return vars(scene), [scene.image(view) for view in scene.views()]


def _contributions(folder: Path) -> Any:
    found = Contributions.load(folder / "default/contributions")
    matrices = [found.matrix(name) for name in ("A", "A_half", "S", "mass")]
    parts = [[matrix.data, matrix.indices, matrix.indptr] for matrix in matrices]
    form = found.quadratic()
    ones = np.ones((found.num_gaussians, 3, 2), np.float32)
    return found, parts, found.means(), found.centres(), form.product(ones)


def _field(folder: Path) -> Any:
    variant = folder / "default"
    contributions = Contributions.load(variant / "contributions")
    return (
        LanguageField.load(variant / "field.safetensors"),
        load_code(variant / "autoencoder").decode_array(np.ones((2, 2), np.float32)[:, :2]),
        load_latents(variant / "autoencoder", contributions),
        read_parents(variant / "coverage_tree", contributions),
    )


def _tree(folder: Path) -> Any:
    tree, clip = folder / "default/semantic_tree", folder / "default/clip"
    return SemanticTree.load(tree, clip), NodeNaming.load(folder / "default/names", tree, clip)


READERS: dict[str, tuple[Callable[[Path], Any], tuple[str, ...]]] = {
    "scene": (_scene, ("scene",)),
    "masks": (_masks, ("default/masks",)),
    "contributions": (_contributions, ("default/contributions",)),
    "field": (_field, ("default/autoencoder", "default/coverage_tree", "default/field.safetensors")),
    "tree": (_tree, ("default/semantic_tree", "default/clip", "default/names")),
}


@pytest.fixture(scope="module")
def desk(desk_project, tmp_path_factory) -> Path:
    return Path(shutil.copytree(desk_project, tmp_path_factory.mktemp("damaged") / "project")) / SCENE


@pytest.fixture(scope="module")
def whole(desk) -> dict[str, Any]:
    return {name: read(desk) for name, (read, _) in READERS.items()}


@pytest.mark.parametrize("name", READERS)
@given(data=st.data(), rnd=st.randoms(use_true_random=True))
@settings(suppress_health_check=list(HealthCheck))
def test_damaged_bytes(desk, whole, name, data, rnd):
    read, places = READERS[name]
    files = [path for place in places for path in [desk / place, *sorted((desk / place).rglob("*"))]]
    path = data.draw(st.sampled_from([path for path in files if path.is_file()]), label="file")
    content = path.read_bytes()
    try:
        path.write_bytes(mutated_bytes(rnd, content))
        assert equal(read(desk), whole[name])
    except HilsplatError as error:
        assert path.name.partition(".")[0] in str(error) or path.parent.name in str(error)
    finally:
        path.write_bytes(content)


# ---- arrays whose checksums match ----


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


def read_damaged(kind: type, path: Path, arrays: dict[str, np.ndarray], damage: tuple) -> Any:
    """Read damaged arrays; return None if they are refused by an error that names the file."""
    write_npz(path, **damaged(arrays, damage))
    try:
        return kind.load(path)
    except HilsplatError as error:
        assert path.name in str(error)
        return None


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(damage=damages([*some_masks().arrays()]))
def test_damaged_masks(damage, tmp_path):
    whole = some_masks()
    found = read_damaged(HierarchicalMasks, tmp_path / "view.npz", whole.arrays(), damage)
    name, kind, *_ = damage
    if found is None or (kind == "value" and name in ("predicted_iou", "stability")):
        return  # any score in the valid range is accepted
    if (name, kind) == ("level", "value"):
        assert set(found.level.tolist()) <= {1, 2, 3}
        return
    assert equal(found, whole), damage


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(damage=damages(["names", "cam_from_world", "K", "size_hw"]))
def test_damaged_cameras(damage, tmp_path):
    whole, path = some_cameras(), tmp_path / "cameras.npz"
    whole.save(path)
    found = read_damaged(Cameras, path, read_npz(path), damage)
    if found is None:
        return
    if damage[1] == "value":  # other numbers are accepted if they are valid for a camera
        assert np.isfinite(found.cam_from_world).all() and (found.size_hw > 0).all()
        return
    assert equal(found, whole), damage


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("level", lambda values: values + 8, "level contains an impossible value"),
        ("offsets", lambda values: values[::-1].copy(), "offsets contains an impossible value"),
        ("offsets", lambda values: values + 2**40, "offsets contains an impossible value"),
        ("runs", lambda values: values * 1000, "runs contains an impossible value"),
        ("runs", lambda values: values[:, None], "runs has the wrong type or shape"),
        ("area_px", lambda values: values + 1, "area_px contains an impossible value"),
        ("box_xyxy", lambda values: values + 1, "box_xyxy contains an impossible value"),
        ("predicted_iou", lambda values: values * np.nan, "predicted_iou contains an impossible value"),
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


def test_a_query_never_answers_from_a_file_with_a_flipped_bit(desk):
    def ask() -> list[Any]:
        opened = hilsplat.open_scene(desk)
        return [
            [hit.score, hit.gaussians]
            for how in ("tree", "field")
            for hit in opened.query("mug", answerer=how)
        ]

    expected, refused = ask(), set()
    files = [path for path in sorted(desk.rglob("*")) if path.is_file() and "/." not in str(path)]
    for number, path in enumerate(files, 1):
        content = flip_bit(path, 0.6, number)
        try:
            assert equal(ask(), expected), path
        except HilsplatError:
            refused.add(path.name)
        finally:
            path.write_bytes(content)
    assert refused >= {
        "gaussians.ply",
        "field.safetensors",
        "autoencoder.safetensors",
        "tree.npz",
        "cameras.npz",
    }
