"""Lidar frames and camera images of Waymo, independent of the file format."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int32

from hilsplat.base.errors import SceneError
from hilsplat.datasets.classes.waymo import WAYMO_22
from hilsplat.datasets.points.labelled_points import LabelledPoints
from hilsplat.datasets.waymo.geometry import WaymoCamera, range_image_points, to_world
from hilsplat.scene.posed_images import PosedImage

CAMERAS = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")
"""Camera names; numbered from 1 in the files."""
TOP = 1
"""The roof lidar, the only one with labels and with a pose per pixel."""
INSTANCE, CLASS = 0, 1
"""Channels of a label image."""


@dataclass(frozen=True, eq=False)
class LidarReturn:
    """One return of the top lidar.

    Attributes:
        image: range (metres; zero or negative without a return), intensity, elongation, no-label zone.
        labels: instance and class; None if the frame is not labelled.
        projection: first camera, x, y, second camera, x, y; camera 0 means none. None if not stored.
    """

    image: Float32[np.ndarray, "H W 4"]
    labels: Int32[np.ndarray, "h w 2"] | None  # h = H and w = W, checked by `frame_points`
    projection: Int32[np.ndarray, "i j 6"] | None  # i = H and j = W, checked by `frame_points`


@dataclass(frozen=True, eq=False)
class LidarFrame:
    """One revolution of the top lidar.

    Attributes:
        inclinations: inclinations of the rows, radians, highest first.
        pixel_pose: roll, pitch, yaw, x, y, z of the vehicle in the world at each pixel, for both returns.
        returns: first and, if there is one, second return.
    """

    timestamp_micros: int
    world_from_vehicle: Float[np.ndarray, "4 4"]
    vehicle_from_lidar: Float[np.ndarray, "4 4"]
    inclinations: Float[np.ndarray, " h"]  # h = H, checked by `frame_points`
    pixel_pose: Float32[np.ndarray, "H W 6"]
    returns: tuple[LidarReturn, ...]


@dataclass(frozen=True, eq=False)
class CameraShot:
    """One image.

    Attributes:
        timestamp_micros: time stamp of its frame.
        encoded: JPEG bytes.
        world_from_vehicle: pose of the vehicle when the image was taken, not that of the frame.
    """

    timestamp_micros: int
    camera: WaymoCamera
    encoded: bytes
    world_from_vehicle: Float[np.ndarray, "4 4"]


def frame_points(frame: LidarFrame, segment_from_world: Float[np.ndarray, "4 4"]) -> LabelledPoints:
    """Return the labelled points of a frame: first return, then second, each row by row.

    Raises:
        SceneError: the images of a return differ in size, or a class is unknown.
    """
    parts = []
    for number, part in enumerate(frame.returns, start=1):
        if part.labels is None:
            continue
        where = f"return {number} of the top lidar at {frame.timestamp_micros}"
        sizes = {part.image.shape[:2], part.labels.shape[:2], frame.pixel_pose.shape[:2]}
        if part.projection is not None:
            sizes.add(part.projection.shape[:2])
        if len(sizes) > 1 or len(frame.inclinations) != part.image.shape[0]:
            raise SceneError(
                f"{where}: ranges, labels, poses and projections do not belong together",
                expected="images of one size and an inclination per row",
                found=f"{sorted(sizes)}, {len(frame.inclinations)} inclinations",
                fix="download all components of the segment from the same release",
            )
        hit = part.image[..., 0] > 0
        places = to_world(
            range_image_points(
                part.image[..., 0].astype(np.float64), frame.inclinations, frame.vehicle_from_lidar
            ),
            frame.pixel_pose,
        )[hit]
        xyz = places @ segment_from_world[:3, :3].T + segment_from_world[:3, 3]
        labels = part.labels[hit]
        visible = None if part.projection is None else part.projection[hit][:, 0] > 0
        parts.append(LabelledPoints(xyz, labels[:, CLASS], labels[:, INSTANCE], "waymo", visible=visible))
    nothing = LabelledPoints(np.zeros((0, 3)), np.zeros(0, np.int32), np.zeros(0, np.int32), "waymo")
    points = joined_points(parts or [nothing])
    classes = points.class_id
    if classes.size and (classes.min() < 0 or classes.max() > max(WAYMO_22.ids)):
        raise SceneError(
            f"labels of the top lidar at {frame.timestamp_micros} have an unknown class",
            expected=f"0 to {max(WAYMO_22.ids)}",
            found=f"{classes.min()} to {classes.max()}",
            fix="use the 3D semantic segmentation of release 1.4.3 or 2.0.1",
        )
    return points


def joined_points(parts: Sequence[LabelledPoints]) -> LabelledPoints:
    """Concatenate points, of at least one frame or return; visibility is kept if every part has it."""
    seen = [part.visible for part in parts if part.visible is not None]
    return LabelledPoints(
        np.concatenate([part.xyz for part in parts]),
        np.concatenate([part.class_id for part in parts]),
        np.concatenate([part.instance_id for part in parts]),
        "waymo",
        visible=np.concatenate(seen) if len(seen) == len(parts) else None,
    )


def shot_image(shot: CameraShot, segment_from_world: Float[np.ndarray, "4 4"]) -> PosedImage:
    """Return an image with its camera in the segment's frame, named after time and camera."""
    in_segment = segment_from_world @ shot.world_from_vehicle
    return PosedImage(
        f"{shot.timestamp_micros}_{shot.camera.name}.jpg",
        shot.encoded,
        shot.camera.cam_from_world(in_segment),
        shot.camera.K,
        shot.camera.size_hw,
        shot.camera.distortion,
    )
