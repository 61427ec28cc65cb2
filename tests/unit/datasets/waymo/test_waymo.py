"""Waymo by hand: a range image of one row, a camera with round numbers, records made by protobuf."""

import os
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest

from hilsplat.base.errors import SceneError
from hilsplat.datasets.registry import DATASETS
from hilsplat.datasets.sources import image_files
from hilsplat.datasets.waymo import frames as waymo
from hilsplat.datasets.waymo.reader import open_segment
from hilsplat.datasets.waymo.records import MESSAGES, matrix
from tests.unit.datasets.writers.points import write_segment

SEGMENT = "1_2_000_3_000"
RECORD = f"segment-{SEGMENT}_with_camera_labels.tfrecord"
SQRT2 = np.sqrt(2.0)


def turned(degrees: float, x: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = waymo.rotation_of(np.array([0.0, 0.0, np.radians(degrees)]))
    pose[0, 3] = x
    return pose


STILL, VEHICLE, LIDAR = np.eye(4), turned(90, x=20000.0), turned(30)
FRONT = waymo.WaymoCamera("FRONT", np.array([2000.0, 2000, 960, 640, 1, 2, 3, 4, 5]), STILL, (1280, 1920))
SIDE = replace(FRONT, name="SIDE_LEFT", vehicle_from_cam=turned(90), size_hw=(886, 1920))


def one_return(ranges, classes, instances=0) -> waymo.LidarReturn:
    """A return of one row."""
    image = np.zeros((1, len(ranges), 4), np.float32)
    image[0, :, 0] = ranges
    labels = np.stack(np.broadcast_arrays(instances, classes), axis=1).astype(np.int32)
    return waymo.LidarReturn(image, labels[None])


def make_frame(time: int = 1000, vehicle: np.ndarray = STILL, lidar: np.ndarray = STILL) -> waymo.LidarFrame:
    """Four columns, range 2 all around; the second return has two hits, one of them unlabelled."""
    yaw = np.arctan2(vehicle[1, 0], vehicle[0, 0])
    pose = np.tile(np.float32([0, 0, yaw, *vehicle[:3, 3]]), (1, 4, 1))
    first = one_return([2, 2, 2, 2], [1, 14, 15, 18], [7, 0, 0, 0])
    second = one_return([-1, 4, 0, 6], [22, 10, 22, 0], [0, 9, 0, 0])
    return waymo.LidarFrame(time, vehicle, lidar, np.zeros(1), pose, (first, second))


def make_shots(vehicle: np.ndarray) -> list[waymo.CameraShot]:
    times = (1000, 2000, 3000)
    return [
        waymo.CameraShot(time, lens, b"jpeg %d" % time, vehicle) for time in times for lens in (FRONT, SIDE)
    ]


@pytest.mark.parametrize("turn", [0, 30, 148])
def test_columns_start_at_the_rear_and_turn_clockwise(turn):
    azimuths = np.degrees(waymo.column_azimuths(4, turned(turn)))  # in the lidar's own frame
    np.testing.assert_allclose(azimuths, np.array([135, 45, -45, -135]) - turn)
    points = waymo.range_image_points(np.full((1, 4), 2.0), np.zeros(1), turned(turn))[0]
    expected = [[-SQRT2, SQRT2, 0], [SQRT2, SQRT2, 0], [SQRT2, -SQRT2, 0], [-SQRT2, -SQRT2, 0]]
    np.testing.assert_allclose(points, expected, atol=1e-12)


def test_the_first_row_is_the_highest_beam():
    # two beams share -20 to 0 degrees: -15 and -5
    even = waymo.beam_inclinations(None, np.radians(-20), 0.0, 2)
    np.testing.assert_allclose(np.degrees(even), [-5, -15])
    np.testing.assert_allclose(
        waymo.beam_inclinations(np.array([-0.3, -0.1, 0.2]), 0.0, 0.0, 3), [0.2, -0.1, -0.3]
    )
    points = waymo.range_image_points(np.ones((2, 4)), even, np.eye(4))
    np.testing.assert_allclose(points[:, 0, 2], np.sin(np.radians([-5, -15])))


def test_rotation_is_yaw_after_pitch_after_roll():
    roll, pitch, yaw = np.pi / 2 * np.eye(3)
    np.testing.assert_allclose(waymo.rotation_of(yaw) @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(waymo.rotation_of(pitch) @ [1, 0, 0], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(waymo.rotation_of(roll) @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    # roll takes y to z, pitch takes z to x, yaw takes x to y
    np.testing.assert_allclose(waymo.rotation_of(roll + pitch + yaw) @ [0, 1, 0], [0, 1, 0], atol=1e-12)


def test_opencv_axes_yield_the_same_pixel():
    """K is unchanged, because 0 is the left edge of the first pixel in Waymo, as here."""
    vehicle = turned(40, x=7.0)
    image = waymo.shot_image(waymo.CameraShot(1000, SIDE, b"", vehicle), STILL)
    x, y, z, _ = image.cam_from_world @ vehicle @ turned(90) @ [10, 1, -0.5, 1]
    np.testing.assert_allclose([x, y, z], [-1, 0.5, 10], atol=1e-12)
    np.testing.assert_allclose((image.K @ [x, y, z])[:2] / z, [760, 740])
    assert image.distortion == (1, 2, 3, 4, 5)


def test_each_return_has_its_own_mask_and_channel_one_is_the_class():
    points = waymo.frame_points(make_frame(), STILL)
    assert points.class_id.tolist() == [1, 14, 15, 18, 10, 0]
    assert points.instance_id.tolist() == [7, 0, 0, 0, 9, 0]
    np.testing.assert_allclose(points.xyz[4], [2 * SQRT2, 2 * SQRT2, 0])  # range 4 in column 1
    np.testing.assert_allclose(points.xyz[5], [-3 * SQRT2, -3 * SQRT2, 0])  # range 6 in column 3


def test_pixel_poses_move_points_into_the_world():
    frame = make_frame()
    pose = np.zeros((1, 4, 6), np.float32)
    pose[0, 1] = [0, 0, np.pi / 2, 10, 0, 1]  # column 1 was measured a quarter turn and 10 m later
    points = waymo.frame_points(replace(frame, pixel_pose=pose), np.eye(4))
    np.testing.assert_allclose(points.xyz[0], [-SQRT2, SQRT2, 0], atol=1e-6)
    np.testing.assert_allclose(points.xyz[1], [10 - SQRT2, SQRT2, 1], atol=1e-6)
    # the second return has no poses and uses those of the first
    np.testing.assert_allclose(points.xyz[4], [10 - 2 * SQRT2, 2 * SQRT2, 1], atol=1e-6)


# --- release 2 ------------------------------------------------------------------------------------


@pytest.fixture
def root(tmp_path):
    frames = [make_frame(time, VEHICLE, LIDAR) for time in (1000, 3000)]
    write_segment(tmp_path / "waymo" / "validation", SEGMENT, frames, make_shots(VEHICLE))
    return tmp_path / "waymo"


def test_a_written_segment_reads_back_in_the_frame_of_its_first_vehicle(root):
    scene = open_segment(root, SEGMENT)
    truth = scene.truth["waymo"]
    one = waymo.frame_points(make_frame(), STILL)
    np.testing.assert_allclose(truth.xyz, np.tile(one.xyz, (2, 1)), atol=2e-3)  # pixel poses are float32
    np.testing.assert_array_equal(truth.class_id, np.tile(one.class_id, 2))
    names = [image.name for image in scene.images]
    assert names[:3] == ["1000_FRONT.jpg", "1000_SIDE_LEFT.jpg", "2000_FRONT.jpg"]
    assert scene.images[2].image == b"jpeg 2000" and scene.images[1].size_hw == (886, 1920)
    np.testing.assert_allclose(scene.images[0].cam_from_world @ [10, 1, -0.5, 1], [-1, 0.5, 10, 1], atol=1e-9)
    alternate = [image.name for image in open_segment(root, SEGMENT, every=2).images]
    assert alternate[::2] == ["1000_FRONT.jpg", "3000_FRONT.jpg"]
    dataset = DATASETS["waymo"]
    assert dataset.locate(root.parent) == root and dataset.found(root) == (SEGMENT,)
    assert dataset.missing(root, SEGMENT) == ()
    assert dataset.check(root, SEGMENT).facts["posed images"] == 2  # of every tenth frame
    assert scene.images[0].distortion[4] and scene.warnings == ()  # imported as FULL_OPENCV
    (root / "validation" / "vehicle_pose" / f"{SEGMENT}.parquet").unlink()
    assert dataset.missing(root, SEGMENT) == (f"validation/vehicle_pose/{SEGMENT}.parquet",)


@pytest.mark.parametrize("split", ["validation", "training"])
def test_a_segments_files_are_inputs_wherever_they_are(root, split):
    (root / "validation").rename(root / "files")
    (root / "files").rename(root / split)
    files = image_files(f"data:waymo/{SEGMENT}", str(root.parent))
    assert files and {path.parents[1] for path in files} == {root / split}
    assert not [path for path in files if path.parent.name == "lidar_segmentation"]  # evaluation reads it
    assert DATASETS["waymo"].num_images(files) == len(open_segment(root, SEGMENT).images)
    (root / split).rename(root / "elsewhere")
    record = root / split / RECORD
    record.parent.mkdir()
    record.touch()
    assert image_files(f"data:waymo/{SEGMENT}", str(root.parent)) == (record,)
    assert DATASETS["waymo"].missing(root, SEGMENT) == ()
    os.truncate(record, 990 * 10**6)
    assert DATASETS["waymo"].num_images([record]) == 990


def test_damaged_components_are_refused_with_a_fix(root):
    def refused(message: str) -> None:
        with pytest.raises(SceneError, match=f"(?s){message}"):
            open_segment(root, SEGMENT)

    poses, ranges = (root / f"validation/{tag}/{SEGMENT}.parquet" for tag in ("lidar_pose", "lidar"))
    poses.write_bytes(poses.read_bytes()[:200])
    refused("cannot be read.*fix ")
    poses.write_bytes(ranges.read_bytes())
    refused("is not component lidar_pose of release 2")
    poses.unlink()
    refused("lidar_pose/.* is missing.*fix       download lidar_pose/")
    (root / "all").mkdir()
    (root / "validation").rename(root / "all" / "validation")
    refused("one level too deep\n  fix       move .*all/validation to")


CALIBRATION, SHOT = "[CameraCalibrationComponent]", "[CameraImageComponent]"
VEHICLE_POSE = "[VehiclePoseComponent].world_from_vehicle.transform"
BEAMS = "[LiDARCalibrationComponent].beam_inclination.values"


@pytest.mark.parametrize(
    ("tag", "column", "value", "message"),
    [
        ("camera_calibration", "key.camera_name", 7, "7 is missing.*expected  cameras 1 to 5"),
        ("camera_calibration", f"{CALIBRATION}.intrinsic.f_u", None, "a lens is not finite"),
        ("camera_calibration", f"{CALIBRATION}.width", None, "calibration/.*cannot be read"),
        ("camera_image", f"{SHOT}.pose.transform", [1.0] * 12, "camera_image/.*cannot reshape"),
        ("camera_image", "key.camera_name", 9, "9 is missing.*expected  images of the cameras in camera_cal"),
        ("camera_image", f"{SHOT}.image", None, "camera_image/.*cannot be read"),
        ("vehicle_pose", VEHICLE_POSE, None, "vehicle_pose/.*cannot be read"),
        ("vehicle_pose", VEHICLE_POSE, [0.0] * 16, "not a rotation"),
        ("lidar_calibration", BEAMS, [np.nan], "no inclination"),
    ],
)
def test_components_with_unusable_values_are_refused(root, tag, column, value, message):
    path = root / f"validation/{tag}/{SEGMENT}.parquet"
    table = parquet.read_table(path, partitioning=None)
    place, column_type = table.column_names.index(column), table.schema.field(column).type
    values = pa.array([value, *table.column(column).to_pylist()[1:]], type=column_type)
    parquet.write_table(table.set_column(place, column, values), path)
    with pytest.raises(SceneError, match=f"(?s){message}"):
        open_segment(root, SEGMENT)


def test_images_and_classes_that_do_not_fit_are_refused():
    frame = make_frame()
    with pytest.raises(SceneError, match=r"return 1 of the top lidar at 1000(.|\n)*one inclination per row"):
        waymo.frame_points(replace(frame, inclinations=np.zeros(2)), np.eye(4))
    strange = replace(frame, returns=(one_return([1, 1], [3, 23]),), pixel_pose=frame.pixel_pose[:, :2])
    with pytest.raises(SceneError, match=r"unknown class\n  expected  0 to 22\n  found     3 to 23"):
        waymo.frame_points(strange, np.eye(4))


# --- release 1 ------------------------------------------------------------------------------------


def compressed(image: np.ndarray) -> bytes:
    kind = "MatrixInt32" if image.dtype.kind == "i" else "MatrixFloat"
    message = MESSAGES[kind](data=image.ravel().tolist(), shape={"dims": image.shape})
    return zlib.compress(message.SerializeToString())


def transform(pose: np.ndarray) -> dict:
    return {"transform": pose.ravel()}


def encoded(frame: waymo.LidarFrame, shots: list[waymo.CameraShot], labelled: bool = True) -> bytes:
    """The record of a frame, with its cameras in reverse and a second lidar that is not read."""
    pose = transform(frame.world_from_vehicle)
    message = MESSAGES["Frame"](timestamp_micros=frame.timestamp_micros, pose=pose)
    lenses, lidars = message.context.camera_calibrations, message.context.laser_calibrations
    for shot in reversed(shots):
        if shot.timestamp_micros == frame.timestamp_micros:
            lens, name = shot.camera, 1 if shot.camera.name == "FRONT" else 4
            message.images.add(name=name, image=shot.encoded, pose=transform(shot.world_from_vehicle))
            size = dict(zip(("height", "width"), lens.size_hw, strict=True))
            place = transform(lens.vehicle_from_cam)
            lenses.add(name=name, intrinsic=lens.intrinsic, extrinsic=place, **size)
    lidars.add(name=2)
    beams = {"beam_inclination_min": -0.1, "beam_inclination_max": 0.1}  # one beam in the middle: 0
    lidars.add(name=1, extrinsic=transform(frame.vehicle_from_lidar), **beams)
    message.lasers.add(name=2)
    top = message.lasers.add(name=1)
    for target, part in zip((top.ri_return1, top.ri_return2), frame.returns, strict=True):
        target.range_image_compressed = compressed(part.image)
        if labelled:
            target.segmentation_label_compressed = compressed(part.labels)
    top.ri_return1.range_image_pose_compressed = compressed(frame.pixel_pose)
    return message.SerializeToString()


def write_records(path: Path, records: list[bytes]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    none = bytes(4)  # instead of a checksum
    path.write_bytes(b"".join(struct.pack("<Q", len(record)) + none + record + none for record in records))
    return path


def test_a_matrix_by_hand():
    # field 1, three bytes: 1 and 300 (ac 02); field 2, four bytes: dims 2 and 1
    message = b"\x0a\x03\x01\xac\x02" + b"\x12\x04\x08\x02\x08\x01"
    assert matrix(zlib.compress(message), np.int32).tolist() == [[1], [300]]
    with pytest.raises(ValueError, match="reshape"):
        matrix(zlib.compress(message[:-1] + b"\x02"), np.int32)
    for damaged in (zlib.compress(bytes(2**27)), zlib.compress(message)[:-5]):
        with pytest.raises(ValueError, match="truncated, or unpacks to more than 64 MiB"):
            matrix(damaged, np.int32)


def test_both_releases_give_the_same_scene(root, tmp_path):
    shots = make_shots(VEHICLE)
    frames = [make_frame(time, VEHICLE, LIDAR) for time in (1000, 2000, 3000)]
    records = [encoded(frame, shots, labelled=frame.timestamp_micros != 2000) for frame in frames]
    write_records(tmp_path / "old" / f"individual_files_validation_{RECORD}", records)
    old, new = open_segment(tmp_path / "old", SEGMENT), open_segment(root, SEGMENT)
    for field in ("xyz", "class_id", "instance_id"):
        np.testing.assert_array_equal(getattr(old.truth["waymo"], field), getattr(new.truth["waymo"], field))
    assert [image.name for image in old.images] == [image.name for image in new.images]
    for first, second in zip(old.images, new.images, strict=True):
        assert first.image == second.image and first.size_hw == second.size_hw
        np.testing.assert_array_equal(first.cam_from_world, second.cam_from_world)
    assert DATASETS["waymo"].found(tmp_path / "old") == (SEGMENT,)
    write_records(tmp_path / "other" / "validation" / RECORD, records)
    assert len(open_segment(tmp_path / "other", SEGMENT).images) == 6


def test_a_record_that_is_cut_off_or_unlabelled_is_refused(tmp_path):
    path = write_records(tmp_path / RECORD, [encoded(make_frame(), make_shots(STILL), labelled=False)])
    whole, damaged = path.read_bytes(), write_records(tmp_path / "damaged", [b"\x0b"]).read_bytes()
    for content, message in (
        (whole, "no frames with labels for the top lidar"),
        (whole[:-30], "record 0 is damaged or truncated.*expected  a TFRecord file"),
        (b"no record at all", "record 0 is damaged"),
        (damaged, "frame 0 cannot be read: Error parsing message"),
        (b"", "contains no frames"),
    ):
        path.write_bytes(content)
        with pytest.raises(SceneError, match=f"(?s){message}"):
            open_segment(tmp_path, SEGMENT)
