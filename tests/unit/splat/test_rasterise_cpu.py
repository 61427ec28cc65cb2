"""Threads, bands of tiles, and choice of the device."""

import logging
import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from cpusplat import binning
from hilsplat.base.errors import DeviceError
from hilsplat.models.card import card_problem
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
    (tmp_path / "csrc.so").touch()  # kernels that were compiled elsewhere
    gsplat = SimpleNamespace(submodule_search_locations=[str(tmp_path)])
    monkeypatch.setattr(device, "find_spec", lambda name: gsplat)
    monkeypatch.setattr(device, "cards", lambda: ["0"])
    monkeypatch.setattr(device, "take_card", lambda: None)
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.get_device_capability", lambda: (8, 6))
    monkeypatch.setattr("torch.cuda.get_arch_list", list)
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
            return run(*arguments)

        module = SimpleNamespace(__version__="1.5.3", spherical_harmonics=spherical_harmonics)
        monkeypatch.setitem(sys.modules, "gsplat", module)
        in_another_process()
        return loads

    yield with_kernels
    in_another_process()


def in_another_process() -> None:
    """Forget what a process remembers, but not what the user's cache holds."""
    device.cuda_problem.cache_clear()
    card_problem.cache_clear()
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


@pytest.mark.parametrize(("place", "variable"), [("bin", "CUDA_HOME"), ("other", "PATH")])
def test_without_a_compiler_the_kernels_of_gsplat_must_have_been_compiled_elsewhere(
    card, monkeypatch, tmp_path, place, variable
):
    loads = card(object())
    monkeypatch.setenv("CUDA_HOME", str(tmp_path))  # an image for running CUDA programs has no nvcc
    monkeypatch.setenv("PATH", "")
    assert device.expected_problem() is device.cuda_problem() is None
    (tmp_path / "csrc.so").unlink()
    loads.clear()
    in_another_process()
    assert device.choose_device("auto") == "cpu" and not loads
    assert "no CUDA toolkit (nvcc) is installed" in device.expected_problem()
    (tmp_path / place).mkdir()
    (tmp_path / place / "nvcc").touch(0o755)
    monkeypatch.setenv(variable, str(tmp_path if place == "bin" else tmp_path / place))
    assert device.cuda_problem() is None and len(loads) == 1


def test_a_plan_runs_no_kernels_but_uses_what_jobs_found(card, monkeypatch):
    loads = card(RuntimeError("Error building extension"))
    assert device.expected_problem() is None and not loads
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")  # jobs see one of two equal cards, and another PATH
    monkeypatch.setenv("PATH", os.environ["PATH"] + ":/other")
    assert device.choose_device("auto") == "cpu" and len(loads) == 1
    assert "Error building extension" in device.expected_problem() and len(loads) == 1


@pytest.mark.parametrize(
    ("requested", "gsplat", "expected"),
    [
        ("cpu", True, []),
        ("auto", False, []),
        ("auto", True, ["take", "run", "release"]),
        ("cuda", True, ["take", "run", "release"]),
    ],
)
def test_a_job_takes_a_card_before_cuda_starts_and_only_if_it_may_use_it(
    card, monkeypatch, requested, gsplat, expected
):
    events: list[str] = []
    card(object(), lambda *arguments: events.append("run") or 1 / 0)
    monkeypatch.setattr(device, "take_card", lambda: events.append("take"))
    monkeypatch.setattr(device, "release_card", lambda: events.append("release"))
    if not gsplat:
        monkeypatch.setattr(device, "find_spec", lambda name: None)
    with pytest.raises(DeviceError) if requested == "cuda" else nullcontext():
        assert device.choose_device(requested) == "cpu"
    assert events == expected


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
    for capability in ((12, 0), (12, 0), (8, 6)):
        monkeypatch.setattr("torch.cuda.get_device_capability", lambda now=capability: now)
        in_another_process()
        assert device.choose_device("auto") == "cpu"
    assert len(loads) == 2


def test_a_card_for_which_torch_has_no_kernels_is_not_used_for_fits(card, monkeypatch, caplog):
    loads = card(object())
    monkeypatch.setattr("torch.cuda.get_device_capability", lambda: (6, 1))
    monkeypatch.setattr("torch.cuda.get_arch_list", lambda: ["sm_75", "sm_90"])
    assert "no kernels for compute capability 6.1" in device.expected_problem()
    assert device.choose_device("auto") == "cpu" and not loads
    assert [each.levelname for each in caplog.records] == ["WARNING"]


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
