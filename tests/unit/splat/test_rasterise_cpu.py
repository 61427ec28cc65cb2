"""Threads, bands of tiles, notice and choice of the device; the CUDA backend without a device."""

import logging
import subprocess
import sys
from dataclasses import replace

import gsplat
import numpy as np
import pytest

from hilsplat.base.errors import DeviceError
from hilsplat.splat.rasterise import binning, cuda, device, parity
from hilsplat.splat.rasterise.api import draw, pixel_weights
from hilsplat.splat.rasterise.binning import bin_gaussians, fill_lists
from hilsplat.splat.rasterise.device import choose_device
from hilsplat.splat.rasterise.project import GEOMETRY
from tests.unit.splat import gsplat_on_cpu
from tests.unit.splat.rasterise_scenes import camera, random_gaussians


def everything(threads: int) -> list[np.ndarray]:
    """Images, gradients and weights of one scene."""
    gaussians, view = random_gaussians(300, seed=5), camera(70, 90)
    features = np.linspace(-1, 1, 1800, dtype=np.float32).reshape(300, 6)
    seen = draw(gaussians, view, 3, features=features, threads=threads, device="cpu")
    gradients = seen.gradients(2 * seen.image, np.ones_like(seen.alpha))
    matrix = pixel_weights(gaussians, view, min_weight=1e-3, threads=threads)
    sparse = [matrix.data, matrix.indices, matrix.indptr]
    return [seen.image, seen.alpha, *vars(gradients).values(), *sparse]


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_any_number_of_threads_gives_the_same_bytes(threads):
    for one, several in zip(everything(1), everything(threads), strict=True):
        np.testing.assert_array_equal(one, several)


@pytest.mark.parametrize("max_entries", [1, 50, 1000])
def test_bands_of_tiles_give_the_same_bytes(monkeypatch, max_entries):
    whole = everything(1)
    monkeypatch.setattr(binning, "MAX_ENTRIES", max_entries)
    for one, in_bands in zip(whole, everything(2), strict=True):
        np.testing.assert_array_equal(one, in_bands)


def test_bands_cover_all_tiles_within_the_limit(monkeypatch):
    tiles = binning.Tiles(2, np.empty(0, np.int32), np.array([0, 3, 3, 10, 12, 13]))
    assert tiles.bands() == [(0, 5)]
    monkeypatch.setattr(binning, "MAX_ENTRIES", 5)
    # tile 2 alone has 7 entries, more than the limit, and forms a band alone
    assert tiles.bands() == [(0, 2), (2, 3), (3, 5)]


def test_tiles_list_the_boxes_that_touch_them_front_to_back():
    rng = np.random.default_rng(0)
    low, high = (np.sort(rng.integers(0, side, (2, 50)), axis=0) for side in (50, 35))
    box = np.stack([low[0], low[1], high[0], high[1]], axis=1).astype(np.int32)
    box[::7, 1] = -1  # not drawn
    depths = rng.uniform(1, 2, 50).astype(np.float32)
    depths[10:20] = depths[10]  # equal depths stay in the order of the rows
    tiles = bin_gaussians(box, depths, (35, 50))
    order = np.argsort(depths, kind="stable")
    gaussian, reach = np.empty(tiles.tile_start[-1], np.int32), np.empty(tiles.tile_start[-1], np.uint16)
    flat, tile_end = np.ones((50, GEOMETRY), np.float32) * 1e-9, np.empty_like(tiles.tile_start)
    out = gaussian, reach, tile_end
    for begin, end in ((0, 5), (5, 6), (6, 12)):  # in pieces: as threads and bands fill them
        fill_lists(begin, end, 0, tiles.tiles_x, tiles.order, tiles.tile_start, box, flat, *out)
    assert (reach == 2**16 - 1).all()  # as wide as they are
    for tile in range(4 * 3):
        x, y = tile % 4 * 16, tile // 4 * 16
        touches = (box[:, 0] < x + 16) & (box[:, 1] >= x) & (box[:, 2] < y + 16) & (box[:, 3] >= y)
        expected = [i for i in order if touches[i] and box[i, 1] >= box[i, 0]]
        assert gaussian[tiles.tile_start[tile] : tile_end[tile]].tolist() == expected


