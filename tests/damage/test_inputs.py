"""Damaged input files raise an error that names them, and accepted input is always usable."""

import json
import re
import shutil
import struct
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, note, settings
from hypothesis import strategies as st
from PIL import ExifTags, Image
from pycocotools import mask as coco_masks

from hilsplat.annotate.exchange import imported
from hilsplat.annotate.labels import Label
from hilsplat.base.errors import HilsplatError
from hilsplat.base.images import read_image, read_mask
from hilsplat.configuration import read_config
from hilsplat.embed.langsplat_files import read_view
from hilsplat.photos.intake import unpack_photographs
from hilsplat.scene.cameras import Camera, Cameras
from hilsplat.scene.importers.known_views import KnownView, Source
from hilsplat.scene.importers.reading import read_source
from hilsplat.scene.layouts import find_known_poses
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.splat.coordinates import decompose, source_from_dataparser
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import import_ply, load_ply, save_ply
from hilsplat.workflow.plan import Plan
from tests.conftest import PROJECT
from tests.damage import oracles
from tests.damage.mutations import mutated, mutated_bytes, mutated_json, mutated_lines
from tests.unit.round_gaussians import round_gaussians

ODD_YAML = (
    *("", "{", "]", "\t", ": ", "- ", "&a ", "*a", "!!binary "),
    *("1e999", ".nan", "null", "yes", "\0", "é", "'"),
)
ANY = settings(suppress_health_check=list(HealthCheck))


def accepted(read: Callable[[], Any]) -> Any:
    """Return the result of a reader, or None if it refuses with a message."""
    try:
        found = read()
    except HilsplatError as error:
        assert str(error).strip()
        event("refused")
        return None
    event("accepted")
    return found


@pytest.mark.parametrize("name", ["config.yaml", "paper.yaml", "demo.yaml"])
@given(rnd=st.randoms(use_true_random=True))
@ANY
def test_configurations(name: str, rnd: Random, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path, lines = tmp_path / name, (PROJECT / "config" / name).read_text().splitlines()
    for _ in range(rnd.randint(1, 3)):
        lines = mutated_lines(rnd, lines, ODD_YAML)
    path.write_text("\n".join(lines), encoding="utf-8")
    found = accepted(lambda: read_config(path))
    if found is not None:
        accepted(lambda: Plan({"groups": ["ci"], "only": [], **found, "scenes": "config/scenes.tsv"}))


@dataclass(frozen=True)
class Case:
    """Files of a format that are mutated, the reader, and a comparison of its result with the oracle's."""

    files: list[Path]
    read: Callable[[], Any]
    check: Callable[[Any], None]


POSES = (
    ((0.8, 0.6, 0.0, 0.0), (0.5, -1.25, 2.0)),
    ((0.5, 0.5, -0.5, 0.5), (-3.5, 0.25, 1.5)),
    ((0.36, 0.48, 0.64, 0.48), (2.75, 3.5, -0.5)),
)
"""Quaternion (wxyz) and translation of three poses with short decimal fractions."""
CENTRE = {"cx": 19.5, "cy": 16.25}
IMAGES = ("cam1/a.png", "cam2/a.png", "b.png")
POINTS = np.array([[0.5, 1.25, 4, 10, 20, 30], [2.5, -1, 6, 40, 50, 60], [-1.5, 0.75, 5, 70, 80, 90]])


def write_pictures(folder: Path, names: Sequence[str]) -> None:
    for row, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (40, 30), (20 * row, 0, 0)).save(folder / name)


