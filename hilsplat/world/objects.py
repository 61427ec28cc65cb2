"""The objects of the synthetic world: sixteen classes, each a true tree of whole, parts and subparts."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int32

from hilsplat.base.errors import SceneError
from hilsplat.base.levels import NONE
from hilsplat.world.paints import Paint, PaintBox
from hilsplat.world.shapes import Mesh, arc, box, cylinder, ellipsoid, extrude, joined, lathe, sphere, sweep

GENERATOR_VERSION = 1
"""Changes whenever the same seed would give another scene or other texts; small models trained on another
version do not fit."""


@dataclass(frozen=True)
class ModelNode:
    """A whole, part or subpart of one object.

    Attributes:
        level: 1 whole, 2 part, 3 subpart.
        parent: row of the node one level up in the object, -1 for the whole.
        text: the query that it answers, such as "bear head".
        synonyms: other texts that name it.
        colour: word for its prevailing colour.
    """

    level: int
    parent: int
    text: str
    synonyms: tuple[str, ...]
    colour: str


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """One object in its own frame: it stands on z = 0, its front faces +x.

    Attributes:
        name: class, such as "bear".
        nodes: its tree; row 0 is the whole.
        triangles: corner positions.
        normals: shading normals at the corners.
        node_ids: rows of `nodes` that a triangle belongs to (whole, part, subpart; -1 none).
        material_ids: rows of `materials`.
        materials: numbers for the shader, `Paint.row`.
    """

    name: str
    nodes: tuple[ModelNode, ...]
    triangles: Float[np.ndarray, "F 3 3"]
    normals: Float[np.ndarray, "F 3 3"]
    node_ids: Int32[np.ndarray, "F 3"]
    material_ids: Int32[np.ndarray, " F"]
    materials: Float[np.ndarray, "M 14"]


class _Builder:
    """Collects the nodes and meshes of one object while its maker runs."""

    def __init__(self, name: str, aliases: tuple[str, ...], rng: np.random.Generator) -> None:
        self.name, self.aliases, self.rng = name, aliases, rng
        self.paints = PaintBox(rng)
        self._nodes: list[tuple[int, int, str, tuple[str, ...]]] = [(1, NONE, name, aliases)]
        self._pieces: list[tuple[int, Mesh, Paint]] = []

    def between(self, low: float | int, high: float | int) -> float:
        """A random size."""
        return float(self.rng.uniform(low, high))

    def chance(self, probability: float) -> bool:
        """A random choice."""
        return bool(self.rng.random() < probability)

    def part(self, word: str, *aliases: str) -> int:
        """A new part of the object; `word` is its name without the object's."""
        self._nodes.append((2, 0, word, aliases))
        return len(self._nodes) - 1

    def subpart(self, part: int, word: str, *aliases: str) -> int:
        """A new subpart of a part."""
        self._nodes.append((3, part, word, aliases))
        return len(self._nodes) - 1

    def put(self, node: int, paint: Paint, *meshes: Mesh) -> None:
        """Add meshes that belong to a part or subpart."""
        self._pieces.append((node, joined(*meshes), paint))

    def build(self) -> ObjectModel:
        paints = list(dict.fromkeys(paint for _, _, paint in self._pieces))
        triples = []
        for level, parent, _, _ in self._nodes:
            row = len(triples)
            triples.append(
                (0, NONE, NONE) if level == 1 else (0, row, NONE) if level == 2 else (0, parent, row)
            )
        area = {}  # of each paint on each node, to know what colour a node has
        for node, mesh, paint in self._pieces:
            edges = mesh.triangles[:, 1:] - mesh.triangles[:, :1]
            surface = float(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum())
            for owner in triples[node]:
                if owner != NONE:
                    per_paint = area.setdefault(owner, {})
                    per_paint[paint] = per_paint.get(paint, 0.0) + surface
        triangles = np.concatenate([mesh.triangles for _, mesh, _ in self._pieces])
        triangles[..., 2] -= triangles[..., 2].min()
        return ObjectModel(
            self.name,
            tuple(self._named(row, max(area[row], key=area[row].get)) for row in range(len(self._nodes))),
            triangles,
            np.concatenate([mesh.normals for _, mesh, _ in self._pieces]),
            np.concatenate(
                [np.tile(np.int32(triples[node]), (len(mesh), 1)) for node, mesh, _ in self._pieces]
            ),
            np.concatenate(
                [np.full(len(mesh), paints.index(paint), np.int32) for _, mesh, paint in self._pieces]
            ),
            np.stack([paint.row() for paint in paints]),
        )

    def _named(self, row: int, paint: Paint) -> ModelNode:
        """Texts of a node: its canonical name, then aliases, attributes and relations."""
        level, parent, word, aliases = self._nodes[row]
        if level == 1:
            text, others = self.name, [*self.aliases]
        else:
            text = f"{self.name} {word}"
            others = [f"{self.name} {alias}" for alias in aliases]
            others += [f"{name} of the {self.name}" for name in (word, *aliases)]
            others += [f"{word} of the {alias}" for alias in self.aliases]
            if level == 3:
                others.append(f"{word} on the {self.name} {self._nodes[parent][2]}")
        others.append(f"{paint.colour} {text}")
        if paint.adjective:
            others.append(f"{paint.adjective} {text}")
        return ModelNode(level, parent, text, tuple(dict.fromkeys(others)), paint.colour)


