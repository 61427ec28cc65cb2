"""Labels, maps and annotations drawn on photographs are moved to the undistorted views.

The object is a disc of viewing directions, so its pixels in every lens are known: a pixel belongs to it if
its ray does. Rays are computed here, without COLMAP.
"""

import functools
import io
import json
import logging
import zipfile
from dataclasses import replace
from typing import get_args

import cv2
import numpy as np
import pytest
from pycocotools import mask as coco_masks

from hilsplat.annotate.exchange import Kind, exported, imported
from hilsplat.annotate.labels import Label, known_labels, write_labels
from hilsplat.base.errors import MisalignedArtifactError, SceneError
from hilsplat.datasets.images.hi import open_annotated
from hilsplat.datasets.labelled import LabelledRegion, LabelledScene
from hilsplat.embed.langsplat_files import read_view
from hilsplat.evaluate.protocols.view_truth import truths_of
from hilsplat.scene.cameras import Camera, Cameras, Photo
from hilsplat.scene.scene import Scene
from hilsplat.web.file_changes import NO_FILE

VIEW = "000.png"
SIZE = HEIGHT, WIDTH = 150, 200
K = np.array([[170.0, 0, 100], [0, 170.0, 75], [0, 0, 1]])


def radial(xy: np.ndarray, k: float = 0.2) -> np.ndarray:
    """Undistorted coordinates of COLMAP's SIMPLE_RADIAL model, by fixed-point iteration."""
    plain = xy.copy()
    for _ in range(25):
        plain = xy / (1 + k * (plain**2).sum(axis=-1, keepdims=True))
    return plain


