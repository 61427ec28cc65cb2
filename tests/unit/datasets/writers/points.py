"""Write scenes, also synthetic rooms and streets, in the layouts of ScanNet, Replica and Waymo."""

import io
import json
import shutil
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
from jaxtyping import Float, Float32, Int32
from numpy.lib.recfunctions import append_fields
from PIL import Image
from plyfile import PlyData, PlyElement

from hilsplat.base.artifacts import read_npz, write_json, write_text
from hilsplat.base.images import read_image
from hilsplat.datasets.classes import REPLICA_NAMES
from hilsplat.datasets.hierarchy import HierarchyAnnotations
from hilsplat.datasets.points.labelled_points import PlyMesh
from hilsplat.datasets.points.scannet import LABEL_TABLE
from hilsplat.datasets.waymo import frames as waymo
from hilsplat.datasets.waymo.parquet import CAMERA, FRAME, INTRINSIC, LASER, component_path
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.posed_images import HALF_PIXEL, PosedImage
from hilsplat_world.labels import replica_id, scannet_ids, waymo_labels
from hilsplat_world.lidar import AZIMUTH_STEPS, BEAMS, INCLINATION_DEG


def write_ply(
    path: Path,
    xyz: Float32[np.ndarray, "P 3"],
    faces: Int32[np.ndarray, "F C"],
    label: np.ndarray | None = None,
    object_id: np.ndarray | None = None,
) -> None:
    """Write a binary mesh with the labels of vertices or the objects of faces."""
    vertices = np.rec.fromarrays(xyz.T, names="x, y, z")
    corners = np.rec.fromarrays([faces], dtype=[("vertex_indices", "i4", faces.shape[1:])])
    if label is not None:
        vertices = append_fields(vertices, "label", label, usemask=False)
    if object_id is not None:
        corners = append_fields(corners, "object_id", object_id, usemask=False)
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(corners, "face")]
    PlyData(elements, byte_order="<").write(path)


SEGMENT_STEP = 7  # step between segment ids, which are not contiguous in real scans either


def write_label_table(root: Path, categories: Mapping[str, tuple[int, int]]) -> None:
    """Write `scannetv2-labels.combined.tsv`, given raw category -> (id, NYU40 id)."""
    rows = [f"{number}\t{category}\t{category}\t{nyu40}" for category, (number, nyu40) in categories.items()]
    write_text(root / LABEL_TABLE, "\n".join(["id\traw_category\tcategory\tnyu40id", *rows, ""]))


