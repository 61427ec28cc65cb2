"""Choice of the device for networks, and sizes of batches when a card's memory is short."""

import ctypes
import sys
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from hilsplat.base.errors import DeviceError, MemoryLimitError
from hilsplat.models import card
from hilsplat.models.card import CPU, Batches, is_out_of_memory, network_device


@pytest.fixture
def with_card(monkeypatch):
    """A card with 4 GiB of free memory."""
    monkeypatch.setattr(card, "card_problem", lambda: None)
    monkeypatch.setattr(card, "free_mib", lambda device="cuda": 4096.0)
    monkeypatch.setattr(card, "cards", lambda: ["0"])


def test_a_card_is_used_if_it_has_enough_memory(with_card, caplog):
    assert network_device("auto", "masks", 4000.0) == network_device("cuda", "clip", 4000.0) == "cuda"
    assert network_device("cpu", "masks", 4000.0) == network_device("auto", "masks", 5000.0) == CPU
    assert "masks runs on the CPU: the GPU has 4.0 GiB free, and about 4.9 are needed" in caplog.text
    words = r"(?s)masks.device: cuda.*4.0 GiB free, and about 4.9.*device: auto or cpu.*masks.model"
    with pytest.raises(DeviceError, match=words):
        network_device("cuda", "masks", 5000.0)


@pytest.mark.parametrize("cards", [[], ["0"]])
def test_without_a_usable_card_auto_means_the_cpu_and_cuda_is_an_error(monkeypatch, caplog, cards):
    monkeypatch.setattr(card, "card_problem", lambda: "torch 2.9.1+cpu finds no CUDA device")
    monkeypatch.setattr(card, "cards", lambda: cards)
    assert network_device("auto", "clip", 1.0) == CPU
    assert caplog.messages == ["clip runs on the CPU: torch 2.9.1+cpu finds no CUDA device"] * len(cards)
    with pytest.raises(
        DeviceError, match=r"clip.device: cuda(.|\n)*finds no CUDA device(.|\n)*clip.device: auto or cpu"
    ):
        network_device("cuda", "clip", 1.0)


def test_a_card_that_another_program_fills_or_locks_is_not_used(with_card, monkeypatch, caplog):
    busy = RuntimeError("CUDA error: CUDA-capable device(s) is/are busy or unavailable\nmore")
    monkeypatch.setattr(card, "free_mib", Mock(side_effect=busy))
    assert network_device("auto", "masks", 100.0) == CPU
    assert "masks runs on the CPU: CUDA cannot be started: CUDA error: CUDA-capable" in caplog.text
    with pytest.raises(DeviceError, match=r"masks.device: cuda(.|\n)*busy or unavailable\n"):
        network_device("cuda", "masks", 100.0)


@pytest.mark.parametrize(
    ("requested", "problem", "expected"),
    [
        ("cpu", None, []),
        ("auto", "no NVIDIA driver is installed", ["examine", "release"]),
        ("auto", "torch finds no CUDA device", ["take", "examine", "release"]),
        ("auto", None, ["take", "examine", "measure"]),
        ("cuda", None, ["take", "examine", "measure"]),
    ],
)
def test_jobs_take_a_card_before_cuda_starts_and_only_if_they_may_use_it(
    with_card, monkeypatch, requested, problem, expected
):
    events: list[str] = []
    monkeypatch.setattr(card, "has_driver", lambda: problem is None or "driver" not in problem)
    monkeypatch.setattr(card, "card_problem", lambda: events.append("examine") or problem)
    monkeypatch.setattr(card, "free_mib", lambda: events.append("measure") or 4096.0)
    monkeypatch.setattr(card, "take_card", lambda: events.append("take"))
    monkeypatch.setattr(card, "release_card", lambda: events.append("release"))
    assert network_device(requested, "masks", 100.0) == (CPU if problem or requested == CPU else "cuda")
    assert events == expected


@pytest.mark.parametrize(
    ("version", "built_for", "works"),
    [
        ((8, 9), "sm_75 sm_80 sm_86 sm_90", True),  # RTX 4090: code for 8.6
        ((6, 1), "sm_75 sm_80 sm_86 sm_90", False),  # GTX 1080 and torch's builds for CUDA 12.8
        ((12, 0), "sm_75 sm_80 sm_86 sm_90", False),  # RTX 5090 and builds for CUDA 12.4
        ((12, 0), "sm_75 sm_90a compute_90", True),  # compiled by the driver
        ((8, 0), "sm_86 compute_86", False),
        ((8, 6), "", True),  # unknown
    ],
)
def test_a_build_of_torch_without_kernels_for_the_card_is_not_used(monkeypatch, version, built_for, works):
    monkeypatch.setattr(card, "has_driver", lambda: True)
    for name, value in {
        "is_available": True, "get_device_capability": version, "get_arch_list": built_for.split()
    }.items():  # fmt: skip
        monkeypatch.setattr(torch.cuda, name, lambda value=value: value)
    card.card_problem.cache_clear()
    problem = card.card_problem()
    card.card_problem.cache_clear()
    words = f"has no kernels for compute capability {version[0]}.{version[1]}, only {built_for}"
    assert problem is None if works else problem.endswith(words)


