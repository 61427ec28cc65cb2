"""Time and memory of each stage of the method on a synthetic scene of the size of a large capture.

    python -m benchmarks.large_scene LARGE                             # 1M Gaussians, 250 views of 986 x 728
    python -m benchmarks.large_scene SMALL --gaussians 100000 --views 48 --width 800 --height 600

The scene is a floor with 400 balls and a ring of cameras. Each view has masks at three levels (balls, halves,
eighths; the largest of each level) with a CLIP vector each. Coverage tree, contributions, semantic tree,
autoencoder and field run in order, each in its own process. An existing scene is reused. Times and peak
memory are printed and written to `times.md` and `times.json`.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.memory import status_mib
from hilsplat.base.artifacts import write_index, write_npy
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.levels import LEVELS
from hilsplat.base.processes import keep_freed_memory
from hilsplat.base.progress import track
from hilsplat.base.tables import markdown_table
from hilsplat.contributions.stage import run_contributions
from hilsplat.field.autoencoder import run_autoencoder
from hilsplat.field.field import run_field
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.scene import Scene
from hilsplat.segment.coverage import run_coverage_tree
from hilsplat.segment.digests import MASKS_SHA256, digest_of, index_entry
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.semantic_tree.build import run_semantic_tree
from hilsplat.settings import (
    AutoencoderSettings,
    ContributionsSettings,
    CoverageTreeSettings,
    FieldSettings,
    SemanticTreeSettings,
)
from hilsplat.splat.gaussians import Gaussians, morton_order
from hilsplat.splat.ply import save_ply
from hilsplat.splat.rasterise.api import pixel_weights
from hilsplat_world.views import looking_at

ROWS = 20  # number of rows and of columns of balls, which are one metre apart
RADIUS = 0.38
CHANNELS = 512
MIN_AREA_PX = 50
STAGES = ("coverage_tree", "contributions", "semantic_tree", "autoencoder", "field")


def made_gaussians(number: int) -> tuple[Gaussians, np.ndarray]:
    """Return Gaussians of the balls (70 %) and of the floor, in the order of a fit's output.

    Returns:
        The Gaussians, and (N, 3) the ball, half and eighth of each, -1 on the floor.
    """
    rng = np.random.default_rng(0)
    on_balls = number * 7 // 10
    ball = rng.integers(0, ROWS * ROWS, on_balls)
    way = rng.normal(size=(on_balls, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    centre = np.stack([ball % ROWS - ROWS / 2, ball // ROWS - ROWS / 2, np.full(on_balls, RADIUS)], axis=1)
    on_floor = number - on_balls
    positions = rng.uniform(-ROWS * 0.6, ROWS * 0.6, (on_floor, 2))
    floor = np.concatenate([positions, np.zeros((on_floor, 1))], axis=1)
    half = 2 * ball + (way[:, 2] > 0)
    eighth = 4 * half + 2 * (way[:, 0] > 0) + (way[:, 1] > 0)
    labels = np.full((number, len(LEVELS)), -1, np.int32)
    labels[:on_balls] = np.stack([ball, half, eighth], axis=1)
    spacing = np.sqrt((ROWS * ROWS * 4 * np.pi * RADIUS**2 + (1.2 * ROWS) ** 2) / number)
    arrays = (
        np.concatenate([centre + RADIUS * way, floor]),
        np.log(spacing) + 0.4 * rng.normal(size=(number, 3)),
        rng.normal(size=(number, 4)),
        rng.normal(0.5, 1.5, size=number),
        0.3 * rng.normal(size=(number, 1, 3)),
    )
    order = morton_order(arrays[0])
    return Gaussians(*(values[order].astype(np.float32) for values in arrays)), labels[order]


def ring_of_cameras(number: int, size_hw: tuple[int, int]) -> Cameras:
    """Return cameras at two heights around the balls that look at points near the middle."""
    rng = np.random.default_rng(1)
    poses = np.empty((number, 4, 4))
    for index in range(number):
        angle = 2 * np.pi * index / number
        at = np.array([np.cos(angle), np.sin(angle), 0]) * ROWS * 0.55 + [0, 0, (3.0, 5.5)[index % 2]]
        poses[index] = looking_at(at, np.append(rng.uniform(-ROWS / 6, ROWS / 6, 2), 0))
    focal = 0.9 * size_hw[1]
    K = np.array([[focal, 0, size_hw[1] / 2], [0, focal, size_hw[0] / 2], [0, 0, 1]])
    names = tuple(f"{index:04d}.png" for index in range(number))
    sizes = np.tile(np.array(size_hw, np.int32), (number, 1))
    return Cameras(names, poses, np.tile(K, (number, 1, 1)), sizes)


def make(out: Path, number: int, views: int, size_hw: tuple[int, int], masks: int, threads: int) -> None:
    """Write scene, Gaussians, masks and CLIP vectors."""
    rng = np.random.default_rng(2)
    gaussians, labels = made_gaussians(number)
    save_ply(out / "gaussians.ply", gaussians)
    cameras = ring_of_cameras(views, size_hw)
    nothing = np.zeros((0, 3), np.float32)
    with atomic_folder(out / "scene") as folder:
        split = dict.fromkeys(cameras.names, "train")
        Scene(
            folder, "made/large", "metre", cameras, split, nothing, nothing.astype(np.uint8), np.eye(4)
        ).save()
    things = [rng.normal(size=(ROWS * ROWS * pieces, CHANNELS)) for pieces in (1, 2, 8)]
    index_of_masks, index_of_clip, nonzeros = {}, {}, 0
    with atomic_folder(out / "masks") as masks_folder, atomic_folder(out / "clip") as clip_folder:
        for name in track(list(cameras.names), "masks of views"):
            weights = pixel_weights(gaussians, cameras[name], min_weight=1 / 255, threads=threads)
            nonzeros += weights.nnz
            front = front_gaussian(weights)
            dense, level, vectors = [], [], []
            for which in LEVELS:
                label = np.where(front >= 0, labels[front, which.index], -1)
                area = np.bincount(label[label >= 0], minlength=len(things[which.index]))
                largest = np.argsort(-area, kind="stable")[: masks // len(LEVELS)]
                for thing in largest[area[largest] >= MIN_AREA_PX]:
                    dense.append((label == thing).reshape(size_hw))
                    level.append(which)
                    vectors.append(things[which.index][thing] + 0.7 * rng.normal(size=CHANNELS))
            ones = np.ones(len(dense), np.float32)
            drawn = HierarchicalMasks.from_dense(np.stack(dense), np.array(level, np.uint8), ones, ones)
            drawn.save(masks_folder / f"{name}.npz")
            unit = np.stack(vectors)
            unit /= np.linalg.norm(unit, axis=1, keepdims=True)
            write_npy(clip_folder / f"{name}.npy", unit.astype(np.float16))
            index_of_masks[name] = index_entry(drawn)
            index_of_clip[name] = {MASKS_SHA256: digest_of(drawn), "masks": len(drawn)}
        print(f"{nonzeros / views / size_hw[0] / size_hw[1]:.1f} Gaussians per pixel")
        write_index(masks_folder, index_of_masks, scene="made/large", segmenter="made", model="")
        write_index(clip_folder, index_of_clip, scene="made/large", dim=CHANNELS, model="")


def front_gaussian(weights) -> np.ndarray:
    """Return the Gaussian with the largest weight at each pixel, -1 for none."""
    front = np.full(weights.shape[0], -1, np.int64)
    counts = np.diff(weights.indptr)
    filled = np.flatnonzero(counts)
    largest = np.maximum.reduceat(weights.data, weights.indptr[filled])
    entries = np.flatnonzero(weights.data == np.repeat(largest, counts[filled]))
    pixel = np.repeat(filled, counts[filled])[entries]
    front[pixel] = weights.indices[entries]
    return front


def stages(out: Path, threads: int, device: Literal["cpu", "cuda"]) -> dict[str, Callable[[], None]]:
    """Return the stages to time; `device` applies to contributions."""
    code = AutoencoderSettings(code="pca", latent=16)
    return {
        "coverage_tree": lambda: run_coverage_tree(
            out / "masks", out / "coverage_tree", CoverageTreeSettings()
        ),
        "contributions": lambda: run_contributions(
            out / "scene",
            out / "gaussians.ply",
            out / "masks",
            out / "contributions",
            out / "cache",
            ContributionsSettings(device=device),
            threads,
        ),
        "semantic_tree": lambda: run_semantic_tree(
            out / "contributions",
            out / "masks",
            out / "semantic_tree",
            SemanticTreeSettings(),
            threads,
        ),
        "autoencoder": lambda: run_autoencoder(
            out / "clip", out / "semantic_tree", out / "contributions", out / "autoencoder", code, 0
        ),
        "field": lambda: run_field(
            out / "contributions",
            out / "coverage_tree",
            out / "autoencoder",
            out / "field.safetensors",
            FieldSettings(),
            threads,
        ),
    }


def main() -> None:
    """Run one stage, or make the scene, run all stages and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--views", type=int, default=250)
    parser.add_argument("--width", type=int, default=986)
    parser.add_argument("--height", type=int, default=728)
    parser.add_argument("--masks", type=int, default=300, help="masks per view, at all levels together")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument(
        "--stage",
        choices=STAGES,
        help="run this stage in this process; print its seconds, CPU seconds and MiB",
    )
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    if given.stage:
        keep_freed_memory()  # as all commands do
        begun, begun_cpu = time.perf_counter(), time.process_time()
        stages(given.out, given.threads, given.device)[given.stage]()
        seconds, cpu = time.perf_counter() - begun, time.process_time() - begun_cpu
        print(f"{seconds:.1f} {cpu:.1f} {status_mib('VmHWM'):.0f}")
        return
    if not (given.out / "clip").exists():
        size_hw = (given.height, given.width)
        make(given.out, given.gaussians, given.views, size_hw, given.masks, given.threads)
    rows = []
    for stage in STAGES:
        command = [sys.executable, "-m", "benchmarks.large_scene", str(given.out), "--stage", stage]
        command += ["--threads", str(given.threads), "--device", given.device]
        environment = {**os.environ, "NUMBA_NUM_THREADS": str(given.threads)}
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
        rows.append((stage, *done.stdout.split()[-3:]))
        print(*rows[-1], flush=True)
    totals = (f"{sum(float(row[column]) for row in rows):.1f}" for column in (1, 2))
    rows.append(("all", *totals, max((row[3] for row in rows), key=float)))
    table = markdown_table(("stage", "s", "CPU s", "peak MiB"), rows, 1)
    (given.out / "times.md").write_text(table + "\n")
    times = {stage: list(map(float, values)) for stage, *values in rows}
    (given.out / "times.json").write_text(json.dumps(times) + "\n")
    print(table)


if __name__ == "__main__":
    main()
