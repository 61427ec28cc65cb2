"""Replica: rendered sequences in three layouts, the labelled quad mesh, and labels per vertex as text.

| | NICE-SLAM | Semantic-NeRF, vMAP |
|---|---|---|
| images | `results/frame000000.jpg` | `rgb/rgb_0.png` |
| depth | `results/depth000000.png`, metres x 6553.5 | `depth/depth_0.png`, millimetres |
| poses | `traj.txt` | `traj_w_c.txt` |
| lens | `cam_params.json` beside the sequence, else 600 of 1200 px | focal length half the width |

Poses are camera-to-world in OpenCV axes, 16 numbers per line.
"""

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hilsplat.base.errors import SceneError
from hilsplat.base.files import list_images
from hilsplat.datasets.classes.replica import SCENES
from hilsplat.datasets.dataset import Dataset, listing
from hilsplat.datasets.labelled import image_size_hw
from hilsplat.datasets.points.labelled_points import PointScene
from hilsplat.datasets.points.point_files import UNPACK_AGAIN, by_number, read_json_object, read_numbers
from hilsplat.datasets.points.replica_mesh import read_labelled_mesh, read_semantic_mesh
from hilsplat.scene.posed_images import HALF_PIXEL, PosedImage, cam_from_world_of

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Layout:
    """Storage layout of a sequence's frames.

    Attributes:
        folder: image folder.
        prefix: what precedes the number in names of images.
        poses: name of the pose file.
    """

    folder: str
    prefix: str
    poses: str


NICE_SLAM = Layout("results", "frame", "traj.txt")
SEMANTIC_NERF = Layout("rgb", "rgb_", "traj_w_c.txt")


def layout_of(folder: Path) -> Layout:
    """Return the layout of a sequence, recognised by its pose file.

    Raises:
        SceneError: it has neither layout.
    """
    for layout in (NICE_SLAM, SEMANTIC_NERF):
        if (folder / layout.poses).is_file() and (folder / layout.folder).is_dir():
            return layout
    inner = sorted(path.parent for name in ("traj.txt", "traj_w_c.txt") for path in folder.glob(f"*/{name}"))
    raise SceneError(
        f"{folder} does not hold a rendered sequence",
        expected="traj.txt with results/, or traj_w_c.txt with rgb/",
        found=listing(folder),
        fix=f"use the folder {inner[0]} instead" if inner else "unpack the rendered sequences there",
    )


def read_lens(path: Path) -> tuple[Float[np.ndarray, "3 3"], tuple[int, int]]:
    """Return K and its image size from `cam_params.json`, which is beside a NICE-SLAM sequence.

    Raises:
        SceneError: the file is damaged.
    """
    camera = read_json_object(path, ("camera",))["camera"]
    try:
        fx, fy, cx, cy = (float(camera[key]) for key in ("fx", "fy", "cx", "cy"))
        size_hw = int(camera["h"]), int(camera["w"])
    except (KeyError, TypeError, ValueError) as error:
        raise SceneError(
            f"{path} cannot be read: {error!r}",
            expected="numbers w, h, fx, fy, cx, cy under the key camera",
            fix=UNPACK_AGAIN,
        ) from error
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]) + HALF_PIXEL, size_hw


def default_lens(image: Path) -> tuple[Float[np.ndarray, "3 3"], tuple[int, int]]:
    """Return K of every Replica rendering: focal length half the width, principal point in the middle.

    The centre in the files, 599.5 of 1200 px, is relative to the first pixel's centre.
    """
    height, width = image_size_hw(image)
    K = np.array([[width / 2, 0.0, width / 2], [0.0, width / 2, height / 2], [0.0, 0.0, 1.0]])
    return K, (height, width)


