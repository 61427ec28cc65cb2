"""Simulated scan of a synthetic street by a spinning laser scanner on the car's roof; lengths are in metres.

The scanner simulates Waymo's top lidar: 64 beams between 17.6 degrees below and 2.4 above the horizon.
Rays are cast exactly; then noise is added to each range, and some returns are dropped. As in a logged drive,
the scanner's positions are recorded, not estimated from the images.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int32

from hilsplat.base.levels import NONE
from hilsplat_world.scenes.scene import WorldScene

BEAMS = 64
INCLINATION_DEG = (-17.6, 2.4)  # inclinations of the lowest and highest beams, as in Waymo's top lidar
AZIMUTH_STEPS = 400  # number of directions per turn; Waymo's lidar has 2650
POSES = 5  # number of positions along the drive at which a turn is recorded
ABOVE_CAMERA_M = 0.35
MAX_RANGE_M = 75.0
RANGE_NOISE_M = 0.015  # standard deviation of the measured range
LOST_SHARE = 0.05  # share of returns that are dropped at random
GLANCING_COSINE = 0.03  # minimum cosine between a beam and the surface normal for a return


@dataclass(frozen=True, eq=False)
class LidarScan:
    """P measured points and the nodes that they belong to."""

    points: Float32[np.ndarray, "P 3"]  # positions in the frame of the ground-truth cameras, with noise
    node_ids: Int32[np.ndarray, "P 3"]  # whole, part and subpart of each point; -1 for none
    pose_index: Int32[np.ndarray, " P"]  # row in `origins` of the position from which each was measured
    range_m: Float32[np.ndarray, " P"]  # measured distance to that position
    beam: Int32[np.ndarray, " P"]  # number of the beam, from 0 (lowest) to 63
    origins: Float[np.ndarray, "S 3"]  # positions of the scanner


def beam_directions() -> Float[np.ndarray, "R 3"]:
    """Return one turn's unit vectors, ordered by beam from the lowest, then by azimuth from +x to +y."""
    share = (np.arange(BEAMS) + 0.5) / BEAMS
    up = np.radians(INCLINATION_DEG[0] + share * (INCLINATION_DEG[1] - INCLINATION_DEG[0]))[:, None]
    around = 2 * np.pi * (np.arange(AZIMUTH_STEPS) + 0.5)[None] / AZIMUTH_STEPS
    level = np.cos(up)
    grid = np.broadcast_arrays(level * np.cos(around), level * np.sin(around), np.sin(up))
    return np.stack(grid, axis=-1).reshape(-1, 3)


def scan_street(scene: WorldScene, camera_centres: Float[np.ndarray, "V 3"]) -> LidarScan:
    """Scan a street from points above evenly spaced camera centres, which are given in driving order.

    The scene's seed also determines the noise and the dropped returns. The sky yields no returns.
    """
    rng = np.random.default_rng([scene.seed, 31])
    chosen = np.unique(np.linspace(0, len(camera_centres) - 1, POSES).round().astype(int))
    origins = camera_centres[chosen] + np.array([0.0, 0.0, ABOVE_CAMERA_M])
    sky = [node.id for node in scene.nodes if node.id in scene.background and node.text == "sky"]
    directions = beam_directions()
    beams = np.repeat(np.arange(BEAMS), AZIMUTH_STEPS)
    rows = []
    for pose, origin in enumerate(origins):
        hits = scene.caster.nearest(origin.astype(np.float32)[None], directions.astype(np.float32))
        prim, away = hits.triangle, hits.distance.astype(np.float64)
        triangle = scene.triangles[prim].astype(np.float64)
        normal = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
        facing = np.abs((normal * directions).sum(axis=1)) / np.linalg.norm(normal, axis=1)
        # Both numbers are drawn for every ray, so that a lost point does not change the others' noise.
        noise, luck = rng.normal(0.0, 1.0, len(directions)), rng.random(len(directions))
        ids = np.where((prim >= 0)[:, None], scene.node_ids[prim], NONE)
        returned = (prim >= 0) & ~np.isin(ids[:, 0], sky) & (away < MAX_RANGE_M)
        returned &= (facing > GLANCING_COSINE) & (luck >= LOST_SHARE)
        measured = away[returned] + RANGE_NOISE_M * noise[returned]
        points = origin + measured[:, None] * directions[returned]
        rows.append((points, ids[returned], np.full(returned.sum(), pose), measured, beams[returned]))
    points, ids, pose_index, ranges, beam = (np.concatenate(column) for column in zip(*rows, strict=True))
    ids, pose_index, beam = (column.astype(np.int32) for column in (ids, pose_index, beam))
    return LidarScan(points.astype(np.float32), ids, pose_index, ranges.astype(np.float32), beam, origins)