def _bear(b: _Builder) -> None:
    fur = b.paints.draw("fur", "brown", "beige", "grey", "white", "orange", "pink")
    light, dark, cloth = b.paints.draw("fur"), b.paints.draw("plastic", "black"), b.paints.draw("cloth")
    body_r, head_r = b.between(0.25, 0.30), b.between(0.21, 0.25)
    body = b.part("body", "torso")
    b.put(body, fur, ellipsoid((body_r * 0.9, body_r, body_r * 1.15), (0, 0, 0.34)))
    belly = b.subpart(body, "belly", "tummy")
    b.put(belly, light, ellipsoid((0.10, body_r * 0.72, body_r * 0.8), (body_r * 0.9 - 0.055, 0, 0.33)))
    neck_z = 0.34 + body_r * 1.02
    bow = b.subpart(body, "bow", "bow tie")
    knot_x = body_r * 0.62 + 0.10
    b.put(bow, cloth, sphere(0.05, (knot_x, 0, neck_z)))
    for side in (-1, 1):
        b.put(bow, cloth, ellipsoid((0.045, 0.10, 0.075), (knot_x - 0.01, side * 0.115, neck_z)))
    head = b.part("head")
    z = neck_z + head_r * 0.86
    b.put(head, fur, ellipsoid((head_r * 0.95, head_r, head_r * 0.92), (0.03, 0, z)))
    ear, nose, eye = b.subpart(head, "ears"), b.subpart(head, "muzzle", "snout"), b.subpart(head, "eyes")
    for side in (-1, 1):
        b.put(ear, light, ellipsoid((0.055, 0.10, 0.10), (0.0, side * head_r * 0.78, z + head_r * 0.72)))
        b.put(eye, dark, sphere(0.042, (0.03 + head_r * 0.80, side * head_r * 0.42, z + head_r * 0.30)))
    b.put(nose, light, ellipsoid((0.11, 0.115, 0.085), (0.03 + head_r * 0.82, 0, z - head_r * 0.28)))
    b.put(nose, dark, ellipsoid((0.03, 0.045, 0.03), (0.03 + head_r * 0.82 + 0.10, 0, z - head_r * 0.16)))
    for side in (-1, 1):
        arm = b.part("arm")
        b.put(
            arm,
            fur,
            sweep(
                [
                    (0.02, side * body_r * 0.75, 0.46),
                    (0.10, side * body_r * 1.2, 0.38),
                    (0.20, side * body_r * 1.25, 0.28),
                ],
                [0.075, 0.085, 0.075],
            ),
        )
        b.put(b.subpart(arm, "paw", "hand"), light, sphere(0.092, (0.22, side * body_r * 1.25, 0.26)))
        leg = b.part("leg")
        b.put(
            leg,
            fur,
            sweep([(0.05, side * 0.15, 0.12), (0.2, side * 0.19, 0.11), (0.34, side * 0.21, 0.11)], 0.11),
        )
        b.put(
            b.subpart(leg, "foot", "sole"), light, ellipsoid((0.06, 0.115, 0.13), (0.36, side * 0.21, 0.13))
        )


def _mug(b: _Builder) -> None:
    glaze, inner, accent = b.paints.draw("ceramic"), b.paints.draw("ceramic"), b.paints.draw("ceramic")
    r, h = b.between(0.36, 0.44), b.between(0.80, 1.0)
    flare = b.between(0.94, 1.08)
    cup = b.part("cup", "body")
    top = r * flare
    b.put(cup, glaze, lathe([(0, 0), (r * 0.92, 0), (r, 0.06), (top, h * 0.86)]))
    inside = b.subpart(cup, "inside", "interior")
    b.put(inside, inner, lathe([(top - 0.05, h), (r - 0.05, 0.12), (0, 0.12)]))
    rim = b.subpart(cup, "rim", "edge")
    b.put(
        rim,
        accent,
        lathe(
            [
                (top, h * 0.86),
                (top + 0.035, h * 0.88),
                (top + 0.035, h),
                (top - 0.05, h),
                (top - 0.06, h - 0.04),
            ]
        ),
    )
    band = b.subpart(cup, "band", "stripe")
    low, high = h * 0.34, h * 0.54
    b.put(
        band,
        b.paints.draw("ceramic"),
        lathe([(r, low), (r * 1.05, low + 0.02), (r * 1.05, high - 0.02), (r, high)]),
    )
    handle = b.part("handle")
    path = [(x + r * 0.94, y, z + h * 0.47) for x, y, z in arc((r * 0.75, h * 0.30), -88, 88)]
    b.put(handle, accent, sweep(path, 0.065).turned("z", 90))
    rest = b.subpart(handle, "thumb rest", "knob")
    b.put(rest, inner, ellipsoid((0.10, 0.11, 0.07), (0, r * 1.5, h * 0.75)))


def _kettle(b: _Builder) -> None:
    metal, accent, dark = b.paints.draw("metal"), b.paints.draw("ceramic"), b.paints.draw("plastic")
    r, h = b.between(0.40, 0.46), b.between(0.50, 0.62)
    body = b.part("body", "pot")
    b.put(
        body,
        metal,
        lathe([(0, 0.05), (r, 0.05), (r * 1.04, h * 0.35), (r * 0.9, h * 0.75), (r * 0.62, h), (0, h)]),
    )
    base = b.subpart(body, "base", "bottom ring")
    b.put(base, dark, lathe([(0, 0), (r * 1.06, 0), (r * 1.08, 0.10), (r * 1.0, 0.13)]))
    lid = b.part("lid", "cover")
    b.put(
        lid, accent, lathe([(r * 0.70, h - 0.02), (r * 0.70, h + 0.03), (r * 0.5, h + 0.10), (0, h + 0.13)])
    )
    knob = b.subpart(lid, "knob", "button")
    b.put(knob, dark, ellipsoid((0.09, 0.09, 0.08), (0, 0, h + 0.19)))
    spout = b.part("spout")
    start = np.array([r * 0.85, 0, h * 0.35])
    b.put(
        spout,
        metal,
        sweep(
            [start, start + np.array([0.18, 0, 0.10]), start + np.array([0.27, 0, 0.26])],
            [0.14, 0.10, 0.075],
        ),
    )
    tip = b.subpart(spout, "tip", "mouth")
    lip = [start + np.array([0.255, 0, 0.235]), start + np.array([0.33, 0, 0.37])]
    b.put(tip, accent, sweep(lip, [0.085, 0.10]))
    handle = b.part("handle")
    b.put(handle, dark, sweep([(x, 0, z + h * 0.72) for x, _, z in arc((r * 0.92, 0.50), 4, 176)], 0.045))
    grip = b.subpart(handle, "grip")
    b.put(grip, accent, sweep([(x, 0, z + h * 0.72) for x, _, z in arc((r * 0.92, 0.50), 55, 125)], 0.075))


