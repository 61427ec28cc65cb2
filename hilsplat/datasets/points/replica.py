"""Replica: rendered sequences in three layouts, and the labelled quad mesh.

All readers raise SceneError if a file is missing, damaged, or doesn't match the others.

| | NICE-SLAM | Semantic-NeRF, vMAP |
|---|---|---|
| images | `results/frame000000.jpg` | `rgb/rgb_0.png` |
| depth | `results/depth000000.png`, metres x 6553.5 | `depth/depth_0.png`, millimetres |
| poses | `traj.txt` | `traj_w_c.txt` |
| focal length | in `cam_params.json` beside the sequence, else half the width (600 px) | half the width |

Poses are camera-to-world in OpenCV axes, 16 numbers per line.
"""

from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, Int32

from hilsplat.base.errors import SceneError
from hilsplat.base.files import list_images
from hilsplat.base.images import image_size_hw
from hilsplat.datasets.classes import REPLICA_NAMES
from hilsplat.datasets.dataset import Dataset, listing
from hilsplat.datasets.points.labelled_points import (
    UNPACK_AGAIN,
    LabelledPoints,
    PlyMesh,
    PointScene,
    decoding,
    posed_frame,
    read_json_object,
    read_matrices,
)
from hilsplat.scene.posed_images import HALF_PIXEL, PosedImage

LENS = "cam_params.json"

LAYOUTS = (("traj.txt", "results", "frame"), ("traj_w_c.txt", "rgb", "rgb_"))
"""Pose file, image folder and image name prefix, for NICE-SLAM, then for Semantic-NeRF and vMAP."""


def find_sequence(root: Path, scene: str) -> tuple[Path, tuple[str, str, str]]:
    """Return the folder and the row of `LAYOUTS` of a scene's rendered sequence.

    The folder is `room0` (NICE-SLAM), `room_0/imap/00` (vMAP) or `room_0/Sequence_1`.
    """
    places = (scene.replace("_", ""), f"{scene}/imap/00", f"{scene}/Sequence_1")
    folders = [root / name for name in places if (root / name).is_dir()]
    for folder in folders:
        for layout in LAYOUTS:
            if (folder / layout[0]).is_file() and (folder / layout[1]).is_dir():
                return folder, layout
    nested = [path.parent for folder in folders for path in sorted(folder.glob("*/traj*.txt"))]
    raise SceneError(
        f"{scene} has no rendered sequence in {root}",
        expected=f"traj.txt with results/, or traj_w_c.txt with rgb/, in {' or '.join(places)}",
        found=listing([*folders, root][0]),
        fix=f"move the files in {nested[0]} one level up"
        if nested
        else "unpack the rendered sequences there",
    )


def read_lens(path: Path) -> tuple[Float[np.ndarray, "3 3"], tuple[int, int]]:
    """Return K and the image size from `cam_params.json`, which is beside a NICE-SLAM sequence."""
    camera = read_json_object(path, ("camera",))["camera"]
    with decoding(path, expected="numbers w, h, fx, fy, cx, cy under the key camera"):
        fx, fy, cx, cy = (float(camera[key]) for key in ("fx", "fy", "cx", "cy"))
        size_hw = int(camera["h"]), int(camera["w"])
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]) + HALF_PIXEL, size_hw


def read_images(root: Path, scene: str) -> tuple[tuple[PosedImage, ...], tuple[str, ...]]:
    """Return the posed images of a scene's rendered sequence, sorted by frame number.

    Line n of the pose file is the pose of frame n. Lines without an image are skipped, and a warning with
    their number is also returned.
    """
    folder, (pose_file, image_folder, prefix) = find_sequence(root, scene)
    path = folder / pose_file
    poses = read_matrices(path, 16)
    frames = sorted(
        (int(image.stem.removeprefix(prefix)), image)
        for image in list_images(folder / image_folder)
        if image.stem.startswith(prefix) and image.stem.removeprefix(prefix).isdecimal()
    )  # other images are depth or colour visualisations
    if twice := [other.name for (number, _), (again, other) in pairwise(frames) if number == again]:
        raise SceneError(
            f"{folder / image_folder} has several images of one frame", found=twice[0], fix=UNPACK_AGAIN
        )
    beyond = [number for number, _ in frames if number >= len(poses)]
    if beyond or not frames:
        missing = f"; the first frame without a line is {beyond[0]}" if beyond else ""
        raise SceneError(
            f"{path} does not match the images in {folder / image_folder}",
            expected="at least one line per frame",
            found=f"{len(poses)} lines, {len(frames)} images{missing}",
            fix=UNPACK_AGAIN,
        )
    lens = folder.parent / LENS
    if pose_file == "traj.txt" and lens.is_file():
        K, size_hw = read_lens(lens)
    else:  # the renderings' stated centre, 599.5 of 1200 px, is relative to the first pixel's centre
        size_hw = height, width = image_size_hw(frames[0][1])
        K = np.array([[width / 2, 0.0, width / 2], [0.0, width / 2, height / 2], [0.0, 0.0, 1.0]])
    images = tuple(
        posed_frame(image, poses[number], f"{path}, line {number + 1}", K, size_hw)
        for number, image in frames
    )
    more = len(poses) - len(frames)
    return images, (f"{more} poses have no image and are skipped",) if more else ()


