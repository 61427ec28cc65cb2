"""Scenes with known poses: COLMAP models, transforms.json (nerfstudio, Blender), poses_bounds.npy (LLFF)."""

import json
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8
from PIL import Image

from hilsplat.base.errors import ImageError, RegistrationError, SceneError
from hilsplat.base.files import IMAGE_SUFFIXES, list_images
from hilsplat.base.images import read_image, resize_to_fit, write_png
from hilsplat.base.progress import track
from hilsplat.scene.assemble import PosedView, split_views, undistort, write_scene
from hilsplat.scene.colmap import pycolmap
from hilsplat.scene.features import (
    EXIF_ORIENTATION,
    MIN_INLIERS,
    extract_features,
    match_features,
    view_names,
)
from hilsplat.scene.llff import POSES_BOUNDS, llff_views
from hilsplat.scene.model import pose_matrix, reprojection_errors, sparse_points
from hilsplat.settings import PosesSettings

logger = logging.getLogger(__name__)

MODEL_FOLDERS = ("sparse/0", "sparse")
MODEL_FILES = ("cameras", "images", "points3D")
TRANSFORMS = ("transforms.json", "transforms_train.json")
MIN_TRIANGULATED = 100
"""With fewer triangulated points, random ones in front of the cameras start the fit instead."""

NUM_RANDOM_POINTS = 20_000
ASPECT_TOLERANCE = 0.01
"""An image may be a scaled copy of what its camera describes, but not another crop of it."""

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class KnownPoses:
    """Where a folder keeps its poses.

    Attributes:
        root: the folder.
        kind: "colmap", "transforms" or "llff".
        files: the model folder, the transforms files (training first, then testing), or LLFF's file.
    """

    root: Path
    kind: str
    files: tuple[Path, ...]


@dataclass(frozen=True)
class KnownView:
    """One posed view as its source describes it, before its image was read.

    Attributes:
        name: name in the source.
        image: its file; None where it is missing.
        camera: its lens, for the size that the source states.
        cam_from_source: world-to-camera transform, OpenCV axes.
        is_test: the source holds it out for testing.
    """

    name: str
    image: Path | None
    camera: pycolmap.Camera
    cam_from_source: Float64[np.ndarray, "4 4"]
    is_test: bool = False


def find_known_poses(folder: Path) -> KnownPoses | None:
    """Look for a COLMAP model, transforms files, LLFF's file, in this order; None where there is none.

    Raises:
        SceneError: there is a `sparse/` folder without a complete model in it.
    """
    folder = Path(folder)
    for place in MODEL_FOLDERS:
        if _is_model(folder / place):
            return KnownPoses(folder, "colmap", (folder / place,))
    for name in TRANSFORMS:
        if (folder / name).is_file():
            files = [folder / name]
            if name == "transforms_train.json" and (folder / "transforms_test.json").is_file():
                files.append(folder / "transforms_test.json")
            return KnownPoses(folder, "transforms", tuple(files))
    if (folder / POSES_BOUNDS).is_file():
        return KnownPoses(folder, "llff", (folder / POSES_BOUNDS,))
    if (folder / "sparse").is_dir():
        raise SceneError(
            f"{folder / 'sparse'} holds no complete COLMAP model",
            expected="cameras, images and points3D, all .bin or all .txt, in sparse/0/ or sparse/",
            found=", ".join(sorted(path.name for path in (folder / "sparse").rglob("*"))) or "nothing",
            fix="complete the model, or rename sparse/ to have the poses computed",
        )
    return None


def _is_model(folder: Path) -> bool:
    return any(
        all((folder / f"{name}{suffix}").is_file() for name in MODEL_FILES) for suffix in (".bin", ".txt")
    )