def _chair(b: _Builder) -> None:
    wood, cloth, accent = b.paints.draw("wood"), b.paints.draw("cloth"), b.paints.draw("plain")
    w, seat_z, top = b.between(0.50, 0.60), b.between(0.42, 0.50), b.between(1.0, 1.15)
    seat = b.part("seat")
    b.put(seat, wood, box((w, w, 0.07), (0, 0, seat_z), 0.015))
    cushion = b.subpart(seat, "cushion", "pillow")
    b.put(cushion, cloth, box((w * 0.86, w * 0.86, 0.11), (0.01, 0, seat_z + 0.085), 0.04))
    back = b.part("back", "backrest")
    for side in (-1, 1):
        b.put(
            back,
            wood,
            box(
                (0.075, 0.085, top - seat_z),
                (-w / 2 + 0.04, side * (w / 2 - 0.045), (top + seat_z) / 2),
                0.015,
            ),
        )
    rail = b.subpart(back, "top rail", "headrest")
    b.put(rail, accent, box((0.09, w + 0.04, 0.17), (-w / 2 + 0.04, 0, top - 0.05), 0.03))
    slats = b.subpart(back, "slats", "bars")
    slat_paint = b.paints.draw("plain")
    low, high = seat_z + 0.06, top - 0.14
    for i in range(3):
        b.put(
            slats,
            slat_paint,
            box((0.05, 0.10, high - low), (-w / 2 + 0.04, (i - 1) * w * 0.26, (low + high) / 2), 0.01),
        )
    for x in (-1, 1):
        for y in (-1, 1):
            leg = b.part("leg")
            px, py = x * (w / 2 - 0.05), y * (w / 2 - 0.05)
            b.put(leg, wood, box((0.09, 0.09, seat_z - 0.13), (px, py, (seat_z + 0.07) / 2), 0.012))
            foot = b.subpart(leg, "foot", "leg tip")
            b.put(foot, accent, box((0.115, 0.115, 0.13), (px, py, 0.065), 0.02))


def _cabinet(b: _Builder) -> None:
    wood, front, metal = b.paints.draw("wood"), b.paints.draw("plain"), b.paints.draw("metal")
    d, w, h = b.between(0.42, 0.5), b.between(0.62, 0.75), b.between(0.75, 0.9)
    body = b.part("body", "case", "frame")
    b.put(body, wood, box((d, w, h - 0.1), (0, 0, h / 2 + 0.05), 0.012))
    b.put(
        body,
        wood,
        *[
            box((0.09, 0.09, 0.12), (x * (d / 2 - 0.06), y * (w / 2 - 0.06), 0.05))
            for x in (-1, 1)
            for y in (-1, 1)
        ],
    )
    top = b.subpart(body, "top", "board")
    b.put(top, b.paints.draw("stone"), box((d + 0.08, w + 0.08, 0.08), (0, 0, h + 0.03), 0.02))
    x, split = d / 2, h * 0.66
    for side in (-1, 1):
        door = b.part("door")
        door_w, door_h = w / 2 - 0.05, split - 0.17
        y, z = side * (w / 4 - 0.003), 0.13 + door_h / 2
        b.put(door, front, box((0.05, door_w, door_h), (x + 0.02, y, z), 0.012))
        panel = b.subpart(door, "panel", "inlay")
        b.put(
            panel,
            b.paints.draw("cloth"),
            box((0.05, door_w * 0.52, door_h * 0.66), (x + 0.04, y + side * door_w * 0.13, z), 0.015),
        )
        knob = b.subpart(door, "knob", "doorknob")
        b.put(knob, metal, sphere(0.062, (x + 0.08, y - side * door_w * 0.34, z)))
    drawer = b.part("drawer")
    z = (split + h) / 2 - 0.01
    b.put(drawer, b.paints.draw("plain"), box((0.05, w - 0.09, h - split - 0.07), (x + 0.02, 0, z), 0.012))
    pull = b.subpart(drawer, "handle", "pull")
    b.put(pull, metal, box((0.07, w * 0.40, 0.085), (x + 0.075, 0, z), 0.025))


def _lamp(b: _Builder) -> None:
    metal, cloth, accent = b.paints.draw("metal"), b.paints.draw("cloth"), b.paints.draw("ceramic")
    h, shade_r = b.between(0.95, 1.15), b.between(0.32, 0.40)
    base = b.part("base", "foot")
    b.put(base, accent, lathe([(0, 0), (0.28, 0), (0.28, 0.07), (0.20, 0.13), (0, 0.14)]))
    button = b.subpart(base, "button", "switch")
    b.put(button, b.paints.draw("plastic"), ellipsoid((0.075, 0.085, 0.06), (0.215, 0, 0.12)))
    pole = b.part("pole", "stem")
    b.put(pole, metal, cylinder(0.055, 0.1, h - 0.22))
    ball = b.subpart(pole, "ball", "joint")
    b.put(ball, b.paints.draw("ceramic"), sphere(b.between(0.115, 0.14), (0, 0, 0.34)))
    shade = b.part("shade", "lampshade")
    low, upper = h - 0.46, shade_r * b.between(0.55, 0.7)

    def radius(z: float) -> float:
        return shade_r + (upper - shade_r) * (z - low) / 0.46

    b.put(
        shade,
        cloth,
        lathe([(shade_r, low), (upper, h), (upper - 0.03, h), (shade_r - 0.03, low), (shade_r, low)]),
    )
    trim = b.paints.draw("cloth")
    lower_band = b.subpart(shade, "border", "trim")
    b.put(
        lower_band,
        trim,
        lathe(
            [
                (shade_r - 0.035, low - 0.01),
                (shade_r + 0.022, low - 0.01),
                (radius(low + 0.115) + 0.022, low + 0.115),
                (radius(low + 0.115), low + 0.12),
            ]
        ),
    )
    bulb = b.subpart(shade, "finial", "top knob")
    b.put(
        bulb,
        accent,
        lathe([(0, h - 0.03), (upper - 0.01, h - 0.03), (0.06, h + 0.01), (0.075, h + 0.07), (0, h + 0.12)]),
    )


