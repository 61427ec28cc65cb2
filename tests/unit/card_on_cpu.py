"""Code for cards on machines without one."""

import gsplat
import pytest

from hilsplat.splat.rasterise import cuda, device
from tests.cpusplat import gsplat_on_cpu

KERNELS = (
    *("rasterization", "spherical_harmonics", "rasterize_to_indices_in_range"),
    "quat_scale_to_covar_preci",
)


def replace_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the code for cards run on the CPU, on a card of 1 TiB that passed its self-test."""
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    monkeypatch.setattr(device, "CHOSEN", {"auto": "cuda", "cuda": "cuda", "cpu": "cpu"})
    monkeypatch.setattr(device, "free_mib", lambda: 2.0**20)
    for name in KERNELS:
        monkeypatch.setattr(gsplat, name, getattr(gsplat_on_cpu, name))