def test_a_tile_lists_only_gaussians_that_reach_its_pixels():
    # along the diagonal of 2 x 2 tiles, (x - y)^2 / 2 px^2: the other two tiles are 1.5 px away at least
    box, order = np.array([[0, 31, 0, 31]], np.int32), np.zeros(1, np.int32)
    geometry = np.zeros((1, GEOMETRY), np.float32)
    geometry[0, :6] = 16, 16, 40, -80 + 1e-3, 40, -0.1
    gaussian, reach = np.empty(4, np.int32), np.empty(4, np.uint16)
    tile_start, tile_end = np.arange(5), np.empty(5, int)
    fill_lists(0, 4, 0, 2, order, tile_start, box, geometry, gaussian, reach, tile_end)
    assert (tile_end[:4] - tile_start[:4]).tolist() == [1, 0, 0, 1]
    assert reach[0] & 0b1000_0100_0010_0001 == 0b1000_0100_0010_0001  # its blocks on the diagonal


def test_gaussians_in_any_memory_order_give_the_same_weights():
    gaussians, view = random_gaussians(40, 2), camera(30, 20)
    turned = replace(gaussians, sh=np.asfortranarray(gaussians.sh), means=np.asfortranarray(gaussians.means))
    same, other = (pixel_weights(each, view, min_weight=0.0) for each in (gaussians, turned))
    assert (same != other).nnz == 0


# ---- compiling ------------------------------------------------------------------------------------

FILL_ONE_LIST = """
import logging, sys
logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(message)s")
import numpy as np
from hilsplat.splat.rasterise.binning import fill_lists
one = np.zeros(1, np.int32)
geometry, out = np.ones((1, 16), np.float32), (one.copy(), np.zeros(1, np.uint16), np.zeros(2, int))
fill_lists(0, 1, 0, 1, one, np.array([0, 1]), np.zeros((1, 4), np.int32), geometry, *out)
"""


def test_compiling_is_announced_once_and_only_when_it_happens(tmp_path):
    def log() -> str:
        environment = {"NUMBA_CACHE_DIR": str(tmp_path), "PATH": ""}
        command = [sys.executable, "-c", FILL_ONE_LIST]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout

    assert log().count("compiling kernels, which takes") == 1
    assert "compiling" not in log()


# ---- device ---------------------------------------------------------------------------------------


@pytest.fixture
def no_cuda(monkeypatch):
    """Simulate a machine with gsplat but without CUDA."""
    monkeypatch.setattr(device, "find_spec", lambda name: name)
    monkeypatch.setattr(device, "_has_driver", lambda: True)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    for cached in (device.cuda_problem, choose_device):
        cached.cache_clear()
    yield
    for cached in (device.cuda_problem, choose_device):
        cached.cache_clear()


@pytest.mark.usefixtures("no_cuda")
def test_without_cuda_auto_selects_the_cpu_and_cuda_is_an_error(caplog):
    with caplog.at_level(logging.INFO):
        assert choose_device("auto") == choose_device("auto") == "cpu"
    assert caplog.text.count("rasterising on cpu (device: auto") == 1
    assert "finds no CUDA device" in caplog.text
    with pytest.raises(DeviceError, match=r"device: cuda was requested(?s:.*)finds no CUDA device(?s:.*)gpu"):
        choose_device("cuda")


def test_the_cpu_is_selected_without_a_check_for_cuda(monkeypatch):
    monkeypatch.setattr(device, "cuda_problem", lambda: pytest.fail("it ran"))
    assert choose_device.__wrapped__("cpu") == "cpu"


# ---- CUDA backend with gsplat's reference implementation in torch ----------------------------------


@pytest.fixture
def without_device(monkeypatch):
    """gsplat's reference functions in place of its kernels."""
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    for name in ("rasterization", "spherical_harmonics", "rasterize_to_indices_in_range"):
        monkeypatch.setattr(gsplat, name, getattr(gsplat_on_cpu, name))


@pytest.mark.usefixtures("without_device")
def test_gsplats_reference_draws_what_our_kernels_draw():
    assert parity.disagreement("cpu", "cuda") is None


@pytest.mark.usefixtures("without_device")
@pytest.mark.parametrize(
    ("name", "value", "what"),
    [("LOW_PASS_PX2", 0.6, "image"), ("NEAR", 1.0, "image"), ("MAX_ALPHA", 0.5, "weights")],
)
def test_the_self_test_detects_other_conventions(monkeypatch, name, value, what):
    monkeypatch.setattr(cuda, name, value)
    assert what in parity.disagreement("cpu", "cuda")