def equidistant(xy: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(xy, axis=-1, keepdims=True)
    return xy * np.tan(angle) / np.maximum(angle, 1e-9)


PHOTOS = {  # photograph, its principal point, and the undistortion of (pixel - principal point) / 170
    "distorted": (Photo("SIMPLE_RADIAL", (170.0, 120.0, 90.0, 0.2), (180, 240)), (120, 90), radial),
    "fisheye": (Photo("SIMPLE_FISHEYE", (170.0, 120.0, 90.0), (180, 240)), (120, 90), equidistant),
    "cropped": (Photo("PINHOLE", (170.0, 170.0, 130.0, 84.0), (190, 240)), (130, 84), lambda xy: xy),
}


def disc(size_hw, centre, focal: float, undistort=lambda xy: xy) -> np.ndarray:
    """Pixels whose ray (x, y, 1) is in a disc off the centre."""
    rows, columns = np.mgrid[: size_hw[0], : size_hw[1]] + 0.5
    rays = undistort((np.stack([columns, rows], axis=-1) - centre) / focal)
    return np.linalg.norm(rays - [0.3, 0.15], axis=-1) < 0.22


SEEN = disc(SIZE, (100, 75), 170)


@functools.cache
def drawn(kind: str, scale: float = 1.0) -> np.ndarray:
    photo, centre, undistort = PHOTOS[kind]
    size_hw = tuple(round(side * scale) for side in photo.size_hw)
    return disc(size_hw, np.multiply(centre, scale), 170 * scale, undistort)


def outline(mask: np.ndarray) -> list[list[int]]:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return max(contours, key=len).reshape(-1, 2).tolist()


def iou(mask: np.ndarray) -> float:
    return (mask & SEEN).sum() / (mask | SEEN).sum()


def cameras_of(kind: str, names=(VIEW,)) -> Cameras:
    eyes, sizes = np.tile(np.eye(4), (len(names), 1, 1)), np.tile(np.int32([SIZE]), (len(names), 1))
    return Cameras(names, eyes, np.tile(K, (len(names), 1, 1)), sizes, dict.fromkeys(names, PHOTOS[kind][0]))


def scene_of(cameras: Cameras, folder) -> Scene:
    none = np.zeros((0, 3), np.float32)
    split = dict.fromkeys(cameras.names, "train")
    return Scene(folder, "photos/desk", "metre", cameras, split, none, none.astype(np.uint8), np.eye(4))


def write_isat(folder, view: str, mask: np.ndarray, **keys) -> None:
    points = outline(mask)
    bbox = [*np.min(points, axis=0).tolist(), *np.max(points, axis=0).tolist()]
    thing = {"category": "ball", "segmentation": points, "bbox": bbox, **keys}
    info = {"name": view, "height": mask.shape[0], "width": mask.shape[1]}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{view[:-4]}.json").write_text(json.dumps({"info": info, "objects": [thing]}))


KINDS = pytest.mark.parametrize("kind", PHOTOS)
SCALES = pytest.mark.parametrize("scale", [1, 0.5, 4])
LEAST = 0.97
"""A border of half a pixel around the disc is 3 % of its area, or 6 % on a drawing of half the size."""

MOVED = 0.94  # a row more moves pixels by up to one; the map from the photograph would leave 0.74


def least(scale: float) -> float:
    return LEAST if scale >= 1 else 0.94


@KINDS
@SCALES
def test_labels_are_scored_where_the_view_shows_them(kind, scale, tmp_path):
    write_isat(tmp_path / "photos/desk", VIEW, drawn(kind, scale))
    known = open_annotated(tmp_path, "photos/desk")
    (query,) = truths_of(known, scene_of(cameras_of(kind), tmp_path), 0)[VIEW]().categories
    assert iou(query.truth) > least(scale)
    rows, columns = np.flatnonzero(SEEN.any(axis=1)), np.flatnonzero(SEEN.any(axis=0))
    ((*box,),) = query.boxes_xyxy.tolist()
    # The extent of a box that is bent by the lens is larger than that of the round object in it.
    slack = 3 + 2 / min(scale, 1)
    assert np.abs(np.subtract(box, [columns[0], rows[0], columns[-1], rows[-1]])).max() <= slack


@KINDS
def test_each_box_of_a_label_is_moved_and_one_outside_the_view_is_omitted(kind):
    camera = cameras_of(kind)[VIEW]
    size_hw = camera.photo.size_hw
    region = LabelledRegion(
        "ball", size_hw, lambda: np.ones(size_hw, bool), np.array([[115, 85, 125, 95], [0, 0, 0, 0]])
    )
    placed = region.on(camera, "label")
    (near,) = placed.boxes()  # the pixel in the corner of the photograph is outside the view
    x, y = np.array(PHOTOS[kind][1]) - [100, 75]  # all lenses are undistorted at the centre
    assert np.abs(near - [115 - x, 85 - y, 125 - x, 95 - y]).max() <= 1
    assert placed.size_hw == placed.mask().shape == SIZE and placed.mask().all()  # all is in the photograph


@KINDS
@SCALES
def test_the_annotator_opens_labels_of_the_photograph(kind, scale, tmp_path):
    write_isat(tmp_path, VIEW, drawn(kind, scale), id=1, level=1, parent=None)
    ((label,),) = known_labels(tmp_path, cameras_of(kind), [VIEW]).values()
    assert iou(label.mask(SIZE)) > least(scale) and label.text == "ball"


@pytest.fixture
def drawn_before() -> tuple[dict[str, list[Label]], Cameras, Cameras]:
    """A label of the view, the cameras with which it was drawn, and those of a slightly different lens.

    The view is one pixel higher then, so the label's size has the shape of the photograph.
    """
    cameras = cameras_of("distorted")
    label = Label(id=1, level=1, text="ball", polygons=[outline(SEEN)])
    return {VIEW: [label]}, cameras, replace(cameras, size_hw=np.int32([(HEIGHT + 1, WIDTH)]))


def test_annotations_stay_in_place_if_the_lens_is_estimated_again(drawn_before, tmp_path):
    known, _, cameras = drawn_before
    write_labels(tmp_path / "photos/desk/000.json", VIEW, SIZE, known[VIEW], NO_FILE)
    ((label,),) = known_labels(tmp_path / "photos/desk", cameras, [VIEW]).values()
    assert iou(label.mask(SIZE)) > MOVED
    labels = open_annotated(tmp_path, "photos/desk")
    (query,) = truths_of(labels, scene_of(cameras, tmp_path), 0)[VIEW]().categories
    assert iou(query.truth[:HEIGHT]) > MOVED


@pytest.mark.parametrize("kind", get_args(Kind))
def test_exported_annotations_stay_in_place_if_the_lens_is_estimated_again(kind, drawn_before):
    known, before, cameras = drawn_before
    data = exported(kind, known, before)
    text = data if kind == "coco" else zipfile.ZipFile(io.BytesIO(data)).read("000.json")
    ((label,),) = imported("000.json", text.decode(), cameras).values()
    assert iou(label.mask(SIZE)) > MOVED


@KINDS
@SCALES
@pytest.mark.parametrize("form", ["COCO polygons", "COCO run lengths", "labelme", "ISAT"])
def test_annotations_of_the_photograph_are_imported_where_the_view_shows_them(kind, scale, form):
    mask = drawn(kind, scale)
    height, width = mask.shape
    runs = coco_masks.encode(np.asfortranarray(mask, np.uint8))
    flat = (np.array(outline(mask)) + 0.5).ravel().tolist()
    region = [flat] if form == "COCO polygons" else {**runs, "counts": runs["counts"].decode()}
    content = {
        "images": [{"id": 1, "file_name": "000.jpg", "height": height, "width": width}],
        "categories": [{"id": 1, "name": "ball"}],
        "annotations": [{"image_id": 1, "category_id": 1, "segmentation": region}],
    }
    if form == "labelme":
        shape = {"label": "ball", "points": outline(mask), "shape_type": "polygon"}
        content = {"imagePath": "000.jpg", "imageHeight": height, "imageWidth": width, "shapes": [shape]}
    if form == "ISAT":
        thing = {"category": "ball", "segmentation": outline(mask)}
        content = {"info": {"name": "000.jpg", "height": height, "width": width}, "objects": [thing]}
    (label,) = imported("x.json", json.dumps(content), cameras_of(kind))[VIEW]
    # COCO's polygon through the border pixels' centres lacks their outer halves.
    assert iou(label.mask(SIZE)) > least(scale) - 0.03 * (form == "COCO polygons")


@KINDS
@SCALES
def test_langsplats_maps_of_the_photograph(kind, scale, tmp_path):
    mask = drawn(kind, scale)
    maps = np.full((4, *mask.shape), -1, np.float32)
    maps[1:, mask] = 0
    np.save(tmp_path / "000_s.npy", maps)
    np.save(tmp_path / "000_f.npy", np.eye(1, 8, dtype=np.float32))
    masks, vectors = read_view(tmp_path, VIEW, cameras_of(kind)[VIEW])
    assert len(masks) == len(vectors) == 3
    assert min(iou(dense) for dense in masks.dense()) > least(scale)


def test_drawings_that_fit_neither_view_nor_photograph_are_refused(tmp_path):
    scene = scene_of(cameras_of("distorted"), tmp_path)
    write_isat(tmp_path / "photos/desk", VIEW, np.ones((100, 200), bool))
    message = r"200 x 150 px \(undistorted\) or 240 x 180 px \(photograph\)(.|\n)*200 x 100 px"
    with pytest.raises(MisalignedArtifactError, match=message):
        truths_of(open_annotated(tmp_path, "photos/desk"), scene, 0)


# -- labelled photographs without a pose -------------------------------------------------------------


@pytest.mark.parametrize(("labelled", "lost"), [(2, 1), (5, 2), (3, 0)])
def test_labels_of_views_without_a_pose_are_skipped_with_one_line(labelled, lost, tmp_path, caplog):
    names = [f"{number:03d}.png" for number in range(labelled)]
    for name in names:
        write_isat(tmp_path / "photos/desk", name, drawn("distorted"))
    scene = scene_of(cameras_of("distorted", tuple(names[lost:])), tmp_path)
    with caplog.at_level(logging.WARNING):
        truths = truths_of(open_annotated(tmp_path, "photos/desk"), scene, 0)
    assert list(truths) == names[lost:]
    lines = [line for line in caplog.messages if "no pose" in line]
    assert len(lines) == (lost > 0) and all(name in line for line in lines for name in names[:lost])


@pytest.mark.parametrize(("dataset", "lost"), [("annotated", 2), ("lerf_ovs", 1)])
def test_too_few_labelled_views_or_an_incomplete_published_set_are_refused(dataset, lost, tmp_path):
    names = [f"{number:03d}.png" for number in range(3)]
    for name in names:
        write_isat(tmp_path / "photos/desk", name, drawn("distorted"))
    known = open_annotated(tmp_path, "photos/desk")
    if dataset != "annotated":
        known = LabelledScene(dataset, "ramen", {}, None, known.views)
    with pytest.raises(SceneError, match=rf"have no pose: {', '.join(names[:lost])}\n"):
        truths_of(known, scene_of(cameras_of("distorted", tuple(names[lost:])), tmp_path), 0)


def test_a_view_of_which_the_photograph_is_unknown_takes_scaled_copies_only(tmp_path):
    camera = Camera(VIEW, np.eye(4), K, SIZE)
    region = LabelledRegion("ball", (2 * HEIGHT, 2 * WIDTH), lambda: SEEN.repeat(2, 0).repeat(2, 1))
    np.testing.assert_array_equal(region.on(camera, "label").mask(SIZE), SEEN)
    with pytest.raises(MisalignedArtifactError, match=r"label does not match.*\n.*200 x 150(.|\n)*240 x 190"):
        LabelledRegion("ball", (190, 240), lambda: drawn("cropped")).on(camera, "label")
