"""Waymo perception: a segment's labelled points from the top lidar, and images from its five cameras.

Reads release 2.0.1 (parquet) or 1.4.3 (TFRecord), which contain the same data. Coordinates are relative to
the vehicle at the segment's first frame, because positions in the files (kilometres) are too large
for float32.
"""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from hilsplat.base.errors import SceneError
from hilsplat.base.files import stats_of
from hilsplat.datasets.dataset import Dataset, SceneReport, listing
from hilsplat.datasets.points.labelled_points import PointScene
from hilsplat.datasets.waymo import parquet, records
from hilsplat.datasets.waymo.frames import frame_points, joined_points, shot_image
from hilsplat.scene.posed_images import rigid_pose

SPLITS = ("validation", "training")
"""Splits searched for a segment. Labels of the testing split are not public."""
LABELS = "lidar_segmentation"
IMAGE_BYTES = 1_000_000  # of release 1 per image, with lidar: about 1 GB for 198 frames of five cameras


def find_parquet(root: Path, segment: str) -> Path | None:
    """Return the folder of the split that contains a segment's release 2 files, or None."""
    splits = (root / split for split in SPLITS)
    return next((s for s in splits if parquet.component_path(s, LABELS, segment).is_file()), None)


def record_files(root: Path) -> dict[str, Path]:
    """Return the release 1 files in `root` and the folders of its splits by segment."""
    files = (*root.glob("*.tfrecord"), *root.glob("*/*.tfrecord"))
    return {path.stem.split("segment-")[-1].removesuffix("_with_camera_labels"): path for path in files}


def open_segment(root: Path, segment: str, every: int = 1) -> PointScene:
    """Read a segment: the top lidar's labelled frames (both returns), and the images of every n-th frame.

    A segment is named after its context, such as 10023947602400723454_1120_000_1140_000.

    Raises:
        SceneError: the segment is missing or damaged, or has no labelled frame.
    """
    split, record = find_parquet(root, segment), record_files(root).get(segment)
    if split is not None:
        poses = parquet.vehicle_poses(split, segment)
        if not poses:
            raise SceneError(f"component vehicle_pose of segment {segment} is empty", fix="download it again")
        first = next(iter(poses.values()))
        frames = parquet.lidar_frames(split, segment)
        shots = parquet.camera_shots(split, segment, every)
    elif record is not None:
        first = records.first_pose(record)
        frames, shots = records.lidar_frames(record), records.camera_shots(record, every)
    else:
        found = listing(root)
        fix = "download all components of the segment, or its .tfrecord; the testing split has no labels"
        if wrong := sorted(root.glob(f"*/*/*/{segment}.parquet")):
            found, fix = f"{wrong[0]}, one level too deep", f"move {wrong[0].parents[1]} to {root}"
        raise SceneError(
            f"segment {segment} is not in {root}",
            expected=f"<split>/{LABELS}/{segment}.parquet, where <split> is {' or '.join(SPLITS)}",
            found=found,
            fix=fix,
        )
    segment_from_world = np.linalg.inv(rigid_pose(first, f"segment {segment}, first frame"))
    points = [frame_points(frame, segment_from_world) for frame in frames]
    if not points:
        raise SceneError(
            f"segment {segment} has no frames with labels for the top lidar",
            fix="use a segment with 3D semantic segmentation labels, from release 1.3.2 or later",
        )
    images = tuple(shot_image(shot, segment_from_world) for shot in shots)
    return PointScene(segment, images, {"waymo": joined_points(points)})


class Segments(Dataset):
    """A data set whose scenes are the segments on disk, because the paper names none."""

    def check(self, root: Path, scene: str) -> SceneReport:
        """Read a segment with the images of every tenth frame, and report what was found."""
        return open_segment(root, scene, every=10).report()

    def found(self, root: Path) -> tuple[str, ...]:
        files = [path for split in SPLITS for path in (root / split).glob(f"{LABELS}/*.parquet")]
        return tuple(sorted({*(path.stem for path in files), *record_files(root)}))

    def needs(self, root: Path, scene: str) -> tuple[str, ...]:
        """Return the paths of a segment in release 2, or its file in release 1."""
        split, record = find_parquet(root, scene), record_files(root).get(scene)
        if split is None and record is not None:
            return (str(record.relative_to(root)),)
        paths = [parquet.component_path(split or root / SPLITS[0], tag, scene) for tag in parquet.COMPONENTS]
        return tuple(str(path.relative_to(root)) for path in paths)

    def num_images(self, files: Sequence[Path]) -> int:
        """Return the number of images inside the files, for release 1 from the size of the file."""
        for path in files:
            if path.parent.name == parquet.COMPONENTS[0]:
                with suppress(SceneError):  # reading the segment reports it
                    return parquet.num_images(path)
        return sum(stat.st_size for stat in stats_of(files).values()) // IMAGE_BYTES


DATASET = Segments(
    name="waymo",
    title="Waymo Open Dataset, 3D semantic segmentation",
    labels="points",
    tables=("waymo",),
    scenes=(),
    licence="code Apache-2.0; data under the Waymo Dataset License Agreement for Non-Commercial Use",
    terms="Non-commercial use after registration; do not redistribute the data.",
    origin="https://waymo.com/open, after registration",
    citation="Sun et al., Scalability in Perception for Autonomous Driving: Waymo Open Dataset, CVPR 2020",
    layout="""waymo/
  validation/                          release 2.0.1, one parquet file per component and segment
    camera_image/<segment>.parquet
    camera_calibration/  lidar/  lidar_calibration/  lidar_pose/  lidar_segmentation/  vehicle_pose/
  individual_files_validation_segment-<segment>_with_camera_labels.tfrecord     or release 1.4.3""",
    required=lambda segment: tuple(f"{SPLITS[0]}/{tag}/{segment}.parquet" for tag in parquet.COMPONENTS),
    open=open_segment,
    protocols=("waymo/segmentation",),
    label_places=lambda segment: (f"*/lidar_segmentation/{segment}.parquet",),
)
