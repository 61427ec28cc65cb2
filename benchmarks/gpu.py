"""Everything that can be tested and measured only on an NVIDIA card, in one command (docs/gpu.md).

    make gpu                                  # on a card; about 450 s are planned on an H100 with 16 cores
    make gpu DEVICE=cpu                       # the same code on the CPU at tiny sizes, with gsplat in torch
    python -m benchmarks.gpu --part steps     # one part
    python -m benchmarks.gpu --models FOLDER  # with full-size networks (benchmarks.real_size exports them)

Each part fails alone; on a card, it runs in its own process. `gpu.json` and `gpu.md` are written to
results/benchmarks. Nothing is downloaded. On a card, the seconds that the estimate of a dry run uses are
written to hilsplat/workflow/gpu.json.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.large_scene import made_gaussians, ring_of_cameras
from benchmarks.scenes import random_scene
from benchmarks.table import markdown_table
from benchmarks.test_splat import HALF_WAY, SETTINGS
from hilsplat.base.artifacts import write_json, write_text
from hilsplat.base.cards import driver_version
from hilsplat.base.errors import first_line
from hilsplat.base.images import write_png
from hilsplat.models.folder import ModelFolder, input_side_px
from hilsplat.scene.scene import Scene
from hilsplat.settings import MasksSettings
from hilsplat.splat.fit import FitState, fit_gaussians, fit_step
from hilsplat.splat.gaussians import FIELDS
from hilsplat.splat.initial import TrainingView
from hilsplat.splat.model import model_on
from hilsplat.splat.rasterise.api import render
from hilsplat.splat.rasterise.parity import disagreement

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "results/benchmarks"
ESTIMATE = ROOT / "hilsplat/workflow/gpu.json"
LIMIT_S = 200  # of a part
CORES = os.cpu_count() or 1
TESTS = ("splat", "contributions", "models", "export")  # folders of tests/unit with tests of a card
MAX_PSNR_LOSS_DB = 0.5
"""Maximum by which the PSNR of a fit on a card may be below that of the same fit on the CPU."""


@dataclass(frozen=True)
class Sizes:
    """How much to measure."""

    copied: int  # bytes
    product: int  # side of the matrices that are multiplied
    steps: tuple[tuple[int, tuple[int, int]], ...]  # Gaussians, image size of fit steps
    fit: tuple[int, int, int, int]  # Gaussians of the scene, views, image side, steps
    long_fit: tuple[int, int, int, int] | None
    contributions: tuple[int, int, int, int]  # Gaussians, views, width, masks
    crops: tuple[int, ...]  # numbers in a batch
    prompts: tuple[int, ...]
    points_per_side: int


CARD = Sizes(
    2**31,
    8192,
    ((100_000, (600, 800)), (100_000, (1200, 1600)), (1_000_000, (728, 986)), (3_000_000, (728, 986))),
    (50_000, 24, 256, 1500),
    (1_000_000, 24, 800, 7000),
    (1_000_000, 24, 986, 300),
    (1, 64, 256),
    (16, 64, 256, 1024),
    32,
)
TINY = Sizes(
    2**24,
    256,
    ((100, (24, 32)), (100, (48, 64)), (200, (24, 32))),
    (200, 4, 32, 30),
    None,
    (2000, 2, 160, 30),
    (1, 4),
    (4, 8),
    4,
)


def synchronise(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def median_ms(work: Callable[[], object], device: str, rounds: int) -> float:
    """Return the median duration of a call after a warm-up, ms; of one call if it isn't on a card."""
    times, warm_ups = [], 2
    if device != "cuda":
        rounds, warm_ups = 1, 0
    for _ in range(rounds + warm_ups):
        synchronise(device)
        begun = time.perf_counter()
        work()
        synchronise(device)
        times.append(time.perf_counter() - begun)
    return 1e3 * statistics.median(times[warm_ups:])


# ---- parts ---------------------------------------------------------------------------------------


