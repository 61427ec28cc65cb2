"""Threads, bands of tiles, and choice of the device."""

import logging
import subprocess
import sys
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from cpusplat import binning
from hilsplat.base.errors import DeviceError
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.rasterise import cuda, device
from hilsplat.splat.rasterise.api import draw, pixel_weights
from hilsplat.splat.rasterise.device import choose_device
from tests.unit.splat.rasterise_scenes import camera, random_gaussians


def everything(threads: int, order: str) -> list[np.ndarray]:
    """Images, gradients and weights of one scene, whose arrays have the given memory order."""
    gaussians, view = random_gaussians(300, seed=5), camera(70, 90)
    gaussians = Gaussians(*(np.asarray(values, order=order) for values in vars(gaussians).values()))
    features = np.linspace(-1, 1, 1800, dtype=np.float32).reshape(300, 6)
    seen = draw(gaussians, view, 3, features=features, threads=threads)
    gradients = seen.gradients(2 * seen.image, np.ones_like(seen.alpha))
    matrix = pixel_weights(gaussians, view, min_weight=1e-3, threads=threads)
    sparse = [matrix.data, matrix.indices, matrix.indptr]
    return [seen.image, seen.alpha, *vars(gradients).values(), *sparse]


@pytest.mark.parametrize(
    ("threads", "max_entries"), [(2, 2**21), (3, 2**21), (7, 2**21), (2, 1), (2, 50), (2, 1000)]
)
def test_threads_bands_of_tiles_and_memory_order_do_not_change_the_bytes(monkeypatch, threads, max_entries):
    whole = everything(1, "C")
    monkeypatch.setattr(binning, "MAX_ENTRIES", max_entries)
    for one, other in zip(whole, everything(threads, "F"), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("step", [2, 3])
def test_weights_on_a_pixel_grid_are_rows_of_all_weights(step):
    gaussians, view = random_gaussians(300, seed=5), camera(70, 90)
    every, some = (pixel_weights(gaussians, view, min_weight=1e-3, step=s) for s in (1, step))
    row, column = np.divmod(np.arange(70 * 90), 90)
    skipped = (row % step > 0) | (column % step > 0)
    assert some.nnz > 0
    assert not np.diff(some.indptr)[skipped].any()
    assert (some[~skipped] != every[~skipped]).nnz == 0


# ---- device ---------------------------------------------------------------------------------------


@pytest.fixture
def no_cuda(monkeypatch):
    """Simulate a machine with gsplat but without CUDA."""
    monkeypatch.setattr(device, "find_spec", lambda name: name)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr("ctypes.CDLL", lambda name: None)
    device.cuda_problem.cache_clear()
    device.CHOSEN.clear()
    yield
    device.cuda_problem.cache_clear()
    device.CHOSEN.clear()


@pytest.mark.usefixtures("no_cuda")
def test_without_cuda_auto_selects_the_cpu_and_cuda_is_an_error(caplog):
    with caplog.at_level(logging.INFO):
        assert choose_device("auto") == choose_device("auto") == "cpu"
    assert caplog.text.count("rasterising on cpu (device: auto") == 1
    assert "finds no CUDA device" in caplog.text
    with pytest.raises(DeviceError, match=r"device: cuda was requested(?s:.*)finds no CUDA device(?s:.*)gpu"):
        choose_device("cuda")


@pytest.fixture
def card(monkeypatch, tmp_path):
    """Simulate a machine with an NVIDIA card and gsplat; return a function that sets gsplat's kernels."""
    monkeypatch.setattr(device, "find_spec", lambda name: name)
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.get_device_name", lambda: "a card")
    monkeypatch.setattr("ctypes.CDLL", lambda name: None)
    monkeypatch.setattr("platformdirs.user_cache_path", lambda name: tmp_path)
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    monkeypatch.setattr("torch.utils.cpp_extension.CUDA_HOME", "/usr/local/cuda")

    def with_kernels(spherical_harmonics: Callable[..., object]) -> None:
        module = SimpleNamespace(__version__="1.5.3", spherical_harmonics=spherical_harmonics)
        monkeypatch.setitem(sys.modules, "gsplat", module)
        device.forget_cuda()

    yield with_kernels
    device.forget_cuda()


def test_a_card_without_a_toolkit_selects_the_cpu_with_a_warning(card, caplog, monkeypatch):
    monkeypatch.setattr("torch.utils.cpp_extension.CUDA_HOME", None)
    card(None)
    assert choose_device("auto") == "cpu"
    (line,) = [each.message for each in caplog.records if each.levelname == "WARNING"]
    assert line.startswith("rasterising on cpu") and "no CUDA toolkit (nvcc) is installed" in line
    with pytest.raises(DeviceError, match=r"nvcc(?s:.*)a CUDA toolkit on a machine"):
        choose_device("cuda")


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("Error building extension 'gsplat_cuda': [1/9] nvcc"),
        subprocess.CalledProcessError(1, "where cl"),
        ImportError("libcudart.so.12: cannot open shared object file"),
        RuntimeError(),
    ],
)
def test_a_failing_build_of_gsplat_is_tried_once_and_selects_the_cpu(card, caplog, error):
    tries = []

    def fail(*arguments: object) -> None:
        tries.append(arguments)
        raise error

    card(fail)
    assert choose_device("auto") == "cpu"
    assert "the CUDA kernels of gsplat cannot be compiled: " in caplog.text
    device.cuda_problem.cache_clear()  # as in the next stage's process
    device.CHOSEN.clear()
    assert choose_device("auto") == "cpu" and len(tries) == 1
    device.forget_cuda()  # as `hilsplat doctor` does
    assert choose_device("auto") == "cpu" and len(tries) == 2


def test_a_self_test_that_fails_selects_the_cpu(card, caplog):
    card(lambda *arguments: None)
    assert choose_device("auto") == "cpu"  # this gsplat cannot render
    assert "the self-test on CUDA failed: " in caplog.text


def test_a_broken_driver_selects_the_cpu(card, monkeypatch, caplog):
    card(lambda *arguments: None)

    def fail() -> bool:
        raise RuntimeError("Unexpected error from cudaGetDeviceCount()\ndriver too old")

    monkeypatch.setattr("torch.cuda.is_available", fail)
    assert choose_device("auto") == "cpu" and "Unexpected error from cudaGetDeviceCount()" in caplog.text


def test_the_cpu_is_selected_without_a_check_for_cuda(monkeypatch):
    monkeypatch.setattr(device, "cuda_problem", lambda: pytest.fail("it ran"))
    monkeypatch.setattr(device, "CHOSEN", {})
    assert choose_device("cpu") == "cpu"
