"""What a damaged file of another program means: a second reading, by json, struct, numpy and scipy alone.

Each oracle returns the content that a reader may report, or raises `Meaningless` if a reader must refuse the
file. Oracles are strict about structure, because programs that write these files are, and take numbers as
nerfstudio takes them: `float` and `int` of what the file contains.
"""

import json
import math
import re
import struct
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from PIL import Image, ImageDraw
from pycocotools import mask as coco
from scipy.spatial.transform import Rotation


class Meaningless(Exception):
    """The file has no meaning; a reader must refuse it."""


def require(condition: object, reason: str = "") -> None:
    if not condition:
        raise Meaningless(reason)


# -- posed views --------------------------------------------------------------------------------


@dataclass
class View:
    """A posed view: lens model, parameters by name, size (width, height), world-to-camera, and image file.

    `images` are the files that may be its image; None if the view may have none.
    """

    name: str
    model: str
    params: dict[str, float]
    size: tuple[float, float]
    pose: np.ndarray
    images: list[Path | None]
    is_test: bool | None = False  # None if it isn't clear
    report: dict[str, Any] = field(default_factory=dict)


@dataclass
class Views:
    """All views that a file describes, None for one that is not valid; points (x y z r g b); unknown keys."""

    views: list[tuple[str, View | None]] = field(default_factory=list)
    points: np.ndarray | None = None
    reported: set[str] = field(default_factory=set)

    def add(self, name: str, build: Any) -> None:
        try:
            self.views.append((name, build()))
        except (Meaningless, KeyError, TypeError, ValueError, OverflowError, ZeroDivisionError, IndexError):
            self.views.append((name, None))


def name_parts(text: str) -> list[str]:
    """Return the parts of a path in one form: without case, suffix and folder of the disk."""
    parts = [part for part in text.replace("\\", "/").casefold().split("/") if part not in ("", ".", "..")]
    parts = [part for part in parts if not part.endswith(":")]
    if parts and parts[-1].endswith((".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")):
        parts[-1] = parts[-1].rpartition(".")[0]
    return parts


def meant(name: str, candidates: list[str]) -> list[str]:
    """Return the candidates that share the most last parts with a name; of these, those without others.

    Above the shared parts, one of the two has no folder, or only `images`.
    """
    wanted, shared = name_parts(name), []
    for candidate in candidates:
        parts = name_parts(candidate)
        same = [one == other for one, other in zip(reversed(wanted), reversed(parts), strict=False)]
        count = same.index(False) if False in same else len(same)
        above = [each[: len(each) - count] for each in (wanted, parts)]
        shared.append(count if [] in above or ["images"] in above else 0)
    best = [each for each, count in zip(candidates, shared, strict=True) if count == max(shared) > 0]
    exact = [each for each in best if len(name_parts(each)) == min(map(len, map(name_parts, best)))]
    return exact if len(exact) == 1 else best


def image_files(root: Path, name: str) -> list[Path | None]:
    """Return the images that a name may mean, and None unless it states the place of the only one."""
    files = {path.relative_to(root).as_posix(): path for path in sorted(root.rglob("*.png"))}
    found: list[Path | None] = [files[each] for each in meant(name, list(files))]
    places = [root / folder / f"{name}{suffix}" for folder in ("", "images") for suffix in ("", ".png")]
    return found if len(found) == 1 and found[0] in places else [*found, None]


