"""A fit on a card, run on the CPU with gsplat's reference functions in torch; and the choice of a card."""

import logging
from dataclasses import replace
from pathlib import Path

import gsplat
import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from cpusplat import photometric
from hilsplat.base.errors import DeviceError, HilsplatError
from hilsplat.base.lineage import read_provenance
from hilsplat.scene.scene import Scene
from hilsplat.settings import GaussiansSettings
from hilsplat.splat import fit, torch_model
from hilsplat.splat.gaussians import FIELDS
from hilsplat.splat.initial import camera_extent, first_gaussians, load_views
from hilsplat.splat.model import TABLES, Model, StepOptions
from hilsplat.splat.rasterise import cuda, device, parity
from hilsplat.splat.torch_model import TorchModel, bytes_needed
from hilsplat.stages import gaussians
from tests.unit.card_on_cpu import replace_kernels
from tests.unit.splat.rasterise_scenes import random_gaussians
from tests.unit.splat.three_gaussians_world import three_gaussians_scene

NUM_POINTS = 210
SETTINGS = GaussiansSettings(
    iterations=60,
    densify_every=10,
    opacity_reset_every=30,
    max_gaussians=260,
    densify_gradient=4e-3,
    image_scale=0.5,
    device="cuda",
    background="random",
)
PLAIN = StepOptions(0, np.zeros(3, np.float32), 0.0, False)
STRATEGIES = pytest.mark.parametrize("strategy", ["default", "mcmc"])


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    rng = np.random.default_rng(0)
    points = rng.normal(0, 0.3, (NUM_POINTS, 3)).astype(np.float32)
    colours = rng.integers(0, 256, (NUM_POINTS, 3)).astype(np.uint8)
    scene = three_gaussians_scene(tmp_path_factory.mktemp("three") / "scene")
    return replace(scene, points_xyz=points, points_rgb=colours)


@pytest.fixture(autouse=True)
def _card_on_the_cpu(monkeypatch, request):
    if not request.node.get_closest_marker("gpu"):
        replace_kernels(monkeypatch)


@pytest.fixture
def same_noise(monkeypatch):
    """Let the torch model draw its noise as `Model` does."""

    def drawn(like: torch.Tensor, generator: np.random.Generator) -> torch.Tensor:
        return torch.from_numpy(generator.standard_normal(tuple(like.shape), dtype=np.float32))

    monkeypatch.setattr(torch_model, "normal_numbers", drawn)


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.usefixtures("same_noise")
@STRATEGIES
def test_sixty_steps_equal_those_of_the_cpu(scene, strategy):
    settings, views = SETTINGS.model_copy(update={"strategy": strategy}), load_views(scene, "train", 0.5)
    cameras, states = [view.camera for view in views], []
    for kind in (Model, TorchModel):
        generator = np.random.default_rng(3)
        start = first_gaussians(scene, cameras, settings, generator)
        states.append(fit.FitState(kind(start), generator))
    sizes = set()
    for _ in range(60):
        for state in states:
            fit.fit_step(state, views, settings, camera_extent(cameras))
        one, other = (state.model for state in states)
        assert len(one) == len(other)
        sizes.add(len(one))
    assert len(sizes) > 2  # Gaussians were added in several rounds
    # the same views, splits, relocations and backgrounds were drawn
    assert states[0].generator.bit_generator.state == states[1].generator.bit_generator.state
    assert states[0].order == states[1].order
    # Adam divides by the gradient's length, which is mere rounding for the rotation of round Gaussians
    bounds = {"means": 1e-4, "log_scales": 1e-3, "quats": 1e-2, "opacity_logits": 1e-3, "sh": 5e-3}
    for name, bound in bounds.items():
        assert relative(other.read(name), one.read(name)) < bound, name
    assert np.median(np.abs(other.read("means") - one.read("means"))) < 1e-5
    np.testing.assert_allclose(states[1].curve, states[0].curve, rtol=1e-4)


# ---- one step -------------------------------------------------------------------------------------


class Recorder(TorchDispatchMode):
    """Records operations that wait for a card or copy rows of all Gaussians, except within gsplat."""

    # `lift_fresh` turns numbers of the host into a tensor, which would be copied to a card
    WAITING = ("_local_scalar_dense", "nonzero", "is_nonzero", "masked_select", "_unique2", "lift_fresh")

    def __init__(self, number: int) -> None:
        super().__init__()
        self.found, self.number, self.is_paused = list[str](), number, False

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        result = function(*arguments, **(options or {}))
        name = function.overloadpacket.__name__
        is_copy = name == "_to_copy" and result.numel() >= self.number
        if not self.is_paused and (name in self.WAITING or is_copy):
            self.found.append(name)
        return result


