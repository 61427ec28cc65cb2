"""Write a finished synthetic room as ScanNet or Replica, a street as Waymo: known truth for the readers."""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int32
from PIL import Image

from hilsplat.base.artifacts import read_npz
from hilsplat.base.images import read_image
from hilsplat.datasets.points.point_files import ply_column, ply_faces, ply_places, read_ply
from hilsplat.datasets.synthetic.hierarchy import HierarchyAnnotations
from hilsplat.datasets.synthetic.world_labels import replica_id, scannet_ids, waymo_labels
from hilsplat.datasets.waymo.frames import (
    CV_FROM_WAYMO,
    CameraShot,
    LidarFrame,
    LidarReturn,
    WaymoCamera,
    column_azimuths,
    rotation_of,
)
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.posed_images import PosedImage
from tests.unit.datasets.writers.replica import write_semantic_mesh, write_sequence
from tests.unit.datasets.writers.scannet import write_label_table, write_scan
from tests.unit.datasets.writers.waymo import write_segment

VEHICLE_FROM_CAM = np.array([[1.0, 0, 0, 1.5], [0, 1, 0, 0], [0, 0, 1, 2.1], [0, 0, 0, 1]])
LIDAR_AT = (1.4, 0.0, 2.2)
"""Place of the lidar on the vehicle, metres; that of the true drive is in its poses."""
LIDAR_TURN_DEG = 148.0
"""The lidar is mounted turned, as Waymo's is: columns are counted from the vehicle's back all the same."""
AZIMUTH_STEPS, BEAMS = 400, 64
"""Directions per turn of the scan, and evenly spaced beams: columns and rows of the range images."""
FRAME_MICROS = 100_000


@dataclass(frozen=True, eq=False)
class LabelledMesh:
    """The labelled surface of a synthetic scene; `whole` is a row of `texts`, -1 for none."""

    xyz: Float32[np.ndarray, "P 3"]
    whole: Int32[np.ndarray, " P"]
    faces: Int32[np.ndarray, "F 3"]
    whole_of_face: Int32[np.ndarray, " F"]
    texts: tuple[str, ...]

    @staticmethod
    def open(world: Path) -> "LabelledMesh":
        """Read `truth/mesh.ply` and the texts of `truth/annotations.json`."""
        path = world / "truth" / "mesh.ply"
        mesh = read_ply(path, 3)
        nodes = HierarchyAnnotations.load(path.parent).nodes
        return LabelledMesh(
            ply_places(path, mesh),
            ply_column(path, mesh, "vertex", "whole").astype(np.int32),
            ply_faces(path, mesh),
            ply_column(path, mesh, "face", "whole").astype(np.int32),
            tuple(node.text for node in nodes),
        )


def posed_images(world: Path) -> list[PosedImage]:
    """Images of a synthetic scene with their true cameras."""
    cameras = Cameras.load(world / "truth" / "cameras.npz")
    return [
        PosedImage(name, world / "images" / name, camera.cam_from_world, camera.K, camera.size_hw)
        for name, camera in ((name, cameras[name]) for name in cameras.names)
    ]


def write_room_as_scannet(world: Path, root: Path, scan: str) -> None:
    """Write a room as `scans/<scan>`; nodes count as objects in their order."""
    mesh = LabelledMesh.open(world)
    categories = {text: scannet_ids(text) for text in mesh.texts}
    write_label_table(root, categories)
    write_scan(root, scan, posed_images(world), mesh.xyz, mesh.faces, mesh.whole, mesh.texts, categories)


def write_room_as_replica(world: Path, root: Path, scene: str) -> None:
    """Write a room as a scene of Replica with the sequence in the layout of NICE-SLAM."""
    mesh = LabelledMesh.open(world)
    classes = [replica_id(text) for text in mesh.texts]
    write_semantic_mesh(root / scene / "habitat", mesh.xyz, mesh.faces, mesh.whole_of_face, classes)
    write_sequence(root / scene.replace("_", ""), posed_images(world))