def write_model(folder: Path, suffix: str) -> None:
    """Write a COLMAP model with three lens models, three images and three points, byte by byte."""
    write_pictures(folder / "images", IMAGES)
    place = folder / "sparse/0"
    place.mkdir(parents=True)
    lenses = [
        (1, 1, "PINHOLE", [50.5, 51.25, 19.5, 16.25]),
        (2, 4, "OPENCV", [48.5, 49.25, 20.5, 14.75, 0.05, -0.02, 0.001, 0.002]),
        (5, 2, "SIMPLE_RADIAL", [45.75, 20.25, 15.5, 0.125]),
    ]
    seen = [(12.5, 8.25, 7), (30.25, 20.5, -1), (5.75, 6.5, 9)]
    if suffix == "bin":
        head = struct.pack("<Q", 3)
        cameras = b"".join(
            struct.pack(f"<IiQQ{len(params)}d", number, model, 40, 30, *params)
            for number, model, _, params in lenses
        )
        images = b"".join(
            struct.pack("<I7dI", row + 1, *quat, *shift, lenses[row][0]) + name.encode() + b"\0"
            + struct.pack("<Q", 3) + b"".join(struct.pack("<ddq", *each) for each in seen)
            for row, (name, (quat, shift)) in enumerate(zip(IMAGES, POSES, strict=True))
        )  # fmt: skip
        points = b"".join(
            struct.pack("<Q3d3BdQII", 7 + row, *point[:3], *point[3:].astype(int), 0.5, 1, 1, 0)
            for row, point in enumerate(POINTS)
        )
        contents = [head + rows for rows in (cameras, images, points)]
    else:

        def line(*values) -> str:
            return " ".join(map(str, values)) + "\n"

        cameras = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n" + "".join(
            line(number, model, 40, 30, *params) for number, _, model, params in lenses
        )
        images = "# Number of images: 3\n" + "".join(
            line(row + 1, *quat, *shift, lenses[row][0], name) + line(*(x for each in seen for x in each))
            for row, (name, (quat, shift)) in enumerate(zip(IMAGES, POSES, strict=True))
        )
        points = "".join(
            line(7 + row, *point[:3], *point[3:].astype(int), 0.5, 1, 0) for row, point in enumerate(POINTS)
        )
        contents = [text.encode() for text in (cameras, images, points)]
    for name, content in zip(("cameras", "images", "points3D"), contents, strict=True):
        (place / f"{name}.{suffix}").write_bytes(content)


def world_from_camera(row: int) -> np.ndarray:
    return oracles.from_quaternion(*POSES[row])


def write_transforms(folder: Path, kind: str) -> None:
    write_pictures(folder / "images", IMAGES)
    lens = {"fl_x": 50.5, "fl_y": 51.25, **CENTRE, "w": 40, "h": 30}
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": world_from_camera(row).tolist()}
        for row, name in enumerate(IMAGES)
    ]
    if kind == "shared":
        coefficients = {"k1": 0.05, "k2": -0.02, "p1": 0.001, "p2": 0.002, "camera_model": "OPENCV"}
        content = {**lens, **coefficients, "ply_file_path": "points.ply", "aabb_scale": 16, "frames": frames}
        write_points(folder / "points.ply")
    else:
        frames[0] |= {**lens, "k1": 0.05}
        frames[1] |= {"camera_angle_x": 0.75, "w": 40, "h": 30}
        frames[2]["file_path"] = "images/b"
        content = {**lens, "is_fisheye": True, "k4": 0.01, "frames": frames}
        content |= {
            "train_filenames": [f"images/{name}" for name in IMAGES[1:]],
            "test_filenames": ["images/cam1/a.png"],
        }
    (folder / "transforms.json").write_text(json.dumps(content))


def write_points(path: Path) -> None:
    kinds = [("x", "float"), ("y", "float"), ("z", "double")]
    kinds += [(channel, "uchar") for channel in ("red", "green", "blue")]
    write_ply(path, "ascii", kinds, POINTS)


def write_ply(path: Path, form: str, kinds: list[tuple[str, str]], rows: np.ndarray) -> None:
    head = f"ply\nformat {form} 1.0\ncomment by a test\nelement vertex {len(rows)}\n"
    head += "".join(f"property {kind} {name}\n" for name, kind in kinds) + "end_header\n"
    types = [(name, ("<" if "little" in form else ">") + oracles.PLY_TYPES[kind]) for name, kind in kinds]
    if form == "ascii":
        lines = (
            " ".join(
                f"{x:g}" if kind[1] != "uchar" else str(int(x)) for x, kind in zip(row, kinds, strict=True)
            )
            for row in rows
        )
        body = "".join(f"{line}\n" for line in lines).encode()
    else:
        body = np.array([tuple(row) for row in rows], types).tobytes()
    path.write_bytes(head.encode() + body)