@pytest.fixture
def recorder(monkeypatch) -> Recorder:
    recorder = Recorder(NUM_POINTS)

    def unrecorded(function):
        def run(*arguments, **options):
            recorder.is_paused = True
            try:
                return function(*arguments, **options)
            finally:
                recorder.is_paused = False

        return run

    for name in ("rasterization", "spherical_harmonics", "quat_scale_to_covar_preci"):
        monkeypatch.setattr(gsplat, name, unrecorded(getattr(gsplat, name)))
    return recorder


@pytest.mark.parametrize(("strategy", "background"), [("default", "black"), ("mcmc", "random")])
def test_a_step_is_on_the_card_and_neither_waits_for_it_nor_copies_the_model(
    scene, monkeypatch, recorder, strategy, background
):
    settings = SETTINGS.model_copy(update={"strategy": strategy, "background": background})
    (view, *_), generator = load_views(scene, "train", 0.5), np.random.default_rng(0)
    # tensors on `meta` have shapes alone: reading one, or mixing it with one on the CPU, is an error
    monkeypatch.setattr(cuda, "DEVICE", "meta")
    monkeypatch.setattr(torch_model, "normal_numbers", lambda like, generator: torch.randn_like(like))
    model = TorchModel(first_gaussians(scene, [view.camera], settings, generator))
    state = fit.FitState(model, generator)
    fit.fit_step(state, [view], settings, 1.0)  # uploads the view
    with recorder:
        for _ in range(3):
            fit.fit_step(state, [view], settings, 1.0)
        assert recorder.found == []
        model.array(np.zeros(NUM_POINTS))
        assert set(recorder.found) == {"lift_fresh", "_to_copy"}
    model.select(np.array([1, 2, 0]))
    for table in TABLES:
        assert {values.device.type for values in getattr(model, table).values()} == {"meta"}
    with pytest.raises(RuntimeError, match="meta"):  # scores are read from the card
        model.step(view, settings, 1.0, PLAIN)()


@pytest.mark.parametrize("size_hw", [(40, 56), (7, 30), (3, 4)])
@pytest.mark.parametrize("ssim_weight", [0.0, 0.2, 1.0])
def test_the_loss_and_its_gradient_equal_those_of_cpusplat(monkeypatch, size_hw, ssim_weight):
    monkeypatch.setattr(torch_model, "fused_ssim", None)
    rng = np.random.default_rng(0)
    image, target = (rng.uniform(size=(*size_hw, 3)).astype(np.float32) for _ in range(2))
    expected, by_image = photometric.photometric_loss(image, target, ssim_weight=ssim_weight)
    leaf = torch.from_numpy(image).requires_grad_()
    loss = torch_model.photometric_loss(leaf, torch.from_numpy(target), ssim_weight)
    loss.backward()
    assert loss.item() == pytest.approx(expected, rel=1e-5)
    assert relative(leaf.grad.numpy(), by_image) < 1e-5


@pytest.mark.usefixtures("same_noise")
@pytest.mark.parametrize("width", [0.0, 60.0])
def test_noise_equals_that_of_the_cpu(width):
    start, moved = vars(random_gaussians(50, degree=0)), []
    start["log_scales"][:, 0] += width  # limited to the extent
    start["opacity_logits"][:] -= 4
    for kind in (Model, TorchModel):
        model = kind({name: start[name].copy() for name in FIELDS})
        model.add_noise(SETTINGS, 1e-4, 2.0, np.random.default_rng(0))
        moved.append(model.read("means") - start["means"])
    assert np.abs(moved[0]).max() > 1e-3
    np.testing.assert_allclose(moved[1], moved[0], rtol=1e-5, atol=2e-6)


def test_noise_depends_on_the_generator_alone():
    drawn = [
        torch_model.normal_numbers(torch.zeros(5000, 3), np.random.default_rng(seed)) for seed in (0, 0, 1)
    ]
    assert torch.equal(drawn[0], drawn[1]) and not torch.equal(drawn[0], drawn[2])
    assert drawn[0].std().item() == pytest.approx(1, abs=0.03)  # standard error 0.006


def test_gaussians_that_cannot_be_drawn_are_reported_with_the_scores(scene):
    (view, *_), generator = load_views(scene, "train", 0.5), np.random.default_rng(0)
    model = TorchModel(first_gaussians(scene, [view.camera], SETTINGS, generator))
    model.write("means", np.array([3]), np.full((1, 3), np.nan, np.float32))
    scores = model.step(view, SETTINGS, 1.0, PLAIN)
    with pytest.raises(HilsplatError, match=rf"\d+ of {NUM_POINTS} Gaussians cannot be drawn"):
        scores()


