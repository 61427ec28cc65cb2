"""Structure from motion of large synthetic captures with random file names, compared with the true cameras.

    python -m benchmarks.shuffled_capture FOLDER world:street:301 --views 900 --px 200
    python -m benchmarks.shuffled_capture FOLDER drive:1 --views 1000 --px 200     # a long row of houses
    python -m benchmarks.shuffled_capture FOLDER --mapper global                   # an existing capture

A drive passes a row of houses, 2.2 m per view, and looks to the side. The script renders the capture into
FOLDER unless it exists, poses it in the folder's subfolder <matcher>-<mapper> and prints one line; existing
matches are reused. Two views are partners if each sees at least a tenth of the other's pixels (a grid of 144
is compared), at half to twice the size and at most `FAR` away.
"""

import argparse
import os
import time
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.table import markdown_table
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.images import write_png
from hilsplat.base.processes import in_own_process, in_processes
from hilsplat.base.progress import track
from hilsplat.evaluate.stage import scene_from_true
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.colmap import pose_matrix, pycolmap
from hilsplat.scene.features import find_matches, lenses_of, prepare_images
from hilsplat.scene.mapping import map_views
from hilsplat.settings import PosesSettings
from hilsplat_world.paints import Paint
from hilsplat_world.render import render_view
from hilsplat_world.scenes.kinds import build_scene, scene_cameras
from hilsplat_world.scenes.scene import Assembly, Style, WorldScene
from hilsplat_world.shapes import box
from hilsplat_world.stage import parse_source
from hilsplat_world.views import numbered_cameras, on_sphere

STEP_M = 2.2  # distance between the views of a drive
FRONT_M = 10.3  # distance from the camera's path to the house fronts
SAMPLES = 1  # per pixel
FAR = 60.0  # the sky of a street is further away
GRID = 12
PARTNER_SHARE = 0.1


def built(source: str, views: int, px: int) -> tuple[WorldScene, Cameras]:
    """Return the scene and the cameras of a source, "world:<kind>:<seed>" or "drive:<seed>"."""
    if not source.startswith("drive:"):
        scene = build_scene(*parse_source(source), 6)
        return scene, scene_cameras(scene, views, px, 360)
    seed, length = int(source.removeprefix("drive:")), STEP_M * views
    rng, assembly, x = np.random.default_rng(seed), Assembly("street", seed, 4.0), -20.0
    while x < length + 20:
        house = assembly.draw("building")
        width = float(np.ptp(house.triangles[..., 1])) + 0.2
        assembly.add_object(house, 1.0, np.array([x + width / 2, FRONT_M]), -90.0)
        x += width
    grey, dark = (0.45, 0.45, 0.46), (0.28, 0.28, 0.30)
    tar = Paint("grey", "mottled", grey, dark, 12.0, 0.03, 8.0, 0.34, (5.0, 7.0, 9.0))
    assembly.add_surroundings("road", (), [(box((length + 80, 60, 0.2), (length / 2, 0, -0.1)), tar)])
    light, sky = np.array([1.15, 1.1, 1.0]), np.array([0.4, 0.45, 0.54])
    style = Style.of(np.array([length / 2, -600, 800]), 14.0, light * 1e6 / 13, sky, sky / 2, 1.1, 4.0, 45.0)
    sights = []
    for row in range(views):
        centre = np.array([STEP_M * row, 0, 1.8]) + rng.uniform(-1, 1, 3) * (0.2, 0.8, 0.2)
        sights.append((centre, centre + on_sphere(90 + rng.uniform(-5, 5), rng.uniform(2, 6), 1.0)))
    return assembly.finished(0, (), style), numbered_cameras(sights, px, 62.0)


def _render(source: str, views: int, px: int, rows: range) -> list[np.ndarray]:
    scene, cameras = built(source, views, px)
    return [render_view(scene, cameras[cameras.names[row]], SAMPLES) for row in rows]


def render(folder: Path, source: str, views: int, px: int, threads: int) -> None:
    """Render a capture with random names, and write its true cameras and the views that overlap."""
    scene, cameras = built(source, views, px)
    numbers = np.random.default_rng(0).choice(2**31, views, replace=False)
    names = tuple(f"{number:08x}.png" for number in numbers)
    with atomic_folder(folder) as work:
        (work / "images").mkdir()
        jobs = [(source, views, px, range(row, views, threads)) for row in range(threads)]
        for rows, images in zip((job[3] for job in jobs), in_processes(_render, jobs, threads), strict=True):
            for row, image in zip(rows, images, strict=True):
                write_png(work / "images" / names[row], image)
        Cameras(names, cameras.cam_from_world, cameras.K, cameras.size_hw).save(work / "cameras.npz")
        np.save(work / "partners.npy", true_partners(scene, cameras))


