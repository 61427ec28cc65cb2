"""Division of a posed scene into blocks: overlapping sets of views that are processed as separate scenes.

A place belongs to the block with the nearest centre. A view belongs to the block in which it sees most, and
is lent to every other block in which it sees enough. Each block is written as images with known poses, in the
coordinates of the scene, so that the results of the blocks can be joined (`semantic_tree.joined`).
"""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, Int64

from hilsplat.base.artifacts import write_json
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.errors import ArtifactError, SettingsError, foreign
from hilsplat.base.files import regular
from hilsplat.base.lineage import sha256_of_file
from hilsplat.base.progress import track
from hilsplat.scene.cameras import Camera
from hilsplat.scene.exporting import posed_images
from hilsplat.scene.posed_images import write_posed_images
from hilsplat.scene.scene import Scene

BLOCKS = "blocks.json"

GRID = 32  # cells along the longer side of a view; of the points in a cell, only the nearest counts as seen

MAX_POINTS = 200_000
"""Maximum number of sparse points whose visibility is computed; of more, an even sample is used."""

MIN_VIEWS = 3  # minimum number of views per block, as of any scene


@dataclass(frozen=True)
class Block:
    """A block of a scene.

    Attributes:
        centre: in the scene's coordinates; places nearest to it belong to the block.
        owned: views that see most in this block, in camera order.
        borrowed: views of other blocks that also see enough in this block.
    """

    centre: tuple[float, float, float]
    owned: tuple[str, ...]
    borrowed: tuple[str, ...]


@dataclass(frozen=True)
class Blocks:
    """The blocks of a scene by name, as `blocks.json` stores them.

    Attributes:
        scene: `<dataset>/<scene>`.
        cameras_sha256: digest of the scene's cameras.
    """

    scene: str
    cameras_sha256: str
    blocks: dict[str, Block]

    def owner_of(self, places: Float[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
        """Return the row of the block that each place belongs to; on a tie, the lowest."""
        centres = np.array([block.centre for block in self.blocks.values()])
        return nearest(places, centres)

    @staticmethod
    def load(folder: Path) -> "Blocks":
        """Read `blocks.json`; raise ArtifactError unless it describes blocks."""
        from pydantic import TypeAdapter

        path = folder / BLOCKS
        with foreign(path, ArtifactError, fix="split the scene again: hilsplat blocks split"):
            return TypeAdapter(Blocks).validate_json(regular(path).read_bytes())


def nearest(places: Float[np.ndarray, "n 3"], centres: Float64[np.ndarray, "K 3"]) -> Int64[np.ndarray, " n"]:
    distances = [np.square(places - centre).sum(axis=1) for centre in centres]
    return np.argmin(distances, axis=0)


def block_centres(places: Float64[np.ndarray, "V 3"], count: int) -> Float64[np.ndarray, "K 3"]:
    """Divide places into groups of nearly equal size, and return the mean of each group.

    A group is divided across its longest direction, again and again, so neighbours stay together.
    """
    if count == 1:
        return places.mean(axis=0, keepdims=True)
    direction = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)[2][0]
    direction *= np.sign(direction[np.abs(direction).argmax()])
    order, first = np.argsort(places @ direction, kind="stable"), count // 2
    cut = len(places) * first // count
    parts = (order[:cut], first), (order[cut:], count - first)
    return np.concatenate([block_centres(places[rows], number) for rows, number in parts])


def seen_points(points: Float[np.ndarray, "P 3"], camera: Camera) -> Int64[np.ndarray, " n"]:
    """Return the nearest of the points in each of a view's cells (`GRID`).

    Sparse points hide nothing, so those behind a wall would otherwise count as seen.
    """
    x, y, z = camera.cam_from_world[:3, :3] @ points.T + camera.cam_from_world[:3, 3:]
    ahead = np.flatnonzero(z > 0)
    x, y, z = x[ahead], y[ahead], z[ahead]
    height, width = camera.size_hw
    size = max(height, width) / GRID
    column = np.floor((camera.K[0, 0] * x / z + camera.K[0, 2]) / size)
    row = np.floor((camera.K[1, 1] * y / z + camera.K[1, 2]) / size)
    inside = np.flatnonzero((column >= 0) & (row >= 0) & (column < width / size) & (row < height / size))
    cell = (row[inside] * GRID + column[inside]).astype(np.int64)
    order = np.lexsort((z[inside], cell))
    first = order[np.flatnonzero(np.diff(cell[order], prepend=-1))]
    return ahead[inside[first]]


def split_scene(scene: Scene, out: Path, count: int, min_share: float) -> Blocks:
    """Divide a scene into blocks, and write `blocks.json` and a folder for each block to a new folder.

    A block's folder has its images, their poses and split (`transforms.json`), and its sparse points, in the
    scene's coordinates.

    Args:
        count: number of blocks, at least 2.
        min_share: share of the points seen by a view from which the view is lent to their block.

    Raises:
        SettingsError: there are fewer than `MIN_VIEWS` views per block.
    """
    cameras = [*scene.cameras]
    if len(cameras) < MIN_VIEWS * count:
        raise SettingsError(
            f"{scene.name} has too few views for {count} blocks",
            expected=f"at least {MIN_VIEWS} views per block",
            found=f"{len(cameras)} views",
            fix="use fewer blocks",
        )
    sample = slice(None, None, len(scene.points_xyz) // MAX_POINTS + 1)
    points, colours = scene.points_xyz[sample].astype(np.float64), scene.points_rgb[sample]
    seen = [seen_points(points, camera) for camera in track(cameras, "views compared")]
    pairs = zip(seen, cameras, strict=True)
    places = [points[rows] if len(rows) else camera.centre[None] for rows, camera in pairs]
    centres = block_centres(np.stack([np.median(of_view, axis=0) for of_view in places]), count)
    shares = np.stack([np.bincount(nearest(p, centres), minlength=count) / len(p) for p in places])
    owner, is_in = shares.argmax(axis=1), shares >= min_share
    is_in[np.arange(len(owner)), owner] = True
    digest, names = sha256_of_file(scene.folder / "cameras.npz"), np.array(scene.cameras.names)
    blocks = Blocks(scene.name, digest, {})
    images, region = posed_images(scene, scene.cameras.cam_from_world), nearest(points, centres)
    with atomic_folder(out) as folder:
        for number, centre in enumerate(centres.tolist()):
            name, owned = f"{scene.name.split('/')[-1]}-{number}", owner == number
            borrowed = names[is_in[:, number] & ~owned]
            blocks.blocks[name] = Block(tuple(centre), tuple(names[owned].tolist()), tuple(borrowed.tolist()))
            of_block = np.flatnonzero(is_in[:, number])
            is_used = region == number
            is_used[np.concatenate([seen[view] for view in of_block])] = True
            chosen = [images[view] for view in of_block]
            write_posed_images(folder / name, chosen, points[is_used], colours[is_used])
        write_json(folder / BLOCKS, asdict(blocks))
    return blocks
