"""Assembly of the scene artifact from posed views: pinhole images, normalised coordinates, split, report."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from hilsplat.base.artifacts import write_json
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.errors import ImageError
from hilsplat.base.images import read_image, require_usable_size, write_png
from hilsplat.scene.cameras import Cameras, Photo
from hilsplat.scene.colmap import Points, is_pinhole, pycolmap
from hilsplat.scene.scene import Scene

MIN_VIEWS_FOR_TEST = 8  # minimum number of views for a test split; with fewer, the fit needs all of them

CHECKED_DIRECTIONS = 33  # directions per side at which a lens must be invertible
MAX_SHIFT_PX = 1.0  # tolerance of that check

WEAK_POINTS_PER_VIEW = 13
"""Fewest points per registered view in any good run on renders; unusable runs had 4 to 18."""

MIN_LEVELNESS_GAP = 3.0
"""Minimum ratio of the second-smallest to the smallest eigenvalue for the cameras' x axes to define up."""


@dataclass(frozen=True)
class PosedView:
    """One view: a PNG, its camera (before or after undistortion), and its pose in source coordinates.

    `photo` is the photograph, if the PNG isn't a scaled copy of it.
    """

    view: str
    image: Path
    camera: pycolmap.Camera
    cam_from_source: Float64[np.ndarray, "4 4"]
    photo: Photo | None = None


Posed = tuple[list[PosedView], Points, dict[str, str], dict[str, Any]]
"""Views and sparse points in source coordinates, the split ("train" or "test") by view, and the report."""


def photo_of(camera: pycolmap.Camera) -> Photo:
    return Photo(camera.model_name, tuple(camera.params.tolist()), (camera.height, camera.width))


def undistort(view: PosedView, folder: Path, max_side_px: int = 2**16) -> PosedView:
    """Write the pinhole image of a view to a folder, and return the view with its pinhole camera.

    An image without distortion is copied byte for byte. Otherwise, the image is warped to the largest size
    without blank pixels, but with sides up to `max_side_px`.

    Raises:
        ImageError: the distortion cannot be undone.
    """
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / view.view
    if is_pinhole(view.camera):
        shutil.copyfile(view.image, target)
        return replace(view, image=target)
    camera = pinhole_of(view.view, view.camera, max_side_px)
    bitmap = pycolmap.Bitmap.from_array(read_image(view.image))
    options = pycolmap.UndistortCameraOptions(max_image_size=max_side_px)
    warped, _ = pycolmap.undistort_image(options, bitmap, view.camera)
    write_png(target, warped.to_array())
    return replace(view, image=target, camera=camera, photo=view.photo or photo_of(view.camera))


def pinhole_of(view: str, lens: pycolmap.Camera, max_side_px: int) -> pycolmap.Camera:
    """Return the camera of a view's undistorted image (`undistort`).

    Raises:
        ImageError: the image would be too small, or the lens maps several directions in it to one pixel.
    """
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(max_image_size=max_side_px), lens)
    require_usable_size(view, (pinhole.height, pinhole.width))
    across = (np.linspace(0, side, CHECKED_DIRECTIONS) for side in (pinhole.width, pinhole.height))
    xy = np.stack(np.meshgrid(*across), axis=-1).reshape(-1, 2)
    directions = (xy - [pinhole.principal_point_x, pinhole.principal_point_y]) / pinhole.mean_focal_length()
    pixels = lens.img_from_cam(np.column_stack([directions, np.ones(len(xy))]))
    inverse = np.asarray(lens.cam_from_img(np.asarray(pixels)))
    shift_px = np.abs(inverse - directions).max() * pinhole.mean_focal_length()
    if not (shift_px < MAX_SHIFT_PX):  # also true for NaN
        raise ImageError(
            f"the lens distortion of view {view} cannot be undone",
            expected="a lens that maps each direction in the image to another pixel",
            found=f"{lens.model_name} {np.round(lens.params, 6).tolist()}",
            fix="correct the lens, or undistort the image with the program that calibrated it",
        )
    return pinhole