def machine(device: str, sizes: Sizes, models: Path | None) -> dict[str, Any]:
    """Versions, and how fast the device copies and multiplies."""
    import gsplat

    source = torch.ones(sizes.copied // 4, device=device)
    target = torch.empty_like(source)
    dtype = torch.bfloat16 if device == "cuda" else torch.float32
    matrix = torch.ones(sizes.product, sizes.product, device=device, dtype=dtype)
    copy_ms = median_ms(lambda: target.copy_(source), device, 5)
    product_ms = median_ms(lambda: matrix @ matrix, device, 5)
    return {
        "card": torch.cuda.get_device_name() if device == "cuda" else "none",
        "driver": driver_version(),
        "torch": torch.__version__,
        "gsplat": gsplat.__version__,
        "cores": CORES,
        "copy_tb_per_s": 2 * sizes.copied / copy_ms / 1e9,
        "product_tflop_per_s": 2 * sizes.product**3 / product_ms / 1e9,
    }


def parity(device: str, sizes: Sizes, models: Path | None) -> dict[str, Any]:
    """A step of the fit and pixel weights against the CPU."""
    if wrong := disagreement("cpu", "cuda"):
        raise RuntimeError(wrong)
    return {"differs": ""}


def tests(device: str, sizes: Sizes, models: Path | None) -> dict[str, Any]:
    """The tests that need a card."""
    if device == "cpu":
        return {"left out": "they need a card"}
    folders = [f"tests/unit/{name}" for name in TESTS]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "gpu", *folders]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    (last,) = done.stdout.strip().splitlines()[-1:]
    if done.returncode or "skipped" in last:
        raise RuntimeError(f"{last}\n{done.stdout[-4000:]}")
    return {"pytest": last}


def steps(device: str, sizes: Sizes, models: Path | None) -> dict[str, Any]:
    """Time of a fit's step, its longest operations, copied bytes, and peak memory."""
    return {"steps": [step_of(number, size_hw, device) for number, size_hw in sizes.steps]}


def step_of(number: int, size_hw: tuple[int, int], device: str) -> dict[str, Any]:
    gaussians, camera = random_scene(number, size_hw)
    picture = render(gaussians, camera, threads=CORES).colours.clip(0, 1)
    view = TrainingView(camera, (255 * picture).astype(np.uint8))
    model = model_on("cuda")({name: getattr(gaussians, name).copy() for name in FIELDS}, 1)
    state = FitState(model, np.random.default_rng(0))
    model.steps = HALF_WAY
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    step_ms = median_ms(lambda: fit_step(state, [view], SETTINGS, 1.0), device, 20 if device == "cuda" else 2)
    peak = torch.cuda.max_memory_allocated() if device == "cuda" else 0
    kinds = [torch.profiler.ProfilerActivity.CPU]
    kinds += [torch.profiler.ProfilerActivity.CUDA] if device == "cuda" else []
    with torch.profiler.profile(activities=kinds) as profile:
        fit_step(state, [view], SETTINGS, 1.0)
        synchronise(device)
    spent = "self_device_time_total" if device == "cuda" else "self_cpu_time_total"
    longest = sorted(profile.key_averages(), key=lambda event: -getattr(event, spent))[:8]
    return {
        "gaussians": number,
        "megapixels": size_hw[0] * size_hw[1] / 1e6,
        "step_ms": step_ms,
        "peak_mib": peak / 2**20,
        "copied_mb": copied_mb(profile),
        "longest_ms": {event.key[:60]: getattr(event, spent) / 1e3 for event in longest},
    }


def copied_mb(profile: torch.profiler.profile) -> dict[str, float]:
    """Megabytes that crossed the bus or were copied on the card, by direction."""
    copied: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        trace = Path(folder) / "trace.json"
        profile.export_chrome_trace(str(trace))
        events = json.loads(trace.read_text())["traceEvents"]
    for event in events:
        if event.get("cat") == "gpu_memcpy":
            copied[event["name"]] = copied.get(event["name"], 0) + event["args"].get("bytes", 0) / 1e6
    return copied


def fit(device: str, sizes: Sizes, models: Path | None) -> dict[str, Any]:
    """A fit on the CPU and on the card, from the same scene: seconds and training PSNR."""
    fits = {name: fitted(name, *sizes.fit) for name in ("cpu", "cuda")}
    if not fits["cuda"]["psnr_db"] > fits["cpu"]["psnr_db"] - MAX_PSNR_LOSS_DB:
        raise RuntimeError(f"the fit on the card is worse than on the CPU: {fits}")
    if sizes.long_fit is not None:
        fits["cuda, long"] = fitted("cuda", *sizes.long_fit)
    return fits


