"""K-means: centroids and groups known by construction."""

import os
import subprocess
import sys

import numpy as np
import pytest

from hilsplat.methods.common.quantise import kmeans


def test_centroids_are_the_means_of_groups_and_every_row_knows_its_own():
    groups = np.float32([[0, 0], [9, 0], [0, 0.2], [9, 0.2]])
    centroids, nearest = kmeans(groups, 2, seed=0)
    assert centroids[nearest] == pytest.approx(np.float32([[0, 0.1], [9, 0.1], [0, 0.1], [9, 0.1]]))
    assert centroids.dtype == np.float32 and nearest.dtype == np.int64


@pytest.mark.parametrize("seed", range(5))
def test_distant_starts_find_separated_groups_in_one_round(seed):
    rng = np.random.default_rng(seed)
    rows = np.repeat(np.float32([[0, 0], [50, 0], [0, 50]]), 10, axis=0)
    _, nearest = kmeans(rows + 0.01 * rng.random(rows.shape).astype(np.float32), 3, seed, rounds=1)
    found = nearest.reshape(3, 10)
    assert (found == found[:, :1]).all() and len(np.unique(found)) == 3


def test_more_centroids_than_different_rows_repeat_the_first_of_them():
    rows = np.float32([[1, 2], [3, 4], [1, 2]])
    centroids, nearest = kmeans(rows, 4, seed=1)
    assert (centroids[nearest] == rows).all()
    assert len(np.unique(centroids, axis=0)) == 2 and (centroids[2:] == centroids[0]).all()


def test_no_rows_have_no_groups():
    centroids, nearest = kmeans(np.zeros((0, 2), np.float32), 3, seed=0)
    assert centroids.tolist() == [[0, 0]] * 3 and len(nearest) == 0


def test_the_same_seed_gives_the_same_bytes_on_any_number_of_threads():
    code = (
        "import numpy as np; from hilsplat.methods.common.quantise import kmeans;"
        "rows = np.random.default_rng(0).normal(size=(5000, 16)).astype(np.float32);"
        "centroids, nearest = kmeans(rows, 100, 3, 5);"
        "import hashlib; print(hashlib.sha256(centroids.tobytes() + nearest.tobytes()).hexdigest())"
    )
    found = {
        subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for threads in ("1", "2")
    }
    assert len(found) == 1
