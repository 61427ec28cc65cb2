"""ScanNet v2 and ScanNet200: exported frames, the evaluated mesh, and its labels and instances.

The layout is that of the ScanNet release, with the frames exported from `.sens` by ScanNet's reader:
`color/<n>.jpg`, `pose/<n>.txt` (camera-to-world, OpenCV axes), `intrinsic/intrinsic_color.txt`. All readers
raise SceneError if a file is missing, damaged, or doesn't match the others.
"""

import csv
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Int32

from hilsplat.base.errors import SceneError
from hilsplat.base.files import list_images
from hilsplat.base.images import image_size_hw
from hilsplat.datasets.classes import SCANNET200
from hilsplat.datasets.dataset import Dataset
from hilsplat.datasets.points.labelled_points import (
    LabelledPoints,
    PlyMesh,
    PointScene,
    decoding,
    posed_frame,
    read_json_object,
    read_matrices,
    require_file,
)
from hilsplat.scene.cameras import MAX_SIDE_PX
from hilsplat.scene.importers.known_views import NOTED_OFFSET, check_centres
from hilsplat.scene.posed_images import HALF_PIXEL, PosedImage

LABEL_TABLE = "scannetv2-labels.combined.tsv"
SAME_PLACE_M = 1e-4
"""Tolerance between corresponding vertices of the labelled and unlabelled meshes; some copies are rounded."""


def scan_folder(root: Path, scan: str) -> Path:
    """Return a scan's folder; raise SceneError if it is misplaced or its frames are still in `.sens`."""
    folder = root / "scans" / scan
    for wrong in (folder / scan, root / scan, root / "scans" / "scans" / scan):
        if not (folder / f"{scan}_vh_clean_2.ply").is_file() and wrong.is_dir():
            fix = f"move {wrong} to {folder}"
            raise SceneError(f"scan {scan} is in the wrong place", expected=folder, found=wrong, fix=fix)
    if (folder / f"{scan}.sens").is_file() and not (folder / "color").is_dir():
        raise SceneError(
            f"the frames of {scan} are still inside {scan}.sens",
            expected=f"color/, pose/ and intrinsic/ in {folder}",
            fix="export them with ScanNet's SensReader: --export_color_images --export_poses "
            "--export_intrinsics",
        )
    return folder


def read_label_table(path: Path) -> dict[str, int]:
    """Map each raw category to its id in the label table, or to 0 if it is not one of the 200 classes."""
    require_file(path, f"download {LABEL_TABLE} from ScanNet's release to the data set's folder")
    labels = {}
    with decoding(path), path.open(encoding="utf-8-sig", newline="") as stream:
        rows = csv.DictReader(stream, delimiter="\t")
        needed = {"id", "raw_category"}
        if not needed <= set(rows.fieldnames or ()):
            raise SceneError(
                f"{path} is not ScanNet's label table",
                expected="tab-separated columns id, raw_category",
                found=", ".join(rows.fieldnames or ())[:120] or "an empty file",
                fix="download the table again, from the latest release",
            )
        for row in rows:
            with decoding(f"{path}, line {rows.line_num}"):
                label = int(row["id"] or 0)
            labels[row["raw_category"]] = label if label in SCANNET200.ids else 0
    return labels