def test_a_missing_driver_is_found_without_importing_torch(monkeypatch):
    def absent(name: str) -> None:
        raise OSError(name)

    monkeypatch.setattr(ctypes, "CDLL", absent)
    monkeypatch.setitem(sys.modules, "torch", None)
    card.card_problem.cache_clear()
    assert card.card_problem() == "no NVIDIA driver is installed"
    monkeypatch.setattr(ctypes, "CDLL", lambda name: None)
    card.card_problem.cache_clear()
    assert "torch cannot be used" in card.card_problem()
    card.card_problem.cache_clear()


def calls_of(batches: Batches, total: int, fitting: int = 1000) -> list[tuple[list[int], int]]:
    """Return the rows of each successful call; calls of more than `fitting` rows run out of memory."""

    def work(rows: np.ndarray, number: int) -> tuple[list[int], int]:
        if len(rows) > fitting:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 MiB.\nmore")
        return rows.tolist(), number

    return list(batches(total, work))


def test_calls_on_a_cpu_have_one_size():
    assert calls_of(Batches(3), 7) == [([0, 1, 2], 3), ([3, 4, 5], 3), ([6], 1)]
    assert calls_of(Batches(3, is_padded=True), 4) == [([0, 1, 2], 3), ([3, 3, 3], 1)]
    assert calls_of(Batches(3), 0) == []


def test_no_item_is_skipped_if_another_thread_halves_the_calls():
    class Halved(Batches):
        @property
        def size(self) -> int:
            self.left = max(1, self.left // 2)
            return self.left

        @size.setter
        def size(self, number: int) -> None:
            self.left = number

    found = calls_of(Halved(16, is_padded=True), 20)
    assert [row for rows, number in found for row in rows[:number]] == list(range(20))


def test_calls_that_run_out_of_memory_are_halved_and_stay_small():
    batches = Batches(16, "cpu:0", 256)
    found = calls_of(batches, 40, fitting=5)
    assert [row for rows, _ in found for row in rows] == list(range(40))
    assert [number for _, number in found] == [4] * 10
    assert calls_of(batches, 6) == [([0, 1, 2, 3], 4), ([4, 5], 2)]


@pytest.mark.parametrize(("batches", "number"), [(Batches(4, "cpu:0", 8), 1), (Batches(4, "cpu:0"), 4)])
def test_a_single_item_or_a_fixed_number_that_does_not_fit_ends_with_the_setting(batches, number):
    words = rf"call of size {number}(.|\n)*Tried to allocate 20 MiB(.|\n)*masks.device: cpu"
    with pytest.raises(MemoryLimitError, match=words):
        calls_of(batches, 9, fitting=0)


@pytest.mark.parametrize("text", ["CUDA error: out of memory", "CUDA error: CUBLAS_STATUS_ALLOC_FAILED"])
def test_libraries_that_find_no_memory_count_and_other_errors_are_not_retried(text):
    assert is_out_of_memory(RuntimeError(text)) and not is_out_of_memory(ValueError(text))
    work = Mock(side_effect=RuntimeError("no kernel image is available"))
    with pytest.raises(RuntimeError, match="no kernel image"):
        list(Batches(4, "cpu:0", 8)(9, work))


def test_the_memory_of_the_first_call_determines_the_size_of_later_calls(monkeypatch, with_card):
    monkeypatch.setattr(torch, "cuda", fake := Mock())
    fake.memory_allocated.return_value = 100 * 2**20
    fake.max_memory_allocated.return_value = 740 * 2**20
    # 640 MiB for 16 items; 80 % of 4096 MiB hold 81
    assert [number for _, number in calls_of(Batches(16, "cuda", 256), 200)] == [16, 81, 81, 22]
    assert [number for _, number in calls_of(Batches(16, "cuda", 50), 120)] == [16, 50, 50, 4]


@pytest.mark.gpu
def test_a_real_card_reports_its_memory():
    if (problem := card.card_problem()) is not None:
        pytest.skip(problem)
    assert card.free_mib() > 100
    batches = Batches(2, "cuda", 64)
    assert len(list(batches(200, lambda rows, number: torch.zeros(number, 2**20, device="cuda").sum()))) < 10
