"""Threads, bands of tiles, and choice of the device."""

import logging
import subprocess
import sys
import warnings
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from cpusplat import binning
from hilsplat.base.errors import DeviceError
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.rasterise import cuda, device, parity
from hilsplat.splat.rasterise.api import draw, pixel_weights
from tests.unit.splat.rasterise_scenes import camera, random_gaussians


def everything(threads: int, order: str) -> list[np.ndarray]:
    """Images, gradients and weights of one scene, whose arrays have the given memory order."""
    gaussians, view = random_gaussians(300, seed=5), camera(70, 90)
    gaussians = Gaussians(*(np.asarray(values, order=order) for values in vars(gaussians).values()))
    features = np.linspace(-1, 1, 1800, dtype=np.float32).reshape(300, 6)
    seen = draw(gaussians, view, 3, features=features, threads=threads)
    by_parameter, by_mean_px = seen.gradients(2 * seen.image, np.ones_like(seen.alpha))
    matrix = pixel_weights(gaussians, view, min_weight=1e-3, threads=threads)
    sparse = [matrix.data, matrix.indices, matrix.indptr]
    return [seen.image, seen.alpha, *by_parameter, by_mean_px, *sparse]


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
def card(monkeypatch, tmp_path):
    """Simulate a machine with a driver, a card and gsplat; return a function that sets gsplat's kernels.

    An error instead of kernels is raised when they are loaded.
    """
    monkeypatch.setattr(device, "find_spec", lambda name: name)
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.get_device_name", lambda: "a card")
    monkeypatch.setattr("ctypes.CDLL", lambda name: None)
    monkeypatch.setattr("platformdirs.user_cache_path", lambda name: tmp_path)
    monkeypatch.setattr(cuda, "DEVICE", "cpu")

    def with_kernels(kernels: object, run: Callable[..., object] = lambda *arguments: None) -> list[object]:
        loads: list[object] = []

        def spherical_harmonics(*arguments: object) -> object:
            loads.append(kernels)
            if isinstance(kernels, Exception):
                raise kernels
            if kernels is None:
                raise AttributeError("'NoneType' object has no attribute 'spherical_harmonics_fwd'")
            return run(*arguments)

        module = SimpleNamespace(__version__="1.5.3", spherical_harmonics=spherical_harmonics)
        monkeypatch.setitem(sys.modules, "gsplat", module)
        device.forget_cuda()
        return loads

    yield with_kernels
    device.forget_cuda()


def in_another_process() -> None:
    """Forget what a process remembers, but not what the user's cache holds."""
    device.cuda_problem.cache_clear()
    device.CHOSEN.clear()


def test_without_cuda_auto_selects_the_cpu_and_cuda_is_an_error(card, monkeypatch, caplog):
    card(None)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with caplog.at_level(logging.INFO):
        assert device.choose_device("auto") == device.choose_device("auto") == "cpu"
    assert caplog.text.count("rasterising on cpu (device: auto") == 1
    assert "finds no CUDA device" in caplog.text
    with pytest.raises(DeviceError, match=r"device: cuda was requested(?s:.*)finds no CUDA device(?s:.*)gpu"):
        device.choose_device("cuda")


@pytest.mark.parametrize(
    ("kernels", "words"),
    [
        (None, "no CUDA toolkit (nvcc) is installed"),
        (RuntimeError("Error building extension 'gsplat_cuda': [1/9] nvcc"), "Error building extension"),
        (subprocess.CalledProcessError(1, "where cl"), "where cl"),
        (ImportError("libcudart.so.12: cannot open shared object file"), "libcudart.so.12"),
        (RuntimeError(), ""),
    ],
    ids=str,
)
def test_a_failing_build_of_gsplat_is_tried_once_and_selects_the_cpu(card, caplog, kernels, words):
    loads = card(kernels)
    assert device.choose_device("auto") == "cpu"
    (line,) = [each.message for each in caplog.records if each.levelname == "WARNING"]
    assert line.startswith("rasterising on cpu") and words in line
    assert "the CUDA kernels of gsplat cannot be compiled" in line
    in_another_process()
    assert device.choose_device("auto") == "cpu" and len(loads) == 1
    with pytest.raises(DeviceError, match=r"cannot be compiled(?s:.*)a CUDA toolkit on a machine"):
        device.choose_device("cuda")
    device.forget_cuda()  # as `hilsplat doctor` does
    assert device.choose_device("auto") == "cpu" and len(loads) == 2


def test_a_folder_of_cuda_without_a_compiler_is_no_toolkit(monkeypatch, tmp_path):
    # such as /usr/local/cuda in images for running CUDA programs
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    monkeypatch.setenv("CUDA_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", "")
    monkeypatch.setitem(sys.modules, "gsplat.csrc", None)  # kernels that were compiled elsewhere
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", None)
    del sys.modules["gsplat.cuda._backend"]
    assert "no CUDA toolkit (nvcc) is installed" in device._build_failure()


@pytest.mark.parametrize("requested", ["auto", "cuda"])
def test_a_card_that_is_full_for_a_while_is_used_afterwards(card, monkeypatch, caplog, requested):
    monkeypatch.setattr(parity, "disagreement", lambda *devices: None)
    error: list[Exception] = [RuntimeError("CUDA error: out of memory\nCompile with TORCH_USE_CUDA_DSA")]

    def run(*arguments: object) -> None:
        if error:
            raise error[0]

    card(object(), run)
    message = "the card cannot run gsplat's kernels: CUDA error: out of memory"
    if requested == "auto":
        assert device.choose_device("auto") == "cpu" and message in caplog.text
    else:
        with pytest.raises(DeviceError, match=message):
            device.choose_device("cuda")
    error.clear()
    in_another_process()
    assert device.choose_device(requested) == "cuda"


def test_a_build_that_failed_for_one_card_is_tried_for_another(card, monkeypatch):
    loads = card(RuntimeError("Unsupported gpu architecture 'compute_120'"))
    for name in ("0", "0", "1"):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", name)
        in_another_process()
        assert device.choose_device("auto") == "cpu"
    assert len(loads) == 2


def test_a_self_test_that_fails_selects_the_cpu(card, caplog):
    card(object())
    assert device.choose_device("auto") == "cpu"  # this gsplat cannot render
    assert "the self-test on CUDA failed: " in caplog.text


def raised() -> bool:
    raise RuntimeError("the driver is broken\nmore")


def warned() -> bool:
    warnings.warn("the driver is too old (found version 11040)\nmore", stacklevel=1)
    return False


@pytest.mark.parametrize("is_available", [raised, warned])
def test_a_driver_that_cannot_be_used_selects_the_cpu_with_a_warning(card, monkeypatch, caplog, is_available):
    card(object())
    monkeypatch.setattr("torch.cuda.is_available", is_available)
    assert device.choose_device("auto") == "cpu"
    (line,) = [each.message for each in caplog.records if each.levelname == "WARNING"]
    assert ": the driver is " in line and "more" not in line


def test_the_cpu_is_selected_without_a_check_for_cuda(monkeypatch):
    monkeypatch.setattr(device, "cuda_problem", lambda: pytest.fail("it ran"))
    monkeypatch.setattr(device, "CHOSEN", {})
    assert device.choose_device("cpu") == "cpu"