def write_polycam(folder: Path) -> None:
    names = ["100.png", "200.png", "300.png"]
    write_pictures(folder / "keyframes/images", names)
    (folder / "keyframes/cameras").mkdir()
    for row, name in enumerate(names):
        matrix = world_from_camera(row)
        content = {f"t_{i}{j}": matrix[i, j] for i in range(3) for j in range(4)}
        content |= {"fx": 50.5, "fy": 51.25, **CENTRE, "width": 40, "height": 30, "timestamp": 5}
        (folder / f"keyframes/cameras/{Path(name).stem}.json").write_text(json.dumps(content))


def write_record3d(folder: Path, per_frame: bool) -> None:
    write_pictures(folder / "rgb", ["0.png", "1.png", "2.png"])
    poses = [[*quat[1:], quat[0], *position] for quat, position in POSES]
    content = {"K": [50.5, 0, 0, 0, 51.25, 0, 19.5, 16.25, 1], "w": 40, "h": 30, "fps": 60, "poses": poses}
    if per_frame:
        content["perFrameIntrinsicCoeffs"] = [[50.5 + row, 51.25, 19.5, 16.25] for row in range(3)]
    (folder / "metadata").write_text(json.dumps(content))


def write_llff(folder: Path) -> None:
    write_pictures(folder / "images", ["a.png", "b.png", "c.png"])
    rows = []
    for row in range(3):
        right, up, back, position = world_from_camera(row)[:3].T
        matrix = np.column_stack([-up, right, back, position, [60, 80, 101]])
        rows.append([*matrix.ravel(), 0.5, 9.5])
    np.save(folder / "poses_bounds.npy", np.array(rows))


def require_same_views(source: Source, expected: oracles.Views) -> None:
    """Fail if an accepted view differs from the oracle's, or if anything is missing without a reason."""
    for view in source.views:
        same = [each for name, each in expected.views if name == view.name and each is not None]
        problems = [difference(view, each) for each in same]
        assert None in problems, f"{view.name}: {problems or 'not a valid view'}"
    used = {view.name for view in source.views}
    lost = [name for name, _ in expected.views if name not in used and not source.left_out.get(name)]
    assert not lost, f"missing without a reason: {lost}"
    images = [view.image for view in source.views if view.image is not None]
    assert len(images) == len(set(images)), "one image for several views"
    silent = [key for key in expected.reported if not any(key in note for note in source.notes)]
    assert not silent, f"not reported: {silent}"
    points = expected.points if expected.points is not None else np.zeros((0, 6))
    finite = points[np.isfinite(points[:, :3]).all(axis=1)]
    if len(finite) < len(points):
        assert any("not finite" in note for note in source.notes)
    found = np.hstack(source.points) if source.points is not None else np.zeros((0, 6))
    np.testing.assert_array_equal(sorted(found.tolist()), sorted(finite.tolist()))


def difference(view: KnownView, expected: oracles.View) -> str | None:
    """Return the first difference between an accepted view and its meaning."""
    camera = view.camera
    params = dict(zip(camera.params_info.split(", "), camera.params, strict=True))
    model = camera.model_name
    if expected.model in ("perspective", "fisheye"):
        model = "fisheye" if "FISHEYE" in model else "perspective"
        if "f" in params:
            params["fx"] = params["fy"] = params.pop("f")
    names = params.keys() | expected.params.keys()
    lens = [[each.get(name, 0.0) for name in sorted(names)] for each in (params, expected.params)]
    checks = {
        "model": model == expected.model,
        "lens": np.allclose(*lens, rtol=1e-12, atol=0),
        "valid lens": np.isfinite(lens[0]).all() and min(params.get("f", 1), params.get("fx", 1)) > 0,
        "size": (camera.width, camera.height) == expected.size
        and 0 < min(expected.size) <= max(expected.size) <= 2**15,
        "pose": np.allclose(view.cam_from_source, expected.pose, rtol=1e-9, atol=1e-9),
        "place": np.abs(view.cam_from_source).max() <= 1e9,
        "image": view.image in expected.images,
        "split": expected.is_test in (None, view.is_test),
    }
    return next((name for name, is_equal in checks.items() if not is_equal), None)


