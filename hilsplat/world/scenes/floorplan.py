"""Placement of furniture along the walls of a room, without collisions and clear of the camera path."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from hilsplat.world.shapes import rotation_about

WALL_GAP = 0.03
"""Distance between furniture and wall, where the skirting fits, m."""
PIECE_GAP = 0.05
PATH_GAP = 0.28
"""Minimum horizontal distance of the camera path from objects taller than `PATH_LOW`, m."""
PATH_LOW = 1.16
"""Height well below all cameras, m; objects up to this height may be under the camera path."""
TRIES = 120


@dataclass(frozen=True)
class Room:
    """Width (x), depth (y) and height of a room, m; the origin is in the middle of the floor.

    Walls 0 to 3 face +x, +y, -x, -y.
    """

    width: float
    depth: float
    height: float

    def wall_length(self, wall: int) -> float:
        """Return the length of a wall, m."""
        return self.depth if wall % 2 == 0 else self.width

    def at_wall(self, wall: int, along: float, away: float) -> Float[np.ndarray, " 2"]:
        """Return the point `away` from a wall into the room and `along` it from its middle, m."""
        half = self.width / 2 if wall % 2 == 0 else self.depth / 2
        return rotation_about("z", yaw_of_wall(wall))[:2, :2] @ np.array([away - half, along])


def yaw_of_wall(wall: int) -> float:
    """Return the yaw of an object whose back is to the wall, degrees."""
    return 90.0 * wall


@dataclass(frozen=True)
class Space:
    """Lowest and highest corner of an axis-aligned box of occupied space, m."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @staticmethod
    def of(corners: Float[np.ndarray, "N 3"]) -> "Space":
        """Return the bounding box of points."""
        return Space(tuple(corners.min(axis=0).tolist()), tuple(corners.max(axis=0).tolist()))

    def meets(self, other: "Space", gap: float) -> bool:
        """Return whether two boxes are nearer than `gap` in x and y and overlap in z."""
        sides = all(self.low[a] < other.high[a] + gap and other.low[a] < self.high[a] + gap for a in range(2))
        return sides and self.low[2] < other.high[2] and other.low[2] < self.high[2]

    def beyond(self, room: Room, gap: float) -> bool:
        """Return whether the box extends beyond the room reduced by a margin of `gap` at the walls."""
        half = (room.width / 2 - gap, room.depth / 2 - gap)
        return any(self.low[a] < -half[a] or self.high[a] > half[a] for a in range(2))

    def distance_xy(self, points: Float[np.ndarray, "N 2"]) -> float:
        """Return the minimum horizontal distance of the points from the box."""
        low, high = np.array(self.low[:2]), np.array(self.high[:2])
        return float(np.linalg.norm(np.maximum(0, np.maximum(low - points, points - high)), axis=1).min())


class FloorPlan:
    """Occupied space of a room while it is being furnished."""

    def __init__(self, room: Room, path: Float[np.ndarray, "N 2"]) -> None:
        self.room, self.path = room, path
        self.taken: list[Space] = []

    def free(self, space: Space, gap: float = PIECE_GAP) -> bool:
        """Return whether a box is inside the room and clear of occupied space and of the camera path."""
        if space.beyond(self.room, 0.0) or any(space.meets(other, gap) for other in self.taken):
            return False
        return space.high[2] <= PATH_LOW or space.distance_xy(self.path) >= PATH_GAP

    def wall_spot(
        self,
        rng: np.random.Generator,
        size: Float[np.ndarray, " 3"],
        base_z: float,
        clear: float,
        gap: float = WALL_GAP,
    ) -> tuple[int, Float[np.ndarray, " 2"], Space] | None:
        """Find a random free place at a wall for an object that faces the room.

        Args:
            size: depth, width and height of the object in its own frame, m.
            base_z: height of its lowest point, m.
            clear: depth that must be free in front of it, m; it is not reserved afterwards.
            gap: distance from the wall, m.

        Returns:
            The wall, the object's centre in x and y, and the space it occupies; None if no place is found.
        """
        for _ in range(TRIES):
            wall = int(rng.choice((0, 1, 2, 3)))
            slack = self.room.wall_length(wall) / 2 - size[1] / 2 - 0.04
            if slack <= 0:
                continue
            along = float(rng.uniform(-slack, slack))
            spot = self.room.at_wall(wall, along, gap + size[0] / 2)
            space = turned_space(spot, size, yaw_of_wall(wall), base_z)
            deeper = np.array([size[0] + clear, size[1], size[2]])
            middle = self.room.at_wall(wall, along, gap + deeper[0] / 2)
            front = turned_space(middle, deeper, yaw_of_wall(wall), base_z)
            if self.free(space) and not any(front.meets(other, 0.0) for other in self.taken):
                return wall, spot, space
        return None


def turned_space(
    spot: Float[np.ndarray, " 2"], size: Float[np.ndarray, " 3"], yaw_deg: float | int, base_z: float | int
) -> Space:
    """Return the space of an object centred at `spot` in x and y; `yaw_deg` is a multiple of 90."""
    depth, width = (size[0], size[1]) if round(yaw_deg / 90) % 2 == 0 else (size[1], size[0])
    return Space(
        (float(spot[0] - depth / 2), float(spot[1] - width / 2), float(base_z)),
        (float(spot[0] + depth / 2), float(spot[1] + width / 2), float(base_z + size[2])),
    )