def class_of_objects(path: Path) -> Int32[np.ndarray, " O"]:
    """Return the class of each object id, from `info_semantic.json`; negative ids (undefined, none) become 0.

    Names and ids must be those of the release.
    """
    content = read_json_object(path, ("classes", "id_to_label"))
    with decoding(path, expected="id_to_label: a list of class ids; classes: objects with id and name"):
        classes = np.asarray(content["id_to_label"], dtype=np.int32).reshape(-1)
        names = {int(entry["id"]): str(entry["name"]) for entry in content["classes"]}
    other = [f"{number} {name}" for number, name in names.items() if REPLICA_NAMES.get(number) != name]
    strange = sorted(set(classes[classes > 0].tolist()) - set(REPLICA_NAMES))
    if other or strange:
        raise SceneError(
            f"{path} has classes that are not in Replica",
            expected=f"the {len(REPLICA_NAMES)} classes of the release, such as {REPLICA_NAMES[1]} (1)",
            found=", ".join([*other[:5], *(f"class id {number}" for number in strange[:5])]),
            fix="use the file of the original release",
        )
    return np.maximum(classes, 0)


def object_of_vertices(
    faces: Int[np.ndarray, "F c"], object_of_face: Int[np.ndarray, " F"], num_vertices: int
) -> Int32[np.ndarray, " P"]:
    """Return the most frequent object among each vertex's faces (lowest id if tied), -1 without faces."""
    span = int(object_of_face.max(initial=0)) + 1
    owned = faces.astype(np.int64) * span + object_of_face[:, None]  # one number for each vertex and object
    pairs, votes = np.unique(owned, return_counts=True)
    # The first pair of each vertex has the most votes and, among ties, the smallest id.
    pairs = pairs[np.lexsort((pairs, -votes, pairs // span))]
    vertices, first = np.unique(pairs // span, return_index=True)
    result = np.full(num_vertices, -1, dtype=np.int32)
    result[vertices] = pairs[first] % span
    return result


def read_semantic_mesh(habitat: Path) -> LabelledPoints:
    """Return the vertices of `mesh_semantic.ply`, each labelled with the most frequent object of its faces.

    The file numbers objects from 0; `instance_id` is that number + 1, or 0 if the class is undefined.
    """
    path = habitat / "mesh_semantic.ply"
    mesh = PlyMesh(path, 4)
    classes = class_of_objects(habitat / "info_semantic.json")
    quads, of_face = mesh.faces, mesh.column("face", "object_id").astype(np.int64)
    if of_face.size and (of_face.min() < 0 or of_face.max() >= len(classes)):
        raise SceneError(
            f"{path} and info_semantic.json do not match",
            expected=f"object ids 0 to {len(classes) - 1}",
            found=f"{of_face.min()} to {of_face.max()}",
            fix="use both files from the same scene",
        )
    owner = object_of_vertices(quads, of_face, len(mesh.xyz))
    class_id = np.where(owner >= 0, classes[owner], 0).astype(np.int32)
    instance = np.where(class_id > 0, owner + 1, 0).astype(np.int32)
    return LabelledPoints(mesh.xyz, class_id, instance)


def open_scene(root: Path, scene: str) -> PointScene:
    truth = read_semantic_mesh(root / scene / "habitat")
    images, warnings = read_images(root, scene)
    return PointScene(scene, images, {"replica": truth}, warnings)


class Rooms(Dataset):
    """Replica, whose rendered sequences are in one of several places."""

    def needs(self, root: Path, scene: str) -> tuple[str, ...]:
        """Return the labels of a room, and the poses, images and lens of its rendered sequence."""
        folder, (poses, images, _) = root / scene.replace("_", ""), LAYOUTS[0]
        with suppress(SceneError):  # the first layout's paths are named as missing
            folder, (poses, images, _) = find_sequence(root, scene)
        lens = folder.parent / LENS
        paths = [folder / poses, folder / images, *([lens] if lens.is_file() else [])]
        return (*self.required(scene), *(path.relative_to(root).as_posix() for path in paths))

    def require(self, root: Path, scene: str) -> None:
        """Raise SceneError if the labels are missing, or else the sequence, with the possible places."""
        if all((root / name).exists() for name in self.required(scene)):
            find_sequence(root, scene)
        super().require(root, scene)

    def num_images(self, files: Sequence[Path]) -> int:
        """Count frames, without depth and other maps."""
        return sum(path.stem.startswith(tuple(prefix for _, _, prefix in LAYOUTS)) for path in files)


DATASET = Rooms(
    name="replica",
    title="Replica",
    labels="points",
    tables=("replica",),
    scenes=(*(f"office_{number}" for number in range(5)), *(f"room_{number}" for number in range(3))),
    licence="Replica Research Terms",
    terms="Non-commercial research and education only; do not redistribute the data.",
    origin="https://github.com/facebookresearch/Replica-Dataset",
    citation="Straub et al., The Replica Dataset: A Digital Replica of Indoor Spaces, arXiv 1906.05797, 2019",
    layout="""replica/
  room_0/                        the original release
    habitat/mesh_semantic.ply
    habitat/info_semantic.json
  cam_params.json                optional: intrinsics of the renderings
  room0/                         NICE-SLAM's renderings; or room_0/imap/00 (vMAP), room_0/Sequence_1
    traj.txt
    results/frame000000.jpg depth000000.png ...""",
    required=lambda scene: (f"{scene}/habitat/mesh_semantic.ply", f"{scene}/habitat/info_semantic.json"),
    open=open_scene,
    protocols=("replica/per-scene", "replica/opennerf", "replica/conceptgraphs"),
    label_places=lambda scene: (f"{scene}/habitat/*",),
)