def fitted(device: str, number: int, views: int, side_px: int, iterations: int) -> dict[str, float]:
    """Fit pictures of made Gaussians, starting from a tenth of them; return seconds and the final PSNR."""
    gaussians, _ = made_gaussians(number)
    cameras = ring_of_cameras(views, (side_px * 3 // 4, side_px))
    start = np.random.default_rng(0).choice(number, number // 10, replace=False)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for name in cameras.names:
            picture = render(gaussians, cameras[name], threads=CORES).colours
            write_png(folder / "images" / name, (255 * picture.clip(0, 1)).astype(np.uint8))
        colours = np.full((len(start), 3), 128, np.uint8)
        split = dict.fromkeys(cameras.names, "train")
        points = gaussians.means[start]
        Scene(folder, "made/large", "metre", cameras, split, points, colours, np.eye(4)).save()
        settings = SETTINGS.model_copy(
            update={
                "device": device,
                "iterations": iterations,
                "steps_per_view": iterations,
                "max_gaussians": number,
            }
        )
        begun = time.perf_counter()
        result, curve = fit_gaussians(Scene.load(folder), settings, seed=0, threads=CORES)
        seconds = time.perf_counter() - begun
    last = curve[-max(1, len(curve) // 10) :, 2]
    return {"seconds": seconds, "psnr_db": float(last.mean()), "gaussians": float(len(result))}


def networks(device: str, sizes: Sizes, models: Path | None) -> dict[str, Any]:
    """SAM and CLIP on the device: milliseconds per picture, and per prompt and crop by batch."""
    from hilsplat.models.folder import open_model_folder
    from hilsplat.models.store import EMBEDDED

    folders = [*models.iterdir()] if models else [ROOT / folder for folder in EMBEDDED.values()]
    opened = [open_model_folder(folder) for folder in folders]
    times = {"sam": times_of_sam, "clip": times_of_clip}
    torch_device = "cuda" if device == "cuda" else "cpu:0"  # `cpu` means onnxruntime
    return {model.folder.name: times[model.kind](model, torch_device, sizes) for model in opened}


def times_of_sam(model: ModelFolder, device: str, sizes: Sizes) -> dict[str, Any]:
    from hilsplat.segment.generate import decode_candidates
    from hilsplat.segment.sam import SamModel

    sam = SamModel(model, device)
    picture = np.random.default_rng(0).integers(0, 256, (600, 800, 3)).astype(np.uint8)
    settings = MasksSettings(points_per_side=sizes.points_per_side)
    encoded, rng = sam.encode(picture), np.random.default_rng(1)

    def prompt_ms(number: int) -> float:
        points = rng.uniform(0, (800, 600), (number, 2))
        return median_ms(lambda: sam.decode(encoded, points), device, 3) / number

    fixed = 0 if sam.factored else sam.decoder.prompts_per_call
    return {
        "encode_ms": median_ms(lambda: sam.encode(picture), device, 3),
        "prompt_ms": {number: prompt_ms(number) for number in ([fixed] if fixed else sizes.prompts)},
        "picture_ms": median_ms(lambda: decode_candidates(picture, sam, settings, None), device, 2),
        "decoder": "factored" if sam.factored else "as exported",
    }


def times_of_clip(model: ModelFolder, device: str, sizes: Sizes) -> dict[str, Any]:
    from hilsplat.embed.clip import ClipModel

    clip, rng = ClipModel(model, device=device), np.random.default_rng(0)

    def crop_ms(number: int) -> float:
        crops = rng.integers(0, 256, (number, *[input_side_px(model)] * 2, 3)).astype(np.uint8)
        return median_ms(lambda: clip.embed_crops(crops), device, 3) / number

    return {"crop_ms": {number: crop_ms(number) for number in sizes.crops}}


def contributions(device: str, sizes: Sizes, models: Path | None) -> dict[str, Any]:
    """Contributions of a generated scene on the CPU and on the card."""
    from benchmarks.large_scene import make, stages

    number, views, width, masks = sizes.contributions
    seconds = {}
    with tempfile.TemporaryDirectory() as temporary:
        out, threads = Path(temporary), CORES
        make(out, number, views, (width * 3 // 4, width), masks, threads)
        for name in ("cpu", "cuda"):
            begun = time.perf_counter()
            stages(out, threads, name)["contributions"]()
            seconds[f"{name}_s"] = time.perf_counter() - begun
    return seconds


def slots(device: str, sizes: Sizes, models: Path | None) -> dict[str, Any]:
    """Two jobs and one card: the second waits until the first has ended."""
    hold = "import time; from hilsplat.base.cards import take_card; take_card(); time.sleep(2)"
    environment = {
        **os.environ,
        "CUDA_VISIBLE_DEVICES": os.environ.get("CUDA_VISIBLE_DEVICES", "0")[:1] or "0",
    }
    with tempfile.TemporaryDirectory() as folder:
        environment["TMPDIR"] = folder
        begun = time.perf_counter()
        jobs = [subprocess.Popen([sys.executable, "-c", hold], env=environment, cwd=ROOT) for _ in range(2)]
        failed = [job.wait() for job in jobs]
    seconds = time.perf_counter() - begun
    if any(failed) or seconds < 4:
        raise RuntimeError(f"two jobs of 2 s on one card took {seconds:.1f} s")
    return {"seconds": seconds}


def answer(device: str, sizes: Sizes, models: Path | None) -> dict[str, Any]:
    """A run from posed photographs to scores."""
    if device == "cpu":
        return {"left out": "make test runs the workflow on the CPU"}
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "hilsplat", "run", "--config", str(ROOT / "config/ci.yaml")]
        begun = time.perf_counter()
        subprocess.run(command, check=True, cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)})
        return {"seconds": time.perf_counter() - begun}


PARTS = (machine, parity, tests, steps, fit, networks, contributions, slots, answer)


# ---- results -------------------------------------------------------------------------------------


def run_parts(names: Sequence[str], device: str, models: Path | None) -> dict[str, Any]:
    """Run parts in one new process; each result has its seconds, and "failed" if the part failed."""
    command = [sys.executable, "-m", "benchmarks.gpu", "--part", *names, "--device", device]
    command += ["--models", str(models)] if models else []
    limit_s = LIMIT_S * len(names)
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit_s, cwd=ROOT)
        if not done.returncode:
            return json.loads(done.stdout.splitlines()[-1])
        problem = done.stderr[-4000:]
    except subprocess.TimeoutExpired:
        problem = f"it took more than {limit_s} s"
    return {name: {"failed": problem, "part_s": 0.0} for name in names}


def result_of(part: Callable[..., dict[str, Any]], *given: Any) -> dict[str, Any]:
    """Run a part in this process; the result is that of `run_parts`."""
    begun, result = time.perf_counter(), dict[str, Any]()
    try:
        result = part(*given)
    except Exception:  # the other parts still run
        result["failed"] = traceback.format_exc()[-4000:]
    return {**result, "part_s": time.perf_counter() - begun}


def estimate_of(results: dict[str, Any]) -> dict[str, Any]:
    """Return the seconds for `hilsplat/workflow/gpu.json`; those of a step by least squares."""
    rows = results["steps"]["steps"]
    terms = np.array([[1.0, row["megapixels"], row["gaussians"]] for row in rows])
    scale = terms.max(axis=0)
    from scipy.optimize import nnls

    weights, _ = nnls(terms / scale, np.array([row["step_ms"] / 1e3 for row in rows]))
    base, per_mp, per_gaussian = (weights / scale).tolist()
    known = json.loads(ESTIMATE.read_text(encoding="utf-8"))
    sam_s = dict(known["sam_picture_s"])
    crop_s = known["clip_crop_s"]
    for name, result in results["networks"].items():
        if isinstance(result, dict) and "picture_ms" in result:
            sam_s[next(word for word in sam_s if word in name)] = result["picture_ms"] / 1e3
        elif isinstance(result, dict) and "crop_ms" in result:
            crop_s = min(result["crop_ms"].values()) / 1e3
    return {
        "card": results["machine"]["card"],
        "measured": True,
        "fit_step_s": base,
        "fit_step_s_per_mp": per_mp,
        "fit_step_s_per_gaussian": per_gaussian,
        "sam_picture_s": sam_s,
        "clip_crop_s": crop_s,
    }


def main() -> int:
    """Run all parts or one, write the results, and return 1 if a part failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    names = [part.__name__ for part in PARTS]
    parser.add_argument("--part", nargs="+", choices=names)
    parser.add_argument("--models", type=Path, help="folder of model folders; default: the embedded models")
    parser.add_argument("--out", type=Path, default=OUT)
    given = parser.parse_args()
    if given.part:
        if given.device == "cpu":
            import pytest

            from tests.unit.card_on_cpu import replace_kernels

            replace_kernels(pytest.MonkeyPatch())
        sizes = CARD if given.device == "cuda" else TINY
        chosen = [part for part in PARTS if part.__name__ in given.part]
        print(
            json.dumps({each.__name__: result_of(each, given.device, sizes, given.models) for each in chosen})
        )
        return 0
    results = {}
    # a part that fails on a card may leave it unusable for its process
    for together in [[name] for name in names] if given.device == "cuda" else [names]:
        for name, result in run_parts(together, given.device, given.models).items():
            results[name], state = result, "FAILED" if "failed" in result else "passed"
            print(f"{name:<14} {state} {result['part_s']:6.1f} s", flush=True)
    write_json(given.out / "gpu.json", results)
    failed = {name: result["failed"] for name, result in results.items() if "failed" in result}
    rows: list[tuple[str, ...]] = [
        (
            name,
            "failed" if name in failed else "",
            f"{result['part_s']:.0f}",
            json.dumps({key: value for key, value in result.items() if key not in ("failed", "part_s")}),
        )
        for name, result in results.items()
    ]
    write_text(given.out / "gpu.md", markdown_table(("part", "", "s", "results"), rows) + "\n")
    print(f"wrote {given.out / 'gpu.json'} and {given.out / 'gpu.md'}")
    if given.device == "cuda" and not {"machine", "steps"} & failed.keys() and given.models:
        write_json(ESTIMATE, estimate_of(results))
        print(f"wrote {ESTIMATE}: the dry run's estimate uses this card")
    for name, problem in failed.items():
        print(f"\n{name} failed: {first_line(problem.strip().splitlines()[-1])}\n{problem}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