def posed(
    write: Callable[[Path], None], pattern: str, oracle: Callable[[Path], oracles.Views]
) -> Callable[[Path], Case]:
    def build(folder: Path) -> Case:
        write(folder)

        def check(source: Source) -> None:
            require_same_views(source, oracle(folder))

        return Case(sorted(folder.glob(pattern)), lambda: read_source(find_known_poses(folder)), check)

    return build


def gaussian_ply(form: str) -> Callable[[Path], Case]:
    """A PLY of 3DGS with degree 1, and in the binary form Mip-Splatting's filter."""

    def build(folder: Path) -> Case:
        path, random = folder / "point_cloud.ply", np.random.default_rng(0)
        names = [*("x", "y", "z", "nx", "ny", "nz"), *(f"f_dc_{k}" for k in range(3))]
        names += [*(f"f_rest_{k}" for k in range(9)), "opacity", *(f"scale_{k}" for k in range(3))]
        names += [*(f"rot_{k}" for k in range(4)), *(["filter_3D"] if form != "ascii" else [])]
        rows = random.normal(size=(40, len(names))).round(3)
        write_ply(path, form, [(name, "float") for name in names], rows)

        def check(found: tuple[Gaussians, list[str], list[str]]) -> None:
            (gaussians, notes, unknown), (values, total) = found, oracles.gaussians(path)
            sh = gaussians.sh[:, 1:].transpose(0, 2, 1).reshape(len(gaussians), -1)
            own = (gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits[:, None])
            own = np.hstack([*own, gaussians.sh[:, 0], sh])
            np.testing.assert_allclose(own, values, rtol=1e-4, atol=1e-4)
            lost = total - len(values)
            assert not lost or any(f"{lost} of {total}" in note for note in notes)
            others = oracles.ply_vertices(path).keys() - set(names) - {"filter_3D"}
            assert {re.sub(r"\d+$", "*", name) for name in others} <= {*unknown, "nx", "ny", "nz", "id"}

        return Case([path], lambda: import_ply(path, "export it again"), check)

    return build


SIZE_HW = (24, 42)
BOX = [[2.0, 3.0], [10.0, 3.0], [10.0, 12.0], [2.0, 12.0]]
DISK = (np.hypot(*(np.indices(SIZE_HW) - [[[12]], [[20]]])) < 8).astype(np.uint8)
DISK_RUNS = coco_masks.encode(np.asfortranarray(DISK))["counts"].decode()
ANNOTATIONS: dict[str, Any] = {
    "labelme": {
        "imagePath": "000.png", "imageHeight": 24, "imageWidth": 42,
        "shapes": [
            {"label": "mug", "points": BOX, "shape_type": "polygon", "group_id": 1, "level": 2},
            {"label": "cup", "points": BOX[::2], "shape_type": "rectangle", "group_id": 1},
            {"label": "dot", "points": [[20.0, 10.5], [24.0, 10.5]], "shape_type": "circle"},
            {"label": "cup", "points": [[30, 5], [38.5, 9], [31, 20]], "group_id": 1},
        ],
    },
    "coco": {
        "images": [{"id": 1, "file_name": "000.png", "height": 24, "width": 42}],
        "categories": [{"id": 7, "name": "mug"}, {"id": 8, "name": "rim"}],
        "annotations": [
            {"id": 1, "image_id": 1, "category_id": 7, "segmentation": [[2, 3, 10, 3, 10, 12]], "iscrowd": 0},
            {"id": 2, "image_id": 1, "category_id": 8, "iscrowd": 1,
             "segmentation": {"size": [24, 42], "counts": [50, 20, 938]}},
            {"id": 3, "image_id": 1, "category_id": 7,
             "segmentation": {"size": [24, 42], "counts": DISK_RUNS}},
        ],
    },
    "isat": {
        "info": {"name": "000.png", "height": 24, "width": 42},
        "objects": [
            {"category": "mug", "group": 1, "segmentation": BOX, "bbox": [2, 3, 10, 12], "level": 1,
             "id": 1, "parent": None},
            {"category": "rim", "group": 2, "segmentation": [[3, 4], [9.5, 4], [9, 8]], "level": 2,
             "id": 2, "parent": 1},
            {"category": "cup", "group": 2, "segmentation": [[[20, 4], [30, 4], [30, 20]], BOX]},
        ],
    },
}  # fmt: skip
ORACLES = {"labelme": oracles.labelme, "coco": oracles.coco_file, "isat": oracles.isat}


