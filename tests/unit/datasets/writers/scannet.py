"""Write a scene in ScanNet's layout."""

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32

from hilsplat.base.artifacts import write_text
from hilsplat.datasets.points.scannet import LABEL_TABLE
from hilsplat.scene.posed_images import HALF_PIXEL, PosedImage
from tests.unit.datasets.writers.ply import write_ply

SEGMENT_STEP = 7
"""Segment ids are not contiguous in real scans; neither are ours."""
GREY = 128


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

    Args:
        images: all share K and size, as ScanNet's do.
        object_of_vertex: row of `objects`, -1 for none.
        objects: raw category of each object.
        categories: raw category -> (id, NYU40 id).
        lost: frames that get the infinite pose of lost tracking.
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
    info = f"colorHeight = {height}\ncolorWidth = {width}\nsceneType = Synthetic room\n"
    write_text(folder / f"{scan}.txt", info)
    places = {axis: xyz[:, column] for column, axis in enumerate("xyz")}
    grey = np.full(len(xyz), GREY, dtype=np.uint8)
    colours = dict.fromkeys(("red", "green", "blue", "alpha"), grey)
    write_ply(folder / f"{scan}_vh_clean_2.ply", {**places, **colours}, faces, {})
    of_object = np.array([categories[name][1] for name in objects] + [0], dtype=np.uint16)
    labels = of_object[object_of_vertex]  # -1, none, is the last
    write_ply(folder / f"{scan}_vh_clean_2.labels.ply", {**places, **colours, "label": labels}, faces, {})
    _write_groups(folder, scan, xyz, object_of_vertex, objects)


def _write_groups(
    folder: Path, scan: str, xyz: np.ndarray, object_of_vertex: np.ndarray, objects: Sequence[str]
) -> None:
    """Two segments per object, at either side of its middle, and the objects made of them."""
    segment = np.zeros(len(xyz), dtype=np.int64)
    groups = []
    for number, category in enumerate(objects):
        rows = np.flatnonzero(object_of_vertex == number)
        if not rows.size:
            continue
        side = xyz[rows, 0] > np.median(xyz[rows, 0])
        segment[rows] = SEGMENT_STEP * (2 * number + 1 + side)
        members = np.unique(segment[rows]).tolist()
        groups.append({"id": len(groups), "objectId": number, "segments": members, "label": category})
    name = f"{scan}_vh_clean_2.0.010000.segs.json"
    record = {"params": {}, "sceneId": scan, "segIndices": segment.tolist()}
    write_text(folder / name, json.dumps(record))
    whole = {"sceneId": f"scannet.{scan}", "segGroups": groups, "segmentsFile": f"scannet.{name}"}
    write_text(folder / f"{scan}.aggregation.json", json.dumps(whole))