@STRATEGIES
def test_a_resumed_fit_equals_an_uninterrupted_one(scene, tmp_path, monkeypatch, strategy):
    changes = {"strategy": strategy, "iterations": 24, "densify_every": 4, "checkpoint_every": 10}
    settings, checkpoint = SETTINGS.model_copy(update=changes), tmp_path / f"{'0' * 16}.npz"
    whole, curve = fit.fit_gaussians(scene, settings, seed=3)
    assert len(whole) != NUM_POINTS
    step = fit.fit_step

    def interrupted(state: fit.FitState, *rest: object) -> None:
        if state.model.steps == 17:
            raise KeyboardInterrupt
        step(state, *rest)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(fit, "fit_step", interrupted)
        fit.fit_gaussians(scene, settings, seed=3, checkpoint=checkpoint)
    resumed, second_curve = fit.fit_gaussians(scene, settings, seed=3, checkpoint=checkpoint)
    np.testing.assert_array_equal(second_curve, curve)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(resumed, name), getattr(whole, name), err_msg=name)
    assert not checkpoint.exists()


# ---- memory of the card ---------------------------------------------------------------------------


def test_needed_bytes_are_those_of_gaussians_and_images():
    # 59 numbers of 4 bytes with gradient and two moments, and 600 bytes; 10 views of 3 Mpx; 800 bytes a pixel
    expected = 1.1 * (1_000_000 * (944 + 600) + 10 * 3 * 3_000_000 + 800 * 3_000_000)
    assert bytes_needed(1_000_000, 16, 10 * [3_000_000]) == pytest.approx(expected, rel=1e-9)


def test_too_small_a_card_is_an_error_or_selects_the_cpu(scene, monkeypatch, caplog):
    monkeypatch.setattr(device, "free_mib", lambda: 1.0)
    large = SETTINGS.model_copy(update={"max_gaussians": 3_000_000})
    with pytest.raises(
        DeviceError, match=r"(?s)more memory.*about 3\.\d GiB.*0\.0 GiB.*gaussians.max_gaussians"
    ):
        fit.fit_gaussians(scene, large, seed=0)
    with caplog.at_level(logging.WARNING):
        assert fit.fit_device(scene, large.model_copy(update={"device": "auto"})) == "cpu"
    assert "about 3." in caplog.text and "gaussians.image_scale" in caplog.text
    monkeypatch.setattr(device, "free_mib", lambda: 2.0**12)
    assert fit.fit_device(scene, large.model_copy(update={"device": "auto"})) == "cuda"  # a later fit
    assert fit.fit_device(scene, large) == "cuda"
    # frozen points are not limited by max_gaussians
    frozen = large.model_copy(update={"initial": "frozen"})
    monkeypatch.setattr(device, "free_mib", lambda: 8.0)
    assert fit.fit_device(scene, frozen) == "cuda"


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB. 1.50 GiB is free.\nSee"),
        RuntimeError("CUDA error: out of memory\nCompile with"),  # of the driver, as it loads kernels
    ],
)
def test_memory_that_runs_out_in_a_fit_is_an_error_with_a_fix(scene, monkeypatch, error):
    def fail(*arguments: object, **options: object) -> None:
        raise error

    monkeypatch.setattr(gsplat, "rasterization", fail)
    with pytest.raises(DeviceError, match=r"(?s)needs more memory.*out of memory.*gaussians.max_gaussians"):
        fit.fit_gaussians(scene, SETTINGS, seed=0)


def test_provenance_records_the_device_that_a_fit_chose(scene, tmp_path, monkeypatch):
    settings = SETTINGS.model_copy(update={"device": "auto", "iterations": 2})

    def recorded(name: str, *free_mib: float, **options: Path) -> str | None:
        left, out = [*free_mib], tmp_path / name / "g.ply"
        monkeypatch.setattr(device, "free_mib", lambda: left.pop(0))
        gaussians(scene.folder, out, out.with_name("report"), settings, cache=tmp_path / "cache", **options)
        return read_provenance(out).device

    # other programs may fill the card after the choice
    assert recorded("card", 2.0**20, 0.0) == "cuda"
    assert recorded("full", 0.0) == "cpu"
    assert recorded("imported", existing=tmp_path / "card/g.ply") is None


