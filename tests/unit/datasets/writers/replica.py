"""Write a scene in Replica's layout."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32

from hilsplat.base.artifacts import write_json
from hilsplat.datasets.classes.replica import NAMES
from hilsplat.scene.posed_images import HALF_PIXEL, PosedImage
from tests.unit.datasets.writers.ply import write_ply

UNDEFINED, NO_OBJECT = -1, -2
"""Class of an object that none of Replica's fits, and of object 0, which is none."""


def write_semantic_mesh(
    habitat: Path,
    xyz: Float32[np.ndarray, "P 3"],
    faces: Int32[np.ndarray, "F 3"],
    object_of_face: Int32[np.ndarray, " F"],
    classes: Sequence[int],
) -> None:
    """Write `mesh_semantic.ply` and `info_semantic.json` of a scene.

    Args:
        faces: triangles; each becomes a quad whose last corner occurs twice.
        object_of_face: row of `classes`, -1 for none. In the files objects count from 1.
        classes: Replica's class id of each object, 0 if it has none for it.
    """
    places = {axis: xyz[:, column] for column, axis in enumerate("xyz")}
    colours = dict.fromkeys(("red", "green", "blue"), np.full(len(xyz), 128, dtype=np.uint8))
    quads = faces[:, [0, 1, 2, 2]]
    of_face = (object_of_face + 1).astype(np.int32)
    labels = [NO_OBJECT, *(number or UNDEFINED for number in classes)]
    objects = [
        {"id": row, "class_id": number, "class_name": NAMES.get(number, "undefined")}
        for row, number in enumerate(labels)
        if row
    ]
    info = {
        "classes": [{"id": n, "name": name, "children": [], "parents": []} for n, name in NAMES.items()],
        "gravity_dir": [0.0, 0.0, -1.0],
        "id_to_label": labels,
        "objects": objects[::-1],  # real files do not sort them either
    }
    habitat.mkdir(parents=True)
    write_ply(habitat / "mesh_semantic.ply", {**places, **colours}, quads, {"object_id": of_face})
    (habitat / "info_semantic.json").write_text(json.dumps(info, indent=1))


def write_sequence(folder: Path, images: Sequence[PosedImage]) -> None:
    """Write a sequence in the layout of NICE-SLAM: `traj.txt`, `results/`, and `cam_params.json` beside it.

    The lens in the folder above is that of all its sequences, so all images must share K and size.
    """
    K, (height, width) = images[0].K - HALF_PIXEL, images[0].size_hw
    lens = {"w": width, "h": height, "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    write_json(folder.parent / "cam_params.json", {"camera": {**lens, "scale": 6553.5}})
    (folder / "results").mkdir(parents=True)
    for number, image in enumerate(images):
        assert isinstance(image.image, Path)
        shutil.copyfile(image.image, folder / "results" / f"frame{number:06d}{image.image.suffix}")
    np.savetxt(folder / "traj.txt", [image.world_from_cam.ravel() for image in images])