def read_images(folder: Path, every: int = 1) -> tuple[tuple[PosedImage, ...], tuple[str, ...]]:
    """Return the posed images of a rendered sequence, by frame number.

    Line n of the pose file is frame n; lines without an image are skipped.

    Returns:
        The images and a sentence for each item that was skipped.

    Raises:
        SceneError: no layout fits, frames exceed the poses, or there are no frames.
    """
    layout = layout_of(folder)
    path = folder / layout.poses
    poses = read_numbers(path, 16).reshape(-1, 4, 4)
    named = [
        image
        for image in list_images(folder / layout.folder)
        if image.stem.startswith(layout.prefix) and image.stem.removeprefix(layout.prefix).isdecimal()
    ]  # the others are depth or colour visualisations
    frames = by_number(named, layout.prefix)
    beyond = [number for number, _ in frames if number >= len(poses)]
    if beyond or not frames:
        raise SceneError(
            f"{path} does not match the images in {folder / layout.folder}",
            expected="one line per frame, or more",
            found=f"{len(poses)} lines, {len(frames)} images"
            + (f", the first without a line is frame {beyond[0]}" if beyond else ""),
            fix=UNPACK_AGAIN,
        )
    lens = folder.parent / "cam_params.json"
    own = layout is NICE_SLAM and lens.is_file()
    K, size_hw = read_lens(lens) if own else default_lens(frames[0][1])
    images = tuple(
        PosedImage(
            image.name, image, cam_from_world_of(poses[number], f"{path}, line {number + 1}"), K, size_hw
        )
        for number, image in frames[::every]
    )
    more = len(poses) - len(frames)
    return images, (f"{more} poses have no image and are skipped",) if more else ()


def sequence_folder(root: Path, scene: str) -> Path:
    """Return a scene's rendered sequence: `room0/` (NICE-SLAM), `room_0/imap/00` (vMAP), `room_0/Sequence_1`.

    Raises:
        SceneError: none of them exists.
    """
    places = (scene.replace("_", ""), f"{scene}/imap/00", f"{scene}/Sequence_1")
    for place in places:
        if (root / place).is_dir():
            return root / place
    raise SceneError(
        f"{scene} has no rendered sequence in {root}",
        expected=" or ".join(f"{place}/" for place in places),
        found=listing(root),
        fix="unpack the rendered sequences there",
    )


def open_scene(root: Path, scene: str, every: int = 1) -> PointScene:
    """Read a scene: the sequence, and the labels of the original release or else of OpenNeRF.

    Args:
        scene: name as spelt in the release, such as room_0.
        every: use every n-th frame.

    Raises:
        SceneError: a file is missing, damaged or does not match the others.
    """
    habitat, short = root / scene / "habitat", scene.replace("_", "")
    text = root / f"semantic_labels_{short}.txt"
    if habitat.is_dir():
        truth = read_semantic_mesh(habitat)
    elif text.is_file():
        instances = root / f"instance_labels_{short}.txt"
        mesh = root / f"{short}_mesh.ply"
        truth = read_labelled_mesh(mesh, text, instances if instances.is_file() else None)
    else:
        raise SceneError(
            f"{scene} of Replica has no labels in {root}",
            expected=f"{scene}/habitat/mesh_semantic.ply, or {text.name} with {short}_mesh.ply",
            found=listing(root),
            fix="unpack the original release there",
        )
    images, warnings = read_images(sequence_folder(root, scene), every)
    for warning in warnings:
        logger.warning("%s: %s", scene, warning)
    return PointScene(scene, images, {"replica": truth}, warnings)


DATASET = Dataset(
    name="replica",
    title="Replica",
    labels="points",
    folder="replica",
    scenes=SCENES,
    licence="Replica Research Terms",
    terms="Non-commercial research and education only; do not pass the data on.",
    citation="Straub et al., The Replica Dataset: A Digital Replica of Indoor Spaces, arXiv 1906.05797, 2019",
    layout="""replica/
  room_0/                        the original release
    habitat/mesh_semantic.ply
    habitat/info_semantic.json
  cam_params.json                lens of the renderings, optional
  room0/                         the renderings of NICE-SLAM, or room_0/imap/00 (vMAP), room_0/Sequence_1
    traj.txt
    results/frame000000.jpg depth000000.png ...""",
    required=lambda scene: (f"{scene}/habitat/mesh_semantic.ply", f"{scene}/habitat/info_semantic.json"),
    open=open_scene,
    protocols=("replica/per-scene", "replica/opennerf", "replica/conceptgraphs"),
    label_places=lambda scene: (f"{scene}/habitat/*",),
)