def _shelf(b: _Builder) -> None:
    wood, back = b.paints.draw("wood"), b.paints.draw("plain")
    d, w, h = b.between(0.32, 0.38), b.between(0.66, 0.8), b.between(0.85, 1.0)
    frame = b.part("frame", "case")
    for side in (-1, 1):
        b.put(frame, wood, box((d, 0.06, h), (0, side * (w / 2 - 0.03), h / 2), 0.012))
    back_wall = b.subpart(frame, "back wall", "backboard")
    b.put(back_wall, back, box((0.04, w - 0.12, h - 0.04), (-d / 2 + 0.02, 0, h / 2)))
    boards = b.subpart(frame, "boards", "planks")
    board_paint = b.paints.draw("wood")
    for z in (0.05, h * 0.5, h - 0.035):
        b.put(boards, board_paint, box((d + 0.03, w - 0.11, 0.07), (0.015, 0, z), 0.012))
    books = b.part("books", "row of books")
    y, bottom = -w / 2 + 0.08, h * 0.5 + 0.035
    while y < 0.04:
        thick, tall = b.between(0.085, 0.12), b.between(0.27, 0.34)
        book = b.subpart(books, "book")
        b.put(
            book,
            b.paints.draw("cloth"),
            box((d * b.between(0.72, 0.9), thick, tall), (0.02, y + thick / 2, bottom + tall / 2), 0.01),
        )
        y += thick + 0.006
    vase = b.part("vase", "pot")
    vy, vz = w / 2 - 0.18, bottom
    b.put(
        vase,
        b.paints.draw("ceramic"),
        lathe([(0, 0), (0.07, 0), (0.12, 0.10), (0.10, 0.20), (0.05, 0.25)]).moved(0.03, vy, vz),
    )
    b.put(
        b.subpart(vase, "rim", "mouth"),
        b.paints.draw("ceramic"),
        lathe([(0.05, 0.22), (0.095, 0.29), (0.08, 0.31), (0, 0.28)]).moved(0.03, vy, vz),
    )
    crate = b.part("box", "basket")
    crate_w = w * 0.52
    cy = b.between(-0.06, 0.06)
    b.put(
        crate, b.paints.draw("cloth"), box((d * 0.85, crate_w, h * 0.30), (0.03, cy, 0.085 + h * 0.15), 0.015)
    )
    b.put(
        b.subpart(crate, "label", "tag"),
        b.paints.draw("plain"),
        box((0.03, crate_w * 0.5, h * 0.14), (0.03 + d * 0.425, cy, 0.085 + h * 0.15), 0.008),
    )


def _car(b: _Builder) -> None:
    body_paint, glass, tyre = (
        b.paints.draw("plastic"),
        b.paints.draw("plastic", "black", "grey", "blue", "teal"),
        b.paints.draw("plastic", "black"),
    )
    metal, lamp = b.paints.draw("metal"), b.paints.draw("plastic", "yellow", "white", "orange")
    length, w = b.between(1.05, 1.2), b.between(0.50, 0.58)
    low, belt, roof = 0.12, b.between(0.34, 0.40), b.between(0.62, 0.70)
    body = b.part("body", "chassis")
    b.put(body, body_paint, box((length, w, belt - low), (0, 0, (belt + low) / 2), 0.05))
    hood = b.subpart(body, "hood", "bonnet")
    b.put(
        hood,
        b.paints.draw("plastic"),
        box((length * 0.27, w * 0.82, 0.06), (length * 0.345, 0, belt + 0.01), 0.025),
    )
    lights = b.subpart(body, "headlights", "front lights")
    for side in (-1, 1):
        b.put(lights, lamp, ellipsoid((0.05, 0.08, 0.07), (length / 2, side * w * 0.32, belt - 0.09)))
    bumper = b.subpart(body, "bumper", "fender")
    for end in (-1, 1):
        b.put(bumper, metal, box((0.09, w * 1.04, 0.085), (end * length * 0.505, 0, low + 0.055), 0.025))
    cabin = b.part("cabin", "top")
    back, front = -length * 0.40, length * 0.20
    outline = [(back, belt - 0.01), (front, belt - 0.01), (front - 0.14, roof), (back + 0.09, roof)]
    b.put(cabin, body_paint, extrude(outline, w * 0.86))
    roof_rack = b.subpart(cabin, "roof", "rooftop")
    b.put(
        roof_rack,
        b.paints.draw("plastic"),
        box((front - back - 0.20, w * 0.84, 0.05), ((front + back) / 2 - 0.025, 0, roof + 0.015), 0.02),
    )
    windows = b.subpart(cabin, "windows", "side windows")
    side_outline = [
        (back + 0.09, belt + 0.035),
        (front - 0.10, belt + 0.035),
        (front - 0.19, roof - 0.04),
        (back + 0.14, roof - 0.04),
    ]
    b.put(windows, glass, extrude(side_outline, w * 0.86 + 0.03))
    shield = b.subpart(cabin, "windshield", "front window")
    tilt = np.degrees(np.arctan2(0.14, roof - belt))
    pane = box((0.03, w * 0.72, (roof - belt) * 0.86), (0, 0, 0)).turned("y", -tilt)
    b.put(shield, glass, pane.moved(front - 0.07, 0, (roof + belt) / 2))
    radius = b.between(0.145, 0.17)
    for x in (-1, 1):
        for side in (-1, 1):
            wheel = b.part("wheel", "tire")
            rubber = cylinder(radius, -0.07, 0.07, 24, 0.025).turned("x", 90)
            b.put(wheel, tyre, rubber.moved(x * length * 0.30, side * (w / 2 - 0.01), radius))
            cap = cylinder(radius * 0.62, -0.025, 0.025, 20, 0.008).turned("x", 90)
            b.put(
                b.subpart(wheel, "hubcap", "rim"),
                metal,
                cap.moved(x * length * 0.30, side * (w / 2 + 0.065), radius),
            )


