"""Triangle meshes from a few primitives: boxes, lathed profiles, swept tubes, extruded outlines."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import compress, pairwise, product

import numpy as np
from jaxtyping import Float

Number = float | int
Point = tuple[Number, Number, Number]

SMOOTH_BELOW_DEG = 40.0
"""Corners of lathed profiles are shaded smoothly below this angle, and sharply above it."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A mesh of F triangles with a shading normal per corner; z is up."""

    triangles: Float[np.ndarray, "F 3 3"]  # corner positions
    normals: Float[np.ndarray, "F 3 3"]  # unit normals at the corners, pointing outwards

    def __len__(self) -> int:
        return len(self.triangles)

    def moved(self, x: Number = 0.0, y: Number = 0.0, z: Number = 0.0) -> "Mesh":
        return Mesh(self.triangles + np.array([x, y, z]), self.normals)

    def both_sides(self, x: Number, y: Number, z: Number) -> "Mesh":
        """Return two copies in one mesh, moved to (x, -y, z) and (x, y, z)."""
        return joined(self.moved(x, -y, z), self.moved(x, y, z))

    def scaled(self, x: Number, y: Number, z: Number) -> "Mesh":
        """Scale about the origin by positive factors."""
        factors = np.array([x, y, z])
        return Mesh(self.triangles * factors, _unit(self.normals / factors))

    def turned(self, axis: str, degrees: Number) -> "Mesh":
        """Rotate about a coordinate axis, right-handed."""
        rotation = rotation_about(axis, degrees)
        return Mesh(self.triangles @ rotation.T, self.normals @ rotation.T)


def rotation_about(axis: str, degrees: Number) -> Float[np.ndarray, "3 3"]:
    """Return the right-handed rotation matrix about "x", "y" or "z"."""
    angle = np.radians(degrees)
    c, s = np.cos(angle), np.sin(angle)
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    rotation = np.eye(3)
    rotation[first, first] = rotation[second, second] = c
    rotation[first, second], rotation[second, first] = -s, s
    return rotation


def joined(*meshes: Mesh) -> Mesh:
    triangles = np.concatenate([mesh.triangles for mesh in meshes])
    return Mesh(triangles, np.concatenate([mesh.normals for mesh in meshes]))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _flat(triangles: np.ndarray) -> Mesh:
    """Return a flat-shaded mesh of non-degenerate triangles."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return Mesh(triangles, np.repeat(_unit(normal)[:, None], 3, axis=1))


def _fan(polygon: np.ndarray) -> list[np.ndarray]:
    return [np.stack([polygon[0], polygon[i], polygon[i + 1]]) for i in range(1, len(polygon) - 1)]


def _strip(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles between two rows of points: those with an edge on `low`, then those on `high`."""
    return np.stack([low[:-1], low[1:], high[1:]], axis=1), np.stack([low[:-1], high[1:], high[:-1]], axis=1)


def box(size: Point, centre: Point = (0.0, 0.0, 0.0), bevel: Number = 0.0) -> Mesh:
    """Return an axis-aligned box with bevelled edges.

    Args:
        size: lengths along x, y, z.
        bevel: length cut off each edge; a box without a bevel has 12 triangles, otherwise 44.
    """
    half = np.asarray(size, dtype=np.float64) / 2
    bevel = float(min(bevel, 0.45 * 2 * half.min()))
    signs, inset = _box_corners(bevel > 0)
    return _flat(signs * (half - bevel * inset)).moved(*centre)


@cache
def _box_corners(bevelled: bool) -> tuple[Float[np.ndarray, "T 3 3"], Float[np.ndarray, "T 3 3"]]:
    """Return two values per triangle corner and axis: its side (-1 or 1), and whether a bevel insets it.

    A bevel insets a corner along the two axes other than its face's normal.
    """
    triangles: list[np.ndarray] = []

    def corner(signs: Sequence[float] | np.ndarray, full_axis: int) -> np.ndarray:
        return np.stack([np.asarray(signs, dtype=np.float64), 1.0 - np.eye(3)[full_axis]])

    def add(polygon: list[np.ndarray]) -> None:
        corners = np.stack(polygon)  # (corners, 2, 3)
        points = corners[:, 0] * (1.0 - 0.25 * corners[:, 1])
        normal = np.cross(points[1] - points[0], points[2] - points[0])
        if normal @ points.mean(axis=0) < 0:
            corners = corners[::-1]
        triangles.extend(_fan(corners))

    for axis in range(3):
        for sign in (-1.0, 1.0):
            around = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
            add([corner(np.roll((sign, *sides), axis), axis) for sides in around])
    if bevelled:
        for axis in range(3):
            b, c = (axis + 1) % 3, (axis + 2) % 3
            for sides in product((-1.0, 1.0), repeat=2):
                low, high = (np.roll((end, *sides), axis) for end in (-1.0, 1.0))
                add([corner(low, b), corner(high, b), corner(high, c), corner(low, c)])
        for signs in product((-1.0, 1.0), repeat=3):
            add([corner(signs, axis) for axis in range(3)])
    stacked = np.stack(triangles)  # (triangles, 3 corners, 2, 3)
    return stacked[:, :, 0], stacked[:, :, 1]


