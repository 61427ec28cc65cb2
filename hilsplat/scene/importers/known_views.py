"""Posed views as other programs describe them: what is read, what is left out, and why."""

from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from hilsplat.base.errors import HilsplatError, SceneError, foreign, in_one_line
from hilsplat.base.files import IMAGE_SUFFIXES, is_outside, list_images, regular
from hilsplat.base.images import image_size_hw
from hilsplat.base.rotations import RIGID_TOLERANCE, are_rotations
from hilsplat.scene.cameras import MAX_SIDE_PX
from hilsplat.scene.colmap import Points, as_camera, pycolmap
from hilsplat.scene.importers.colmap_model import ModelImage, read_model
from hilsplat.scene.layouts import KnownPoses, largest_copies, photo_folder, used_images
from hilsplat.scene.posed_images import rigid_pose
from hilsplat.scene.view_names import match_names, name_parts

ASPECT_TOLERANCE = 0.01
"""Relative tolerance of an image's aspect ratio: a scaled copy is accepted, a different crop is not."""

MIN_FOCAL, MAX_FOCAL = 0.1, 50  # range of focal lengths, in sides of the image; other numbers aren't px

NOTED_OFFSET, MAX_OFFSET = 0.1, 0.25
"""Distances of the principal point from the middle of the image, in its sides, that are noted and refused:
a centred lens has them if it belongs to an image 1.2 and 1.5 times as large."""

Lens = tuple[Float64[np.ndarray, "3 3"], tuple[int, int]]
"""Intrinsics K in px, and the height and width of the image that they belong to."""

MAX_COORDINATE = 1e9  # maximum coordinate, in the source's units; beyond it, 32-bit numbers are too coarse


@dataclass(frozen=True)
class KnownView:
    """A posed view as described by its source, before its image is read.

    Attributes:
        image: image file, or None if missing.
        camera: lens for the image size stated by the source.
        cam_from_source: world-to-camera transform, OpenCV axes.
        border_px: width of a blank border to crop, px of the camera.
        report: number of observations and mean reprojection error, if the source has observations.
    """

    name: str
    image: Path | None
    camera: pycolmap.Camera
    cam_from_source: Float64[np.ndarray, "4 4"]
    is_test: bool = False
    border_px: int = 0
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def lens(self) -> Lens:
        return self.camera.calibration_matrix(), (self.camera.height, self.camera.width)


@dataclass
class Source:
    """The content of a source of poses.

    Attributes:
        views: the posed views that can be used, with or without an image.
        points: sparse points; None if the source has none.
        left_out: why a view cannot be used, by name.
        notes: what else in the source is not used, one sentence each.
        unposed: names of images that no view has.
        has_split: the source lists its training views, which may be all views.
    """

    views: list[KnownView] = field(default_factory=list)
    points: Points | None = None
    left_out: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    unposed: list[str] = field(default_factory=list)
    has_split: bool = False

    def add(self, name: str, described: Callable[..., KnownView], *args: Any) -> None:
        """Add the view `described(*args)`; leave it out if its description, lens or pose is not valid."""
        try:
            with foreign(f"view {name}"):
                view = described(*args)
                require_valid(view)
        except HilsplatError as error:
            self.leave_out(name, in_one_line(error))
        else:
            self.views.append(view)

    def leave_out(self, name: str, reason: str) -> None:
        """Record why a view is not used; names may repeat in damaged files."""
        while name in self.left_out:
            name += " (again)"
        self.left_out[name] = reason

    def drop(self, view: KnownView, error: HilsplatError) -> None:
        """Leave out a view whose image cannot be used."""
        self.views = [other for other in self.views if other is not view]
        self.leave_out(view.name, in_one_line(error))

    @property
    def without_image(self) -> list[str]:
        """Names of the views whose image is missing, sorted."""
        return sorted(view.name for view in self.views if view.image is None)

    def listed(self, listed: Iterable[str], names: Sequence[str], where: str) -> set[str]:
        """Return the views that a list of names means, and note the number of names without a view."""
        matches = match_names(listed, names).values()
        if num_lost := sum(name is None for name in matches):
            self.notes.append(f"{num_lost} names in {where} belong to no view")
        return {name for name in matches if name is not None}

    def check_keys(
        self, objects: Iterable[Mapping[str, Any]], file: Path, known: Set[str], refused: Mapping[str, str]
    ) -> None:
        """Note the keys of a file that are not known; raise SceneError if one is refused.

        Args:
            known: keys that are used, or that don't change the meaning of others.
            refused: what a key means that cannot be applied.
        """
        unknown: set[str] = set()
        for content in objects:
            for key in content.keys() & refused.keys():
                if np.any(content[key]):
                    raise SceneError(
                        f"{file} describes {refused[key]}, which is not supported",
                        found=f"{key}: {str(content[key])[:60]}",
                        fix="export undistorted images of ordinary cameras, in the usual axes",
                    )
            unknown |= content.keys() - known - refused.keys()
        if unknown:
            self.notes.append(f"keys of {file.name} that are not used: {', '.join(sorted(unknown))}")

    def require_most(self, min_share: float, files: object, *, images: bool = False) -> None:
        """Raise SceneError if fewer than this share of the views can be used; `images`: and have an image."""
        total, missing = len(self.views) + len(self.left_out), self.without_image if images else []
        reasons = [*self.left_out.values(), *(f"{name}: its image is missing" for name in missing)]
        if total - len(reasons) < max(1 if reasons or images else 0, min_share * total):
            more = f"\n            and {len(reasons) - 3} more" if len(reasons) > 3 else ""
            raise SceneError(
                f"{len(reasons)} of {total} views of {files} cannot be used",
                expected=f"at least {min_share:.0%} of the views (poses.min_registered_share)",
                found="\n            ".join(reasons[:3]) + more,
                fix="export the poses again, with each image once: in the same folder or its images/ folder",
            )