def _house(b: _Builder) -> None:
    brick, roof_paint = (
        b.paints.draw(str(b.rng.choice(["brick", "stone", "plain"]))),
        b.paints.draw("brick", "red", "brown", "grey", "orange", "teal", "blue"),
    )
    wood, glass = b.paints.draw("wood"), b.paints.draw("plastic")
    d, w, h = b.between(0.55, 0.66), b.between(0.66, 0.8), b.between(0.45, 0.52)
    rise = b.between(0.30, 0.38)
    walls = b.part("walls", "building")
    b.put(walls, brick, box((d, w, h), (0, 0, h / 2)))
    gable = extrude([(-w / 2, h), (w / 2, h), (0, h + rise)], d).turned("z", 90)
    b.put(walls, brick, gable)
    door = b.subpart(walls, "door", "front door")
    b.put(door, wood, box((0.05, 0.19, 0.34), (d / 2 + 0.01, 0.0, 0.17), 0.01))
    window = b.subpart(walls, "windows")
    for side in (-1, 1):
        b.put(window, glass, box((0.05, 0.15, 0.17), (d / 2 + 0.01, side * w * 0.32, h * 0.62), 0.01))
        b.put(window, glass, box((d * 0.36, 0.05, 0.18), (0, side * (w / 2 + 0.01), h * 0.55), 0.01))
    b.put(window, glass, box((0.05, 0.20, 0.18), (-d / 2 - 0.01, 0, h * 0.55), 0.01))
    roof = b.part("roof")
    slope = np.hypot(w / 2, rise)
    angle = np.degrees(np.arctan2(rise, w / 2))
    for side in (-1, 1):
        slab = box((d + 0.12, slope + 0.12, 0.06), (0, 0, 0), 0.012)
        slab = slab.turned("x", -side * angle)
        outward = np.array([0, side * np.sin(np.radians(angle)), np.cos(np.radians(angle))]) * 0.03
        middle = np.array([0, side * w / 4, h + rise / 2]) + outward
        down = np.array([0, side * np.cos(np.radians(angle)), -np.sin(np.radians(angle))]) * 0.04
        middle += down
        b.put(roof, roof_paint, slab.moved(*middle))
        if side == 1:
            sky = box((0.22, 0.2, 0.04), (0, 0, 0), 0.01).turned("x", -angle)
            light = middle + np.array([0, np.sin(np.radians(angle)), np.cos(np.radians(angle))]) * 0.035
    skylight = b.subpart(roof, "skylight", "roof window")
    b.put(skylight, b.paints.draw("plastic"), sky.moved(*(light + np.array([d * 0.12, 0, 0]))))
    ridge = b.subpart(roof, "ridge")
    b.put(ridge, b.paints.draw("plain"), box((d + 0.15, 0.10, 0.075), (0, 0, h + rise + 0.055), 0.025))
    chimney = b.part("chimney")
    x, y, top = -d * 0.22, -w * 0.22, h + rise + 0.18
    b.put(chimney, b.paints.draw("brick"), box((0.15, 0.15, 0.48), (x, y, top - 0.24)))
    b.put(
        b.subpart(chimney, "cap", "top"), b.paints.draw("stone"), box((0.21, 0.21, 0.085), (x, y, top), 0.015)
    )


def _plant(b: _Builder) -> None:
    clay, rim_paint = b.paints.draw("ceramic"), b.paints.draw("ceramic")
    leaf, stem_paint, petal = (
        b.paints.draw("plain", "green", "teal"),
        b.paints.draw("wood", "brown"),
        b.paints.draw("plain", "red", "pink", "yellow", "purple", "orange", "white", "blue"),
    )
    r, h = b.between(0.24, 0.30), b.between(0.30, 0.38)
    pot = b.part("pot", "flowerpot")
    b.put(pot, clay, lathe([(0, 0), (r * 0.72, 0), (r, h)]))
    rim = b.subpart(pot, "rim", "edge")
    b.put(
        rim,
        rim_paint,
        lathe([(r, h - 0.10), (r + 0.05, h - 0.09), (r + 0.05, h), (r - 0.03, h), (r - 0.04, h - 0.05)]),
    )
    soil = b.subpart(pot, "soil", "earth")
    b.put(
        soil,
        b.paints.draw("stone", "brown", "black"),
        lathe([(r - 0.02, h - 0.04), (r * 0.5, h - 0.015), (0, h)]),
    )
    stem = b.part("stem", "trunk")
    top = h + b.between(0.26, 0.34)
    b.put(
        stem,
        stem_paint,
        sweep([(0, 0, h - 0.05), (0.02, 0.02, (h + top) / 2), (0, 0, top + 0.05)], [0.06, 0.05, 0.05]),
    )
    b.put(
        b.subpart(stem, "ring", "ribbon"),
        b.paints.draw("cloth"),
        lathe([(0.05, -0.065), (0.095, -0.05), (0.095, 0.05), (0.05, 0.065)]).moved(0.01, 0.01, h + 0.11),
    )
    crown = b.part("crown", "leaves", "foliage")
    size = b.between(0.26, 0.31)
    b.put(crown, leaf, ellipsoid((size, size, size * 0.92), (0, 0, top + size * 0.7)))
    for i in range(5):
        a = 2 * np.pi * i / 5 + b.between(0, 0.8)
        b.put(
            crown,
            leaf,
            sphere(
                size * 0.52,
                (size * 0.72 * np.cos(a), size * 0.72 * np.sin(a), top + size * b.between(0.35, 0.75)),
            ),
        )
    for i in range(5):
        a, up = 2 * np.pi * i / 5 + b.between(0, 0.5), b.between(0.15, 1.0)
        flat = size * 1.1 * np.cos(up)
        flower = b.subpart(crown, "flower", "blossom")
        place = (flat * np.cos(a), flat * np.sin(a), top + size * 0.75 + size * np.sin(up) * 0.95)
        b.put(flower, petal, sphere(0.085, place, 16))


