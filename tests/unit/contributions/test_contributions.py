"""A and G compared with their definitions, and the files of the stage."""

import errno
import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.base.arrays import Scratch
from hilsplat.base.artifacts import read_index, write_index
from hilsplat.base.errors import MemoryLimitError, MisalignedArtifactError
from hilsplat.base.levels import Level
from hilsplat.base.lineage import sha256_of_path
from hilsplat.contributions import quadratic_builder, stage
from hilsplat.contributions.compositing import normalised_weights
from hilsplat.contributions.quadratic import Gram, StackedWeights, form, level_mass
from hilsplat.contributions.quadratic_builder import GramBuilder, QuadraticBuilder, stack_weights
from hilsplat.contributions.rows import Contributions
from hilsplat.contributions.stage import run_contributions
from hilsplat.contributions.view_matrices import label_maps, labelled_rows, random_half, view_contributions
from hilsplat.embed.vectors import mask_embeddings
from hilsplat.segment.digests import index_entry
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.settings import ContributionsSettings
from tests.unit.segment.handmade import pack
from tests.unit.two_boxes_world import (
    HEIGHT,
    NUM_GAUSSIANS,
    REGIONS,
    WIDTH,
    build_contributions,
    two_boxes_weights,
)

SIZE = (9, 7)
PIXELS = 63
IN_MEMORY = Scratch(Path(tempfile.gettempdir()), math.inf)


def random_view(seed: int, num_gaussians: int = 40) -> tuple[sp.csr_matrix, HierarchicalMasks]:
    """Weights and masks; some pixels are nearly transparent, and masks overlap within and across levels."""
    rng = np.random.default_rng(seed)
    weights = sp.random(PIXELS, num_gaussians, 0.15, random_state=rng, dtype=np.float32, format="csr")
    weights = weights.multiply(1 / np.maximum(weights.sum(axis=1), 1e-9)).tocsr()
    weights = sp.diags(np.where(rng.random(PIXELS) < 0.2, 0.3, 0.98)) @ weights
    dense = rng.random((8, *SIZE)) < rng.uniform(0.1, 0.6, (8, 1, 1))
    level = [1, 1, 1, 2, 2, 3, 3, 3]
    return weights.astype(np.float32).tocsr(), pack(dense, level)


def labelled_part(seed: int) -> StackedWeights:
    """The labelled rows of a random view."""
    raw, masks = random_view(seed)
    return labelled_rows(normalised_weights(raw), label_maps(masks))


def matrix(arrays: dict[str, np.ndarray], name: str, columns: int) -> np.ndarray:
    parts = arrays[f"{name}_data"], arrays[f"{name}_indices"], arrays[f"{name}_indptr"]
    return sp.csr_matrix(parts, shape=(len(parts[2]) - 1, columns)).toarray()


def test_normalised_rows_sum_to_one_or_are_empty():
    weights = sp.csr_matrix(np.array([[0.6, 0.3, 0], [0.1, 0.2, 0], [0, 0, 0]], np.float32))
    normalised = normalised_weights(weights)
    assert normalised.toarray() == pytest.approx(np.array([[2 / 3, 1 / 3, 0], [0, 0, 0], [0, 0, 0]]))


@pytest.mark.parametrize("seed", range(3))
def test_mask_means_equal_their_definition(seed):
    raw, masks = random_view(seed)
    weights = normalised_weights(raw)
    arrays = view_contributions("v", weights, masks)
    dense = weights.toarray().astype(np.float64)
    covered = dense.sum(axis=1) > 0
    half = random_half("v", PIXELS)
    labels = label_maps(masks)
    A, A_half, S = (matrix(arrays, name, 40) for name in ("A", "A_half", "S"))
    for row in range(len(masks)):
        painted = (labels == row).any(axis=1) & covered
        assert arrays["pixels"][row] == painted.sum()
        assert arrays["half_pixels"][row] == (painted & half).sum()
        assert A[row] == pytest.approx(dense[painted].mean(axis=0), abs=1e-6)
        if (painted & half).any():
            assert A_half[row] == pytest.approx(dense[painted & half].mean(axis=0), abs=1e-6)
        raw_mask = masks.dense(np.array([row]))[0].ravel()
        assert S[row] == pytest.approx(dense[raw_mask].sum(axis=0), abs=1e-5)
    mass = np.zeros(dense.shape[1])
    mass[arrays["mass_indices"]] = arrays["mass_data"]
    assert mass == pytest.approx(dense.sum(axis=0), abs=1e-5)
    for threads in (2, 20):
        again = view_contributions("v", weights, masks, threads)
        assert all(arrays[name].tobytes() == again[name].tobytes() for name in arrays)