def colmap_name(model: int) -> str:
    """Return the name of a lens model in COLMAP's files, by id."""
    names = (
        *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"),
        *("FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
    )
    return names[model] if model < len(names) else pycolmap.CameraModelId(model).name


def colmap_lens(model: str, width: int, height: int, params: list[float]) -> tuple[Any, ...]:
    """Return a lens with its parameters by name."""
    require(model in pycolmap.CameraModelId.__members__)
    names = pycolmap.Camera.create_from_model_name(1, model, 1.0, 2, 2).params_info.split(", ")
    require(len(names) == len(params))
    return model, dict(zip(names, params, strict=True)), (width, height)


def rotation(w: float, x: float, y: float, z: float) -> np.ndarray:
    """Return the rotation of a quaternion; it may be 2 % too long."""
    require(abs(math.sqrt(w * w + x * x + y * y + z * z) - 1) < 0.02, "quaternion")
    return Rotation.from_quat([x, y, z, w]).as_matrix()


def rigid(matrix: np.ndarray) -> np.ndarray:
    """Return a 3 x 4 or 4 x 4 matrix as 4 x 4 if it is nearly a rotation and a translation."""
    require(matrix.shape in ((3, 4), (4, 4)) and np.isfinite(matrix).all(), "matrix")
    pose = np.eye(4)
    pose[: len(matrix)] = matrix
    require(np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() < 2e-3, "rotation")
    require(np.linalg.det(pose[:3, :3]) > 0 and np.abs(pose[3] - [0, 0, 0, 1]).max() < 1e-4, "mirrored")
    return pose


def from_quaternion(quat_wxyz: tuple[float, ...], translation: tuple[float, ...]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation(*quat_wxyz), translation
    return pose


def opencv_from(world_from_camera: np.ndarray) -> np.ndarray:
    """Return a world-to-camera matrix in OpenCV axes from a camera-to-world matrix in OpenGL axes."""
    return np.linalg.inv(world_from_camera @ np.diag([1.0, -1, -1, 1]))


def _colmap(root: Path, cameras: list[tuple], images: list[tuple], points: list[tuple]) -> Views:
    """Join the records of a model: cameras, images with a pose, and points with colours."""
    lenses: dict[int, tuple] = {}
    for number, *lens in cameras:
        require(lenses.setdefault(number, tuple(lens)) == tuple(lens), f"two cameras {number}")
    found = Views()
    for quat, translation, camera, name, _ in images:

        def build(quat=quat, translation=translation, camera=camera, name=name) -> View:
            model, params, size = colmap_lens(*lenses[camera])
            return View(
                name, model, params, size, from_quaternion(quat, translation), image_files(root, name)
            )

        found.add(name, build)
    found.points = np.array([[*xyz, *rgb] for _, xyz, rgb in points], np.float64).reshape(-1, 6)
    return found


def colmap_binary(root: Path) -> Views:
    """Read cameras.bin, images.bin and points3D.bin as COLMAP's documentation describes them."""
    folder = root / "sparse/0"

    def records(name: str, read: Any) -> list[tuple]:
        data, at = (folder / name).read_bytes(), 0

        def take(form: str) -> tuple:
            nonlocal at
            require(at + struct.calcsize("<" + form) <= len(data), "it ends")
            values = struct.unpack_from("<" + form, data, at)
            at += struct.calcsize("<" + form)
            return values

        def text() -> str:
            nonlocal at
            end = data.find(b"\0", at)
            require(end >= 0, "name without an end")
            found, at = data[at:end].decode("utf-8", "surrogateescape"), end + 1
            return found

        def skip(size: int, count: int) -> None:
            nonlocal at
            require(at + size * count <= len(data), "it ends")
            at += size * count

        (count,) = take("Q")
        require(count <= len(data))
        rows = [read(take, text, skip) for _ in range(count)]
        require(at == len(data), "bytes follow")
        return rows

    def camera(take: Any, text: Any, skip: Any) -> tuple:
        number, model, width, height = take("IiQQ")
        require(0 <= model < 18, "model")
        name = colmap_name(model)
        count = len(pycolmap.Camera.create_from_model_name(1, name, 1.0, 2, 2).params)
        return number, name, width, height, list(take(f"{count}d"))

    def image(take: Any, text: Any, skip: Any) -> tuple:
        values = take("I7dI")
        name = text()
        skip(24, take("Q")[0])
        return values[1:5], values[5:8], values[8], name, None

    def point(take: Any, text: Any, skip: Any) -> tuple:
        number, x, y, z, red, green, blue, _, length = take("Q3d3BdQ")
        skip(8, length)
        return number, (x, y, z), (red, green, blue)

    return _colmap(
        root, records("cameras.bin", camera), records("images.bin", image), records("points3D.bin", point)
    )


NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf|infinity)", re.IGNORECASE)


def number(text: str) -> float:
    """Return a number as C++ and C read it."""
    require(NUMBER.fullmatch(text) and text.isascii(), f"number {text}")
    return float(text)


def whole(text: str) -> int:
    require(re.fullmatch(r"[-+]?\d+", text) and text.isascii(), f"whole number {text}")
    return int(text)


def colmap_text(root: Path) -> Views:
    """Read the text form. A line with 10 words is an image if 9 of them are its numbers."""
    folder = root / "sparse/0"

    def lines(name: str) -> list[str]:
        text = (folder / name).read_bytes().decode("utf-8", "surrogateescape").removeprefix("\ufeff")
        rows = re.split(r"\r\n|\r|\n", text)
        return [row.strip() for row in rows if not row.startswith("#") and row.strip()]

    cameras = []
    for row in lines("cameras.txt"):
        words = row.split()
        require(len(words) >= 4, "camera")
        params = [number(word) for word in words[4:]]
        cameras.append((whole(words[0]), words[1], whole(words[2]), whole(words[3]), params))
        colmap_lens(*cameras[-1][1:])
    images = []
    for row in lines("images.txt"):
        words = row.split(maxsplit=9)
        is_points = len(row.split()) % 3 == 0 and all(NUMBER.fullmatch(word) for word in row.split())
        if len(words) < 10 or is_points:
            require(is_points, f"neither an image nor points: {row}")
            continue
        whole(words[0])
        values = [number(word) for word in words[1:8]]
        images.append((tuple(values[:4]), tuple(values[4:]), whole(words[8]), words[9], None))
    points = []
    for row in lines("points3D.txt"):
        words = row.split()
        require(len(words) >= 7, "point")
        whole(words[0])
        colour = [number(word) for word in words[4:7]]
        require(all(each in range(256) for each in colour), "colour")
        points.append((0, [number(word) for word in words[1:4]], colour))
    return _colmap(root, cameras, images, points)


def json_object(path: Path) -> dict[str, Any]:
    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        require(len(dict(pairs)) == len(pairs), "a key occurs twice")
        return dict(pairs)

    try:
        content = json.loads(path.read_bytes().decode("utf-8-sig"), object_pairs_hook=unique)
    except ValueError as error:
        raise Meaningless(str(error)) from error
    require(isinstance(content, dict), "not an object")
    return content


TRANSFORMS_KEYS = {
    *("frames", "file_path", "transform_matrix", "w", "h", "fl_x", "fl_y", "cx", "cy"),
    *("k1", "k2", "k3", "k4", "p1", "p2", "camera_model", "is_fisheye"),
    *("ply_file_path", "train_filenames", "val_filenames"),
    *("test_filenames", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov", "applied_transform", "scale"),
    *("applied_scale", "aabb_scale"),
}
FISHEYES = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL")


def transforms(root: Path) -> Views:
    """Read transforms.json as nerfstudio does, with its lists of file names and its points."""
    content = json_object(root / "transforms.json")
    frames = content.get("frames")
    require(isinstance(frames, list) and all(isinstance(frame, dict) for frame in frames), "frames")
    found = Views(reported={key for each in (content, *frames) for key in each} - TRANSFORMS_KEYS)
    names = [str(frame.get("file_path", f"frame {row}")) for row, frame in enumerate(frames)]
    listed: dict[str, set[str]] = {}
    unclear: set[str] = set()
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        value, listed[key] = content.get(key), set()
        if value is not None and not isinstance(value, list):
            found.reported.add(key)
            continue
        for each in value or ():
            same = meant(str(each), names)
            listed[key].update(same if len(same) == 1 else ())
            unclear.update(same if len(same) > 1 else ())
            found.reported.update(() if same else (key,))
    train, held = listed["train_filenames"], listed["val_filenames"] | listed["test_filenames"]
    held = set(names) - train if train else held
    for name, frame in zip(names, frames, strict=True):
        own = any(
            key in frame for axis in "xy" for key in (f"fl_{axis}", f"camera_angle_{axis}", f"{axis}_fov")
        )
        shared = {
            key: value
            for key, value in content.items()
            if not (own and re.fullmatch(r"fl_[xy]|camera_angle_[xy]|[xy]_fov", key))
        }
        merged = {**shared, **frame}

        def build(name=name, merged=merged) -> View:
            require(isinstance(merged["file_path"], str))
            images = image_files(root, name)
            model, params, size = transforms_lens(merged, images[0])
            pose = opencv_from(rigid(np.array(merged["transform_matrix"], np.float64)))
            return View(name, model, params, size, pose, images, None if name in unclear else name in held)

        found.add(name, build)
    if isinstance(content.get("ply_file_path"), str):
        found.points = ply_points(root / content["ply_file_path"].replace("\\", "/"))
    elif content.get("ply_file_path") is not None:
        found.reported.add("ply_file_path")
    return found


def transforms_lens(frame: dict[str, Any], image: Path | None) -> tuple[Any, ...]:
    def value(key: str) -> float:
        return 0.0 if frame.get(key) is None else float(frame[key])

    size = [None if frame.get(key) is None else int(frame[key]) for key in "wh"]
    stored = Image.open(image).size if image is not None else (2, 2)
    size = [stored[axis] if None in size else each for axis, each in enumerate(size)]
    require(min(size) > 0, "size")
    focal = {}
    for axis, side in zip("xy", size, strict=True):
        for key in (f"fl_{axis}", f"camera_angle_{axis}", f"{axis}_fov"):
            if frame.get(key) is not None and axis not in focal:
                angle = float(frame[key]) * (math.pi / 180 if key.endswith("fov") else 1)
                focal[axis] = float(frame[key]) if key[0] == "f" else side / 2 / math.tan(angle / 2)
    require(focal and all(each > 0 for each in focal.values()), "focal length")
    fx, fy = focal.get("x", focal.get("y")), focal.get("y", focal.get("x"))
    fisheye = frame.get("is_fisheye")
    require(fisheye is None or fisheye in (True, False), "is_fisheye")
    model = str(frame.get("camera_model", "OPENCV")).upper()
    require(model in FISHEYES + PERSPECTIVE, "camera_model")
    is_fisheye = bool(fisheye) or model in FISHEYES
    require(not (is_fisheye and (value("p1") or value("p2"))), "tangential")
    require(is_fisheye or not value("k4"), "k4")
    centre = zip((frame.get("cx"), frame.get("cy")), size, strict=True)
    cx, cy = (side / 2 if stated is None else float(stated) for stated, side in centre)
    params = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    params |= {key: value(key) for key in ("k1", "k2", "k3", "k4", "p1", "p2")}
    return "fisheye" if is_fisheye else "perspective", params, tuple(size)


def polycam(root: Path) -> Views:
    """Read a raw Polycam export."""
    found, used = Views(), {f"t_{row}{column}" for row in range(3) for column in range(4)}
    used |= {"fx", "fy", "cx", "cy", "width", "height", "timestamp", "blur_score"}
    for image in sorted((root / "keyframes/images").iterdir()):

        def build(image=image) -> View:
            content = json_object(root / f"keyframes/cameras/{image.stem}.json")
            found.reported |= content.keys() - used
            entries = [float(content[f"t_{row}{column}"]) for row in range(3) for column in range(4)]
            params = {key: float(content[key]) for key in ("fx", "fy", "cx", "cy")}
            size = [content.get("width"), content.get("height")]
            size = Image.open(image).size if None in size else tuple(map(int, size))
            return View(image.name, "perspective", params, size, phone_pose(entries), [image])

        found.add(image.name, build)
    return found


def phone_pose(entries: list[float]) -> np.ndarray:
    """Return world-to-camera in OpenCV axes, in a world whose x, y, z are ARKit's z, x, y."""
    world = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    return opencv_from(world @ rigid(np.reshape(entries, (3, 4))))


def record3d(root: Path) -> Views:
    """Read a Record3D export; `poses` and `perFrameIntrinsicCoeffs` have a row for each image."""
    content = json_object(root / "metadata")
    found = Views(reported=content.keys() - {"K", "w", "h", "poses", "perFrameIntrinsicCoeffs", "fps"})
    images = sorted((root / "rgb").iterdir(), key=lambda image: int(image.stem))
    try:
        poses, K = content["poses"], np.array(content["K"], np.float64).reshape(3, 3)
        size = int(content["w"]), int(content["h"])
        poses = np.array(poses, np.float64).reshape(-1, 7)
        own = content.get("perFrameIntrinsicCoeffs")
        own = None if own is None else np.array(own, np.float64)
        require(own is None or own.shape == (len(poses), 4), "perFrameIntrinsicCoeffs")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise Meaningless(str(error)) from error
    for row, image in enumerate(images):

        def build(row=row, image=image) -> View:
            lens = [K[0, 0], K[1, 1], K[2, 0], K[2, 1]] if own is None else own[row].tolist()
            x, y, z, w, *position = poses[row].tolist()
            matrix = np.column_stack([rotation(w, x, y, z), position])
            params = dict(zip(("fx", "fy", "cx", "cy"), lens, strict=True))
            return View(image.name, "perspective", params, size, phone_pose(matrix.ravel().tolist()), [image])

        found.add(image.name, build)
    return found


def array(path: Path) -> np.ndarray:
    """Read an array to the end of its file."""
    with path.open("rb") as stream:
        found = np.load(stream, allow_pickle=False)
        require(isinstance(found, np.ndarray) and not stream.read(1), "bytes follow")
    return found


def llff(root: Path) -> Views:
    """Read LLFF's poses_bounds.npy."""
    try:
        rows = array(root / "poses_bounds.npy")
    except Exception as error:
        raise Meaningless(str(error)) from error
    images = sorted((root / "images").iterdir())
    require(isinstance(rows, np.ndarray) and rows.dtype.kind in "fiu" and rows.shape == (len(images), 17))
    found = Views()
    for row, image in zip(rows.astype(np.float64), images, strict=True):

        def build(row=row, image=image) -> View:
            matrix = row[:15].reshape(3, 5)
            _, stated, focal = matrix[:, 4]
            size = width, height = Image.open(image).size  # the focal length is for the stated width
            focal *= width / stated
            params = {"fx": focal, "fy": focal, "cx": width / 2, "cy": height / 2}
            pose = np.column_stack([matrix[:, 1], -matrix[:, 0], matrix[:, 2], matrix[:, 3]])
            return View(image.name, "perspective", params, size, opencv_from(rigid(pose)), [image])

        found.add(image.name, build)
    return found


# -- PLY ----------------------------------------------------------------------------------------

PLY_TYPES = {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8", "uchar": "u1", "uint8": "u1"}
PLY_TYPES |= {"char": "i1", "int8": "i1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2"}
PLY_TYPES |= {"int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"}


def ply_vertices(path: Path) -> dict[str, np.ndarray]:
    """Read the vertices of a PLY file whose only element they are; all bytes must belong to them."""
    require(path.is_file(), "missing")
    head, end, body = path.read_bytes().partition(b"end_header")
    require(end and body[:1] in (b"\n", b"\r"), "header")
    body = body[2:] if body.startswith(b"\r\n") else body[1:]
    lines = re.split(r"\r\n|\n|\r", head.decode("latin-1"))
    require(lines[0] == "ply", "magic")
    form, counts, properties = None, [], []
    for line in lines[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and form is None:
            require(
                words[1:2] and words[1] in ("ascii", "binary_little_endian", "binary_big_endian"), "format"
            )
            form = words[1]
        elif words[0] == "element" and not counts:
            require(len(words) == 3 and words[1] == "vertex" and words[2].isdigit(), "element")
            counts.append(int(words[2]))
        elif words[0] == "property" and len(words) == 3 and words[1] in PLY_TYPES and counts:
            properties.append((words[2], PLY_TYPES[words[1]]))
        else:
            raise Meaningless(line)
    names = [name for name, _ in properties]
    require(form and counts and len(set(names)) == len(names), "header")
    if form == "ascii":
        rows = [row.split() for row in body.decode("latin-1").split("\n") if row.strip()]
        require(len(rows) == counts[0] and all(len(row) == len(names) for row in rows), "rows")
        columns = {}
        for column, (name, kind) in enumerate(properties):
            read = number if kind[0] == "f" else whole
            values = [read(row[column]) for row in rows]
            if kind[0] != "f":
                limits = np.iinfo(kind)
                require(all(limits.min <= value <= limits.max for value in values), "range")
            with np.errstate(over="ignore"):
                columns[name] = np.array(values, np.float64).astype(kind)
        return columns
    order = "<" if form == "binary_little_endian" else ">"
    kinds = np.dtype([(name, order + kind) for name, kind in properties])
    require(len(body) == counts[0] * kinds.itemsize, "size")
    table = np.frombuffer(body, kinds)
    return {name: table[name] for name in names}


def ply_points(path: Path) -> np.ndarray:
    """Return points and colours, 0 to 255: float colours up to 1 count as shares."""
    vertices = ply_vertices(path)
    require({"x", "y", "z"} <= vertices.keys(), "coordinates")
    xyz = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    names = ("red", "green", "blue")
    if not set(names) <= vertices.keys():
        return np.hstack([xyz, np.full(xyz.shape, 128.0)])
    rgb = np.stack([vertices[name] for name in names], axis=1)
    most = np.nanmax(rgb) if rgb.size else 0
    scale = 255 if rgb.dtype.kind == "f" and most <= 1 else 1 if most <= 255 else 255 / 65535
    return np.hstack([xyz, np.clip(np.rint(np.nan_to_num(rgb * float(scale), nan=128.0)), 0, 255)])


def gaussians(path: Path) -> tuple[np.ndarray, int]:
    """Return means, log scales, quaternions, opacity logit, and f_dc of usable Gaussians, and their total."""
    vertices = ply_vertices(path)
    names = [*"xyz", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4)), "opacity"]
    names += [f"f_dc_{k}" for k in range(3)]
    rest = [name for name in vertices if name.startswith("f_rest_")]
    require(len(rest) in (0, 9, 24, 45) and {f"f_rest_{k}" for k in range(len(rest))} == set(rest), "f_rest")
    names += [f"f_rest_{k}" for k in range(len(rest))]
    require(all(name in vertices and vertices[name].dtype.kind == "f" for name in names), "properties")
    allowed = {*names, "nx", "ny", "nz", "filter_3D"}
    changed = [name for name in vertices if name not in allowed]
    require(
        not any(re.fullmatch(r"(scale|rot|opacity|f_dc)(_\w+)?|\w*filter\w*", name) for name in changed),
        "changed",
    )
    with np.errstate(all="ignore"):
        values = np.stack([vertices[name].astype(np.float32) for name in names], axis=1).astype(np.float64)
        if "filter_3D" in vertices:
            extra = np.log(np.abs(vertices["filter_3D"].astype(np.float64)))[:, None]
            least, most = np.minimum(values[:, 3:6], extra), np.maximum(values[:, 3:6], extra)
            wider = most + np.log1p(np.exp(2 * (least - most))) / 2  # of log(sqrt(s^2 + f^2))
            shrunk = (values[:, 3:6] - wider).sum(axis=1)  # log of the factor of the opacity
            odds = np.exp(-values[:, 10])
            # 1 / opacity = (1 + odds) / factor, so the new odds are (1 + odds) / factor - 1.
            new_odds = (1 + odds) * np.exp(-shrunk) - 1
            logit = np.where(
                new_odds < 1e300,
                -np.log(new_odds),
                np.where(odds < 1e300, -np.log1p(odds), values[:, 10]) + shrunk,
            )
            values[:, 3:6], values[:, 10] = wider, logit
        infinite = np.isinf(values[:, 10])
        values[infinite, 10] = 16 * np.sign(values[infinite, 10])
        usable = (np.abs(values) < 1e15).all(axis=1) & (values[:, 3:6] < np.log(1e15)).all(axis=1)
        usable &= np.linalg.norm(values[:, 6:10], axis=1) >= 1e-12
    return values[usable], len(values)


# -- annotations --------------------------------------------------------------------------------


@dataclass(eq=False)
class Region:
    """An annotation: text, the object that it is a part of, pixels, level, and parent."""

    text: str
    thing: Any
    mask: np.ndarray
    level: int
    parent: Any


def size_of(content: Any, view_hw: tuple[int, int]) -> tuple[int, int]:
    size = content["height"], content["width"]
    require(all(type(side) in (int, float) and 0 < side <= 20000 and side % 1 == 0 for side in size), "size")
    size = int(size[0]), int(size[1])
    require(abs(size[0] - size[1] * view_hw[0] / view_hw[1]) <= max(1, 0.01 * size[0]), "shape")
    return size


def scaled(mask: np.ndarray, size_hw: tuple[int, int]) -> np.ndarray:
    """Return the values at the centres of the pixels of another size."""
    rows, columns = (
        ((np.arange(size) + 0.5) * old / size).astype(int)
        for size, old in zip(size_hw, mask.shape, strict=True)
    )
    return mask[np.ix_(rows, columns)]


def filled(rings: list[Any], size_hw: tuple[int, int]) -> np.ndarray:
    """Fill polygons as LERF-OVS's evaluation does."""
    canvas = np.zeros(size_hw, np.uint8)
    for ring in rings:
        points = np.array(ring, np.float64)
        require(points.ndim == 2 and points.shape[1] == 2 and (np.abs(points) < 1e6).all(), "polygon")
        cv2.fillPoly(canvas, [points.astype(np.int32)], 1)
    return canvas.astype(bool)


def level_of(entry: dict[str, Any]) -> int:
    level = 1 if entry.get("level") is None else int(entry["level"])
    require(level in (1, 2, 3) and level == float(entry.get("level") or 1), "level")
    return level


def isat(content: dict[str, Any], view_hw: tuple[int, int]) -> list[Region | None]:
    size = size_of({"height": content["info"]["height"], "width": content["info"]["width"]}, view_hw)

    def region(entry: Any) -> Region:
        value = entry["segmentation"]
        rings = value if isinstance(value[0][0], list) else [value]
        require(isinstance(entry["category"], str) and entry["category"].strip(), "category")
        thing = entry.get("id", entry.get("group") if "level" in entry else None)
        mask = scaled(filled(rings, size), view_hw)
        return Region(entry["category"], thing, mask, level_of(entry), entry.get("parent"))

    return [attempt(region, entry) for entry in content["objects"]]


def labelme(content: dict[str, Any], view_hw: tuple[int, int]) -> list[Region | None]:
    def region(entry: Any) -> Region:
        size = size_of({"height": content["imageHeight"], "width": content["imageWidth"]}, view_hw)
        kind = entry.get("shape_type") or "polygon"
        points = np.array(entry["points"], np.float64).reshape(-1, 2)
        require((np.abs(points) < 1e6).all() and isinstance(entry["label"], str), "points")
        canvas = Image.new("1", size[::-1])
        draw = ImageDraw.Draw(canvas)
        if kind == "polygon" and "level" in entry:
            canvas = Image.fromarray(filled([points], size))
        elif kind == "polygon":
            require(len(points) > 2, "points")
            draw.polygon([tuple(point) for point in points.tolist()], fill=1, outline=1)
        elif kind == "rectangle":
            require(len(points) > 1, "points")
            draw.rectangle([*points.min(axis=0).tolist(), *points.max(axis=0).tolist()], fill=1, outline=1)
        elif kind == "circle":
            (x, y), (x2, y2) = points.tolist()
            radius = math.hypot(x - x2, y - y2)
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=1, outline=1)
        else:
            raise Meaningless(f"{kind}")
        mask = scaled(np.asarray(canvas, bool), view_hw)
        return Region(entry["label"], entry.get("group_id"), mask, level_of(entry), entry.get("parent"))

    return [attempt(region, entry) for entry in content["shapes"]]


def coco_file(content: dict[str, Any], view_hw: tuple[int, int]) -> list[Region | None]:
    def only(rows: list[Any], number: Any) -> dict[str, Any]:
        same = [row for row in rows if isinstance(row, dict) and repr(row.get("id")) == repr(number)]
        require(same and all(row == same[0] for row in same), f"id {number}")
        return same[0]

    def region(entry: Any) -> Region:
        image = only(content["images"], entry.get("image_id"))
        text = only(content["categories"], entry.get("category_id"))["name"]
        require(isinstance(text, str | int), "name")
        require(name_parts(image["file_name"])[-1] == "000", "file_name")
        shape = entry["segmentation"]
        if isinstance(shape, dict):
            require(len(shape["size"]) == 2)
            size = size_of(dict(zip(("height", "width"), shape["size"], strict=True)), view_hw)
            mask = runs_decoded(shape["counts"], size)
        else:
            size = size_of(image, view_hw)
            nested = shape if isinstance(shape[0], list) and len(shape[0]) > 2 else [shape]
            flat = [np.array(ring, np.float64).reshape(-1, 2).ravel().tolist() for ring in nested]
            require(all(abs(value) < 1e6 for ring in flat for value in ring), "polygon")
            flat = [ring for ring in flat if len(ring) >= 6]
            require(flat, "polygon")
            mask = coco.decode(coco.merge(coco.frPyObjects(flat, *size))).astype(bool)
        return Region(
            str(text), entry.get("thing"), scaled(mask, view_hw), level_of(entry), entry.get("parent")
        )

    return [attempt(region, entry) for entry in content["annotations"]]


def runs_decoded(counts: Any, size_hw: tuple[int, int]) -> np.ndarray:
    """Decode COCO's run lengths, column by column; compressed ones are differences in base 32."""
    if isinstance(counts, str):
        runs: list[int] = []
        value, shift = 0, 0
        for letter in counts:
            code = ord(letter) - 48
            require(0 <= code < 64 and shift < 60, "letter")
            value |= (code & 31) << shift
            shift += 5
            if not code & 32:
                value -= (1 << shift) if code & 16 else 0
                runs.append(value + (runs[-2] if len(runs) > 2 else 0))
                value, shift = 0, 0
        require(shift == 0, "it ends")
    else:
        require(isinstance(counts, list) and all(type(run) is int for run in counts), "counts")
        runs = counts
    require(all(run >= 0 for run in runs) and sum(runs) == size_hw[0] * size_hw[1], "counts")
    values = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    return values.reshape(size_hw[::-1]).T


def attempt(region: Any, entry: Any) -> Region | None:
    with suppress(Exception):  # whatever a damaged entry makes numpy, OpenCV and Pillow raise
        return region(entry)
    return None


# -- pictures, maps, transforms -----------------------------------------------------------------


def opened(path: Path) -> Image.Image:
    """Return a decoded picture of a format of photographs."""
    try:
        image = Image.open(path, formats=("JPEG", "PNG", "TIFF", "BMP", "WEBP"))
        image.load()
    except Exception as error:
        raise Meaningless(str(error)) from error
    return image


def picture(path: Path) -> np.ndarray:
    """Return upright RGB pixels; alpha is dropped, and 16 bits become 8."""
    image = opened(path)
    try:
        turn = image.getexif().get(274, 1)
    except Exception:
        turn = 1
    pixels = np.asarray(image)
    if image.mode.startswith("I"):
        pixels = np.rint(pixels / 257).astype(np.uint8)
    else:
        pixels = np.asarray(image.convert("RGBA" if image.mode == "P" else "RGB"))[..., :3]
    pixels = pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)
    if turn in (2, 3, 4):
        return pixels[:: -1 if turn > 2 else 1, :: -1 if turn < 4 else 1]
    if turn in (5, 6, 7, 8):
        turned = pixels.transpose(1, 0, 2)
        return turned[:: -1 if turn in (7, 8) else 1, :: -1 if turn in (6, 7) else 1]
    return pixels