def _bottle(b: _Builder) -> None:
    glass, label_paint, cap_paint = (
        b.paints.draw("ceramic", "green", "teal", "blue", "brown", "purple", "red"),
        b.paints.draw("plain", "white", "beige", "yellow", "orange", "pink"),
        b.paints.draw("metal"),
    )
    r, h = b.between(0.22, 0.26), b.between(0.62, 0.72)
    neck_r = b.between(0.085, 0.10)
    body = b.part("body")
    b.put(
        body,
        glass,
        lathe([(0, 0), (r * 0.93, 0), (r, 0.04), (r, h * 0.78), (r * 0.86, h * 0.9), (neck_r * 1.15, h)]),
    )
    label = b.subpart(body, "label", "sticker")
    b.put(
        label,
        label_paint,
        lathe([(r, h * 0.28), (r * 1.035, h * 0.29), (r * 1.035, h * 0.64), (r, h * 0.65)]),
    )
    foot = b.subpart(body, "base", "bottom")
    b.put(
        foot,
        b.paints.draw("ceramic"),
        lathe([(0, -0.005), (r * 1.04, -0.005), (r * 1.05, 0.10), (r, 0.11)]).moved(z=0.005),
    )
    neck = b.part("neck")
    top = h + b.between(0.20, 0.26)
    b.put(neck, glass, lathe([(neck_r * 1.15, h), (neck_r, h + 0.04), (neck_r, top)]))
    ring = b.subpart(neck, "collar", "ring")
    b.put(
        ring,
        b.paints.draw("ceramic"),
        lathe([(neck_r, h + 0.04), (neck_r + 0.05, h + 0.06), (neck_r + 0.05, h + 0.13), (neck_r, h + 0.15)]),
    )
    cap = b.part("cap", "lid")
    b.put(cap, cap_paint, cylinder(neck_r + 0.045, top - 0.03, top + 0.10, bevel=0.015))
    button = b.subpart(cap, "knob", "stopper")
    b.put(button, b.paints.draw("plastic"), ellipsoid((neck_r * 0.9, neck_r * 0.9, 0.07), (0, 0, top + 0.13)))


def _snowman(b: _Builder) -> None:
    snow, hat_paint = (
        b.paints.draw("snow", "white"),
        b.paints.draw("cloth", "black", "blue", "purple", "brown", "red", "green"),
    )
    scarf_paint, dark = b.paints.draw("cloth"), b.paints.draw("stone", "black")
    r0, r1, r2 = b.between(0.30, 0.34), b.between(0.23, 0.26), b.between(0.18, 0.20)
    z0, z1 = r0 * 0.92, r0 * 1.75 + r1 * 0.75
    z2 = z1 + r1 * 0.85 + r2 * 0.75
    base = b.part("base", "bottom ball")
    b.put(base, snow, sphere(r0, (0, 0, z0)))
    pads = b.subpart(base, "feet", "boots")
    boots = b.paints.draw("plastic")
    for side in (-1, 1):
        b.put(pads, boots, ellipsoid((0.14, 0.10, 0.08), (r0 * 0.80, side * 0.14, 0.075)))
    body = b.part("body", "middle ball")
    b.put(body, snow, sphere(r1, (0, 0, z1)))
    buttons = b.subpart(body, "buttons")
    for up in (-0.28, 0.38):
        b.put(buttons, dark, sphere(0.055, (r1 * np.cos(up), 0, z1 + r1 * np.sin(up))))
    scarf = b.subpart(body, "scarf", "shawl")
    neck = z1 + r1 * 0.88
    b.put(
        scarf,
        scarf_paint,
        sweep([(0.175 * np.cos(a), 0.175 * np.sin(a), neck) for a in np.linspace(0, 2 * np.pi, 22)], 0.06),
    )
    b.put(
        scarf,
        scarf_paint,
        box((0.06, 0.11, 0.24), (0, 0, 0), 0.02).turned("y", -14).moved(r1 * 0.92, 0.11, neck - 0.15),
    )
    head = b.part("head")
    b.put(head, snow, sphere(r2, (0, 0, z2)))
    eyes = b.subpart(head, "eyes")
    for side in (-1, 1):
        b.put(eyes, dark, sphere(0.042, (r2 * 0.85, side * r2 * 0.42, z2 + r2 * 0.22)))
    nose = b.subpart(head, "nose", "carrot")
    carrot = lathe([(0, -0.02), (0.062, -0.02), (0.05, 0.08), (0, 0.27)]).turned("y", 90)
    b.put(nose, b.paints.draw("plain", "orange"), carrot.moved(r2 * 0.88, 0, z2 - 0.015))
    hat = b.part("hat", "top hat")
    top = z2 + r2 * 0.62
    b.put(hat, hat_paint, cylinder(r2 * 0.80, top + 0.02, top + 0.27, bevel=0.015))
    brim = b.subpart(hat, "brim", "hat edge")
    b.put(brim, hat_paint, cylinder(r2 * 1.35, top - 0.01, top + 0.05, bevel=0.015))
    band = b.subpart(hat, "band", "ribbon")
    b.put(
        band,
        b.paints.draw("cloth"),
        lathe(
            [(r2 * 0.8, top + 0.05), (r2 * 0.86, top + 0.05), (r2 * 0.86, top + 0.13), (r2 * 0.8, top + 0.13)]
        ),
    )
    for side in (-1, 1):
        arm = b.part("arm", "stick")
        elbow = np.array([0.06, side * (r1 + 0.16), z1 + 0.08])
        b.put(
            arm,
            b.paints.draw("wood", "brown"),
            sweep(
                [(0, side * r1 * 0.85, z1 + 0.03), elbow, elbow + np.array([0.06, side * 0.05, 0.10])], 0.035
            ),
        )
        mitten = b.subpart(arm, "mitten", "glove")
        b.put(mitten, boots, sphere(0.085, tuple(elbow + np.array([0.07, side * 0.06, 0.14]))))