def import_poses(
    known: KnownPoses,
    out: Path,
    work: Path,
    name: str,
    unit: str,
    settings: PosesSettings,
    seed: int,
    threads: int,
) -> dict[str, Any]:
    """Write the Scene artifact of a folder with known poses; returns the registration report.

    Images are matched to poses by name; poses without an image and images without a pose are named
    in the report. The pixels are taken as stored, since COLMAP pays no heed to the EXIF orientation.
    Coordinates keep the source's axes.

    Raises:
        SceneError: the model or transforms file cannot be used.
        RegistrationError: too few of its views have an image.
    """
    points: tuple[np.ndarray, np.ndarray] | None = None
    errors: dict[str, dict[str, Any]] = {}
    if known.kind == "colmap":
        described, points, errors = read_colmap(known)
    elif known.kind == "transforms":
        described, points = read_transforms(known)
    else:
        described = known_views(known)
    present = [view for view in described if view.image is not None]
    missing = sorted(view.name for view in described if view.image is None)
    _check_present(known, name, present, missing, settings)
    views = [
        _with_pixels(view, view_name, work / "images", settings.max_side_px)
        for view, view_name in track(
            list(zip(present, view_names([view.image for view in present]), strict=True)), "images read"
        )
    ]
    origin_of_points = "source"
    warnings = [f"{len(missing)} of {len(described)} posed views have no image file"] if missing else []
    if points is None:
        views = [undistort(view, work / "pinhole") for view in views]
        points = triangulate(views, work, settings, seed, threads)
        origin_of_points = "triangulated from the known poses"
        if len(points[0]) < MIN_TRIANGULATED:
            warnings.append(
                f"only {len(points[0])} points could be triangulated; {NUM_RANDOM_POINTS} random ones in "
                "front of the cameras take their place"
            )
            points = random_points(views, seed)
            origin_of_points = "random"
    unposed = _images_without_pose(known, present)
    if unposed:
        warnings.append(f"{len(unposed)} images have no pose and are left out")
    for warning in warnings:
        logger.warning("%s: %s", name, warning)
    entries: dict[str, Any] = {}
    for posed, view in zip(present, views, strict=True):
        assert posed.image is not None
        entries[view.view] = {"file": posed.image.name, "registered": True, **errors.get(posed.name, {})}
    for gone in missing:
        entries[gone] = {"file": gone, "registered": False, "why_not": "its image file is missing"}
    for path in unposed:
        entries.setdefault(
            path.name, {"file": path.name, "registered": False, "why_not": "the source has no pose for it"}
        )
    observed = [(entry["observations"], entry["reprojection_error_px"]) for entry in errors.values()]
    num_observations = sum(count for count, error in observed if error is not None)
    total_error = sum(count * error for count, error in observed if error is not None)
    files = ", ".join(path.relative_to(known.root).as_posix() for path in known.files)
    report = {
        "scene": name,
        "poses": f"imported from {files}",
        "seed": seed,
        "images": len(described) + len(unposed),
        "registered": len(views),
        "models": [len(views)],
        "points": len(points[0]),
        "points_from": origin_of_points,
        "points_per_view": round(len(points[0]) / len(views), 1),
        "mean_reprojection_error_px": round(total_error / num_observations, 4) if num_observations else None,
        "warnings": warnings,
        "views": entries,
    }
    names = [view.view for view in views]
    if any(view.is_test for view in present):  # the source has a split of its own
        split = {name: "test" if view.is_test else "train" for name, view in zip(names, present, strict=True)}
    else:
        split = split_views(names, settings.test_every)
    write_scene(out, name, unit, views, points[0], points[1], split, report, turn=False)
    return report


def _check_present(
    known: KnownPoses,
    name: str,
    present: Sequence[KnownView],
    missing: Sequence[str],
    settings: PosesSettings,
) -> None:
    """Refuse a source most of whose images are not there."""
    total = len(present) + len(missing)
    if total == 0:
        raise SceneError(f"{known.files[0]} of {name} poses no view", fix="export it again")
    if not present or len(present) < settings.min_registered_share * total:
        listed = ", ".join(missing[:20]) + (f" and {len(missing) - 20} more" if len(missing) > 20 else "")
        raise RegistrationError(
            f"too few posed views of {name} have an image in {known.root}",
            expected=f"at least {settings.min_registered_share:.0%} of {total} (poses.min_registered_share)",
            found=f"{len(present)}; missing: {listed}",
            fix="put the images where the model names them: in images/ or beside it",
        )