def annotations(name: str) -> Callable[[Path], Case]:
    K = np.array([[30.0, 0, 21], [0, 30, 12], [0, 0, 1]])
    cameras = Cameras(("000.png",), np.eye(4)[None], K[None], np.array([SIZE_HW], np.int32))

    def build(folder: Path) -> Case:
        path = folder / "000.json"
        path.write_text(json.dumps(ANNOTATIONS[name]))

        def read() -> tuple[dict[str, list[Label]], list[str]]:
            notes: list[str] = []
            return imported("000.json", path.read_text(encoding="utf-8"), cameras, notes), notes

        def check(found: tuple[dict[str, list[Label]], list[str]]) -> None:
            labels, notes = found
            assert labels.keys() <= {"000.png"}
            regions = ORACLES[name](oracles.json_object(path), SIZE_HW)
            require_same_regions(labels.get("000.png", []), regions, notes)

        return Case([path], read, check)

    return build


def require_same_regions(
    labels: Sequence[Label], regions: Sequence[oracles.Region | None], notes: Sequence[str]
) -> None:
    """Fail if a label isn't the union of pieces of one object, or if pieces are missing without a note."""
    rest: dict[Any, list[oracles.Region]] = {}
    for row, region in enumerate(regions):
        if region is not None and region.mask.any():
            key = row if region.thing is None else (region.text, repr(region.thing))
            rest.setdefault(key, []).append(region)
    for label in labels:
        mask = label.mask(SIZE_HW)

        def is_label(pieces: Sequence[oracles.Region], label=label, mask=mask) -> bool:
            union = np.any([piece.mask for piece in pieces], axis=0)
            same = (" ".join(pieces[0].text.split()), pieces[0].level) == (label.text, label.level)
            parent = label.parent is None or str(label.parent) == str(pieces[0].parent).replace("True", "1")
            return same and parent and np.array_equal(union, mask)

        found = [
            (key, pieces)
            for key, group in rest.items()
            for count in range(1, len(group) + 1)
            for pieces in combinations(group, count)
            if is_label(pieces)
        ]
        assert found or not mask.any(), f"{label.text}, level {label.level}: {mask.sum()} px"
        if found:
            key, pieces = found[-1]
            rest[key] = [region for region in rest[key] if region not in pieces]
    assert notes or not any(rest.values()), f"missing without a note: {[key for key in rest if rest[key]]}"
    assert notes or None not in regions, "an invalid annotation is missing without a note"


def langsplat(folder: Path) -> Case:
    """Maps with overlapping squares, and a vector for each."""
    maps = np.full((4, *SIZE_HW), -1, np.float32)
    for row in range(6):
        maps[row % 4, row : row + 12, 5 * row : 5 * row + 10] = row
    vectors = np.random.default_rng(0).normal(size=(6, 8)).astype(np.float32)
    paths = [folder / f"000_{kind}.npy" for kind in "sf"]
    for path, array in zip(paths, (maps, vectors), strict=True):
        np.save(path, array)

    def check(found: tuple[HierarchicalMasks, np.ndarray]) -> None:
        expected = oracles.langsplat(*paths, SIZE_HW)
        masks, directions = found
        assert len(masks) == len(expected)
        pairs = zip(masks.dense(), masks.level.tolist(), directions.astype(np.float64), strict=True)
        for dense, level, direction in pairs:
            assert any(
                level == known_level
                and np.array_equal(dense, mask)
                and np.allclose(direction, vector, atol=2e-3)
                for known_level, mask, vector in expected
            ), f"level {level}: {direction}"

    return Case(
        paths, lambda: read_view(folder, "000.png", Camera("000.png", np.eye(4), np.eye(3), SIZE_HW)), check
    )