def read_images(folder: Path, scan: str) -> tuple[tuple[PosedImage, ...], tuple[str, ...]]:
    """Return posed colour images, sorted by frame number, skipping frames for which tracking failed.

    ScanNet's coordinates are relative to the first pixel's centre (the depth camera's centre is 319.5 of
    640), so half a pixel is added to the principal point in K.

    Also return a warning for each reason that frames were skipped.
    """
    frames = sorted((_frame_number(path), path) for path in list_images(folder / "color"))
    poses = {int(path.stem): path for path in (folder / "pose").glob("*.txt") if path.stem.isdecimal()}
    lens = folder / "intrinsic" / "intrinsic_color.txt"
    K = read_matrices(lens, 4)[0, :3, :3] + HALF_PIXEL
    lost, unposed, images = [], [], []
    described = folder / f"{scan}.txt"
    with decoding(described, expected="colorHeight and colorWidth as whole numbers"):
        info = dict(re.findall("(.*) = (.*)", described.read_text("utf-8"))) if described.is_file() else {}
        if "colorHeight" in info and "colorWidth" in info:
            size_hw = int(info["colorHeight"]), int(info["colorWidth"])
            if not 0 < min(size_hw) <= max(size_hw) <= MAX_SIDE_PX:
                raise ValueError(f"its sides are not from 1 to {MAX_SIDE_PX} px")
        else:
            size_hw = image_size_hw(frames[0][1]) if frames else (0, 0)
    for number, path in frames:
        if (pose := poses.get(number)) is None:
            unposed.append(number)
            continue
        world_from_cam = read_matrices(pose, 4)[0]
        if not np.isfinite(world_from_cam).all():
            lost.append(number)
            continue
        images.append(posed_frame(path, world_from_cam, str(pose), K, size_hw))
    if frames:  # no scan was cropped
        check_centres({str(lens): (K, size_hw)}, NOTED_OFFSET)
    if not images:
        raise SceneError(
            f"{scan} has no usable frames",
            expected="images in color/, each with a finite matrix in pose/",
            found=f"{len(frames)} images; {len(unposed)} without a pose, {len(lost)} with failed tracking",
            fix="export poses and images again",
        )
    warnings = []
    if lost:
        warnings.append(f"{len(lost)} frames are skipped because tracking failed (infinite poses)")
    if unposed:
        warnings.append(f"{len(unposed)} images (first: {unposed[0]}) have no file in pose/ and are skipped")
    return tuple(images), tuple(warnings)


def _frame_number(path: Path) -> int:
    if not (path.stem.isascii() and path.stem.isdecimal()):
        raise SceneError(
            f"{path} is not named like a frame",
            expected=f"<number>{path.suffix}",
            fix="move images that are not frames to another folder",
        )
    return int(path.stem)


def read_truth(
    folder: Path, scan: str, table: dict[str, int]
) -> tuple[dict[str, LabelledPoints], tuple[str, ...]]:
    """Return the labels of the evaluated mesh's vertices: NYU40 ids, ScanNet200 ids and instances.

    NYU40 ids are those of `.labels.ply`; ScanNet200 ids and instances (objectId + 1) come from the
    aggregation. A vertex in two groups belongs to the later one, as in the official exporter.
    """
    mesh_path = folder / f"{scan}_vh_clean_2.ply"
    label_path = folder / f"{scan}_vh_clean_2.labels.ply"
    mesh, labelled = PlyMesh(mesh_path, 3), PlyMesh(label_path, 3)
    xyz = mesh.xyz
    nyu40 = labelled.column("vertex", "label").astype(np.int32)
    if len(nyu40) != len(xyz) or not np.allclose(labelled.xyz, xyz, atol=SAME_PLACE_M):
        raise SceneError(
            f"{label_path.name} does not match {mesh_path.name} of {scan}",
            expected=f"the same {len(xyz)} vertices in the same order",
            found=f"{len(nyu40)} vertices" if len(nyu40) != len(xyz) else "vertices at other positions",
            fix="use both files from the same release",
        )
    if nyu40.size and nyu40.max() > 40:
        raise SceneError(
            f"{label_path} does not contain NYU40 labels", expected="0 to 40", found=int(nyu40.max())
        )
    fine, instance, unknown = _from_aggregation(folder, scan, table, len(xyz))
    warnings = []
    if unknown:
        listed = ", ".join(f"{name} ({count})" for name, count in sorted(unknown.items()))
        warnings.append(f"no ScanNet200 class for categories that are not in {LABEL_TABLE}: {listed}")
    points = LabelledPoints(xyz, nyu40, instance)
    truth = {"nyu40": points, "scannet200": replace(points, class_id=fine)}
    return truth, tuple(warnings)