def _images_without_pose(known: KnownPoses, present: Sequence[KnownView]) -> list[Path]:
    """Images in the folder of a COLMAP model that it does not pose."""
    if known.kind != "colmap" or not (known.root / "images").is_dir():
        return []
    used = {view.image for view in present}
    return [path for path in list_images(known.root / "images") if path not in used]


def _with_pixels(view: KnownView, view_name: str, folder: Path, max_side_px: int) -> PosedView:
    """Read a view's image as its camera describes it, write the work image, and fit the lens to it."""
    assert view.image is not None
    folder.mkdir(parents=True, exist_ok=True)
    pixels = resize_to_fit(_read_as_described(view.image, view.camera), max_side_px)
    height, width = pixels.shape[:2]
    camera = pycolmap.Camera(view.camera.todict())
    if (camera.width, camera.height) != (width, height):
        camera.rescale(width, height)
    write_png(folder / view_name, pixels)
    return PosedView(view_name, folder / view_name, camera, view.cam_from_source)


def _read_as_described(path: Path, camera: pycolmap.Camera) -> UInt8[np.ndarray, "H W 3"]:
    """Pixels of an image in the orientation whose shape fits the camera; as stored where both do.

    Raises:
        ImageError: unreadable, or of another shape than the camera says.
    """
    upright = read_image(path)
    candidates = [upright]
    with Image.open(path) as image:
        if image.getexif().get(EXIF_ORIENTATION, 1) != 1:
            candidates.insert(0, np.asarray(image.convert("RGB")))
    for pixels in candidates:
        ratio = (pixels.shape[1] / pixels.shape[0]) / (camera.width / camera.height)
        if abs(ratio - 1) <= ASPECT_TOLERANCE:
            return pixels
    raise ImageError(
        f"image {path} does not have the shape its camera describes",
        expected=f"{camera.width} x {camera.height} px (width x height), or a scaled copy",
        found=f"{upright.shape[1]} x {upright.shape[0]} px",
        fix="use the images that the poses were computed from",
    )


def known_views(known: KnownPoses) -> list[KnownView]:
    """Posed views of a folder, whatever it keeps them in.

    Raises:
        SceneError: they cannot be read.
    """
    if known.kind == "colmap":
        return read_colmap(known)[0]
    if known.kind == "transforms":
        return read_transforms(known)[0]
    folder = known.root / "images"
    images = list_images(folder if folder.is_dir() else known.root)
    return [
        KnownView(image.name, image, camera, pose)
        for image, camera, pose in llff_views(known.files[0], images)
    ]


def read_colmap(
    known: KnownPoses,
) -> tuple[list[KnownView], tuple[np.ndarray, np.ndarray], dict[str, dict[str, Any]]]:
    """Read a COLMAP model: views, points, and observations and reprojection error per view.

    Raises:
        SceneError: the model cannot be read.
    """
    folder = known.files[0]
    try:
        model = pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, IndexError) as error:
        raise SceneError(
            f"the COLMAP model in {folder} cannot be read: {error}", fix="export it again with COLMAP"
        ) from error
    views = []
    for image_id in sorted(model.reg_image_ids(), key=lambda row: model.images[row].name):
        image = model.images[image_id]
        views.append(
            KnownView(
                image.name,
                _find_image(known.root, image.name),
                pycolmap.Camera(image.camera.todict()),
                pose_matrix(image.cam_from_world()),
            )
        )
    errors = {
        name: {
            "observations": len(of_view),
            "reprojection_error_px": round(float(of_view.mean()), 4) if len(of_view) else None,
        }
        for name, of_view in reprojection_errors(model).items()
    }
    return views, sparse_points(model), errors


def _find_image(root: Path, name: str) -> Path | None:
    """File of an image named in a source: as named, or with a suffix, in the folder or its images/."""
    for base in (root / "images", root):
        candidate = base / name
        if candidate.is_file():
            return candidate
        for suffix in sorted(IMAGE_SUFFIXES):
            if (with_suffix := candidate.with_name(candidate.name + suffix)).is_file():
                return with_suffix
    return None


