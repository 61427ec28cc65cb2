"""Times of the rasteriser and of a fit's steps on the CPU and on CUDA, with the same scenes as `test_splat`.

    python -m benchmarks.devices                 # both devices; CUDA needs hilsplat[gpu]
    python -m benchmarks.devices --devices cpu

Times are medians. Those of pixel weights include copies between host and device.
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch

from benchmarks.scenes import SIZES, random_scene
from benchmarks.test_splat import HALF_WAY, SETTINGS
from hilsplat.base.tables import markdown_table
from hilsplat.scene.cameras import Camera
from hilsplat.splat.fit import FitState, fit_step
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.initial import TrainingView
from hilsplat.splat.model import model_on
from hilsplat.splat.rasterise import cuda
from hilsplat.splat.rasterise.api import draw, pixel_weights
from hilsplat.splat.rasterise.drawn import Device
from hilsplat.splat.rasterise.parity import disagreement

SIZES_TIMED = {**SIZES, "1M 986x728": (1_000_000, (728, 986))}
WARM_UP_S, TIMED_S, MIN_ROUNDS = 0.5, 2.0, 3


def median_ms(work: Callable[[], object]) -> float:
    """Return the median duration of a call after a warm-up, ms."""
    times: list[float] = []
    begun = time.perf_counter()
    work()
    while time.perf_counter() - begun < WARM_UP_S:
        work()
    while sum(times) < TIMED_S or len(times) < MIN_ROUNDS:
        begun = time.perf_counter()
        work()
        times.append(time.perf_counter() - begun)
    return 1e3 * statistics.median(times)


def times_of(gaussians: Gaussians, camera: Camera, device: Device, threads: int) -> list[float]:
    """Return the times of a view's pixel weights and of a step of a fit, ms."""
    view = TrainingView(camera, (255 * draw(gaussians, camera, 3).image.clip(0, 1)).astype(np.uint8))
    model = model_on(device)({field: getattr(gaussians, field).copy() for field in FIELDS}, threads)
    state = FitState(model, np.random.default_rng(0))
    model.steps = HALF_WAY

    def step() -> None:
        fit_step(state, [view], SETTINGS, 1.0)
        if device == "cuda":
            torch.cuda.synchronize()

    def weights() -> object:
        if device == "cpu":
            return pixel_weights(gaussians, camera, min_weight=1 / 255, threads=threads)
        g = cuda.on_device(gaussians)
        return cuda.pixel_weights(g, cuda.CardCamera.of(camera), 1 / 255).on_host()

    return [median_ms(weights), median_ms(step)]


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--devices", nargs="+", choices=("cpu", "cuda"), default=("cpu", "cuda"))
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    given = parser.parse_args()
    if "cuda" in given.devices:
        print("CUDA against the CPU:", disagreement("cpu", "cuda") or "equal up to rounding", flush=True)
    rows = []
    for name, (number, size_hw) in SIZES_TIMED.items():
        gaussians, camera = random_scene(number, size_hw)
        for device in given.devices:
            times = times_of(gaussians, camera, device, given.threads)
            rows.append((name, device, *(f"{value:.1f}" for value in times)))
            print(*rows[-1], flush=True)
    head = ("scene", "device", "pixel weights", "step of a fit")
    print(markdown_table(head, rows, 2))


if __name__ == "__main__":
    main()
