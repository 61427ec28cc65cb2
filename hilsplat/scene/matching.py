"""Matching of SIFT features between views, and verification by two-view geometry.

The distance measure and limits are COLMAP's. COLMAP's matcher uses approximate neighbours (FAISS); here, all
inner products of descriptors are computed in integers, which takes a third of the time.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import onnxruntime
from jaxtyping import Float64, Int8, Int32, UInt8, UInt32

from hilsplat.base.processes import in_order
from hilsplat.models.network import one_thread_session
from hilsplat.models.onnx_graph import Graph
from hilsplat.scene.colmap import pycolmap
from hilsplat.scene.kernels import two_nearest

MAX_ANGLE = 0.7  # maximum angle between matching descriptors, radians (as in COLMAP)
MAX_RATIO = 0.8  # maximum ratio of the angles to the nearest and the second-nearest descriptor (as in COLMAP)
MIN_MATCHES = 15  # minimum number of matches for a pair to count as matched (as in COLMAP)

_CHANNELS = 128
_LENGTH = 512.0  # length of a descriptor in COLMAP's database
_BLOCK = 128  # descriptors per block; their products fit into the CPU cache


@dataclass(frozen=True, eq=False)
class ViewFeatures:
    """The N features of one view.

    Attributes:
        points: positions, px.
        descriptors: SIFT descriptors of length 512.
        columns: descriptors minus 128, one feature per column.
    """

    image_id: int
    camera: pycolmap.Camera
    points: Float64[np.ndarray, "N 2"]
    descriptors: UInt8[np.ndarray, "N 128"]
    columns: Int8[np.ndarray, "128 N"]


def read_features(database: pycolmap.Database) -> list[ViewFeatures]:
    """Read the features of all views in a database, sorted by view name."""
    cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
    views = []
    for image in sorted(database.read_all_images(), key=lambda image: image.name):
        descriptors = np.ascontiguousarray(database.read_descriptors(image.image_id).data, np.uint8)
        columns = np.ascontiguousarray(descriptors.T ^ np.uint8(128)).view(np.int8)
        points = np.ascontiguousarray(database.read_keypoints(image.image_id)[:, :2], np.float64)
        views.append(ViewFeatures(image.image_id, cameras[image.camera_id], points, descriptors, columns))
    return views


def match_pairs(
    database: pycolmap.Database,
    views: Sequence[ViewFeatures],
    pairs: Sequence[tuple[int, int]],
    options: pycolmap.TwoViewGeometryOptions,
    threads: int,
) -> list[tuple[int, int]]:
    """Match pairs of rows of `views`, write matches and geometries to the database, return verified pairs.

    A pair is verified if its matches fit a two-view geometry. The result does not depend on `threads`.
    """

    def match(pair: tuple[int, int]) -> tuple[UInt32[np.ndarray, "M 2"], pycolmap.TwoViewGeometry]:
        one, other = views[pair[0]], views[pair[1]]
        matches = mutual_matches(one, other)
        if len(matches) < MIN_MATCHES:
            return matches[:0], pycolmap.TwoViewGeometry()
        limits = copy.deepcopy(options)
        # With fewer matches, a larger share of them must be inliers, so RANSAC needs fewer trials.
        min_share = options.min_num_inliers / len(matches)
        limits.ransac.min_inlier_ratio = max(options.ransac.min_inlier_ratio, min_share)
        return matches, pycolmap.estimate_two_view_geometry(
            one.camera, one.points, other.camera, other.points, matches, limits
        )

    verified = []
    with pycolmap.DatabaseTransaction(database):
        matched = zip(pairs, in_order(match, pairs, threads), strict=True)
        for (one, other), (matches, geometry) in matched:
            numbers = views[one].image_id, views[other].image_id
            database.write_matches(*numbers, matches)
            database.write_two_view_geometry(*numbers, geometry)
            if len(geometry.inlier_matches) >= options.min_num_inliers:
                verified.append((one, other))
    return verified


def mutual_matches(one: ViewFeatures, other: ViewFeatures) -> UInt32[np.ndarray, "M 2"]:
    """Return the rows of mutually nearest features within `MAX_ANGLE` that pass the ratio test."""
    rows, columns = len(one.descriptors), len(other.descriptors)
    if not rows or not columns:
        return np.zeros((0, 2), np.uint32)
    products_of = _multiplier(other.columns)
    best, second, column = (np.empty(rows, np.int32) for _ in range(3))
    best_of_column, second_of_column, row_of_column = (np.full(columns, -1, np.int32) for _ in range(3))
    for first in range(0, rows, _BLOCK):
        products = products_of(one.descriptors[first : first + _BLOCK])
        two_nearest(products, first, best, second, column, best_of_column, second_of_column, row_of_column)
    clear = _is_clear(best, second)
    clear &= _is_clear(best_of_column, second_of_column)[column]
    clear &= row_of_column[column] == np.arange(rows)
    matched = np.flatnonzero(clear)
    return np.stack([matched, column[matched]], axis=1).astype(np.uint32)


def _is_clear(best: Int32[np.ndarray, " N"], second: Int32[np.ndarray, " N"]) -> np.ndarray:
    nearest, next_nearest = (np.arccos(np.clip(products / _LENGTH**2, 0, 1)) for products in (best, second))
    return (nearest <= MAX_ANGLE) & (nearest < MAX_RATIO * next_nearest)


def _multiplier(columns: Int8[np.ndarray, "128 N"]) -> Callable[[UInt8[np.ndarray, "R 128"]], np.ndarray]:
    """Return a function that multiplies up to `_BLOCK` descriptors with these columns, exactly."""
    session = _integer_products()
    if session is not None:
        return lambda rows: session.run(None, {"rows": rows, "columns": columns})[0]
    whole = columns.astype(np.float32) + 128
    space = np.empty((_BLOCK, whole.shape[1]), np.float32)  # reused: allocating it is slower than multiplying
    # Sums are below 2**24, so float32 is exact.
    return lambda rows: np.matmul(rows.astype(np.float32), whole, out=space[: len(rows)])


@cache
def _integer_products() -> onnxruntime.InferenceSession | None:
    """Return a session for exact 8-bit matrix products, or None on x86 without VNNI, where sums saturate."""
    from onnx import TensorProto, helper

    graph = helper.make_graph(
        [helper.make_node("MatMulInteger", ["rows", "columns", "", "zero"], ["products"])],
        "products",
        [
            helper.make_tensor_value_info("rows", TensorProto.UINT8, ["R", _CHANNELS]),
            helper.make_tensor_value_info("columns", TensorProto.INT8, [_CHANNELS, "N"]),
        ],
        [helper.make_tensor_value_info("products", TensorProto.INT32, ["R", "N"])],
        [helper.make_tensor("zero", TensorProto.INT8, [], [-128])],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    session = one_thread_session(Graph(model, {}))
    rows = np.full((_BLOCK, _CHANNELS), 255, np.uint8)
    columns = np.repeat(np.array([[-128, 127]], np.int8), _CHANNELS, axis=0)
    products = session.run(None, {"rows": rows, "columns": columns})[0]
    return session if (products == [0, 255 * 255 * _CHANNELS]).all() else None
