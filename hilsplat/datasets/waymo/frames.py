"""Waymo's lidar frames and cameras, independent of the file format.

The formulas are those of `utils/range_image_utils.py` and `wdl_limited/camera` of
waymo-research/waymo-open-dataset (Apache-2.0), reimplemented. Vehicle and camera axes are x forward, y left,
z up.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int32

from hilsplat.base.errors import SceneError
from hilsplat.datasets.classes import WAYMO_22
from hilsplat.datasets.points.labelled_points import LabelledPoints
from hilsplat.scene.posed_images import PosedImage

CAMERAS = dict(enumerate(("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT"), start=1))
"""Name of each camera by its number in the files."""
TOP = 1  # number of the roof lidar, the only one that has labels and a pose for each pixel
CV_FROM_WAYMO = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Change of camera axes: OpenCV's x, y and z are Waymo's -y, -z and x."""


@dataclass(frozen=True, eq=False)
class LidarReturn:
    """One labelled return of the top lidar."""

    # Range (metres; zero or negative if there is no return), intensity, elongation, no-label zone.
    image: Float32[np.ndarray, "H W 4"]
    labels: Int32[np.ndarray, "h w 2"]  # instance, class; h = H and w = W, checked by `frame_points`


@dataclass(frozen=True, eq=False)
class LidarFrame:
    """One revolution of the top lidar."""

    timestamp_micros: int
    world_from_vehicle: Float[np.ndarray, "4 4"]
    vehicle_from_lidar: Float[np.ndarray, "4 4"]
    inclinations: Float[np.ndarray, " h"]  # radians, highest first; h = H, checked by `frame_points`
    # Vehicle pose in the world at each pixel: roll, pitch, yaw (radians), x, y, z (metres).
    pixel_pose: Float32[np.ndarray, "H W 6"]
    returns: tuple[LidarReturn, ...]  # one or two


@dataclass(frozen=True, eq=False)
class WaymoCamera:
    name: str
    # f_u, f_v, c_u, c_v, k1, k2, p1, p2, k3: px with the first pixel's left edge at 0, OpenCV's distortion
    intrinsic: Float[np.ndarray, " 9"]
    vehicle_from_cam: Float[np.ndarray, "4 4"]  # in Waymo's camera axes
    size_hw: tuple[int, int]


@dataclass(frozen=True, eq=False)
class CameraShot:
    """One image (JPEG bytes), with its frame's timestamp and the vehicle's pose when the image was taken."""

    timestamp_micros: int
    camera: WaymoCamera
    encoded: bytes
    world_from_vehicle: Float[np.ndarray, "4 4"]


def beam_inclinations(
    values: Float[np.ndarray, " H"] | None, lowest: float, highest: float, height: int
) -> Float[np.ndarray, " H"]:
    """Return the inclination of each row of a range image, radians; row 0 is the highest beam.

    `values` are calibrated inclinations, ascending; None if the beams are evenly spaced between the limits
    `lowest` and `highest`. ValueError is raised if one isn't finite.
    """
    if values is None:
        values = lowest + (np.arange(height) + 0.5) / height * (highest - lowest)
    if not np.isfinite(values).all():
        raise ValueError("a beam has no inclination")
    return np.asarray(values, dtype=np.float64)[::-1]


def column_azimuths(width: int, vehicle_from_lidar: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " W"]:
    """Return each column's azimuth in the lidar's frame, radians; column 0 points to the vehicle's rear.

    Example:
        >>> np.degrees(column_azimuths(4, np.eye(4)))
        array([ 135.,   45.,  -45., -135.])
    """
    turn = np.arctan2(vehicle_from_lidar[1, 0], vehicle_from_lidar[0, 0])
    share = (width - np.arange(width) - 0.5) / width
    return (2 * share - 1) * np.pi - turn