def require_valid(view: KnownView) -> None:
    """Raise SceneError if the lens or pose of a view is not valid."""
    values = np.array([*view.camera.params, view.camera.width, view.camera.height], np.float64)
    focal = [view.camera.params[row] for row in view.camera.focal_length_idxs()]
    pose, sides = view.cam_from_source, values[-2:]
    is_size = (sides > 0).all() and (sides <= MAX_SIDE_PX).all()
    if not focal:
        fault, found = "lens", view.camera.model_name
        expected = "a lens with a focal length: panoramas are not supported"
    elif not np.isfinite(values).all() or min(focal) <= 0 or not is_size:
        fault, found = "lens", f"{view.camera.model_name} {values.tolist()}"
        expected = f"finite numbers, a focal length above 0, sides of 1 to {MAX_SIDE_PX} px"
    elif view.image is not None and (
        min(focal) < MIN_FOCAL * min(sides) or max(focal) > MAX_FOCAL * max(sides)
    ):
        fault, found = "lens", f"{view.camera.model_name} {values.tolist()}"
        expected = f"a focal length of {MIN_FOCAL} to {MAX_FOCAL} sides, px"
    elif not np.isfinite(pose).all() or not are_rotations(pose[:3, :3], RIGID_TOLERANCE):
        fault, found = "rotation", np.array2string(pose[:3, :3], precision=4).replace("\n", "")
        expected = "a matrix that neither scales nor mirrors, or a quaternion of length 1"
    elif np.abs(pose[:3, 3]).max() > MAX_COORDINATE:
        fault, found = "position", str(pose[:3, 3].tolist())
        expected = f"coordinates up to {MAX_COORDINATE:g}"
    else:
        if view.image is not None:
            check_centres({f"view {view.name}": view.lens})
        return
    raise SceneError(f"the camera {fault} of view {view.name} is not valid", expected=expected, found=found)


def check_centres(lenses: Mapping[str, Lens], max_offset: float = MAX_OFFSET) -> list[str]:
    """Return a note if principal points are more than `NOTED_OFFSET` from the middle of their images.

    Raises:
        SceneError: one is `max_offset` or more, so that the lens belongs to another size of the image.
    """
    noted = []
    for where, (K, (height, width)) in lenses.items():
        offset = float(np.abs(K[:2, 2] / (width, height) - 0.5).max())
        if offset >= max_offset:
            raise SceneError(
                f"cx and cy of {where} belong to another size of the image",
                expected=f"less than {max_offset:.0%} of a side off the middle of {width} x {height} px",
                found=f"{K[0, 2]:g}, {K[1, 2]:g}",
                fix="use the lens of these images, or the images that it was computed from",
            )
        if offset > NOTED_OFFSET:
            noted.append(where)
    more = f" and {len(noted) - 1} others" if len(noted) > 1 else ""
    what = f"more than {NOTED_OFFSET:.0%} of a side off the middle: are their lenses of this image size?"
    return [f"cx or cy of {noted[0]}{more} is {what}"] if noted else []


def find_images(root: Path, names: Sequence[str]) -> dict[str, Path | None]:
    """Return the image of each of a source's names, from `root`, its `images/` or folders below, or None.

    A name without such a file means the image that `match_names` finds, unless another name has that image,
    or other names in the same folder have files, but elsewhere: the image is then missing. This includes
    paths that lead outside `root`, so that downloaded data cannot access other files.

    Raises:
        SceneError: a path leads outside the folder, which has no such image.
    """
    bases, ends = (root / "images", root), ("", ".png", *sorted(IMAGE_SUFFIXES))  # Blender writes PNG
    images: dict[str, Path | None] = {}
    for name in names:
        plain = name.replace("\\", "/")
        paths = [] if is_outside(name) else [base / f"{plain}{end}" for base in bases for end in ends]
        images[name] = next((path for path in paths if path.is_file()), None)
    if missing := [name for name, image in images.items() if image is None]:
        listed = {image: image.relative_to(root).as_posix() for image in images.values() if image is not None}
        others = largest_copies([path for path in used_images(root) if path not in listed])
        below = {path.relative_to(root).as_posix(): path for path in others}
        homes: dict[tuple[str, ...], set[tuple[str, ...]]] = {}
        for name, image in images.items():
            if image is not None:
                homes.setdefault(name_parts(name)[:-1], set()).add(name_parts(listed[image])[:-1])
        for name, match in match_names(missing, below).items():
            home = homes.get(name_parts(name)[:-1])
            if match is None:
                require_inside(root, name)
            elif home is None or name_parts(match)[:-1] in home:
                images[name] = below[match]
    return images


