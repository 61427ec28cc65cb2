"""Centroid, axis-aligned box and oriented box of each node."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8

from hilsplat.base.levels import Level

BOX_PERCENTILES = (2.0, 98.0)
"""Percentiles of the members' centres that bound a box, so that a few stray Gaussians do not inflate it."""

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class OrientedBox:
    """A box along its own axes.

    Attributes:
        centre: scene units.
        axes: three orthogonal unit vectors, right-handed, the longest side's first.
        size: full length along each axis, scene units.
    """

    centre: Triple
    axes: tuple[Triple, Triple, Triple]
    size: Triple

    @staticmethod
    def from_array(rows: Float[np.ndarray, "5 3"]) -> "OrientedBox":
        """Create a box from its stored form: centre, three axes, sizes."""
        centre, first, second, third, size = ((x, y, z) for x, y, z in np.asarray(rows, np.float64).tolist())
        return OrientedBox(centre, (first, second, third), size)

    def corners(self) -> Float[np.ndarray, "8 3"]:
        """Return the eight corners."""
        signs = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing="ij"), axis=-1).reshape(8, 3)
        return np.asarray(self.centre) + (signs * np.asarray(self.size)) @ np.asarray(self.axes)


def oriented_box(
    points: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, " n"]
) -> Float32[np.ndarray, "5 3"]:
    """Return the box along the weighted points' principal axes, from their 2nd to their 98th percentile.

    Returns:
        centre, three axes (right-handed, longest side first, the largest component of the first two
        positive) and sizes, in the form that `OrientedBox.from_array` reads.
    """
    mean = (weight[:, None] * points).sum(axis=0) / weight.sum()
    centred = points - mean
    covariance = np.einsum("n,ni,nj->ij", weight, centred, centred)
    _, vectors = np.linalg.eigh(covariance)
    axes = vectors.T
    low, high = np.percentile(centred @ axes.T, BOX_PERCENTILES, axis=0)
    order = np.argsort(low - high, kind="stable")
    axes, low, high = axes[order], low[order], high[order]
    sign = np.sign(axes[np.arange(3), np.abs(axes).argmax(axis=1)])
    sign[2] = sign[2] * np.sign(np.linalg.det(axes * sign[:, None]))
    axes = axes * sign[:, None]
    low, high = np.where(sign > 0, low, -high), np.where(sign > 0, high, -low)
    centre = mean + ((low + high) / 2) @ axes
    return np.concatenate([centre[None], axes, (high - low)[None]]).astype(np.float32)


def node_boxes(
    node_of_gaussian: Int32[np.ndarray, "N 3"],
    level: UInt8[np.ndarray, " T"],
    means: Float[np.ndarray, "N 3"],
    mass: Float[np.ndarray, " N"],
) -> tuple[Float32[np.ndarray, "T 3"], Float32[np.ndarray, "T 2 3"], Float32[np.ndarray, "T 5 3"]]:
    """Return each node's centroid, axis-aligned box and oriented box.

    Centroids and axes are weighted by visible mass. No node may be empty (`nodes.renumbered_without_empty`).
    """
    centroid = np.zeros((len(level), 3), np.float32)
    box = np.zeros((len(level), 2, 3), np.float32)
    oriented = np.zeros((len(level), 5, 3), np.float32)
    order = np.argsort(node_of_gaussian, axis=0, kind="stable")
    ids = np.arange(len(level) + 1)
    starts = [np.searchsorted(node_of_gaussian[rows, k], ids) for k, rows in enumerate(order.T)]
    for node, each in enumerate(level):
        index = Level(int(each)).index
        members = order[starts[index][node] : starts[index][node + 1], index]
        weight = mass[members] / mass[members].sum()
        points = means[members]
        centroid[node] = (weight[:, None] * points).sum(axis=0)
        box[node] = np.percentile(points, BOX_PERCENTILES, axis=0)
        oriented[node] = oriented_box(points.astype(np.float64), weight)
    return centroid, box, oriented