def rotation_of(angles: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Return Rz(yaw) Ry(pitch) Rx(roll) for angles (roll, pitch, yaw), radians."""
    roll, pitch, yaw = (angles[..., column] for column in range(3))
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(angle), np.sin(angle)) for angle in (roll, pitch, yaw))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def range_image_points(
    range_m: Float[np.ndarray, "H W"],
    inclinations: Float[np.ndarray, " H"],
    vehicle_from_lidar: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "H W 3"]:
    """Return the position of each pixel, metres, in the vehicle's frame at the time of that pixel.

    Positions of pixels without a positive range are meaningless.
    """
    azimuth = column_azimuths(range_m.shape[1], vehicle_from_lidar)[None]
    up = inclinations[:, None]
    sensor = range_m[..., None] * np.stack(
        [np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up) + 0 * azimuth], axis=-1
    )
    return sensor @ vehicle_from_lidar[:3, :3].T + vehicle_from_lidar[:3, 3]


def frame_points(frame: LidarFrame, segment_from_world: Float[np.ndarray, "4 4"]) -> LabelledPoints:
    """Return the labelled points of a frame: first return, then second, each row by row.

    Raises:
        SceneError: the images of a return differ in size, or a class is unknown.
    """
    parts = []
    for number, part in enumerate(frame.returns, start=1):
        sizes = {part.image.shape[:2], part.labels.shape[:2], frame.pixel_pose.shape[:2]}
        if len(sizes) > 1 or len(frame.inclinations) != part.image.shape[0]:
            raise SceneError(
                f"return {number} of the top lidar at {frame.timestamp_micros}: its images do not match",
                expected="images of the same size, and one inclination per row",
                found=f"{sorted(sizes)}, {len(frame.inclinations)} inclinations",
                fix="download all components of the segment from the same release",
            )
        hit = part.image[..., 0] > 0
        range_m = part.image[..., 0].astype(np.float64)
        in_vehicle = range_image_points(range_m, frame.inclinations, frame.vehicle_from_lidar)
        pose = frame.pixel_pose.astype(np.float64)  # vehicle pose at the time of each pixel
        turned = np.einsum("hwij,hwj->hwi", rotation_of(pose[..., :3]), in_vehicle)
        places = (turned + pose[..., 3:])[hit]
        xyz = places @ segment_from_world[:3, :3].T + segment_from_world[:3, 3]
        instance, class_id = part.labels[hit].T
        parts.append(LabelledPoints(xyz, class_id, instance))
    points = joined_points(parts)
    classes = points.class_id
    if classes.size and (classes.min() < 0 or classes.max() > max(WAYMO_22.ids)):
        raise SceneError(
            f"the top lidar's labels at {frame.timestamp_micros} contain an unknown class",
            expected=f"0 to {max(WAYMO_22.ids)}",
            found=f"{classes.min()} to {classes.max()}",
            fix="use the 3D semantic segmentation from release 1.4.3 or 2.0.1",
        )
    return points


def joined_points(parts: Sequence[LabelledPoints]) -> LabelledPoints:
    return LabelledPoints(
        np.concatenate([part.xyz for part in parts]),
        np.concatenate([part.class_id for part in parts]),
        np.concatenate([part.instance_id for part in parts]),
    )


def shot_image(shot: CameraShot, segment_from_world: Float[np.ndarray, "4 4"]) -> PosedImage:
    """Return an image with its camera in the segment's frame, named after its timestamp and camera."""
    camera = shot.camera
    f_u, f_v, c_u, c_v, k1, k2, p1, p2, k3 = camera.intrinsic.tolist()
    segment_from_cam = segment_from_world @ shot.world_from_vehicle @ camera.vehicle_from_cam
    return PosedImage(
        f"{shot.timestamp_micros}_{camera.name}.jpg",
        shot.encoded,
        CV_FROM_WAYMO @ np.linalg.inv(segment_from_cam),
        np.array([[f_u, 0.0, c_u], [0.0, f_v, c_v], [0.0, 0.0, 1.0]]),
        camera.size_hw,
        (k1, k2, p1, p2, k3),
    )