def read_transforms(
    known: KnownPoses,
) -> tuple[list[KnownView], tuple[np.ndarray, np.ndarray] | None]:
    """Read transforms files: camera-to-world in OpenGL axes, intrinsics for all or per frame.

    Returns the views and, where the file names a `ply_file_path`, its points.

    Raises:
        SceneError: a file is no JSON, or a key is missing or unusable.
    """
    views: list[KnownView] = []
    points = None
    for file in known.files:
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
        except ValueError as error:
            raise SceneError(f"{file} is not valid JSON: {error}", fix="export it again") from error
        if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
            raise SceneError(f"{file} has no list `frames`", fix="export it again")
        for number, frame in enumerate(content["frames"]):
            views.append(_read_frame(known, file, number, {**content, **frame}))
        if points is None and isinstance(content.get("ply_file_path"), str):
            points = _read_ply_points(known.root / content["ply_file_path"])
    return views, points


def _read_frame(known: KnownPoses, file: Path, number: int, frame: Mapping[str, Any]) -> KnownView:
    """One frame of a transforms file; its own keys come before those of the whole file."""
    where = f"{file}, frame {number}"
    try:
        name = str(frame["file_path"]).removeprefix("./")
        source_from_cam = np.array(frame["transform_matrix"], dtype=np.float64)
    except (KeyError, ValueError, TypeError) as error:
        raise SceneError(
            f"{where}: file_path or transform_matrix cannot be used: {error!r}", fix="export it again"
        ) from error
    rotation = source_from_cam[:3, :3] if source_from_cam.shape in ((4, 4), (3, 4)) else np.zeros((3, 3))
    if not np.isfinite(source_from_cam).all() or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise SceneError(
            f"{where} ({name}): transform_matrix is no rigid pose",
            expected="a 4 x 4 camera-to-world matrix with a rotation in it",
            found=f"shape {source_from_cam.shape}",
            fix="export it again without scaling the cameras",
        )
    pose = np.eye(4)
    pose[:3] = source_from_cam[:3]
    image = _find_image(known.root, name)
    camera = _frame_camera(where, frame, image)
    is_test = file.name == "transforms_test.json"
    return KnownView(name, image, camera, np.linalg.inv(pose @ OPENGL_TO_OPENCV), is_test)


def _frame_camera(where: str, frame: Mapping[str, Any], image: Path | None) -> pycolmap.Camera:
    """The lens of a frame: PINHOLE, or OPENCV where it has distortion (k1, k2, p1, p2)."""
    try:
        width, height = frame.get("w"), frame.get("h")
        if width is None or height is None:
            if image is None:
                width = height = 2  # never used: the view has no image and is left out
            else:
                with Image.open(image) as opened:
                    width, height = opened.size
        width, height = int(width), int(height)
        if "fl_x" in frame:
            focal_x = float(frame["fl_x"])
        else:
            focal_x = width / 2 / math.tan(float(frame["camera_angle_x"]) / 2)
        focal_y = float(frame.get("fl_y", focal_x))
        centre = [float(frame.get("cx", width / 2)), float(frame.get("cy", height / 2))]
        lens = [float(frame.get(key, 0.0)) for key in ("k1", "k2", "p1", "p2")]
        further = [float(frame.get(key, 0.0)) for key in ("k3", "k4")]
    except KeyError as error:
        raise SceneError(
            f"{where} has no focal length",
            expected="fl_x (px) or camera_angle_x (radian)",
            fix="export it again",
        ) from error
    except (TypeError, ValueError, OSError) as error:
        raise SceneError(f"{where}: intrinsics cannot be used: {error}", fix="export it again") from error
    model = str(frame.get("camera_model", "OPENCV"))
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE") or any(further):
        raise SceneError(
            f"{where}: lens {model} with k3, k4 = {further} is not supported",
            expected="PINHOLE or OPENCV with k1, k2, p1, p2",
            fix="undistort the images first",
        )
    if not (focal_x > 0 and focal_y > 0 and width > 0 and height > 0):
        raise SceneError(f"{where}: focal length and size must be positive", fix="export it again")
    params = [focal_x, focal_y, *centre]
    return pycolmap.Camera(
        model="OPENCV" if any(lens) else "PINHOLE",
        width=width,
        height=height,
        params=[*params, *lens] if any(lens) else params,
    )