def mask(path: Path) -> np.ndarray:
    """Return grey values: alpha if parts are clear, 255 for one colour on black, else the brightness."""
    image = opened(path)
    if image.mode.startswith("I"):
        values = np.asarray(image).astype(np.int64)
        require(values.min() >= 0, "range")
        grey = (np.rint(values / 257) if values.max() > 255 else values).astype(np.uint8)
    else:
        rgba = np.asarray(image.convert("RGBA")).astype(np.int64)
        colours, alpha = rgba[..., :3], rgba[..., 3]
        is_plain = np.ptp(colours.reshape(-1, 3), axis=0).max() == 0
        if 0.01 < np.mean(alpha == 0) < 1 or (is_plain and (np.ptp(alpha) or not alpha.any())):
            solid = np.unique(colours[alpha == alpha.max()], axis=0)
            require(not 2 <= len(solid) <= 20, "classes")
            return np.floor(alpha * 255.0 / max(1, alpha.max()) + 0.5).astype(np.uint8)
        vivid = colours.max(axis=2) - colours.min(axis=2) > 16
        used = np.unique(colours.reshape(-1, 3), axis=0).tolist()
        if (vivid.any() or image.mode == "P") and len(used) == 2 and used[0] == [0, 0, 0]:
            return np.where(colours.any(axis=2), 255, 0).astype(np.uint8)
        require(not vivid.any(), "classes")
        grey = np.asarray(image.convert("RGB").convert("L"))
    require(not 3 <= np.unique(grey).size <= 20 or grey.max() == 255, "classes")
    return grey