def few_points_doubt(per_view: float) -> list[str]:
    """Return a warning if few points fit the poses, from structure from motion or known."""
    warning = f"only {per_view} points per registered view (good runs: {WEAK_POINTS_PER_VIEW} or more)"
    return [f"{warning}: the poses may be wrong"] if per_view < WEAK_POINTS_PER_VIEW else []


def up_direction(cam_from_source: Float64[np.ndarray, "V 4 4"]) -> Float64[np.ndarray, " 3"]:
    """Estimate the up direction from cameras that were mostly held level.

    The x axes of level cameras are horizontal at any tilt, so up is the direction most orthogonal to all of
    them. If the x axes are nearly parallel (the camera only moved sideways), that direction is
    ambiguous, and the mean of the cameras' own up axes is used.
    """
    right, up_of_camera = cam_from_source[:, 0, :3], -cam_from_source[:, 1, :3]
    mean_up = up_of_camera.mean(axis=0)
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    if values[1] > MIN_LEVELNESS_GAP * values[0] and values[1] > 1e-3:
        up = vectors[:, 0] * (1.0 if vectors[:, 0] @ mean_up >= 0 else -1.0)
    else:
        up = mean_up
    length = float(np.linalg.norm(up))
    return up / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])


def rotation_to_z_up(up: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the shortest rotation from a unit vector to +z; for +z itself, the identity."""
    z = np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(up, z), float(up @ z)
    if cosine < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def normalising_similarity(
    cam_from_source: Float64[np.ndarray, "V 4 4"],
    points: Float64[np.ndarray, "P 3"],
    *,
    metric: bool,
    turn: bool,
) -> Float64[np.ndarray, "4 4"]:
    """Return the similarity `scene_from_source` that normalises the coordinates of a scene.

    The origin is the median of the sparse points, or of the camera centres if there are no points. The unit
    is the median distance of the cameras from the origin, so every scene has a size of a few units; metric
    sources keep the metre. If `turn` is set, +z becomes the cameras' up direction, because structure from
    motion produces an arbitrary rotation; imported poses keep their axes.
    """
    centres = -np.einsum("vji,vj->vi", cam_from_source[:, :3, :3], cam_from_source[:, :3, 3])
    origin = np.median(points if len(points) else centres, axis=0)
    distance = float(np.median(np.linalg.norm(centres - origin, axis=1)))
    scale = 1.0 if metric or distance < 1e-9 else 1.0 / distance
    rotation = rotation_to_z_up(up_direction(cam_from_source)) if turn else np.eye(3)
    similarity = np.eye(4)
    similarity[:3, :3] = scale * rotation
    similarity[:3, 3] = -scale * rotation @ origin
    return similarity


def move_cameras(
    cam_from_source: Float64[np.ndarray, "V 4 4"], scene_from_source: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "V 4 4"]:
    """Convert world-to-camera transforms to scene coordinates; camera coordinates get the scene's scale."""
    scale = np.cbrt(np.linalg.det(scene_from_source[:3, :3]))
    rotation, offset = scene_from_source[:3, :3] / scale, scene_from_source[:3, 3]
    moved = np.tile(np.eye(4), (len(cam_from_source), 1, 1))
    moved[:, :3, :3] = cam_from_source[:, :3, :3] @ rotation.T
    moved[:, :3, 3] = scale * cam_from_source[:, :3, 3] - moved[:, :3, :3] @ offset
    return moved


def split_views(names: Sequence[str], test_every: int) -> dict[str, str]:
    """Hold out every `test_every`-th view by sorted name, starting with the first (3DGS: index % 8 == 0).

    No view is held out if `test_every` is 0 or 1 (1 leaves no training view) or there are fewer than 8 views.
    """
    ordered = sorted(names)
    holds_out = test_every > 1 and len(ordered) >= MIN_VIEWS_FOR_TEST
    return {
        name: "test" if holds_out and index % test_every == 0 else "train"
        for index, name in enumerate(ordered)
    }


def write_scene(
    out: Path, name: str, unit: str, posed: Posed, *, turn: bool, lost: Path, max_side_px: int
) -> None:
    """Write the scene artifact with its registration report, atomically.

    Args:
        unit: "metre" keeps the source's scale; for any other unit, the scale is normalised.
        posed: its report gets each view's split, size and focal length.
        turn: rotate the scene so that +z is up.
        lost: picture of the unregistered photographs; if it exists, it is appended to the camera plot.
    """
    views, (points, colours), split, report = posed
    views = sorted(views, key=lambda view: view.view)
    source_poses = np.stack([view.cam_from_source for view in views])
    scene_from_source = normalising_similarity(source_poses, points, metric=unit == "metre", turn=turn)
    points = points @ scene_from_source[:3, :3].T + scene_from_source[:3, 3]
    with atomic_folder(out) as folder:
        pinhole = [undistort(view, folder / "images", max_side_px) for view in views]
        cameras = Cameras(
            names=tuple(view.view for view in pinhole),
            cam_from_world=move_cameras(source_poses, scene_from_source),
            K=np.stack([view.camera.calibration_matrix() for view in pinhole]),
            size_hw=np.array([(view.camera.height, view.camera.width) for view in pinhole], dtype=np.int32),
            photos={view.view: view.photo for view in pinhole if view.photo is not None},
        )
        xyz = points.astype(np.float32)
        scene = Scene(folder, name, unit, cameras, split, xyz, colours, scene_from_source)
        for view, size_hw, K in zip(cameras.names, cameras.size_hw.tolist(), cameras.K, strict=True):
            focal_px = round(float(K[0, 0]), 3)
            report["views"][view] |= {"split": split[view], "size_hw_px": size_hw, "focal_px": focal_px}
        write_json(folder / "registration.json", report)
        plot_registration(folder / "registration.png", scene, report)
        if lost.exists():
            pictures = [read_image(folder / "registration.png"), read_image(lost)]  # of the same width
            write_png(folder / "registration.png", np.concatenate(pictures))
        scene.save()


def plot_registration(path: Path, scene: Scene, report: Mapping[str, Any]) -> None:
    """Draw camera centres and sparse points from above and from the side."""
    from matplotlib.figure import Figure

    poses = scene.cameras.cam_from_world
    rotation = rotation_to_z_up(up_direction(poses))
    centres = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3]) @ rotation.T
    looks = poses[:, 2, :3] @ rotation.T
    points = scene.points_xyz.astype(np.float64) @ rotation.T
    colours = scene.points_rgb / 255
    is_test = np.array([scene.split[view] == "test" for view in scene.cameras.names])
    # The axes cover the cameras and the middle 96 % of the points, because outliers would shrink the scene.
    around = np.percentile(points, [2, 98], axis=0) if len(points) else np.zeros((0, 3))
    framed = np.concatenate([centres, around])
    low, high = framed.min(axis=0), framed.max(axis=0)
    margin = 0.08 * float((high - low).max()) or 1.0
    arrow = 0.08 * float((high - low).max())

    figure = Figure(figsize=(12, 6), layout="constrained")
    for position, (title, x, y) in enumerate((("from above", 0, 1), ("from the side", 0, 2)), start=1):
        axes = figure.add_subplot(1, 2, position)
        axes.scatter(points[:, x], points[:, y], s=1.5, c=colours, linewidths=0)
        for rows, colour, label in ((~is_test, "tab:blue", "train"), (is_test, "tab:orange", "test")):
            if rows.any():
                at, ahead = centres[rows], centres[rows] + arrow * looks[rows]
                lines = [at[:, x], ahead[:, x]], [at[:, y], ahead[:, y]]
                axes.plot(*lines, color=colour, linewidth=0.8, zorder=2)
                label = f"{rows.sum()} {label}"
                axes.scatter(at[:, x], at[:, y], s=14, color=colour, label=label, zorder=3)
        axes.set_xlim(low[x] - margin, high[x] + margin)
        axes.set_ylim(low[y] - margin, high[y] + margin)
        axes.set_aspect("equal")
        axes.set_xlabel("scene units")
        axes.set_title(title)
        axes.legend(loc="upper right", fontsize=8)
    error = report["mean_reprojection_error_px"]
    quality = f", reprojection error {error:.2f} px" if error is not None else ""
    figure.suptitle(
        f"{scene.name}: {report['registered']} of {report['images']} views, {len(points)} points{quality}"
    )
    # Date and library version are omitted, so that the same scene produces the same bytes.
    figure.savefig(path, format="png", dpi=100, metadata={"Software": None})
