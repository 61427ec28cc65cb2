"""Peak memory of one forward and one backward pass, measured in a separate process (Linux).

    python -m benchmarks.memory 1000000 2160 3840 3     # Gaussians, height, width, channels

The script prints the peak of forward, and of forward and backward, in MiB beyond the scene itself. The peak
includes image, alpha, all gradients and intermediate arrays, but not the gradients of the image, which are
inputs.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np


def peaks_mib(num_gaussians: int, size_hw: tuple[int, int], channels: int) -> tuple[float, float]:
    """Return the peak of forward, and of forward and backward, measured in a new process."""
    numbers = [str(number) for number in (num_gaussians, *size_hw, channels)]
    command = [sys.executable, "-m", "benchmarks.memory", *numbers]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    return float(printed[-2]), float(printed[-1])


def _measure(num_gaussians: int, size_hw: tuple[int, int], channels: int) -> tuple[float, float]:
    from benchmarks.scenes import random_scene
    from cpusplat.views import blend_forward, blend_gradients, project_gradients
    from hilsplat.splat.rasterise.api import project_gaussians

    def passes(num: int, size_hw: tuple[int, int]) -> tuple[float, float]:
        gaussians, camera = random_scene(num, size_hw)
        features = np.ones((num, channels - 3), np.float32)
        grad = np.ones((*size_hw, channels), np.float32), np.ones(size_hw, np.float32)
        # This resets the recorded peak to the current memory use.
        Path("/proc/self/clear_refs").write_text("5")
        before = status_mib("VmRSS")
        view = project_gaussians(gaussians, camera, 3, 1)
        values = np.concatenate([view.colours, features], axis=1) if channels > 3 else view.colours
        image, alpha = blend_forward(view, values, 1)
        forward = status_mib("VmHWM") - before
        project_gradients(view, blend_gradients(view, values, image, alpha, *grad, 1), 1)
        return forward, status_mib("VmHWM") - before

    passes(1000, (32, 32))  # load the kernels before measuring
    return passes(num_gaussians, size_hw)


def status_mib(name: str) -> float:
    """Return a figure of this process's memory, such as "VmHWM", its peak."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) / 1024
    raise LookupError(f"/proc/self/status has no {name}")


if __name__ == "__main__":
    number, height, width, depth = (int(word) for word in sys.argv[1:])
    print(*(f"{peak:.0f}" for peak in _measure(number, (height, width), depth)))