def pictures(
    read: Callable[[Path], np.ndarray], oracle: Callable[[Path], np.ndarray]
) -> Callable[[Path], Case]:
    """One picture of each kind; which one a mutation changed is what the reader reads."""

    def build(folder: Path) -> Case:
        random = np.random.default_rng(0)
        colours = cv2.resize(random.integers(0, 255, (5, 7, 4), np.uint8), SIZE_HW[::-1])
        if read is read_mask:  # several colours would be refused as several classes
            colours[..., 1:3], colours[..., 3] = colours[..., :1], colours[..., 3] // 128 * 255
        rgb, exif = Image.fromarray(colours[..., :3]), Image.Exif()
        exif[ExifTags.Base.Orientation], exif[ExifTags.Base.Model] = 6, "a camera"
        rgb.save(folder / "turned.jpg", exif=exif, quality=90)
        rgb.save(folder / "plain.png")
        rgb.quantize(2).save(folder / "palette.png")
        Image.fromarray(colours).save(folder / "alpha.png")
        Image.fromarray(colours[..., 0].astype(np.uint16) * 257).save(folder / "deep.png")
        Image.fromarray(colours[..., 0] // 128 * 255).convert("1").save(folder / "bits.png")
        files = sorted(folder.iterdir())
        contents = {path: path.read_bytes() for path in files}

        def changed() -> Path:
            return next((path for path in files if path.read_bytes() != contents[path]), files[0])

        def check(pixels: np.ndarray) -> None:
            np.testing.assert_array_equal(pixels, oracle(changed()))

        return Case(files, lambda: read(changed()), check)

    return build


def dataparser(folder: Path) -> Case:
    """nerfstudio's transform to its training coordinates, and the transform that was applied before."""
    paths = [folder / "dataparser_transforms.json", folder / "transforms.json"]
    turn = world_from_camera(0)[:3].tolist()
    applied = [[0, 1, 0, 0.5], [0, 0, 1, 0], [1, 0, 0, 0]]
    paths[0].write_text(json.dumps({"transform": turn, "scale": 0.25}))
    paths[1].write_text(json.dumps({"applied_transform": applied, "applied_scale": 2.0, "frames": []}))

    def read() -> np.ndarray:
        matrix = source_from_dataparser(*paths)
        decompose(matrix)  # as for the Gaussians
        return matrix

    def check(matrix: np.ndarray) -> None:
        expected = oracles.source_from_training(*paths)
        np.testing.assert_allclose(matrix, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())

    return Case(paths, read, check)


def archive(folder: Path) -> Case:
    """A zip with photographs and poses; unpacked files must be complete and unchanged."""
    path, out = folder / "photos.zip", folder / "out"
    contents = {f"scene/images/{name}.png": bytes([row]) * 90 for row, name in enumerate("abc")}
    contents["scene/transforms.json"] = b'{"frames": []}'
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, content in contents.items():
            opened.writestr(name, content, zipfile.ZIP_STORED if name.endswith("a.png") else None)

    def read() -> dict[str, bytes]:
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        unpack_photographs(path, out)
        return {
            file.relative_to(out).as_posix(): file.read_bytes() for file in out.rglob("*") if file.is_file()
        }

    def check(found: dict[str, bytes]) -> None:
        named = [entry.filename for entry in zipfile.ZipFile(path).infolist()]
        other = [name for name in named if name not in contents]  # in a suffix or folder, and not unpacked
        assert found.items() <= contents.items()
        is_whole = len(named) == len(contents) == len(found) + len(other)
        assert is_whole or not found, (
            f"{sorted(found)} of {named}"
        )  # without any photograph, it is refused later

    return Case([path], read, check)


FORMATS: dict[str, Callable[[Path], Case]] = {
    "COLMAP binary": posed(lambda folder: write_model(folder, "bin"), "sparse/0/*", oracles.colmap_binary),
    "COLMAP text": posed(lambda folder: write_model(folder, "txt"), "sparse/0/*", oracles.colmap_text),
    "transforms": posed(lambda f: write_transforms(f, "shared"), "transforms.json", oracles.transforms),
    "transforms per frame": posed(lambda f: write_transforms(f, "frames"), "*.json", oracles.transforms),
    "points": posed(lambda f: write_transforms(f, "shared"), "points.ply", oracles.transforms),
    "Polycam": posed(write_polycam, "keyframes/cameras/*", oracles.polycam),
    "Record3D": posed(lambda folder: write_record3d(folder, False), "metadata", oracles.record3d),
    "Record3D per frame": posed(lambda folder: write_record3d(folder, True), "metadata", oracles.record3d),
    "LLFF": posed(write_llff, "poses_bounds.npy", oracles.llff),
    "Gaussians ASCII": gaussian_ply("ascii"),
    "Gaussians binary": gaussian_ply("binary_little_endian"),
    "ISAT": annotations("isat"),
    "labelme": annotations("labelme"),
    "COCO": annotations("coco"),
    "LangSplat": langsplat,
    "photographs": pictures(read_image, oracles.picture),
    "masks": pictures(read_mask, oracles.mask),
    "dataparser": dataparser,
    "archive": archive,
}


def mutate(rnd: Random, path: Path) -> bytes:
    """Change a file, and return its original content."""
    content = path.read_bytes()
    if path.suffix == ".json" or path.name == "metadata":
        path.write_text(mutated_json(rnd, json.loads(content)), encoding="utf-8")
    else:
        path.write_bytes(mutated(rnd, path))
    return content


@pytest.fixture(params=FORMATS)
def case(request, tmp_path) -> Case:
    return FORMATS[request.param](tmp_path)


def test_intact_files_are_read(case: Case):
    case.check(case.read())


@given(rnd=st.randoms(use_true_random=True))
@ANY
def test_what_is_accepted_is_right(case: Case, rnd: Random):
    path = rnd.choice(case.files)
    original = mutate(rnd, path)
    try:
        found = accepted(case.read)
        if found is not None:
            case.check(found)
    except oracles.Meaningless as error:
        raise AssertionError(f"a damaged file was accepted: {error}") from error
    finally:
        damaged = path.read_bytes()
        path.write_bytes(original)
        note(f"{path}:\n{damaged!r}\ninstead of\n{original!r}")


@given(rnd=st.randoms(use_true_random=True))
@ANY
def test_gaussians(rnd: Random, tmp_path):
    path = tmp_path / "gaussians.ply"
    save_ply(path, round_gaussians(np.arange(15.0).reshape(5, 3), log_scale=-1.0, opacity_logit=1.0))
    path.write_bytes(mutated_bytes(rnd, path.read_bytes()))
    found = accepted(lambda: load_ply(path))
    assert found is None or all(np.isfinite(array).all() for array in vars(found).values())


def with_change(folder: Path, kind: str, file: str, intact: bytes, damaged: bytes) -> Case:
    """Write the files of a format, and replace a part of one of them."""
    case, path = FORMATS[kind](folder), folder / file
    assert intact in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(intact, damaged))
    return case


