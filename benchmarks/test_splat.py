"""Timings of the CPU rasteriser, the photometric loss and a whole fit iteration on random scenes.

One thread is timed in processor time, which depends less on other load, and two threads in wall time. Both
report the minimum of many rounds. Only hits (a Gaussian blended at a pixel) count as useful operations:
22 + 2 D forward, 40 + 4 D backward, where D is the number of colour and feature channels.
"""

import time
from functools import cache

import numpy as np
import pytest

from benchmarks.goals import Goal
from benchmarks.memory import peaks_mib
from benchmarks.scenes import SIZES, random_scene
from cpusplat.photometric import photometric_loss
from cpusplat.views import blend_forward, blend_gradients, project_gradients
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.fit import FitState, fit_step
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.initial import TrainingView
from hilsplat.splat.model import Model
from hilsplat.splat.rasterise.api import pixel_weights, project_gaussians

LARGE = "100k 800x600"
HALF_WAY = 500_000
# settings of the middle of a fit: all harmonics are on, gradients are accumulated, no density control
SETTINGS = GaussiansSettings(
    iterations=2 * HALF_WAY,
    sh_degree=3,
    max_gaussians=1_000_000,
    densify_every=4 * HALF_WAY,
    opacity_reset_every=4 * HALF_WAY,
    device="cpu",
)

scenes = pytest.mark.parametrize("scene", SIZES)
threads = pytest.mark.parametrize(
    "threads",
    [
        pytest.param(1, marks=pytest.mark.benchmark(timer=time.process_time, min_rounds=12, max_time=1.5)),
        pytest.param(2, marks=pytest.mark.benchmark(timer=time.perf_counter, min_rounds=25, max_time=3.0)),
    ],
)
channels = pytest.mark.parametrize("channels", [3, 9])


def name(what: str, scene: str, threads: int, channels: int | None = None) -> str:
    """Return the name of a case, as used in the goals."""
    width = f", D={channels}" if channels else ""
    return f"{what}, {scene}{width}, {threads} thread{'s' if threads > 1 else ''}"


@cache
def scene_of(scene: str) -> tuple:
    """Return camera, Gaussians, and number of hits (Gaussians blended at pixels) of a scene."""
    gaussians, camera = random_scene(*SIZES[scene])
    hits = pixel_weights(gaussians, camera, min_weight=0.0, threads=2)
    return camera, gaussians, hits.nnz


def blended(gaussians: Gaussians, view, channels: int) -> np.ndarray:
    """Return colours, followed by random features up to the number of channels."""
    rng = np.random.default_rng(1)
    more = rng.normal(size=(len(gaussians), channels - 3)).astype(np.float32)
    return np.concatenate([view.colours, more], axis=1) if channels > 3 else view.colours


@scenes
@channels
@threads
def test_forward(benchmark, scene, channels, threads):
    camera, gaussians, hits = scene_of(scene)
    values = blended(gaussians, project_gaussians(gaussians, camera, 3, 1), channels)

    def forward():
        return blend_forward(project_gaussians(gaussians, camera, 3, threads), values, threads)

    benchmark.extra_info |= {"case": name("forward", scene, threads, channels), "threads": threads}
    benchmark.extra_info |= {"count": hits, "of": "hits", "flop": hits * (22 + 2 * channels)}
    _, alpha = benchmark(forward)
    assert alpha.mean() > 0.9


@scenes
@channels
@threads
def test_backward(benchmark, scene, channels, threads):
    camera, gaussians, hits = scene_of(scene)
    view = project_gaussians(gaussians, camera, 3, threads)
    values = blended(gaussians, view, channels)
    image, alpha = blend_forward(view, values, threads)
    rng = np.random.default_rng(2)
    grads = [rng.normal(size=shown.shape).astype(np.float32) for shown in (image, alpha)]

    def backward():
        sums = blend_gradients(view, values, image, alpha, *grads, threads)
        return project_gradients(view, sums, threads)[0]

    benchmark.extra_info |= {"case": name("backward", scene, threads, channels), "threads": threads}
    benchmark.extra_info |= {"count": hits, "of": "hits", "flop": hits * (40 + 4 * channels)}
    assert np.abs(benchmark(backward).means).max() > 0