def true_partners(scene: WorldScene, cameras: Cameras) -> Bool[np.ndarray, "V V"]:
    """Return whether two views see the same surface, in the order of `cameras.names`."""
    size, K = float(cameras.size_hw[0, 0]), cameras.K[0]
    x, y = np.meshgrid(*[(np.arange(GRID) + 0.5) * size / GRID] * 2)
    rays = np.stack([x.ravel(), y.ravel(), np.ones(GRID**2)], axis=1) @ np.linalg.inv(K).T
    turns, shifts = cameras.cam_from_world[:, :3, :3], cameras.cam_from_world[:, :3, 3]
    centres = np.stack([cameras[name].centre for name in cameras.names]).astype(np.float32)
    share = np.zeros((len(centres), len(centres)))
    for row in track(range(len(centres)), "overlaps"):
        toward = (rays @ turns[row]).astype(np.float32)
        hits = scene.caster.nearest(centres[row : row + 1], toward)
        hit = (hits.triangle >= 0) & (hits.distance < FAR)
        points, depth = centres[row] + toward[hit] * hits.distance[hit, None], hits.distance[hit]
        view, point = _inside(points, turns, shifts, K, size, depth)
        reach = np.full(len(view), 0.995, np.float32)  # up to just before the point
        free = ~scene.caster.blocked(centres[view], points[point] - centres[view], reach)
        share[row] = np.bincount(view[free], minlength=len(centres)) / GRID**2
    return np.minimum(share, share.T) >= PARTNER_SHARE


def _inside(
    points: Float[np.ndarray, "P 3"],
    turns: Float[np.ndarray, "V 3 3"],
    shifts: Float[np.ndarray, "V 3"],
    K: Float[np.ndarray, "3 3"],
    size: float,
    depth: Float[np.ndarray, " P"],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the (view, point) pairs where the point is in the image, at half to twice its depth."""
    seen = np.einsum("vij,pj->vpi", turns, points) + shifts[:, None]
    z = np.maximum(seen[..., 2], 1e-6)
    pixel = seen[..., :2] / z[..., None] * K[0, 0] + K[0, 2]
    fits = ((pixel > 0) & (pixel < size)).all(axis=-1) & (z < 2 * depth) & (z > depth / 2)
    view, point = np.nonzero(fits)
    return view, point


def run(folder: Path, settings: PosesSettings, threads: int) -> dict[str, str]:
    """Return the row of one run's table."""
    true, partners = Cameras.load(folder / "cameras.npz"), np.load(folder / "partners.npy")
    work = folder / f"{settings.matcher}-{settings.mapper}"
    images, _ = prepare_images(sorted((folder / "images").iterdir()), work / "images", settings.max_side_px)
    started, database = _clocks(), work / "features.db"
    if not database.exists():
        lenses = lenses_of(images, "simple_pinhole", "auto")
        unfinished = work / "unfinished.db"  # a killed run leaves no matches that a later run would reuse
        unfinished.unlink(missing_ok=True)
        in_own_process(find_matches, unfinished, work / "images", lenses, {}, settings, 0, threads)
        unfinished.rename(database)
    matched = _clocks()
    models = map_views(database, work / "images", work / "models", settings.mapper, 0)
    mapped = _clocks()
    poses = {models[0].images[i].name: models[0].images[i] for i in models[0].reg_image_ids()}
    names = tuple(sorted(poses))
    fitted = np.stack([pose_matrix(poses[name].cam_from_world()) for name in names])
    error = scene_from_true(true, Cameras(names, fitted, true.K[: len(names)], true.size_hw[: len(names)]))[1]
    with pycolmap.Database.open(database) as opened:
        numbers = {image.image_id: true.names.index(image.name) for image in opened.read_all_images()}
        pair_ids, inliers = opened.read_two_view_geometry_num_inliers()
    rows = np.array([[numbers[n] for n in pycolmap.pair_id_to_image_pair(pair)] for pair in pair_ids])
    assert all(inliers)  # COLMAP doesn't list pairs without a geometry
    is_partner = partners[rows[:, 0], rows[:, 1]]
    num_partners = (partners.sum() - len(true)) / 2
    return {
        "views": str(len(true)),
        "partners of a view": f"{(partners.sum(axis=1) - 1).mean():.1f}",
        "matcher, mapper": f"{settings.matcher}, {settings.mapper}",
        "verified pairs": str(len(rows)),
        "of them partners": f"{is_partner.mean():.1%}",
        "verified of all partners": f"{is_partner.sum() / num_partners:.1%}",
        "in the models": ", ".join(str(model.num_reg_images()) for model in models),
        "median error, m": f"{error:.4f}",
        "features, matches: s, CPU s": "; ".join(f"{value:.0f}" for value in matched - started),
        "mapping: s, CPU s": "; ".join(f"{value:.0f}" for value in mapped - matched),
    }


def _clocks() -> Float[np.ndarray, "2"]:
    """Return the time and the CPU time of this process and of its children, seconds."""
    return np.array([time.time(), sum(os.times()[:4])])


def main() -> None:
    """Render a capture if needed, pose it and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("source", nargs="?", default="world:street:301")
    parser.add_argument("--views", type=int, default=260)
    parser.add_argument("--px", type=int, default=200)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--matcher", default="auto")
    parser.add_argument("--mapper", default="incremental")
    given = parser.parse_args()
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    os.environ["OMP_NUM_THREADS"] = "1"  # for processes started below, as the hilsplat command does
    if not (given.folder / "cameras.npz").exists():
        render(given.folder, given.source, given.views, given.px, given.threads)
    settings = PosesSettings(matcher=given.matcher, mapper=given.mapper)
    row = run(given.folder, settings, given.threads)
    print(markdown_table(tuple(row), [tuple(row.values())]))


if __name__ == "__main__":
    main()