# ---- self-test ------------------------------------------------------------------------------------


def test_the_self_test_passes_with_gsplats_reference():
    assert parity.disagreement("cpu", "cuda") is None


def test_the_layout_of_gradients_does_not_matter(monkeypatch):
    def transposed(*arguments: object) -> list[torch.Tensor]:
        return [values.mT.contiguous().mT if values.ndim > 1 else values for values in grad(*arguments)]

    grad = torch.autograd.grad
    monkeypatch.setattr(torch.autograd, "grad", transposed)
    assert parity.disagreement("cpu", "cuda") is None


@pytest.mark.parametrize(
    ("module", "name", "value", "what"),
    [
        (cuda, "LOW_PASS_PX2", 0.6, "gradients of 1 Gaussians"),
        (cuda, "NEAR", 1.0, "loss of 300 Gaussians"),
        (cuda, "MAX_ALPHA", 0.5, "weights of 300 Gaussians"),
        (torch_model, "SH_REST_SHARE", 1.0, "step of 300 Gaussians"),
        (torch_model, "TAPS", np.full(11, 1 / 11, np.float32), "loss of 300 Gaussians"),
    ],
)
def test_the_self_test_detects_other_conventions(monkeypatch, module, name, value, what):
    torch_model._taps.cache_clear()
    monkeypatch.setattr(module, name, value)
    assert what in (parity.disagreement("cpu", "cuda") or "")
    torch_model._taps.cache_clear()


def test_the_self_test_is_repeated_after_a_new_driver_or_library(monkeypatch, tmp_path):
    monkeypatch.setattr("platformdirs.user_cache_path", lambda name: tmp_path)
    monkeypatch.setattr("torch.cuda.get_device_name", lambda: "a card")
    known, tests = ["550.1", None], list[object]()
    monkeypatch.setattr(parity, "driver_version", lambda: known[0])
    monkeypatch.setattr(parity, "version_of", lambda name: known[1] if name == "fused-ssim" else "1")
    monkeypatch.setattr(parity, "disagreement", lambda *devices: tests.append(tuple(known)))
    for known[:] in (("550.1", None), ("550.1", None), ("560.2", None), ("560.2", "0.2")):
        assert parity.cuda_disagreement() is None
    assert tests == [("550.1", None), ("560.2", None), ("560.2", "0.2")]


# ---- on a card ------------------------------------------------------------------------------------


@pytest.fixture
def real_card():
    device.CHOSEN.clear()
    if problem := device.cuda_problem():
        pytest.skip(f"no CUDA device: {problem}")


@pytest.mark.gpu
@pytest.mark.usefixtures("real_card")
def test_a_card_passes_the_self_test_and_fits(scene):
    assert parity.disagreement("cpu", "cuda") is None
    for strategy in ("default", "mcmc"):
        settings = SETTINGS.model_copy(update={"strategy": strategy})
        curves = [
            fit.fit_gaussians(scene, settings.model_copy(update={"device": each}), seed=0)[1]
            for each in ("cpu", "cuda")
        ]
        np.testing.assert_allclose(curves[1][:, 2], curves[0][:, 2], atol=0.2)  # dB


@pytest.mark.gpu
@pytest.mark.usefixtures("real_card")
def test_a_step_on_a_card_waits_only_within_gsplat(scene, monkeypatch):
    settings = SETTINGS.model_copy(update={"strategy": "mcmc"})
    (view, *_), generator = load_views(scene, "train", 0.5), np.random.default_rng(0)
    state = fit.FitState(TorchModel(first_gaussians(scene, [view.camera], settings, generator)), generator)
    fit.fit_step(state, [view], settings, 1.0)  # uploads the view
    rasterization = gsplat.rasterization

    def waiting(*arguments: object, **options: object) -> object:
        torch.cuda.set_sync_debug_mode("default")
        drawn = rasterization(*arguments, **options)
        torch.cuda.set_sync_debug_mode("error")
        return drawn

    monkeypatch.setattr(gsplat, "rasterization", waiting)
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(3):
            fit.fit_step(state, [view], settings, 1.0)
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.gpu
@pytest.mark.usefixtures("real_card")
def test_fused_ssim_has_the_same_value(monkeypatch):
    pytest.importorskip("fused_ssim")
    images = torch.rand(2, 40, 56, 3, device="cuda")
    fused = torch_model.photometric_loss(*images, 1.0).item()
    monkeypatch.setattr(torch_model, "fused_ssim", None)
    assert torch_model.photometric_loss(*images, 1.0).item() == pytest.approx(fused, rel=1e-4)