@scenes
@threads
def test_fit_iteration(benchmark, scene, threads):
    camera, gaussians, _ = scene_of(scene)
    view = project_gaussians(gaussians, camera, 3, 2)
    image, _ = blend_forward(view, view.colours, 2)
    target = (255 * np.clip(image, 0, 1)).astype(np.uint8)
    views = [TrainingView(camera, target)]
    rng = np.random.default_rng(3)
    start = {field: getattr(gaussians, field).copy() for field in FIELDS}
    start["sh"] += 0.1 * rng.normal(size=start["sh"].shape).astype(np.float32)
    state = FitState(Model(start, threads), rng)

    def reset():
        # Every round starts from the same Gaussians, so that the number of hits stays valid.
        for field in FIELDS:
            state.model.parameters[field][...] = start[field] if field == "sh" else getattr(gaussians, field)
        state.model.steps, state.order = HALF_WAY, []

    benchmark.extra_info |= {"case": name("fit iteration", scene, threads), "count": 1, "of": "iterations"}
    benchmark.pedantic(lambda: fit_step(state, views, SETTINGS, 1.0), setup=reset, rounds=25)


@threads
def test_photometric_loss(benchmark, threads):
    rng = np.random.default_rng(4)
    image, target = (rng.random((600, 800, 3), np.float32) for _ in range(2))
    benchmark.extra_info |= {"case": name("photometric loss", "800x600", threads)}
    loss, _ = benchmark(lambda: photometric_loss(image, target, ssim_weight=0.2, threads=threads))
    assert loss > 0


@pytest.mark.parametrize("channels", [3, 16])
def test_peak_memory(benchmark, channels):
    """Measure peak memory; the timing covers the whole measuring process and is not meaningful."""
    benchmark.extra_info |= {"case": memory_case(channels)}
    _, peak = benchmark.pedantic(lambda: peaks_mib(*SIZES[LARGE], channels), rounds=1)
    benchmark.extra_info["peak_mib"] = peak


def memory_case(channels: int) -> str:
    """Return the name of a memory case."""
    return f"memory of forward and backward, {LARGE}, D={channels}"


def _ratio(what: str, above: tuple, below: tuple):
    """Return a function that divides the time of one case by that of another."""
    return lambda times: times[name(what, *above)] / times[name(what, *below)]


GOALS = [
    Goal("forward, 100k 800x600, D=3, 1 thread", "ms", 70, lambda t: t[name("forward", LARGE, 1, 3)]),
    Goal("the same, stretch", "ms", 41, lambda t: t[name("forward", LARGE, 1, 3)]),
    Goal("backward, 100k 800x600, D=3, 1 thread", "ms", 100, lambda t: t[name("backward", LARGE, 1, 3)]),
    Goal("the same, stretch", "ms", 61, lambda t: t[name("backward", LARGE, 1, 3)]),
    Goal(
        "forward and backward, D=9 over D=3, 1 thread",
        "x",
        1.6,
        lambda t: (
            sum(t[name(what, LARGE, 1, 9)] for what in ("forward", "backward"))
            / sum(t[name(what, LARGE, 1, 3)] for what in ("forward", "backward"))
        ),
    ),
    Goal(
        "forward, 1 thread over 2", "x", 1.7, _ratio("forward", (LARGE, 1, 3), (LARGE, 2, 3)), at_least=True
    ),
    Goal(
        "backward, 1 thread over 2", "x", 1.7, _ratio("backward", (LARGE, 1, 3), (LARGE, 2, 3)), at_least=True
    ),
    Goal(
        "fit iteration, 1 thread over 2",
        "x",
        1.7,
        _ratio("fit iteration", (LARGE, 1), (LARGE, 2)),
        at_least=True,
    ),
    Goal(
        "fit iterations, 100k 800x600, 2 threads",
        "per s",
        6,
        lambda t: 1e3 / t[name("fit iteration", LARGE, 2)],
        at_least=True,
    ),
    Goal(
        "fit iterations, 20k 256x256, 2 threads",
        "per s",
        45,
        lambda t: 1e3 / t[name("fit iteration", "20k 256x256", 2)],
        at_least=True,
    ),
    Goal(
        "peak memory of forward and backward, 100k 800x600",
        "MiB",
        200,
        lambda t: t[f"{memory_case(3)}, peak MiB"],
    ),
]
