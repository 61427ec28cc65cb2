"""The CUDA backend with gsplat's reference implementation in torch: the same image, gradients and weights."""

import gsplat
import pytest

from hilsplat.splat.rasterise import cuda, parity
from tests.unit.splat import gsplat_on_cpu


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
def test_the_self_test_notices_other_conventions(monkeypatch, name, value, what):
    monkeypatch.setattr(cuda, name, value)
    assert what in parity.disagreement("cpu", "cuda")
