"""Posed pinhole cameras of a scene, keyed by view name."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int32

from hilsplat.base.arrays import require_arrays, require_types
from hilsplat.base.artifacts import damaged, read_npz, write_npz
from hilsplat.base.errors import SceneError, shorten_list
from hilsplat.base.levels import spelt
from hilsplat.base.rotations import RIGID_TOLERANCE, are_rotations

MAX_SIDE_PX = 2**15
LIMITS = {"size_hw": (1, MAX_SIDE_PX)}
MAX_PARAMETERS = 16  # number of parameters of COLMAP's largest lens model


@dataclass(frozen=True)
class Photo:
    """The photograph from which a view was cropped or undistorted; both have the same pose.

    Attributes:
        model: COLMAP's name of the lens model.
        params: its parameters, for the size `size_hw`, px.
        size_hw: height and width of the photograph, px.
    """

    model: str
    params: tuple[float, ...]
    size_hw: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Camera:
    """An undistorted pinhole camera (OpenCV axes: x right, y down, z forward).

    Attributes:
        name: view name, the image's file name.
        cam_from_world: `x_cam = cam_from_world @ x_world`, scene units.
        K: intrinsics, px; the centre of the top-left pixel is (0.5, 0.5).
        size_hw: image height and width, px.
        photo: the photograph, if it was cropped or undistorted; else the view is the photograph, or a scaled
            copy.

    Raises:
        SettingsError: an array has the wrong type or shape.
        SceneError: a value is impossible, such as a pose that is not rigid or a size of 0.
    """

    name: str
    cam_from_world: Float[np.ndarray, "4 4"]
    K: Float[np.ndarray, "3 3"]
    size_hw: tuple[int, int]
    photo: Photo | None = None

    def __post_init__(self) -> None:
        require_arrays(self)
        for name in ("cam_from_world", "K"):  # not shared: a change would also change the scene
            object.__setattr__(self, name, getattr(self, name).copy())
        fault = _fault_of(self.cam_from_world[None], self.K[None])
        if not all(isinstance(side, int | np.integer) and 1 <= side <= MAX_SIDE_PX for side in self.size_hw):
            fault = f"height and width in whole px, 1 to {MAX_SIDE_PX}"
        if fault:
            raise SceneError(
                f"camera {self.name} is not valid",
                expected=fault,
                found=f"size {self.size_hw}, pose {self.cam_from_world.tolist()}, K {self.K.tolist()}",
            )

    def __repr__(self) -> str:
        height, width = self.size_hw
        return f"Camera({self.name}: {width} x {height} px, focal length {self.K[0, 0]:.1f} px)"

    @property
    def centre(self) -> Float[np.ndarray, " 3"]:
        """Camera centre in world coordinates, scene units."""
        rotation, translation = self.cam_from_world[:3, :3], self.cam_from_world[:3, 3]
        return -rotation.T @ translation

    def scaled(self, size_hw: tuple[int, int]) -> "Camera":
        """Return the camera for a resized image, with K scaled along each side."""
        scale = np.array([size_hw[1] / self.size_hw[1], size_hw[0] / self.size_hw[0], 1.0])
        return replace(self, K=scale[:, None] * self.K, size_hw=size_hw)


@dataclass(frozen=True, eq=False)
class Cameras:
    """V posed cameras.

    Attributes:
        names: view names (file names of the images), in the order of the rows.
        cam_from_world, K, size_hw: as in `Camera`, one row per view.
        photos: as in `Camera`, by name.
    """

    names: tuple[str, ...]
    cam_from_world: Float[np.ndarray, "V 4 4"]
    K: Float[np.ndarray, "V 3 3"]
    size_hw: Int32[np.ndarray, "V 2"]
    photos: Mapping[str, Photo] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[Camera]:
        return (self[row] for row in range(len(self)))

    def __repr__(self) -> str:
        return f"Cameras({len(self)} views: {shorten_list(self.names)})"

    def __getitem__(self, view: str | int) -> Camera:
        """Return the camera of a view, by name or row; raise SceneError if there is none."""
        try:
            row = (
                self.names.index(spelt(view, self.names) or view)
                if isinstance(view, str)
                else range(len(self))[view]
            )
        except (ValueError, IndexError) as error:
            raise SceneError(
                f"view {view!r} has no camera",
                expected=f"one of {len(self.names)} views: {', '.join(self.names[:5])}, ...",
            ) from error
        name, (height, width) = self.names[row], self.size_hw[row].tolist()
        return Camera(name, self.cam_from_world[row], self.K[row], (height, width), self.photos.get(name))

    def save(self, path: Path) -> None:
        """Write `cameras.npz` atomically."""
        require_types(Cameras, vars(self), path, LIMITS)
        none = Photo("", (), (0, 0))
        photos = [self.photos.get(name, none) for name in self.names] if self.photos else []
        params = [np.pad(photo.params, (0, MAX_PARAMETERS - len(photo.params))) for photo in photos]
        lenses = {
            "photo_model": np.array([photo.model for photo in photos], dtype=np.str_),
            "photo_params": np.array(params, dtype=np.float64),
            "photo_size_hw": np.array([photo.size_hw for photo in photos], dtype=np.int32),
        }
        write_npz(
            path,
            names=np.array(self.names, dtype=np.str_),
            cam_from_world=self.cam_from_world.astype(np.float64),
            K=self.K.astype(np.float64),
            size_hw=self.size_hw.astype(np.int32),
            **(lenses if photos else {}),
        )

    @staticmethod
    def load(path: Path) -> "Cameras":
        """Read `cameras.npz`; raise ArtifactError if it does not contain valid cameras."""
        arrays = read_npz(path, "names", "cam_from_world", "K", "size_hw")
        numbers = {name: array for name, array in arrays.items() if name != "names"}
        require_types(Cameras, numbers, path, LIMITS)
        names, poses, K = arrays["names"], arrays["cam_from_world"], arrays["K"]
        if names.dtype.kind != "U" or names.shape != (len(poses),) or len(set(names.tolist())) != len(names):
            fault = f"a distinct name for each of {len(poses)} cameras ({len(names)} names found)"
        else:
            fault = _fault_of(poses, K)
        if fault:
            raise damaged(path, " does not contain valid cameras", fault)
        order = tuple(names.tolist())
        photos = {}
        if "photo_model" in arrays:
            columns = (arrays[f"photo_{what}"].tolist() for what in ("model", "params", "size_hw"))
            for name, model, params, size_hw in zip(order, *columns, strict=True):
                if model:
                    photos[name] = Photo(model, tuple(params), tuple(size_hw))
        return Cameras(order, poses, K, arrays["size_hw"], photos)


def _fault_of(poses: Float[np.ndarray, "V 4 4"], K: Float[np.ndarray, "V 3 3"]) -> str:
    """Return what cameras lack to be valid, or ""."""
    if not (np.isfinite(poses).all() and np.isfinite(K).all()):
        return "finite numbers"
    if not are_rotations(poses[:, :3, :3], RIGID_TOLERANCE).all() or (poses[:, 3] != (0, 0, 0, 1)).any():
        return "rigid poses"
    if not (K[:, [0, 1], [0, 1]] > 0).all() or (K[:, 2] != (0, 0, 1)).any():
        return "focal lengths above 0"
    if (K[:, [0, 1], [1, 0]] != 0).any():
        return "pixels without skew (K[0, 1] and K[1, 0] are 0), as after undistortion"
    return ""