def _robot(b: _Builder) -> None:
    shell, metal, dark = (
        b.paints.draw("metal"),
        b.paints.draw("metal", "grey", "white", "beige"),
        b.paints.draw("plastic", "black"),
    )
    glow, accent = b.paints.draw("plastic", "yellow", "red", "teal", "green"), b.paints.draw("plastic")
    w, h = b.between(0.40, 0.48), b.between(0.40, 0.48)
    low = 0.30
    body = b.part("body", "torso")
    b.put(body, shell, box((0.32, w, h), (0, 0, low + h / 2), 0.03))
    screen = b.subpart(body, "screen", "display")
    b.put(screen, dark, box((0.05, w * 0.62, h * 0.36), (0.16, 0, low + h * 0.70), 0.015))
    dial = b.subpart(body, "buttons", "dials")
    for side in (-1, 1):
        b.put(dial, glow, sphere(0.058, (0.16, side * w * 0.22, low + h * 0.25)))
    pack = b.subpart(body, "backpack", "battery")
    b.put(pack, accent, box((0.12, w * 0.6, h * 0.6), (-0.20, 0, low + h * 0.52), 0.03))
    head = b.part("head")
    z = low + h + 0.05
    b.put(
        head,
        metal,
        cylinder(0.09, low + h - 0.01, z + 0.02),
        box((0.28, w * 0.78, 0.27), (0, 0, z + 0.135), 0.03),
    )
    eyes = b.subpart(head, "eyes")
    for side in (-1, 1):
        b.put(
            eyes,
            glow,
            cylinder(0.062, -0.03, 0.03, 20, 0.01).turned("y", 90).moved(0.15, side * w * 0.19, z + 0.17),
        )
    mouth = b.subpart(head, "mouth", "grille")
    b.put(mouth, dark, box((0.04, w * 0.42, 0.065), (0.14, 0, z + 0.055), 0.012))
    antenna = b.subpart(head, "antenna", "aerial")
    b.put(antenna, accent, cylinder(0.025, z + 0.26, z + 0.40, 12), sphere(0.07, (0, 0, z + 0.43)))
    for side in (-1, 1):
        arm = b.part("arm")
        y = side * (w / 2 + 0.085)
        b.put(
            arm,
            metal,
            sphere(0.095, (0, y, low + h * 0.84)),
            sweep([(0, y, low + h * 0.8), (0.05, y, low + h * 0.35), (0.12, y, low + 0.05)], 0.06),
        )
        b.put(b.subpart(arm, "hand", "claw"), accent, box((0.13, 0.15, 0.15), (0.14, y, low - 0.01), 0.035))
        leg = b.part("leg")
        b.put(leg, metal, cylinder(0.075, 0.05, low + 0.01).moved(0, side * w * 0.25, 0))
        b.put(
            b.subpart(leg, "foot", "shoe"),
            dark,
            box((0.30, 0.19, 0.13), (0.05, side * w * 0.26, 0.065), 0.035),
        )


def _cake(b: _Builder) -> None:
    sponge, icing, cream = (
        b.paints.draw("plain", "brown", "beige", "pink", "yellow", "teal"),
        b.paints.draw("snow", "white", "pink", "beige", "purple", "red", "teal"),
        b.paints.draw("plain"),
    )
    plate_paint, cherry = (
        b.paints.draw("ceramic"),
        b.paints.draw("plastic", "red", "purple", "orange", "green"),
    )
    r, h = b.between(0.36, 0.42), b.between(0.22, 0.27)
    plate = b.part("plate", "dish")
    b.put(
        plate, plate_paint, lathe([(0, 0.0), (r * 0.8, 0.0), (r + 0.10, 0.05), (r + 0.10, 0.07), (0, 0.06)])
    )
    rim = b.subpart(plate, "rim", "edge")
    b.put(
        rim,
        b.paints.draw("ceramic"),
        lathe([(r + 0.03, 0.045), (r + 0.15, 0.06), (r + 0.15, 0.09), (r + 0.04, 0.085)], 36),
    )
    lower = b.part("bottom tier", "lower layer")
    b.put(lower, sponge, cylinder(r, 0.06, 0.06 + h))
    frost = b.subpart(lower, "icing", "frosting")
    top = 0.06 + h
    b.put(
        frost,
        icing,
        lathe(
            [
                (r, top - 0.09),
                (r + 0.03, top - 0.08),
                (r + 0.03, top),
                (r - 0.02, top + 0.03),
                (0, top + 0.03),
            ]
        ),
    )
    upper = b.part("top tier", "upper layer")
    r2, top2 = r * b.between(0.55, 0.64), top + 0.03 + h * 0.85
    b.put(upper, cream, cylinder(r2, top + 0.02, top2))
    glaze = b.subpart(upper, "glaze", "topping")
    b.put(
        glaze,
        b.paints.draw("snow"),
        lathe(
            [
                (r2, top2 - 0.07),
                (r2 + 0.03, top2 - 0.06),
                (r2 + 0.03, top2),
                (r2 - 0.02, top2 + 0.03),
                (0, top2 + 0.03),
            ]
        ),
    )
    cherries = b.subpart(lower, "cherries", "berries")
    for i in range(6):
        a = 2 * np.pi * i / 6
        b.put(
            cherries,
            cherry,
            sphere(
                0.068, ((r + r2) / 2 * np.cos(a) * 1.02, (r + r2) / 2 * np.sin(a) * 1.02, top + 0.075), 16
            ),
        )
    candle = b.part("candle")
    b.put(candle, b.paints.draw("ceramic"), cylinder(0.062, top2 + 0.02, top2 + 0.25))
    b.put(
        b.subpart(candle, "flame", "fire"),
        b.paints.draw("plain", "yellow", "orange"),
        lathe([(0, 0), (0.07, 0.06), (0.05, 0.12), (0, 0.21)]).moved(z=top2 + 0.25),
    )


def _rocket(b: _Builder) -> None:
    hull, nose_paint, fin_paint = (
        b.paints.draw("plain", "white", "grey", "beige", "teal", "blue", "orange"),
        b.paints.draw("plastic"),
        b.paints.draw("plastic"),
    )
    glass, band_paint, metal = (
        b.paints.draw("plastic", "blue", "teal", "black", "yellow"),
        b.paints.draw("plastic"),
        b.paints.draw("metal"),
    )
    r, low, high = b.between(0.19, 0.23), 0.22, b.between(0.72, 0.80)
    body = b.part("body", "hull")
    b.put(body, hull, lathe([(0, low), (r * 0.85, low), (r, low + 0.15), (r, high - 0.1), (r * 0.92, high)]))
    window = b.subpart(body, "windows", "portholes")
    for a in (0, 120, 240):
        pane = cylinder(0.095, -0.03, 0.035, 20, 0.015).turned("y", 90).moved(r, 0, high - 0.16)
        b.put(window, glass, pane.turned("z", a))
    band = b.subpart(body, "band", "stripe")
    b.put(
        band,
        band_paint,
        lathe([(r * 0.98, low + 0.12), (r * 1.07, low + 0.13), (r * 1.07, low + 0.24), (r, low + 0.25)]),
    )
    nose = b.part("nose cone", "nose")
    tip_z = high + b.between(0.28, 0.36)
    b.put(
        nose,
        nose_paint,
        lathe([(r * 0.92, high), (r * 0.78, high + 0.12), (r * 0.38, tip_z - 0.05), (0, tip_z)]),
    )
    b.put(b.subpart(nose, "tip", "point"), b.paints.draw("plastic"), sphere(0.095, (0, 0, tip_z)))
    for i in range(3):
        angle = 60 + 120 * i
        fin = b.part("fin", "wing")
        outline = [(r * 0.7, low + 0.03), (r + 0.26, 0.0), (r + 0.26, 0.18), (r * 0.8, low + 0.36)]
        b.put(fin, fin_paint, extrude(outline, 0.06).turned("z", angle))
        pad = b.subpart(fin, "foot", "landing pad")
        b.put(pad, band_paint, box((0.11, 0.11, 0.22), (r + 0.25, 0, 0.11), 0.03).turned("z", angle))
    engine = b.part("engine", "nozzle")
    b.put(engine, metal, lathe([(0, 0.08), (r * 0.9, 0.08), (r * 0.6, low + 0.02)]))
    b.put(
        b.subpart(engine, "flame", "fire"),
        b.paints.draw("plain", "orange", "yellow", "red"),
        lathe([(0, 0.0), (r * 0.5, 0.0), (r * 0.78, 0.085), (0, 0.09)]),
    )