def lathe(profile: Sequence[tuple[Number, Number]], segments: int = 28) -> Mesh:
    """Return a surface of revolution about z.

    Args:
        profile: distinct (radius, z) points from bottom to top of the outside; normals then point outwards.
        segments: number of facets around the axis.
    """
    points = np.asarray(profile, dtype=np.float64)
    steps = np.diff(points, axis=0)
    normals = _unit(np.stack([steps[:, 1], -steps[:, 0]], axis=1))  # (radial, z) of each piece
    smooth = np.cos(np.radians(SMOOTH_BELOW_DEG))
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ring[-1] = ring[0]
    triangles: list[np.ndarray] = []
    shading: list[np.ndarray] = []
    for i, (low, high) in enumerate(pairwise(points)):
        normal = normals[i]
        below = normals[i - 1] if i > 0 and normals[i - 1] @ normal > smooth else normal
        above = normals[i + 1] if i + 1 < len(normals) and normals[i + 1] @ normal > smooth else normal
        normal_low, normal_high = _unit(normal + below), _unit(normal + above)

        def around(value: np.ndarray) -> np.ndarray:
            out = np.full((len(ring), 3), value[1])
            out[:, :2] = ring * value[0]
            return out

        p0, p1, n0, n1 = around(low), around(high), around(normal_low), around(normal_high)
        extended = (low[0] > 1e-9, high[0] > 1e-9)  # a ring of radius 0 is a point
        triangles += compress(_strip(p0, p1), extended)
        shading += compress(_strip(n0, n1), extended)
    return Mesh(np.concatenate(triangles), _unit(np.concatenate(shading)))


def cylinder(radius: Number, bottom: Number, top: Number, segments: int = 28, bevel: Number = 0.0) -> Mesh:
    """Return a closed upright cylinder about z."""
    if bevel <= 0:
        return lathe([(0, bottom), (radius, bottom), (radius, top), (0, top)], segments)
    lower = [(0, bottom), (radius - bevel, bottom), (radius, bottom + bevel)]
    return lathe([*lower, (radius, top - bevel), (radius - bevel, top), (0, top)], segments)


def ellipsoid(radii: Point, centre: Point = (0.0, 0.0, 0.0), segments: int = 24, rings: int = 12) -> Mesh:
    """Return an ellipsoid with the given semi-axes."""
    return _unit_sphere(segments, rings).scaled(*radii).moved(*centre)


@cache
def _unit_sphere(segments: int, rings: int) -> Mesh:
    angle = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    profile = [(float(np.cos(a)), float(np.sin(a))) for a in angle]
    profile[0], profile[-1] = (0.0, -1.0), (0.0, 1.0)
    return lathe(profile, segments)


def sphere(radius: Number, centre: Point = (0.0, 0.0, 0.0), segments: int = 24) -> Mesh:
    return ellipsoid((radius, radius, radius), centre, segments)


def sweep(
    path: Sequence[Sequence[Number] | np.ndarray] | np.ndarray,
    radius: Number | Sequence[Number],
    segments: int = 12,
) -> Mesh:
    """Return a round tube along a polyline, closed at both ends.

    Args:
        path: points of the centre line.
        radius: radius of the tube, either one for all points or one per point.
        segments: number of facets around the tube.
    """
    points = np.asarray(path, dtype=np.float64)
    radii = np.broadcast_to(np.asarray(radius, dtype=np.float64), (len(points),))
    tangents = _unit(np.gradient(points, axis=0))
    reference = np.eye(3)[np.argmin(np.abs(tangents[0]))]
    side = _unit(np.cross(tangents[0], reference))
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    rings, normals = [], []
    for point, tangent, r in zip(points, tangents, radii, strict=True):
        side = _unit(side - (side @ tangent) * tangent)  # parallel transport, so that the tube does not twist
        other = np.cross(tangent, side)
        direction = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other
        direction[-1] = direction[0]
        rings.append(point + r * direction)
        normals.append(direction)
    triangles: list[np.ndarray] = []
    shading: list[np.ndarray] = []
    for (p0, p1), (n0, n1) in zip(pairwise(rings), pairwise(normals), strict=True):
        triangles += _strip(p0, p1)
        shading += _strip(n0, n1)
    first, last = (np.broadcast_to(end, (segments, 3)) for end in points[[0, -1]])
    caps = (
        np.stack([first, rings[0][1:], rings[0][:-1]], axis=1),
        np.stack([last, rings[-1][:-1], rings[-1][1:]], axis=1),
    )
    tube = Mesh(np.concatenate(triangles), _unit(np.concatenate(shading)))
    return joined(tube, _flat(np.concatenate(caps)))