def built(
    parts: list[StackedWeights], threads: int = 1, keep: str | None = None, arrays: Scratch = IN_MEMORY
) -> Gram | StackedWeights:
    """Build G, or with `keep` G or W."""
    more = threads, arrays
    builder = QuadraticBuilder(40, keep, len(parts), *more) if keep else GramBuilder(40, *more)
    for part in parts:
        builder.add(part)
    return builder.finish()


def assert_same(one: Gram | StackedWeights, other: Gram | StackedWeights) -> None:
    arrays = ("values", one, other) if isinstance(one, Gram) else ("data", one.weights, other.weights)
    for name in ("indptr", "indices", arrays[0]):
        assert getattr(arrays[1], name).tobytes() == getattr(arrays[2], name).tobytes()


@pytest.mark.parametrize("channels", [1, 4, 16, 17])
def test_gram_and_weights_give_the_quadratic_form_of_every_level(channels):
    stacked, dense = [], np.zeros((3, 40, 40))
    for seed in range(3):
        raw, masks = random_view(seed)
        weights, labels = normalised_weights(raw), label_maps(masks)
        full = weights.toarray().astype(np.float64)
        stacked.append(labelled_rows(weights, labels))
        for index in range(3):
            valid = labels[:, index] >= 0
            dense[index] += full[valid].T @ full[valid]
    gram = built(stacked)
    features = np.random.default_rng(5).normal(size=(40, 3, channels)).astype(np.float32)
    expected = np.einsum("lij,jld->ild", dense, features)
    for each in (gram, stack_weights(list(stacked), IN_MEMORY)):
        assert each.product(features) == pytest.approx(expected, abs=1e-5)
        assert form(each, features) == pytest.approx((features * expected).sum(), rel=1e-6)
        own, others = each.block(10, 30).product(features[10:30]), each.across(10, 30, features)
        assert own == pytest.approx(
            np.einsum("lij,jld->ild", dense[:, 10:30, 10:30], features[10:30]), abs=1e-5
        )
        assert own + others == pytest.approx(expected[10:30], abs=1e-5)
    # entry by entry: unit vectors pick columns
    columns = np.repeat(np.eye(40, dtype=np.float32)[:, None], 3, axis=1)
    assert gram.product(columns).transpose(1, 0, 2) == pytest.approx(dense, abs=1e-6)
    blocks = ((0, 15), (15, 40)) if channels > 1 else ((0, 40),)
    # rows of W sum to 1, so G 1 is the mass in labelled pixels
    assert level_mass(gram, blocks) == pytest.approx(dense.sum(axis=2).T, abs=1e-5)


@pytest.mark.parametrize("merge_at", [0, 1, 8])
def test_gram_depends_neither_on_threads_nor_on_how_the_pixels_are_divided(merge_at, monkeypatch):
    monkeypatch.setattr(quadratic_builder, "MERGE_AT", merge_at)
    parts = [labelled_part(seed) for seed in range(4)]
    one = built([stack_weights(list(parts), IN_MEMORY)])
    assert_same(built(parts), one)
    assert_same(built(parts, threads=2), one)
    assert_same(built(parts, keep="gram"), one)
    # too many weights to hold: G of any size
    monkeypatch.setattr(quadratic_builder, "MAX_WEIGHTS", parts[0].nonzeros)
    assert_same(built(parts, keep="auto"), one)


@pytest.mark.parametrize("memory_bytes", [0.0, 10_000.0])
def test_sums_in_files_are_the_same(memory_bytes, tmp_path):
    parts = [labelled_part(seed) for seed in range(4)]
    arrays = Scratch(tmp_path, memory_bytes)
    for keep in ("gram", "weights"):
        assert_same(built(parts, 2, keep, arrays), built(parts, keep=keep))
    assert not list(tmp_path.iterdir())


def test_a_full_disk_ends_the_sums_with_its_error(tmp_path, monkeypatch):
    builder = GramBuilder(40, 1, Scratch(tmp_path))

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full)
    with pytest.raises(OSError, match="No space left"):
        builder.add(labelled_part(0))


def test_scratch_keeps_arrays_in_memory_up_to_its_limit(tmp_path):
    arrays = Scratch(tmp_path, 100.0)
    first, second = arrays.empty(10, np.float64), arrays.empty((2, 2), np.float64)
    assert first.base is None
    assert second.base is not None  # in a file
    del first
    assert arrays.empty(10, np.float64).base is None


@pytest.mark.parametrize("keep", ["auto", "weights", "gram"])
def test_a_builder_resumes_from_its_state(keep):
    parts = [labelled_part(seed) for seed in range(3)]
    first, second = (QuadraticBuilder(40, keep, 3, 1, IN_MEMORY) for _ in range(2))
    first.add(parts[0])
    first.add(parts[1])
    second.restore(first.state())
    second.add(parts[2])
    whole, resumed = built(parts, keep=keep), second.finish()
    assert type(whole) is type(resumed)
    assert_same(whole, resumed)


