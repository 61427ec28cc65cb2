"""Points of Waymo's range images, and its cameras (waymo-research/waymo-open-dataset, Apache-2.0).

The formulas are those of `utils/range_image_utils.py` and `wdl_limited/camera`, reimplemented. Vehicle and
camera axes are x forward, y left, z up.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

CV_FROM_WAYMO = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Camera axes: OpenCV's x is Waymo's -y, y is -z, z is x."""


def beam_inclinations(
    values: Float[np.ndarray, " H"] | None, lowest: float, highest: float, height: int
) -> Float[np.ndarray, " H"]:
    """Return the inclination of each row of a range image, radians; row 0 is the highest beam.

    Args:
        values: calibrated inclinations, ascending; None if beams are evenly spaced.
        lowest: border of the lowest beam, for evenly spaced ones.
        highest: border of the highest beam.
    """
    if values is None:
        values = lowest + (np.arange(height) + 0.5) / height * (highest - lowest)
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
    """Return Rz(yaw) Ry(pitch) Rx(roll) of (roll, pitch, yaw), radians."""
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
    """Return positions of all pixels in the vehicle's frame at the time of each pixel, metres.

    Positions of pixels without a positive range are meaningless.
    """
    azimuth = column_azimuths(range_m.shape[1], vehicle_from_lidar)[None]
    up = inclinations[:, None]
    sensor = range_m[..., None] * np.stack(
        [np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up) + 0 * azimuth], axis=-1
    )
    return sensor @ vehicle_from_lidar[:3, :3].T + vehicle_from_lidar[:3, 3]


def to_world(
    points: Float[np.ndarray, "H W 3"], pixel_pose: Float[np.ndarray, "H W 6"]
) -> Float[np.ndarray, "H W 3"]:
    """Transform points of the top lidar to the world by the vehicle's pose at each pixel.

    Args:
        points: points in the vehicle's frame at the time of the pixel.
        pixel_pose: roll, pitch, yaw (radians), x, y, z (metres) of the vehicle in the world.
    """
    pose = pixel_pose.astype(np.float64)
    turned = np.einsum("hwij,hwj->hwi", rotation_of(pose[..., :3]), points)
    return turned + pose[..., 3:]


@dataclass(frozen=True, eq=False)
class WaymoCamera:
    """One camera of the car.

    Attributes:
        intrinsic: f_u, f_v, c_u, c_v, k1, k2, p1, p2, k3; px with the first pixel's left edge at 0, as in
            this project.
        vehicle_from_cam: pose on the vehicle, Waymo's camera axes.
    """

    name: str
    intrinsic: Float[np.ndarray, " 9"]
    vehicle_from_cam: Float[np.ndarray, "4 4"]
    size_hw: tuple[int, int]

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        """Intrinsics without distortion, px; the centre of the first pixel is (0.5, 0.5)."""
        f_u, f_v, c_u, c_v = self.intrinsic[:4]
        return np.array([[f_u, 0.0, c_u], [0.0, f_v, c_v], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> tuple[float, float, float, float, float]:
        """k1, k2, p1, p2, k3 in OpenCV's order and definition."""
        k1, k2, p1, p2, k3 = self.intrinsic[4:].tolist()
        return k1, k2, p1, p2, k3

    def cam_from_world(self, world_from_vehicle: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """Return the world-to-camera transform in OpenCV axes.

        Args:
            world_from_vehicle: the pose stored with the image; the frame's pose has a different time.
        """
        return CV_FROM_WAYMO @ np.linalg.inv(world_from_vehicle @ self.vehicle_from_cam)