def _read_ply_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points and colours of a PLY file (grey where it has no colours)."""
    from plyfile import PlyData, PlyParseError

    try:
        vertex = PlyData.read(path)["vertex"].data
        xyz = np.stack([vertex[axis] for axis in ("x", "y", "z")], axis=1).astype(np.float64)
    except (OSError, PlyParseError, KeyError, ValueError) as error:
        raise SceneError(
            f"the points of {path} cannot be read: {error}",
            fix="put the file there, or remove ply_file_path from the file to have points computed",
        ) from error
    if {"red", "green", "blue"} <= set(vertex.dtype.names):
        rgb = np.stack([vertex[colour] for colour in ("red", "green", "blue")], axis=1).astype(np.uint8)
    else:
        rgb = np.full(xyz.shape, 128, dtype=np.uint8)
    return xyz, rgb


def triangulate(
    views: Sequence[PosedView], work: Path, settings: PosesSettings, seed: int, threads: int
) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
    """Sparse points of pinhole views with known poses: features, matches, triangulation; poses stay."""
    if len(views) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8)
    folder, database = views[0].image.parent, work / "triangulation.db"
    pycolmap.Database.open(database).close()
    for view in views:
        options = pycolmap.ImageReaderOptions()
        options.camera_model = view.camera.model_name
        options.camera_params = ", ".join(repr(float(value)) for value in view.camera.params)
        pycolmap.import_images(database, folder, pycolmap.CameraMode.PER_IMAGE, [view.view], options)
    extract_features(database, folder, [view.view for view in views], settings, threads)
    match_features(database, len(views), settings, seed, threads)
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        for view in views:
            entry = opened.read_image_with_name(view.view)
            model.add_camera_with_trivial_rig(opened.read_camera(entry.camera_id))
            image = pycolmap.Image(name=view.view, camera_id=entry.camera_id, image_id=entry.image_id)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_source[:3]))
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.min_num_matches = MIN_INLIERS
    target = work / "triangulated"
    target.mkdir()
    model = pycolmap.triangulate_points(model, database, folder, target, options=options)
    return sparse_points(model)


def random_points(
    views: Sequence[PosedView], seed: int
) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
    """Random points that cameras see, to start a fit where triangulation found none.

    Each lies on the ray of a random pixel of a random view, at a depth between 0.3 and 2 times the
    distance from the camera to the point nearest to all optical axes; grey.
    """
    generator = np.random.default_rng(seed)
    centres = np.stack([view.centre for view in views])
    looks = np.stack([view.cam_from_source[2, :3] for view in views])
    # Least squares for the point nearest to all axes, with a weak pull to one camera spread ahead.
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()) or 1.0
    across = np.eye(3)[None] - looks[:, :, None] * looks[:, None, :]
    prior = 1e-3
    ahead = (centres + spread * looks).mean(axis=0)
    focus = np.linalg.solve(
        across.mean(axis=0) + prior * np.eye(3),
        np.einsum("vij,vj->i", across, centres) / len(views) + prior * ahead,
    )
    rows = generator.integers(len(views), size=NUM_RANDOM_POINTS)
    depth = np.maximum(np.linalg.norm(centres - focus, axis=1), 1e-3 * spread)[rows]
    depth = depth * generator.uniform(0.3, 2.0, NUM_RANDOM_POINTS)
    xyz = np.empty((NUM_RANDOM_POINTS, 3))
    for row, view in enumerate(views):
        chosen = rows == row
        pixels = generator.random((int(chosen.sum()), 2)) * [view.camera.width, view.camera.height]
        K = view.camera.calibration_matrix()
        rays = np.concatenate([(pixels - K[:2, 2]) / np.diag(K)[:2], np.ones((len(pixels), 1))], axis=1)
        xyz[chosen] = centres[row] + (rays * depth[chosen, None]) @ view.cam_from_source[:3, :3]
    return xyz, np.full(xyz.shape, 128, dtype=np.uint8)
