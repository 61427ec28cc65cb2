"""Placement of furniture along a room's walls, without collisions and clear of the camera path."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from hilsplat_world.shapes import rotation_about

WALL_GAP = 0.03  # distance between furniture and wall, m, which leaves space for the skirting
PIECE_GAP = 0.05
PATH_GAP = 0.28  # minimum horizontal distance between the camera path and objects taller than `PATH_LOW`, m
PATH_LOW = 1.16  # height well below all cameras, m; objects up to this height may be under the camera path
TRIES = 120


@dataclass(frozen=True)
class Room:
    """Width (x), depth (y) and height of a room, m; the origin is in the middle of the floor.

    Walls 0 to 3 face +x, +y, -x, -y. The yaw of an object with its back to a wall is 90 degrees times the
    wall's number.
    """

    width: float
    depth: float
    height: float

    def wall_length(self, wall: int) -> float:
        return self.depth if wall % 2 == 0 else self.width

    def at_wall(self, wall: int, along: float, away: float) -> Float[np.ndarray, " 2"]:
        """Return the point at distances `away` from a wall and `along` from the wall's middle, m."""
        half = self.width / 2 if wall % 2 == 0 else self.depth / 2
        return rotation_about("z", 90.0 * wall)[:2, :2] @ np.array([away - half, along])


@dataclass(frozen=True)
class Space:
    """Axis-aligned box of occupied space, given by its lowest and highest corners, m."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @staticmethod
    def of(corners: Float[np.ndarray, "N 3"]) -> "Space":
        return Space(tuple(corners.min(axis=0).tolist()), tuple(corners.max(axis=0).tolist()))

    def meets(self, other: "Space", gap: float) -> bool:
        """Return whether two boxes are less than `gap` apart in x and y, and overlap in z."""
        sides = all(self.low[a] < other.high[a] + gap and other.low[a] < self.high[a] + gap for a in range(2))
        return sides and self.low[2] < other.high[2] and other.low[2] < self.high[2]

    def beyond(self, room: Room) -> bool:
        """Return whether the box extends beyond the walls of a room."""
        half = (room.width / 2, room.depth / 2)
        return any(self.low[a] < -half[a] or self.high[a] > half[a] for a in range(2))

    def distance_xy(self, points: Float[np.ndarray, "N 2"]) -> float:
        """Return the minimum horizontal distance between the points and the box."""
        low, high = np.array(self.low[:2]), np.array(self.high[:2])
        return float(np.linalg.norm(np.maximum(0, np.maximum(low - points, points - high)), axis=1).min())


class FloorPlan:
    """Occupied space of a room that is being furnished."""

    def __init__(self, room: Room, path: Float[np.ndarray, "N 2"]) -> None:
        self.room, self.path = room, path
        self.taken: list[Space] = []

    def claim(self, space: Space, gap: float = PIECE_GAP) -> bool:
        """Occupy a box if it is inside the room and clear of occupied space and of the camera path.

        Returns:
            Whether the box was free.
        """
        if space.beyond(self.room) or any(space.meets(other, gap) for other in self.taken):
            return False
        if space.high[2] > PATH_LOW and space.distance_xy(self.path) < PATH_GAP:
            return False
        self.taken.append(space)
        return True

    def wall_spot(
        self,
        rng: np.random.Generator,
        size: Float[np.ndarray, " 3"],
        base_z: float,
        clear: float,
        gap: float = WALL_GAP,
    ) -> tuple[Float[np.ndarray, " 2"], float] | None:
        """Occupy a random free place against a wall for an object that faces the room.

        Args:
            size: depth, width and height of the object in its own frame, m.
            base_z: height of the object's lowest point, m.
            clear: depth that must be free in front of the object, m; this space is not occupied.
            gap: distance from the wall, m.

        Returns:
            The object's centre in x and y and its yaw in degrees; None if no place is found.
        """
        for _ in range(TRIES):
            wall = int(rng.choice((0, 1, 2, 3)))
            slack = self.room.wall_length(wall) / 2 - size[1] / 2 - 0.04
            if slack <= 0:
                continue
            along, yaw = float(rng.uniform(-slack, slack)), 90.0 * wall
            deeper = size + np.array([clear, 0, 0])
            middle = self.room.at_wall(wall, along, gap + deeper[0] / 2)
            front = turned_space(middle, deeper, yaw, base_z)
            spot = self.room.at_wall(wall, along, gap + size[0] / 2)
            is_clear = not any(front.meets(other, 0.0) for other in self.taken)
            if is_clear and self.claim(turned_space(spot, size, yaw, base_z)):
                return spot, yaw
        return None


def turned_space(
    spot: Float[np.ndarray, " 2"], size: Float[np.ndarray, " 3"], yaw_deg: float | int, base_z: float | int
) -> Space:
    """Return the space of an object centred at `spot` in x and y; `yaw_deg` is a multiple of 90."""
    depth_width = size[:2] if round(yaw_deg / 90) % 2 == 0 else size[1::-1]
    low, high = spot - depth_width / 2, spot + depth_width / 2
    return Space((*low.tolist(), float(base_z)), (*high.tolist(), float(base_z + size[2])))