def test_a_view_that_needs_more_memory_is_refused(two_boxes):
    inputs = two_boxes.scene, two_boxes.ply, two_boxes.masks, two_boxes.folder / "out", two_boxes.folder / "c"
    with pytest.raises(MemoryLimitError, match=r"96 Gaussians in a view of(.|\n)*poses.max_side_px"):
        run_contributions(*inputs, ContributionsSettings(), 1, memory_mib=100.0)


def test_the_smaller_quadratic_is_kept_and_read_back_equal(two_boxes):
    read, inputs = {}, (two_boxes.scene, two_boxes.ply, two_boxes.masks)
    for keep in ("gram", "weights", "auto"):
        out = two_boxes.folder / keep
        run_contributions(*inputs, out, out / "cache", ContributionsSettings(keep=keep), 1)
        read[keep] = Contributions.load(out).quadratic()
    assert (type(read["gram"]), type(read["weights"])) == (Gram, StackedWeights)
    assert read["auto"].nonzeros == min(read["gram"].nonzeros, read["weights"].nonzeros)
    features = np.random.default_rng(5).normal(size=(NUM_GAUSSIANS, 3, 4)).astype(np.float32)
    expected = read["gram"].product(features)
    assert read["weights"].product(features) == pytest.approx(expected, rel=1e-5, abs=1e-5)


def test_stage_writes_rows_in_view_order_and_masses(two_boxes_contributions):
    world, out = two_boxes_contributions
    found = Contributions.load(out)
    assert found.views == world.views  # the test view is held out
    assert len(found) == 4 * (len(REGIONS) - 1)
    assert found.view.tolist() == np.repeat(range(4), 6).tolist()
    assert found.mask.tolist() == list(range(6)) * 4
    # view 0 misses region 3, "A bottom": A, B, A top, B top, A top left, B corner
    assert found.level[:6].tolist() == [1, 1, 2, 2, 3, 3]
    assert found.pixels[:6].tolist() == [48, 48, 24, 24, 8, 6]
    assert found.rows_of(Level.SUBPART)[:2].tolist() == [4, 5]
    assert [rows.tolist() for rows in found.rows_of_views()] == np.arange(24).reshape(4, 6).tolist()
    assert np.ravel(found.matrix("mass").sum(axis=1)) == pytest.approx([HEIGHT * WIDTH] * 4, rel=1e-5)
    A = found.matrix("A").toarray()
    assert A.sum(axis=1) == pytest.approx(np.ones(len(found)), abs=1e-5)
    weights = normalised_weights(two_boxes_weights(0))
    corner = weights.toarray().reshape(HEIGHT, WIDTH, -1)[6:8, 6:9].reshape(6, -1).mean(axis=0)
    assert A[5] == pytest.approx(corner, abs=1e-6)
    assert mask_embeddings(world.clip, found.folder).shape == (24, 16)


@pytest.mark.parametrize("is_damaged", [False, True], ids=["whole", "without one file"])
def test_a_killed_run_resumes_from_its_checkpoint_if_it_is_whole(two_boxes, monkeypatch, is_damaged):
    settings, folder, drawn = ContributionsSettings(keep="gram"), two_boxes.folder, []
    last = two_boxes.views[2]
    weights, inputs = stage.pixel_weights, (two_boxes.scene, two_boxes.ply, two_boxes.masks)

    def run(out: str, cache: str, threads: int = 1) -> str:
        run_contributions(*inputs, folder / out, folder / cache, settings, threads)
        return sha256_of_path(folder / out)

    def counted(gaussians, camera, **more):
        drawn.append(camera.name)
        if camera.name == last:
            raise KeyboardInterrupt
        return weights(gaussians, camera, **more)

    expected = run("whole", "other cache", threads=2)
    monkeypatch.setattr(quadratic_builder, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(stage, "pixel_weights", counted)
    with pytest.raises(KeyboardInterrupt):
        run("out", "cache")
    last = ""
    drawn.clear()  # also of a view that was drawn ahead
    if is_damaged:
        min((folder / "cache").rglob("*.npy")).unlink()
    assert run("out", "cache") == expected
    # views in the checkpoint are not drawn again
    assert drawn == list(two_boxes.views[0 if is_damaged else 2 :])
    assert not list((folder / "cache").rglob("*.npy"))  # the checkpoint is removed


def test_masks_of_another_size_are_refused(two_boxes):
    view = two_boxes.views[1]
    wrong = pack(np.ones((1, 4, 4)))
    wrong.save(two_boxes.masks / f"{view}.npz")
    index = read_index(two_boxes.masks)["views"]
    write_index(two_boxes.masks, {**index, view: index_entry(wrong)}, segmenter="sam")
    with pytest.raises(MisalignedArtifactError, match=r"masks of view 001.png do not match the size"):
        build_contributions(two_boxes)