def require_inside(root: Path, name: str) -> None:
    """Refuse a path outside the source folder, so that downloaded data cannot access other files."""
    if is_outside(name):
        raise SceneError(
            f"the poses in {root} refer to a file outside it: {name}",
            expected="paths inside the folder",
            fix="put the file into the folder, and correct the name in the pose file",
        )


def read_colmap(known: KnownPoses) -> Source:
    """Read a COLMAP model, and the names of its test views from the `test.txt` of 3DGS, if present."""
    folder = known.files[0]
    model, source = read_model(folder), Source()
    point_ids, xyz, rgb = model.points or (np.zeros(0, np.int64), np.zeros((0, 3)), None)
    names = [image.name for image in model.images]
    files, held_out = find_images(known.root, names), set[str]()
    if (listed := folder / "test.txt").is_file():
        with foreign(listed, expected="the name of a test view in each line"):
            lines = regular(listed).read_text(encoding="utf-8-sig").splitlines()
        held_out = source.listed([line.strip() for line in lines if line.strip()], names, listed.name)

    def described(image: ModelImage) -> KnownView:
        if image.camera_id not in model.lenses:
            raise SceneError(f"view {image.name} has camera {image.camera_id}, which the model lacks")
        camera = as_camera(model.lenses[image.camera_id])
        return KnownView(image.name, files[image.name], camera, image.cam_from_world, image.name in held_out)

    num_lost = 0
    for image in sorted(model.images, key=lambda image: image.name):
        source.add(image.name, described, image)
        if image.name in source.left_out:
            continue
        view, (xy, seen) = source.views[-1], image.seen
        rows = np.searchsorted(point_ids, seen)
        rows[rows == len(point_ids)] = 0
        is_known = point_ids[rows] == seen if len(point_ids) else np.zeros(len(seen), bool)
        num_lost += int((~is_known).sum())
        seen_xyz = xyz[rows[is_known]] @ view.cam_from_source[:3, :3].T + view.cam_from_source[:3, 3]
        projected = view.camera.img_from_cam(seen_xyz, check_cheirality=False)
        px = np.linalg.norm(projected - xy[is_known], axis=1) if len(seen_xyz) else np.zeros(0)
        px = px[np.isfinite(px)]
        mean = round(float(px.mean()), 4) if len(px) else None
        view.report.update(observations=len(px), reprojection_error_px=mean)
    if rgb is not None:
        source.points = xyz, rgb
        if num_lost:
            source.notes.append(f"{num_lost} observations refer to points that {folder} does not contain")
    return source


def read_llff(known: KnownPoses) -> Source:
    """Read the posed views of an LLFF scene; row i of `poses_bounds.npy` belongs to the i-th image by name.

    The first 15 of a row's 17 numbers are a 3 x 5 matrix, by rows: rotation columns (down, right, back),
    translation, and the column (height, width, focal). OpenCV's axes are x = right, y = down, z = -back. The
    last two are the near and far depths. The lens is SIMPLE_PINHOLE with its centre in the middle, for the
    image size on disk; an image of another shape than stated is noted.
    """
    path = known.files[0]
    expected = "finite numbers of shape (images, 17)"
    with foreign(path, expected=expected, fix="unpack it again"), path.open("rb") as stream:
        rows = np.load(stream, allow_pickle=False)
        if stream.read(1):
            raise ValueError("bytes follow its array")
        if rows.shape[1:] != (17,) or rows.dtype.kind not in "fiu" or not np.isfinite(rows).any():
            raise ValueError(f"it does not contain LLFF poses, but {rows.dtype} of shape {rows.shape}")
    images = list_images(photo_folder(known.root))
    if len(images) != len(rows):
        raise SceneError(
            f"{path} has {len(rows)} poses for {len(images)} images",
            expected="one row per image, in order of file name",
            found=f"{images[0].name} to {images[-1].name}" if images else "no images",
            fix="unpack the images again, and remove files that are not photographs of the scene",
        )

    def described(number: int, image: Path) -> KnownView:
        matrix = rows[number, :15].astype(np.float64).reshape(3, 5)
        down, right, back, position, (height_px, width_px, focal_px) = matrix.T
        pose = np.stack([right, down, -back, position], axis=1)
        source_from_cam = rigid_pose(pose, f"{path}, row {number}")
        height, width = image_size_hw(image)
        if abs(width * height_px - height * width_px) > ASPECT_TOLERANCE * width * height_px:
            source.notes.append(f"{image.name} has another shape than {path.name} states")
        params = [float(focal_px * width / width_px), width / 2, height / 2]
        camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=width, height=height, params=params)
        return KnownView(image.name, image, camera, np.linalg.inv(source_from_cam))

    source = Source()
    for number, image in enumerate(images):
        source.add(image.name, described, number, image)
    return source