def write_street_as_waymo(world: Path, split: Path, segment: str) -> None:
    """Write a street as a segment of Waymo's release 2: range images of its scan, its views as FRONT."""
    scan = read_npz(world / "truth" / "lidar.npz")
    nodes = HierarchyAnnotations.load(world / "truth").nodes
    labels = waymo_labels(scan["node_ids"], [node.text for node in nodes])
    images = posed_images(world)
    shots = [_shot(image, FRAME_MICROS * (number + 1)) for number, image in enumerate(images)]
    centres = np.stack([image.world_from_cam[:3, 3] for image in images])
    up = np.arcsin((scan["points"] - scan["origins"][scan["pose_index"]])[:, 2] / scan["range_m"])
    slope, start = np.polyfit(scan["beam"], up.astype(np.float64), 1)
    inclinations = (start + slope * np.arange(BEAMS))[::-1]
    frames = []
    for pose, origin in enumerate(scan["origins"]):
        view = int(np.linalg.norm(centres - origin, axis=1).argmin())
        rows = scan["pose_index"] == pose
        frames.append(
            _lidar_frame(
                {name: scan[name][rows] for name in ("points", "range_m", "beam")},
                labels[rows],
                origin,
                inclinations,
                shots[view],
            )
        )
    write_segment(split, segment, frames, shots)


def _shot(image: PosedImage, time: int) -> CameraShot:
    """A view as an image of the front camera."""
    assert isinstance(image.image, Path)
    K = image.K
    lens = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], 0, 0, 0, 0, 0], dtype=np.float64)
    stream = io.BytesIO()
    Image.fromarray(read_image(image.image)).save(stream, format="JPEG", quality=95)
    world_from_vehicle = image.world_from_cam @ CV_FROM_WAYMO @ np.linalg.inv(VEHICLE_FROM_CAM)
    camera = WaymoCamera("FRONT", lens, VEHICLE_FROM_CAM, image.size_hw)
    return CameraShot(time, camera, stream.getvalue(), world_from_vehicle)


def _lidar_frame(
    scan: dict[str, np.ndarray],
    labels: np.ndarray,
    origin: Float[np.ndarray, " 3"],
    inclinations: Float[np.ndarray, " H"],
    shot: CameraShot,
) -> LidarFrame:
    """One turn of the scan as a range image. The vehicle heads along the axis x of the world."""
    height, width = len(inclinations), AZIMUTH_STEPS
    turn = np.radians(LIDAR_TURN_DEG)
    vehicle_from_lidar = np.eye(4)
    vehicle_from_lidar[:3, :3] = rotation_of(np.array([0.0, 0.0, turn]))
    vehicle_from_lidar[:3, 3] = LIDAR_AT
    world_from_vehicle = np.eye(4)
    world_from_vehicle[:3, 3] = origin - np.array(LIDAR_AT)
    away = scan["points"] - origin
    azimuth = np.arctan2(away[:, 1], away[:, 0])
    first = column_azimuths(width, vehicle_from_lidar)[0] + turn
    column = (first - azimuth) / (2 * np.pi / width)
    assert np.abs(column - column.round()).max(initial=0) < 0.1  # the scan has the directions of the columns
    place = height - 1 - scan["beam"], column.round().astype(int) % width
    image = np.zeros((height, width, 4), dtype=np.float32)
    image[..., 0] = -1
    image[*place, 0] = scan["range_m"]
    of_pixel = np.zeros((height, width, 2), dtype=np.int32)
    of_pixel[place] = labels
    in_camera = shot.camera.cam_from_world(shot.world_from_vehicle)
    local = scan["points"].astype(np.float64) @ in_camera[:3, :3].T + in_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = (local @ shot.camera.K.T)[:, :2] / local[:, 2:]  # the front camera has no distortion
    rows, columns = shot.camera.size_hw
    inside = (local[:, 2] > 0) & (pixel >= 0).all(axis=1) & (pixel < [columns, rows]).all(axis=1)
    cells = np.zeros((height, width, 6), dtype=np.int32)
    cells[place] = np.where(
        inside[:, None], np.stack([inside, *np.floor(pixel.T), *np.zeros((3, len(pixel)))], axis=1), 0
    )
    pose = np.tile(np.float32([0, 0, 0, *world_from_vehicle[:3, 3]]), (height, width, 1))
    return LidarFrame(
        shot.timestamp_micros,
        world_from_vehicle,
        vehicle_from_lidar,
        inclinations,
        pose,
        (LidarReturn(image, of_pixel, cells),),
    )