def langsplat(
    maps: Path, vectors: Path, size_hw: tuple[int, int]
) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Return level, pixels and unit vector of each mask of the maps s, m and l."""
    try:
        rows, features = array(maps), array(vectors)
    except Exception as error:
        raise Meaningless(str(error)) from error
    require(rows.shape == (4, *size_hw) and features.ndim == 2 and features.dtype.kind == "f", "shape")
    require(np.isfinite(rows).all() and np.isfinite(features).all(), "finite")
    require((rows == np.rint(rows)).all() and rows.min() >= -1 and rows.max() < len(features), "rows")
    found = []
    for level, plane in zip((3, 2, 1), rows[1:], strict=True):
        for row in np.unique(plane[plane >= 0]):
            vector = features[int(row)].astype(np.float64)
            largest = np.abs(vector).max(initial=0)
            vector = vector / largest / np.linalg.norm(vector / largest) if largest else vector
            found.append((level, plane == row, vector))
    return found


def source_from_training(dataparser: Path, saved: Path) -> np.ndarray:
    """Return the inverse of x -> scale / applied_scale * transform @ inverse(applied_transform) @ x."""

    def matrix(value: Any) -> np.ndarray:
        try:
            return rigid(np.array(value, np.float64))
        except (TypeError, ValueError) as error:
            raise Meaningless(str(error)) from error

    def scale(value: Any) -> float:
        require(type(value) in (int, float) and 0 < value < math.inf, "scale")
        return float(value)

    content, before = json_object(dataparser), json_object(saved)
    require("transform" in content and "scale" in content, "keys")
    applied = matrix(before["applied_transform"]) if "applied_transform" in before else np.eye(4)
    training = matrix(content["transform"]) @ np.linalg.inv(applied)
    training[:3] *= scale(content["scale"]) / scale(before.get("applied_scale", 1.0))
    return np.linalg.inv(training)