@pytest.mark.parametrize(
    ("kind", "file", "intact", "damaged", "message"),
    [
        ("points", "points.ply", b"vertex 3", b"vertex 2", "1 rows follow"),
        ("Gaussians ASCII", "point_cloud.ply", b"vertex 40", b"vertex 39", "1 rows follow"),
        ("Gaussians ASCII", "point_cloud.ply", b"\n0.126 ", b"\n0.1_6 ", "underscore"),
        ("Gaussians binary", "point_cloud.ply", b"vertex 40", b"vertex 39", "bytes follow"),
        ("Gaussians binary", "point_cloud.ply", b"filter_3D", b"Filter_3D", "parameters that 3DGS does not"),
        ("COLMAP text", "sparse/0/points3D.txt", b" 40 50 60", b" 40 2.5 60", r"points3D\.txt has colours"),
        ("COLMAP text", "sparse/0/points3D.txt", b" 40 50 60", b" 40 500 60", r"points3D\.txt, line 2"),
        ("COLMAP text", "sparse/0/cameras.txt", b"\n5 SIMPLE", b"\n1 SIMPLE", "same id"),
        ("COLMAP text", "sparse/0/cameras.txt", b" 40 30 ", b" 4_0 30 ", r"cameras\.txt, line 2"),
        ("transforms", "transforms.json", b'"points.ply"', b"16", "with the points, cannot be read"),
        ("dataparser", "dataparser_transforms.json", b'"scale"', b'"Scale"', "scale is not a positive"),
        ("dataparser", "transforms.json", b"[0, 1, 0, 0.5]", b"[0, 2, 0, 0.5]", "not a rotation"),
        ("LangSplat", "000_f.npy", b"(6, 8)", b"(5, 8)", "bytes follow"),
        ("LLFF", "poses_bounds.npy", b"(3, 17)", b"(2, 17)", "bytes follow"),
    ],
)
def test_a_damaged_file_is_refused(kind, file, intact, damaged, message, tmp_path):
    case = with_change(tmp_path, kind, file, intact, damaged)
    with pytest.raises(HilsplatError, match=message):
        case.read()