def _clock(b: _Builder) -> None:
    case_paint, face_paint = (
        b.paints.draw("plastic"),
        b.paints.draw("plain", "white", "beige", "yellow", "pink"),
    )
    dark, accent, metal = (
        b.paints.draw("plastic", "black", "blue", "red", "purple"),
        b.paints.draw("plastic"),
        b.paints.draw("metal"),
    )
    r, depth = b.between(0.36, 0.42), b.between(0.22, 0.28)
    z = r + 0.13
    case = b.part("case", "body", "housing")
    b.put(case, case_paint, cylinder(r, -depth / 2, depth / 2 - 0.02, 36, 0.03).turned("y", 90).moved(z=z))
    frame = b.subpart(case, "frame", "ring")
    ring = lathe(
        [(r + 0.01, -0.01), (r + 0.03, 0.0), (r + 0.03, 0.06), (r - 0.07, 0.07), (r - 0.08, 0.0)], 36
    )
    b.put(frame, accent, ring.turned("y", 90).moved(depth / 2 - 0.03, 0, z))
    feet = b.subpart(case, "feet", "stand")
    for side in (-1, 1):
        b.put(
            feet,
            metal,
            sweep([(0, side * r * 0.55, z - r * 0.72), (0, side * r * 0.72, 0.05)], [0.06, 0.085]),
        )
    key = b.subpart(case, "key", "winder")
    b.put(
        key,
        metal,
        box((0.10, 0.24, 0.11), (-depth / 2 - 0.07, 0, z), 0.03),
        cylinder(0.05, 0, 0.06).turned("y", -90).moved(-depth / 2, 0, z),
    )
    face = b.part("face", "dial")
    x = depth / 2 - 0.015
    b.put(face, face_paint, cylinder(r - 0.07, 0, 0.03, 36).turned("y", 90).moved(x - 0.02, 0, z))
    marks = b.subpart(face, "hour marks", "numbers")
    for i in range(4):
        b.put(marks, dark, box((0.03, 0.075, 0.13), (x + 0.015, 0, r - 0.16)).turned("x", 90 * i).moved(z=z))
    hands = b.subpart(face, "hands", "pointers")
    for angle, length, width in ((b.between(0, 360), 0.56, 0.07), (b.between(0, 360), 0.36, 0.09)):
        b.put(
            hands,
            accent,
            box((0.03, width, r * length), (x + 0.045, 0, r * length / 2 - 0.03), 0.01)
            .turned("x", angle)
            .moved(z=z),
        )
    b.put(hands, accent, cylinder(0.07, 0, 0.05, 16, 0.01).turned("y", 90).moved(x + 0.02, 0, z))
    for side in (-1, 1):
        bell = b.part("bell", "alarm bell")
        place = (0, side * r * 0.62, z + r * 0.86)
        dome = lathe([(0, 0), (0.19, 0), (0.175, 0.09), (0.10, 0.16), (0, 0.18)]).turned("x", -side * 32)
        b.put(bell, metal, dome.moved(*place))
        top = np.array(place) + np.array([0, side * np.sin(np.radians(32)), np.cos(np.radians(32))]) * 0.19
        b.put(b.subpart(bell, "knob", "button"), dark, sphere(0.062, tuple(top)))


_MAKERS: dict[str, tuple[Callable[[_Builder], None], tuple[str, ...]]] = {
    "bear": (_bear, ("teddy bear", "teddy", "stuffed bear")),
    "mug": (_mug, ("coffee mug", "tea mug")),
    "kettle": (_kettle, ("teapot", "tea kettle")),
    "chair": (_chair, ("dining chair", "side chair")),
    "cabinet": (_cabinet, ("cupboard", "sideboard")),
    "lamp": (_lamp, ("table lamp", "light")),
    "shelf": (_shelf, ("bookshelf", "bookcase")),
    "car": (_car, ("toy car", "automobile")),
    "house": (_house, ("toy house", "cottage")),
    "plant": (_plant, ("potted plant", "flower plant")),
    "bottle": (_bottle, ("flask", "glass bottle")),
    "snowman": (_snowman, ("snow figure",)),
    "robot": (_robot, ("toy robot", "android")),
    "cake": (_cake, ("birthday cake", "torte")),
    "rocket": (_rocket, ("toy rocket", "spaceship")),
    "clock": (_clock, ("alarm clock", "timepiece")),
}

CLASSES: tuple[str, ...] = tuple(_MAKERS)
"""Names of the object classes."""


def build_object(name: str, rng: np.random.Generator) -> ObjectModel:
    """Draw one object of a class: sizes, colours, materials.

    Raises:
        SceneError: there is no such class.
    """
    if name not in _MAKERS:
        raise SceneError(f"unknown object class {name!r}", expected=f"one of {', '.join(CLASSES)}")
    maker, aliases = _MAKERS[name]
    builder = _Builder(name, aliases, rng)
    maker(builder)
    return builder.build()