def write_scan(
    root: Path,
    scan: str,
    images: Sequence[PosedImage],
    xyz: Float32[np.ndarray, "P 3"],
    faces: Int32[np.ndarray, "F 3"],
    object_of_vertex: Int32[np.ndarray, " P"],
    objects: Sequence[str],
    categories: Mapping[str, tuple[int, int]],
    lost: Sequence[int] = (),
) -> None:
    """Write `scans/<scan>`: frames numbered 0, 1, ..., mesh, labels, segments and aggregation.

    All images share K and size. `object_of_vertex` is a row of `objects` (raw categories), -1 for none;
    `categories` maps them to (id, NYU40 id). Frames in `lost` get the infinite pose of lost tracking.
    """
    folder = root / "scans" / scan
    for name in ("color", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    for number, image in enumerate(images):
        assert isinstance(image.image, Path)
        shutil.copyfile(image.image, folder / "color" / f"{number}{image.image.suffix}")
        pose = np.full((4, 4), -np.inf) if number in lost else image.world_from_cam
        np.savetxt(folder / "pose" / f"{number}.txt", pose)
    K = np.eye(4)
    K[:3, :3] = images[0].K - HALF_PIXEL
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", K)
    height, width = images[0].size_hw
    write_text(folder / f"{scan}.txt", f"colorHeight = {height}\ncolorWidth = {width}\nsceneType = Office\n")
    write_ply(folder / f"{scan}_vh_clean_2.ply", xyz, faces)
    of_object = np.array([categories[name][1] for name in objects] + [0], dtype=np.uint16)
    labels = of_object[object_of_vertex]  # -1, none, is the last
    write_ply(folder / f"{scan}_vh_clean_2.labels.ply", xyz, faces, labels)
    # Two segments per object, on either side of its middle.
    segment = np.zeros(len(xyz), dtype=np.int64)
    groups = []
    for number, category in enumerate(objects):
        rows = np.flatnonzero(object_of_vertex == number)
        if not rows.size:
            continue
        side = xyz[rows, 0] > np.median(xyz[rows, 0])
        segment[rows] = SEGMENT_STEP * (2 * number + 1 + side)
        members = np.unique(segment[rows]).tolist()
        groups.append({"objectId": number, "segments": members, "label": category})
    segments = json.dumps({"segIndices": segment.tolist()})
    write_text(folder / f"{scan}_vh_clean_2.0.010000.segs.json", segments)
    write_text(folder / f"{scan}.aggregation.json", json.dumps({"segGroups": groups}))


NUMBERS = {name: number for number, name in waymo.CAMERAS.items()}  # number of each camera of Waymo

UNDEFINED, NO_OBJECT = -1, -2
"""Class of an object without a class in Replica, and of object 0, which means no object."""


def write_semantic_mesh(
    habitat: Path,
    xyz: Float32[np.ndarray, "P 3"],
    faces: Int32[np.ndarray, "F 3"],
    object_of_face: Int32[np.ndarray, " F"],
    classes: Sequence[int],
) -> None:
    """Write `mesh_semantic.ply` and `info_semantic.json` of a scene.

    Each triangle becomes a quad whose last corner occurs twice. `object_of_face` is a row of `classes` (ids,
    0 for none), -1 for none; in the files, objects count from 1.
    """
    quads = faces[:, [0, 1, 2, 2]]
    of_face = (object_of_face + 1).astype(np.int32)
    labels = [NO_OBJECT, *(number or UNDEFINED for number in classes)]
    names = [{"id": number, "name": name} for number, name in REPLICA_NAMES.items()]
    habitat.mkdir(parents=True)
    write_ply(habitat / "mesh_semantic.ply", xyz, quads, object_id=of_face)
    write_json(habitat / "info_semantic.json", {"classes": names, "id_to_label": labels})


def write_sequence(folder: Path, images: Sequence[PosedImage]) -> None:
    """Write a sequence in the layout of NICE-SLAM: `traj.txt`, `results/`, and `cam_params.json` beside it.

    All images must share K and size, because all sequences in the folder above have the same lens.
    """
    K, (height, width) = images[0].K - HALF_PIXEL, images[0].size_hw
    lens = {"w": width, "h": height, "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    write_json(folder.parent / "cam_params.json", {"camera": {**lens, "scale": 6553.5}})
    (folder / "results").mkdir(parents=True)
    for number, image in enumerate(images):
        assert isinstance(image.image, Path)
        shutil.copyfile(image.image, folder / "results" / f"frame{number:06d}{image.image.suffix}")
    np.savetxt(folder / "traj.txt", [image.world_from_cam.ravel() for image in images])


def write_segment(
    split: Path, segment: str, frames: Sequence[waymo.LidarFrame], shots: Sequence[waymo.CameraShot]
) -> None:
    """Write the components of a segment of release 2 to a folder such as `validation`.

    All frames have the lidar pose and inclinations of the first, and each camera has the calibration of its
    first image.
    """
    write = partial(_write_component, split, segment)
    pose = "[VehiclePoseComponent].world_from_vehicle.transform"
    write("vehicle_pose", [{FRAME: f.timestamp_micros, pose: f.world_from_vehicle.ravel()} for f in frames])
    base = "[LiDARCalibrationComponent]"
    beams = frames[0].inclinations[::-1]
    calibration = {
        LASER: waymo.TOP,
        f"{base}.extrinsic.transform": frames[0].vehicle_from_lidar.ravel(),
        f"{base}.beam_inclination.min": float(beams[0]),
        f"{base}.beam_inclination.max": float(beams[-1]),
        f"{base}.beam_inclination.values": beams.astype(np.float64),
    }
    write("lidar_calibration", [calibration])
    for tag, component, part in (
        ("lidar", "LiDARComponent", "image"),
        ("lidar_segmentation", "LiDARSegmentationLabelComponent", "labels"),
    ):
        images = [[getattr(each, part) for each in frame.returns] for frame in frames]
        write(tag, [_cells(component, *pair) for pair in zip(frames, images, strict=True)])
    write("lidar_pose", [_cells("LiDARPoseComponent", frame, [frame.pixel_pose]) for frame in frames])
    base = "[CameraCalibrationComponent]"
    cameras = {shot.camera.name: shot.camera for shot in reversed(shots)}
    calibrations = [
        {
            CAMERA: NUMBERS[camera.name],
            **{f"{base}.intrinsic.{name}": v for name, v in zip(INTRINSIC, camera.intrinsic, strict=True)},
            f"{base}.extrinsic.transform": camera.vehicle_from_cam.ravel(),
            f"{base}.width": camera.size_hw[1],
            f"{base}.height": camera.size_hw[0],
        }
        for camera in cameras.values()
    ]
    write("camera_calibration", calibrations)
    write(
        "camera_image",
        [
            {
                FRAME: shot.timestamp_micros,
                CAMERA: NUMBERS[shot.camera.name],
                "[CameraImageComponent].image": shot.encoded,
                "[CameraImageComponent].pose.transform": shot.world_from_vehicle.ravel(),
            }
            for shot in shots
        ],
    )


def _cells(component: str, frame: waymo.LidarFrame, images: Sequence[np.ndarray]) -> dict[str, Any]:
    """Return a row with values and shape of the first and second return, null if there is none."""
    row: dict[str, Any] = {FRAME: frame.timestamp_micros, LASER: waymo.TOP}
    for number in (1, 2):
        image = images[number - 1] if len(images) >= number else None
        name = f"[{component}].range_image_return{number}"
        row[f"{name}.values"] = None if image is None else image.ravel()
        row[f"{name}.shape"] = None if image is None else np.array(image.shape, dtype=np.int32)
    return row


def _write_component(split: Path, segment: str, tag: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write one row group; the columns have the types of the release."""
    keys = {CAMERA: pa.int8(), LASER: pa.int8(), FRAME: pa.int64()}
    columns = {name: pa.array([row[name] for row in rows], type=keys.get(name)) for name in rows[0]}
    path = component_path(split, tag, segment)
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(pa.table(columns), path)


VEHICLE_FROM_CAM = np.array([[1.0, 0, 0, 1.5], [0, 1, 0, 0], [0, 0, 1, 2.1], [0, 0, 0, 1]])
LIDAR_AT = (1.4, 0.0, 2.2)  # position of the lidar on the vehicle, metres
FRAME_MICROS = 100_000


class LabelledMesh(PlyMesh):
    """The labelled surface of a synthetic scene; `whole` is a row of `texts`, -1 for none."""

    def __init__(self, world: Path) -> None:
        super().__init__(world / "truth" / "mesh.ply", 3)
        self.whole = self.column("vertex", "whole").astype(np.int32)
        self.whole_of_face = self.column("face", "whole").astype(np.int32)
        nodes = HierarchyAnnotations.load(world / "truth").nodes
        self.texts = tuple(node.text for node in nodes)


def posed_images(world: Path) -> list[PosedImage]:
    """Return the images of a synthetic scene with their ground-truth cameras."""
    cameras = Cameras.load(world / "truth" / "cameras.npz")
    return [
        PosedImage(name, world / "images" / name, camera.cam_from_world, camera.K, camera.size_hw)
        for name, camera in ((name, cameras[name]) for name in cameras.names)
    ]


def write_room_as_scannet(world: Path, root: Path, scan: str) -> None:
    """Write a room as `scans/<scan>`; nodes count as objects in their order."""
    mesh = LabelledMesh(world)
    categories = {text: scannet_ids(text) for text in mesh.texts}
    write_label_table(root, categories)
    write_scan(root, scan, posed_images(world), mesh.xyz, mesh.faces, mesh.whole, mesh.texts, categories)


def write_room_as_replica(world: Path, root: Path, scene: str) -> None:
    """Write a room as a scene of Replica with the sequence in the layout of NICE-SLAM."""
    mesh = LabelledMesh(world)
    classes = [replica_id(text) for text in mesh.texts]
    write_semantic_mesh(root / scene / "habitat", mesh.xyz, mesh.faces, mesh.whole_of_face, classes)
    write_sequence(root / scene.replace("_", ""), posed_images(world))


def write_street_as_waymo(world: Path, split: Path, segment: str) -> None:
    """Write a street as a segment of Waymo's release 2: range images of its scan, and its views as FRONT."""
    scan = read_npz(world / "truth" / "lidar.npz")
    nodes = HierarchyAnnotations.load(world / "truth").nodes
    labels = waymo_labels(scan["node_ids"], [node.text for node in nodes])
    images = posed_images(world)
    shots = [_shot(image, FRAME_MICROS * (number + 1)) for number, image in enumerate(images)]
    centres = np.stack([image.world_from_cam[:3, 3] for image in images])
    frames = []
    for pose, origin in enumerate(scan["origins"]):
        view = int(np.linalg.norm(centres - origin, axis=1).argmin())
        rows = scan["pose_index"] == pose
        turn = {name: scan[name][rows] for name in ("points", "range_m", "beam")}
        frames.append(_lidar_frame(turn, labels[rows], origin, shots[view].timestamp_micros))
    write_segment(split, segment, frames, shots)


def _shot(image: PosedImage, time: int) -> waymo.CameraShot:
    """Return a view as an image of the front camera."""
    assert isinstance(image.image, Path)
    K = image.K
    lens = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], 0, 0, 0, 0, 0], dtype=np.float64)
    stream = io.BytesIO()
    Image.fromarray(read_image(image.image)).save(stream, format="JPEG", quality=95)
    world_from_vehicle = image.world_from_cam @ waymo.CV_FROM_WAYMO @ np.linalg.inv(VEHICLE_FROM_CAM)
    camera = waymo.WaymoCamera("FRONT", lens, VEHICLE_FROM_CAM, image.size_hw)
    return waymo.CameraShot(time, camera, stream.getvalue(), world_from_vehicle)