@pytest.mark.parametrize(
    ("kind", "file", "intact", "damaged", "reason"),
    [
        ("transforms", "transforms.json", b'"k1": 0.05', b'"k1": []', "float"),
        ("transforms", "transforms.json", b'"fl_x": 50.5', b'"fl_x": 0', "focal length"),
        ("transforms per frame", "transforms.json", b'fisheye": true', b'fisheye": "false"', "is_fisheye"),
        ("Record3D", "metadata", b", [0.48, 0.64, 0.48, 0.36, 2.75, 3.5, -0.5]", b"", "only 2 poses"),
    ],
)  # fmt: skip
def test_a_damaged_view_is_left_out(kind, file, intact, damaged, reason, tmp_path):
    source = with_change(tmp_path, kind, file, intact, damaged).read()
    assert source.left_out and all(reason in why for why in source.left_out.values())


@pytest.mark.parametrize(
    ("intact", "damaged", "reason"),
    [(b"938]", b"938.25]", "not whole numbers"), (b'"rim"', b"{}", "categories")],
)
def test_a_damaged_annotation_is_left_out(intact, damaged, reason, tmp_path):
    labels, (sentence,) = with_change(tmp_path, "COCO", "000.json", intact, damaged).read()
    assert len(labels["000.png"]) == 2
    assert "1 of 3 annotations are left out" in sentence and reason in sentence


def test_a_list_of_names_that_is_none_is_reported(tmp_path):
    names = b'"train_filenames": ["images/cam2/a.png", "images/b.png"]'
    change = "transforms per frame", "transforms.json", names, b'"train_filenames": "images/b.png"'
    source = with_change(tmp_path, *change).read()
    assert source.notes == ["train_filenames is not a list of names, and is not used"]


def test_a_picture_with_damaged_pixels_is_refused(tmp_path):
    path = tmp_path / "a.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (24, 42, 3), np.uint8)).save(path)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(HilsplatError, match=r"a\.png cannot be read"):
        read_image(path)


@pytest.mark.parametrize("damage", ["bytes", "count", "size"])
def test_a_damaged_archive_is_refused(damage, tmp_path):
    case = archive(tmp_path)
    path = case.files[0]
    content = bytearray(path.read_bytes())
    central = content.index(b"PK\1\2")  # a record of 46 bytes before each name
    if damage == "bytes":
        content[content.index(b"scene/images/b.png") + 18] ^= 0xFF  # compressed data
    elif damage == "count":
        content[central + 32 : central + 34] = b"\xff\xff"  # the comment of the first file hides all others
    else:
        content[central + 16 : central + 24] = bytes(8)  # checksum and compressed size
    path.write_bytes(content)
    with pytest.raises(HilsplatError, match=r"photos\.zip cannot be unpacked"):
        case.read()
