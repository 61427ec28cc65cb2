"""Providers are used only if a session runs on them."""

import ctypes
import os
import subprocess
import sys
from types import SimpleNamespace

import onnxruntime
import pytest

from hilsplat.models import network
from hilsplat.models.network import CPU, CUDA, cuda_provider_problem, execution_providers
from hilsplat.segment.sam import SamModel
from hilsplat.workflow import doctor
from tests.conftest import PROJECT


@pytest.fixture(autouse=True)
def fresh():
    """Examine the machine again in each test."""
    cuda_provider_problem.cache_clear()
    yield
    cuda_provider_problem.cache_clear()


@pytest.fixture
def lying(monkeypatch):
    """An onnxruntime that lists CUDA although its library cannot be loaded."""
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [CUDA, CPU])

    def load(path: str) -> None:
        raise OSError("libcudnn.so.9: cannot open shared object file: No such file or directory")

    monkeypatch.setattr(ctypes, "CDLL", load)


def warnings_in(caplog) -> list[str]:
    own = [each for each in caplog.records if each.name.startswith("hilsplat")]
    return [each.message for each in own if each.levelname == "WARNING"]


def test_a_list_that_names_cuda_without_its_libraries_means_the_cpu_and_its_fast_paths(
    lying, sam_parts, caplog
):
    assert execution_providers() == execution_providers() == (CPU,)
    (line,) = warnings_in(caplog)
    assert "libcudnn.so.9: cannot open shared object file" in line
    model = SamModel.load(sam_parts[-1])
    assert model.factored is not None and not model.as_exported


def test_doctor_reports_the_provider_of_a_session_and_what_is_missing(lying, monkeypatch):
    versions = {"onnxruntime-gpu": "1.31"}
    monkeypatch.setattr(doctor, "version_of", versions.get)
    (found,) = doctor.onnx()
    assert found.state == "note" and "onnxruntime-gpu runs on the CPU: libcudnn.so.9" in found.found
    versions |= {"onnxruntime": "1.31"}
    versions.pop("onnxruntime-gpu")
    (found,) = doctor.onnx()
    assert found.state == "ok" and found.found.endswith(f"sessions run on {CPU}")


@pytest.mark.parametrize("error", [RuntimeError("CUDA failure 35\nmore"), ValueError("EP Error")])
def test_a_session_that_cannot_be_opened_on_cuda_means_the_cpu(monkeypatch, caplog, error):
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [CUDA, CPU])

    def fail(*given: object) -> None:
        raise error

    monkeypatch.setattr(network, "one_thread_session", fail)
    assert execution_providers() == (CPU,)
    assert str(error).splitlines()[0] in warnings_in(caplog)[0]


def test_an_overwritten_onnxruntime_gpu_is_named(monkeypatch, caplog):
    monkeypatch.setattr(network.metadata, "distributions", lambda name: [name] * (name == "onnxruntime-gpu"))
    assert execution_providers() == (CPU,)
    assert "onnxruntime-gpu was overwritten by onnxruntime" in warnings_in(caplog)[0]


def test_a_working_cuda_comes_first(monkeypatch):
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [CUDA, CPU])
    session = SimpleNamespace(run=lambda *given: None, get_providers=lambda: [CUDA, CPU])
    monkeypatch.setattr(network, "one_thread_session", lambda *given: session)
    assert execution_providers() == (CUDA, CPU)


def test_an_onnxruntime_that_lost_its_files_is_named(tmp_path):
    (tmp_path / "onnxruntime").mkdir()
    program = "import hilsplat.models.network"
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{PROJECT}"}
    (tmp_path / "onnxruntime/__init__.py").touch()
    words = [sys.executable, "-c", program]
    done = subprocess.run(words, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert "ModelError: onnxruntime is incomplete" in done.stderr and "--force-reinstall" in done.stderr