def _lidar_frame(
    scan: dict[str, np.ndarray], labels: np.ndarray, origin: Float[np.ndarray, " 3"], time: int
) -> waymo.LidarFrame:
    """Return one revolution of the scan as a range image; the vehicle heads along the world's x axis."""
    height, width = BEAMS, AZIMUTH_STEPS
    inclinations = waymo.beam_inclinations(None, *np.radians(INCLINATION_DEG), height)
    vehicle_from_lidar, world_from_vehicle = np.eye(4), np.eye(4)
    vehicle_from_lidar[:3, 3] = LIDAR_AT
    world_from_vehicle[:3, 3] = origin - np.array(LIDAR_AT)
    away = scan["points"] - origin
    azimuth = np.arctan2(away[:, 1], away[:, 0])
    column = (waymo.column_azimuths(width, vehicle_from_lidar)[0] - azimuth) / (2 * np.pi / width)
    assert np.abs(column - column.round()).max(initial=0) < 0.1  # the scan has the directions of the columns
    place = height - 1 - scan["beam"], column.round().astype(int) % width
    image = np.zeros((height, width, 4), dtype=np.float32)
    image[..., 0] = -1
    image[*place, 0] = scan["range_m"]
    of_pixel = np.zeros((height, width, 2), dtype=np.int32)
    of_pixel[place] = labels
    pose = np.tile(np.float32([0, 0, 0, *world_from_vehicle[:3, 3]]), (height, width, 1))
    returns = (waymo.LidarReturn(image, of_pixel),)
    return waymo.LidarFrame(time, world_from_vehicle, vehicle_from_lidar, inclinations, pose, returns)