def arc(
    radii: tuple[Number, Number], start_deg: Number, stop_deg: Number, centre: Point, axis: str = "y"
) -> Float[np.ndarray, "15 3"]:
    """Return an elliptic arc about y or x, as a path for `sweep`; 0 degrees is +x or +y, and 90 is +z."""
    points = np.zeros((15, 3))
    for row, angle in enumerate(np.radians(np.linspace(start_deg, stop_deg, len(points)))):
        points[row, 0 if axis == "y" else 1] = radii[0] * np.cos(angle)
        points[row, 2] = radii[1] * np.sin(angle)
    return points + np.array(centre)


def extrude(outline: Sequence[tuple[Number, Number]], depth: Number) -> Mesh:
    """Return a prism over a convex outline in the x-z plane, from y = -depth/2 to y = +depth/2."""
    points = np.asarray(outline, dtype=np.float64)
    shifted = np.roll(points, -1, axis=0)
    area = (points[:, 0] * shifted[:, 1] - shifted[:, 0] * points[:, 1]).sum()
    if area < 0:  # counter-clockwise as seen from -y, so that normals point outwards
        points = points[::-1]
    front = np.insert(points, 1, -depth / 2, axis=1)
    back = np.insert(points, 1, depth / 2, axis=1)
    triangles = [*_fan(front), *_fan(back[::-1])]
    for i in range(len(points)):
        j = (i + 1) % len(points)
        triangles += [np.stack([front[i], back[j], front[j]]), np.stack([front[i], back[i], back[j]])]
    return _flat(np.stack(triangles))


def loft(sections: Sequence[Sequence[Point] | np.ndarray]) -> Mesh:
    """Return a closed flat-shaded solid through convex outlines with equal numbers of points.

    Args:
        sections: outlines in order along the solid, either all clockwise or all counter-clockwise; triangles
            are wound so that the volume is positive.
    """
    outlines = [np.asarray(section, dtype=np.float64) for section in sections]
    triangles = [*_fan(outlines[0][::-1]), *_fan(outlines[-1])]
    for low, high in pairwise(outlines):
        for i in range(len(low)):
            j = (i + 1) % len(low)
            triangles += [np.stack([low[i], low[j], high[j]]), np.stack([low[i], high[j], high[i]])]
    solid = np.stack(triangles)
    corners = solid - solid.reshape(-1, 3).mean(axis=0)
    if np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
        solid = solid[:, ::-1]
    return _flat(solid)


def plate(outline: Sequence[tuple[Number, Number]], back: Number, front: Number) -> Mesh:
    """Return a closed plate over a convex outline of (y, z) points, from x = back to x = front."""
    return loft([[(x, y, z) for y, z in outline] for x in (back, front)])


def disc(radius: Number, back: Number, front: Number, segments: int = 28, bevel: Number = 0.0) -> Mesh:
    """Return a closed cylinder about x, from x = back to x = front, such as a disc on an object's front."""
    return cylinder(radius, back, front, segments, bevel).turned("y", 90)


def roller(radius: Number, low: Number, high: Number, segments: int = 28, bevel: Number = 0.0) -> Mesh:
    """Return a closed cylinder about y, from y = -high to y = -low, such as a wheel."""
    return cylinder(radius, low, high, segments, bevel).turned("x", 90)


def ring(
    radius: Number, tube: Number, centre: Point = (0.0, 0.0, 0.0), axis: str = "z", segments: int = 28
) -> Mesh:
    """Return a torus about a coordinate axis."""
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    around = np.linspace(0, 2 * np.pi, 13)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    direction[-1] = direction[0]
    away, up = np.cos(around), np.sin(around)
    away[-1], up[-1] = away[0], up[0]
    x, y = direction[:, None, 0] * away, direction[:, None, 1] * away
    normal = np.stack([x, y, np.broadcast_to(up, x.shape)], axis=-1)
    points = tube * normal
    points[..., :2] += radius * direction[:, None]

    def picked(values: np.ndarray) -> np.ndarray:
        """Return the values at the corners of all triangles."""
        a, b, c, d = values[:-1, :-1], values[1:, :-1], values[1:, 1:], values[:-1, 1:]
        return np.concatenate([np.stack(three, axis=2).reshape(-1, 3, 3) for three in ((a, b, c), (a, c, d))])

    mesh = Mesh(picked(points), picked(normal))
    turned = {"z": mesh, "x": mesh.turned("y", 90), "y": mesh.turned("x", 90)}[axis]
    return turned.moved(*centre)