def _from_aggregation(
    folder: Path, scan: str, table: dict[str, int], num_points: int
) -> tuple[Int32[np.ndarray, " P"], Int32[np.ndarray, " P"], Counter[str]]:
    """Return each vertex's ScanNet200 id and instance, and the raw categories missing from the table."""
    segments_path = folder / f"{scan}_vh_clean_2.0.010000.segs.json"
    with decoding(segments_path):
        segments = np.asarray(read_json_object(segments_path, ("segIndices",))["segIndices"])
    if segments.shape != (num_points,) or segments.dtype.kind != "i":
        raise SceneError(
            f"{segments_path} does not match the mesh of {scan}",
            expected=f"an integer for each of {num_points} vertices",
            found=f"{segments.size} values of type {segments.dtype}",
            fix="use the file for the decimated mesh (vh_clean_2)",
        )
    path = folder / f"{scan}.aggregation.json"
    fine, instance = np.zeros((2, num_points), dtype=np.int32)
    unknown = Counter[str]()
    with decoding(path):
        groups = list(read_json_object(path, ("segGroups",))["segGroups"])
    for row, group in enumerate(groups):
        with decoding(f"{path}, group {row}", expected="objectId, label and a list of segments"):
            category, number = str(group["label"]), np.int32(int(group["objectId"]) + 1)
            members = np.asarray(group["segments"], dtype=np.int64)
        rows = np.isin(segments, members)
        if not rows.any():
            raise SceneError(
                f"{path}, group {row} ({category}): none of its segments is in {segments_path.name}",
                fix="use the aggregation for the decimated mesh, not the one for the full mesh",
            )
        if category not in table:
            unknown[category] += 1
        fine[rows], instance[rows] = table.get(category, 0), number
    return fine, instance, unknown


def open_scan(root: Path, scan: str) -> PointScene:
    folder = scan_folder(root, scan)
    DATASET.require(root, scan)
    truth, of_labels = read_truth(folder, scan, read_label_table(root / LABEL_TABLE))
    images, of_images = read_images(folder, scan)
    return PointScene(scan, images, truth, (*of_images, *of_labels))


def _label_files(scan: str) -> tuple[str, ...]:
    suffixes = ("_vh_clean_2.labels.ply", "_vh_clean_2.0.010000.segs.json", ".aggregation.json")
    return tuple(f"scans/{scan}/{scan}{suffix}" for suffix in suffixes)


DATASET = Dataset(
    name="scannet",
    title="ScanNet v2",
    labels="points",
    tables=("scannet",),
    # The ten scans of OpenGaussian's table. All but the last are in the training split.
    scenes=tuple(f"scene{number:04d}_00" for number in (0, 62, 70, 97, 140, 200, 347, 400, 590, 645)),
    licence="code MIT; data under the ScanNet Terms of Use",
    terms="Research use only, with a signed agreement; never redistribute scans or labels made from them.",
    origin="https://github.com/ScanNet/ScanNet, after signing the terms of use",
    citation="Dai et al., ScanNet: Richly-annotated 3D Reconstructions of Indoor Scenes, CVPR 2017; "
    "ScanNet200: Rozenberszki et al., Language-Grounded Indoor 3D Semantic Segmentation, ECCV 2022",
    layout="""scannet/
  scannetv2-labels.combined.tsv
  scans/
    scene0000_00/
      color/0.jpg 1.jpg ...            exported from the .sens file
      pose/0.txt 1.txt ...
      intrinsic/intrinsic_color.txt
      scene0000_00_vh_clean_2.ply
      scene0000_00_vh_clean_2.labels.ply
      scene0000_00_vh_clean_2.0.010000.segs.json
      scene0000_00.aggregation.json
      scene0000_00.txt                 optional: image size""",
    required=lambda scan: (
        *(f"scans/{scan}/{name}" for name in ("color", "pose", "intrinsic/intrinsic_color.txt")),
        f"scans/{scan}/{scan}_vh_clean_2.ply",
        *_label_files(scan),
    ),
    open=open_scan,
    protocols=(
        "scannet/opengaussian-19",
        "scannet/opengaussian-15",
        "scannet/opengaussian-10",
        "scannet200/opengaussian",
        "scannet200/benchmark",
        "scannet200/instances",
    ),
    label_places=lambda scan: (LABEL_TABLE, *_label_files(scan)),
)

SCANNET200_DATASET = replace(DATASET, name="scannet200", title="ScanNet200", folder="scannet")
"""The same scans and files with different labels. The paper does not state whether it scored these ten scans
with 200 classes, or the benchmark's 312 validation scans (ScanNet's `Tasks/Benchmark/scannetv2_val.txt`)."""
