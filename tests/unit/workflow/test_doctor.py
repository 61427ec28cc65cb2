"""Each check of `hilsplat doctor` passes on this machine, and reports a fault with its fix."""

import importlib.metadata
import json
import os
import shutil
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from typer.testing import CliRunner

from hilsplat.base.errors import ModelError
from hilsplat.base.lineage import version_of
from hilsplat.cli.main import app
from hilsplat.embed import model_check
from hilsplat.models.torch_network import TorchNetwork
from hilsplat.splat.rasterise import parity
from hilsplat.workflow import doctor
from tests.unit.models.test_store import write_model


@pytest.fixture(autouse=True)
def fresh():
    """Each test looks for distributions anew."""
    version_of.cache_clear()
    yield
    version_of.cache_clear()


def test_a_sound_machine_has_no_fault(project, monkeypatch):
    monkeypatch.chdir(project)
    findings = list(doctor.examine())
    assert [finding for finding in findings if finding.state == "fault"] == []
    assert {finding.check for finding in findings} >= {"python", "libraries", "kernels", "disk", "memory"}


def test_a_missing_codec_is_a_fault(monkeypatch):
    monkeypatch.setattr("av.codec.Codec", Mock(side_effect=[None, None, ValueError]))
    [found] = doctor.video()
    assert found.state == "fault" and "lacks w libx264" in found.found


def install(monkeypatch, missing: str, **versions: str) -> None:
    """Pretend that a library is missing and that others have these versions."""

    def version(name: str) -> str:
        if name == missing:
            raise importlib.metadata.PackageNotFoundError(name)
        return versions.get(name) or known(name)

    known = importlib.metadata.version
    monkeypatch.setattr(importlib.metadata, "version", version)


def test_a_library_that_is_missing_or_old_is_named(monkeypatch):
    install(monkeypatch, "scipy", numpy="1.20.0")
    [found] = doctor.libraries()
    assert found.state == "fault"
    assert "scipy is missing" in found.found and "numpy 1.20.0 does not satisfy >=2" in found.found


@pytest.mark.parametrize(
    ("absent", "problem", "apart", "state", "words"),
    [
        ("no driver", "no driver", None, "note", "no driver: everything runs on the CPU"),
        (None, "no gsplat", None, "note", "no gsplat: fits and contributions run on the CPU"),
        (None, None, "cuda differs from cpu: image by 0.3", "fault", "differs"),
        (None, None, None, "ok", "agree"),
    ],
)
def test_cuda_is_optional_but_must_agree_with_the_cpu(monkeypatch, absent, problem, apart, state, words):
    monkeypatch.setattr("hilsplat.models.card.card_problem", lambda: absent)
    monkeypatch.setattr("hilsplat.splat.rasterise.device.forget_cuda", lambda: None)
    monkeypatch.setattr("hilsplat.splat.rasterise.device.cuda_problem", lambda: problem)
    monkeypatch.setattr("hilsplat.splat.rasterise.device.kernel_problem", lambda: None)
    monkeypatch.setattr("hilsplat.splat.rasterise.parity.cuda_disagreement", lambda: apart)
    (found,) = doctor.cuda()
    assert found.state == state and words in found.found


def test_a_broken_model_is_a_fault_and_missing_real_ones_are_noted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_model(tmp_path / "models/sam-vit-base", "sam")
    states = {finding.state: finding.found for finding in doctor.models()}
    assert "sam-vit-base" in states["fault"] and "no CLIP" in states["note"]


@pytest.mark.parametrize(("shift", "state"), [(0.0, "ok"), (0.1, "fault")])
def test_a_model_must_give_the_same_on_a_card(project, monkeypatch, shift, state):
    monkeypatch.chdir(project)
    monkeypatch.setattr("hilsplat.embed.model_check.check_model", lambda folder: "")
    monkeypatch.setattr("hilsplat.models.card.card_problem", lambda: None)
    compare, run = model_check.card_disagreement, TorchNetwork.run
    monkeypatch.setattr(model_check, "card_disagreement", lambda folder: compare(folder, "cpu:0"))
    monkeypatch.setattr(
        TorchNetwork, "run", lambda self, **feeds: [out * (1 + shift) for out in run(self, **feeds)]
    )
    findings = [finding for finding in doctor.models() if finding.state != "note"]
    assert {finding.state for finding in findings} == {state} and len(findings) == 2
    monkeypatch.setattr(TorchNetwork, "run", Mock(side_effect=torch.OutOfMemoryError("Tried to allocate")))
    findings = [each for each in doctor.models() if "works on the CPU, but not on the GPU" in each.found]
    assert [each.state for each in findings] == ["note", "note"]
    assert all("Tried to allocate" in each.found for each in findings)


def test_a_card_that_is_too_small_or_busy_is_not_compared_and_is_no_fault(project, monkeypatch):
    monkeypatch.chdir(project)
    monkeypatch.setattr("hilsplat.embed.model_check.check_model", lambda folder: "")
    monkeypatch.setattr("hilsplat.models.card.card_problem", lambda: None)
    monkeypatch.setattr(TorchNetwork, "run", lambda *given, **feeds: pytest.fail("it ran"))
    busy = RuntimeError("CUDA error: all CUDA-capable devices are busy or unavailable")
    for free, words in (
        (Mock(return_value=1.0), "the GPU has 0.0 GiB free"),
        (Mock(side_effect=busy), "busy"),
    ):
        monkeypatch.setattr("hilsplat.models.card.free_mib", free)
        findings = list(doctor.models())
        assert {each.state for each in findings} == {"note"}
        assert sum(words in each.found for each in findings) == 2


@pytest.mark.parametrize(("what", "value"), [("disk", 2**20), ("memory", 100.0)])
def test_too_little_disk_or_memory_is_a_fault(project, monkeypatch, what, value):
    monkeypatch.chdir(project)
    if what == "disk":
        monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=value))
    else:
        monkeypatch.setattr(doctor, "machine_mib", lambda: value)
    states = {finding.check: finding.state for finding in doctor.space()}
    assert states.pop(what) == "fault" and set(states.values()) == {"ok"}


def test_a_read_only_working_folder_is_a_fault(monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    states = [finding.state for finding in doctor.writing()]
    assert states == ["fault", "note", "note"]


def test_a_check_that_fails_unexpectedly_is_a_fault_and_does_not_stop_the_others(monkeypatch):
    def check():
        raise ModelError("no")

    monkeypatch.setattr(doctor, "CHECKS", (check, doctor.python))
    done = CliRunner().invoke(app, ["doctor", "--json"])
    assert done.exit_code == 1
    assert [finding["state"] for finding in json.loads(done.output)] == ["fault", "ok"]


def test_the_cuda_self_test_runs_once(monkeypatch, tmp_path):
    drawn = []
    monkeypatch.setattr(parity, "disagreement", lambda one, other: drawn.append(other))
    monkeypatch.setattr("platformdirs.user_cache_path", lambda name: tmp_path)
    monkeypatch.setitem(__import__("sys").modules, "gsplat", SimpleNamespace(__version__="1.5"))
    monkeypatch.setattr("torch.cuda.get_device_name", lambda: "a GPU")
    assert parity.cuda_disagreement() is None and parity.cuda_disagreement() is None
    assert drawn == ["cuda"]
