"""Miniature household objects: each function draws one class of object."""

import numpy as np

from hilsplat.world.objects.builder import CORNERS, Builder, Maker
from hilsplat.world.shapes import box, cylinder, ellipsoid, lathe, sphere, sweep


def _chair(b: Builder) -> None:
    wood, cloth, accent = b.paint("wood"), b.paint("cloth"), b.paint("plain")
    w, seat_z, top = b.between(0.50, 0.60), b.between(0.42, 0.50), b.between(1.0, 1.15)
    seat = b.part("seat").put(wood, box((w, w, 0.07), (0, 0, seat_z), 0.015))
    seat.subpart("cushion", "pillow").put(
        cloth, box((w * 0.86, w * 0.86, 0.11), (0.01, 0, seat_z + 0.085), 0.04)
    )
    back = b.part("back", "backrest")
    for side in (-1, 1):
        size = (0.075, 0.085, top - seat_z)
        place = (-w / 2 + 0.04, side * (w / 2 - 0.045), (top + seat_z) / 2)
        back.put(wood, box(size, place, 0.015))
    back.subpart("top rail", "headrest").put(
        accent, box((0.09, w + 0.04, 0.17), (-w / 2 + 0.04, 0, top - 0.05), 0.03)
    )
    slats = back.subpart("slats", "bars")
    slat_paint = b.paint("plain")
    low, high = seat_z + 0.06, top - 0.14
    for i in range(3):
        slats.put(
            slat_paint,
            box((0.05, 0.10, high - low), (-w / 2 + 0.04, (i - 1) * w * 0.26, (low + high) / 2), 0.01),
        )
    for x, y in CORNERS:
        px, py = x * (w / 2 - 0.05), y * (w / 2 - 0.05)
        leg = b.part("leg").put(wood, box((0.09, 0.09, seat_z - 0.13), (px, py, (seat_z + 0.07) / 2), 0.012))
        leg.subpart("foot", "leg tip").put(accent, box((0.13, 0.13, 0.16), (px, py, 0.08), 0.02))


def _cabinet(b: Builder) -> None:
    wood, front, metal = b.paint("wood"), b.paint("plain"), b.paint("metal")
    d, w, h = b.between(0.42, 0.5), b.between(0.62, 0.75), b.between(0.75, 0.9)
    body = b.part("body", "case", "frame").put(wood, box((d, w, h - 0.1), (0, 0, h / 2 + 0.05), 0.012))
    body.put(
        wood,
        *[
            box((0.09, 0.09, 0.12), (x * (d / 2 - 0.06), y * (w / 2 - 0.06), 0.05))
            for x in (-1, 1)
            for y in (-1, 1)
        ],
    )
    body.subpart("top", "board").put(
        b.paint("stone"), box((d + 0.08, w + 0.08, 0.08), (0, 0, h + 0.03), 0.02)
    )
    body.subpart("back panel", "back").put(
        b.paint("plain"), box((0.04, w * 0.80, h * 0.62), (-d / 2 - 0.005, 0, h * 0.52), 0.01)
    )
    inlays = body.subpart("side panels", "sides")
    inlay = b.paint("wood")
    for side in (-1, 1):
        inlays.put(inlay, box((d * 0.62, 0.04, h * 0.56), (0, side * (w / 2 + 0.003), h * 0.52), 0.01))
    x, split = d / 2, h * 0.66
    for side in (-1, 1):
        door_w, door_h = w / 2 - 0.05, split - 0.17
        y, z = side * (w / 4 - 0.003), 0.13 + door_h / 2
        door = b.part("door").put(front, box((0.05, door_w, door_h), (x + 0.02, y, z), 0.012))
        door.subpart("panel", "inlay").put(
            b.paint("cloth"),
            box((0.05, door_w * 0.52, door_h * 0.66), (x + 0.04, y + side * door_w * 0.13, z), 0.015),
        )
        door.subpart("knob", "doorknob").put(metal, sphere(0.072, (x + 0.08, y - side * door_w * 0.34, z)))
    z = (split + h) / 2 - 0.01
    drawer = b.part("drawer").put(
        b.paint("plain"), box((0.05, w - 0.09, h - split - 0.07), (x + 0.02, 0, z), 0.012)
    )
    drawer.subpart("handle", "pull").put(metal, box((0.07, w * 0.40, 0.085), (x + 0.075, 0, z), 0.025))


def _lamp(b: Builder) -> None:
    metal, cloth, accent = b.paint("metal"), b.paint("cloth"), b.paint("ceramic")
    h, shade_r = b.between(0.95, 1.15), b.between(0.32, 0.40)
    base = b.part("base", "foot").put(
        accent, lathe([(0, 0), (0.28, 0), (0.28, 0.07), (0.20, 0.13), (0, 0.14)])
    )
    base.subpart("button", "switch").put(b.paint("plastic"), ellipsoid((0.09, 0.11, 0.075), (0.205, 0, 0.12)))
    pole = b.part("pole", "stem").put(metal, cylinder(0.055, 0.1, h - 0.22))
    pole.subpart("ball", "joint").put(b.paint("ceramic"), sphere(b.between(0.13, 0.155), (0, 0, 0.34)))
    low, upper = h - 0.46, shade_r * b.between(0.55, 0.7)

    def radius(z: float) -> float:
        return shade_r + (upper - shade_r) * (z - low) / 0.46

    shade = b.part("shade", "lampshade").put(
        cloth, lathe([(shade_r, low), (upper, h), (upper - 0.03, h), (shade_r - 0.03, low), (shade_r, low)])
    )
    trim = b.paint("cloth")
    profile = [
        (shade_r - 0.035, low - 0.01),
        (shade_r + 0.022, low - 0.01),
        (radius(low + 0.115) + 0.022, low + 0.115),
        (radius(low + 0.115), low + 0.12),
    ]
    shade.subpart("border", "trim").put(trim, lathe(profile))
    shade.subpart("finial", "top knob").put(
        accent,
        lathe([(0, h - 0.03), (upper - 0.01, h - 0.03), (0.06, h + 0.01), (0.075, h + 0.07), (0, h + 0.12)]),
    )


def _shelf(b: Builder) -> None:
    wood, back = b.paint("wood"), b.paint("plain")
    d, w, h = b.between(0.32, 0.38), b.between(0.66, 0.8), b.between(0.85, 1.0)
    frame = b.part("frame", "case")
    for side in (-1, 1):
        frame.put(wood, box((d, 0.06, h), (0, side * (w / 2 - 0.03), h / 2), 0.012))
    frame.subpart("back wall", "backboard").put(
        back, box((0.04, w - 0.12, h - 0.04), (-d / 2 + 0.02, 0, h / 2))
    )
    braces = frame.subpart("braces", "back bars")
    brace_paint = b.paint("plain")
    for z in (h * 0.28, h * 0.72):
        braces.put(brace_paint, box((0.04, w - 0.04, 0.13), (-d / 2 - 0.005, 0, z), 0.01))
    boards = frame.subpart("boards", "planks")
    board_paint = b.paint("wood")
    for z in (0.05, h * 0.5, h - 0.035):
        boards.put(board_paint, box((d + 0.03, w - 0.11, 0.07), (0.015, 0, z), 0.012))
    books = b.part("books", "row of books")
    y, bottom = -w / 2 + 0.08, h * 0.5 + 0.035
    while y < 0.04:
        thick, tall = b.between(0.085, 0.12), b.between(0.27, 0.34)
        books.subpart("book").put(
            b.paint("cloth"),
            box((d * b.between(0.72, 0.9), thick, tall), (0.02, y + thick / 2, bottom + tall / 2), 0.01),
        )
        y += thick + 0.006
    vy, vz = w / 2 - 0.18, bottom
    vase = b.part("vase", "pot").put(
        b.paint("ceramic"),
        lathe([(0, 0), (0.08, 0), (0.135, 0.10), (0.11, 0.20), (0.05, 0.25)]).moved(0.03, vy, vz),
    )
    vase.subpart("rim", "mouth").put(
        b.paint("ceramic"), lathe([(0.05, 0.19), (0.14, 0.28), (0.13, 0.345), (0, 0.31)]).moved(0.03, vy, vz)
    )
    crate_w = w * 0.52
    cy = b.between(-0.06, 0.06)
    crate = b.part("box", "basket").put(
        b.paint("cloth"), box((d * 0.85, crate_w, h * 0.30), (0.03, cy, 0.085 + h * 0.15), 0.015)
    )
    crate.subpart("label", "tag").put(
        b.paint("plain"),
        box((0.03, crate_w * 0.5, h * 0.14), (0.03 + d * 0.425, cy, 0.085 + h * 0.15), 0.008),
    )


def _plant(b: Builder) -> None:
    clay, rim_paint = b.paint("ceramic"), b.paint("ceramic")
    leaf = b.paint("plain", "green", "teal")
    stem_paint = b.paint("wood", "brown")
    petal = b.paint("plain", "red", "pink", "yellow", "purple", "orange", "white", "blue")
    r, h = b.between(0.24, 0.30), b.between(0.30, 0.38)
    pot = b.part("pot", "flowerpot").put(clay, lathe([(0, 0), (r * 0.72, 0), (r, h)]))
    pot.subpart("rim", "edge").put(
        rim_paint,
        lathe([(r, h - 0.10), (r + 0.05, h - 0.09), (r + 0.05, h), (r - 0.03, h), (r - 0.04, h - 0.05)]),
    )
    pot.subpart("soil", "earth").put(
        b.paint("plain", "brown", "black"), lathe([(r - 0.02, h - 0.04), (r * 0.5, h - 0.015), (0, h)])
    )
    top = h + b.between(0.26, 0.34)
    stem = b.part("stem", "trunk").put(
        stem_paint,
        sweep([(0, 0, h - 0.05), (0.02, 0.02, (h + top) / 2), (0, 0, top + 0.05)], [0.06, 0.05, 0.05]),
    )
    stem.subpart("ring", "ribbon").put(
        b.paint("cloth"),
        lathe([(0.05, -0.065), (0.095, -0.05), (0.095, 0.05), (0.05, 0.065)]).moved(0.01, 0.01, h + 0.11),
    )
    size = b.between(0.26, 0.31)
    crown = b.part("crown", "leaves", "foliage").put(
        leaf, ellipsoid((size, size, size * 0.92), (0, 0, top + size * 0.7))
    )
    for i in range(5):
        a = 2 * np.pi * i / 5 + b.between(0, 0.8)
        crown.put(
            leaf,
            sphere(
                size * 0.52,
                (size * 0.72 * np.cos(a), size * 0.72 * np.sin(a), top + size * b.between(0.35, 0.75)),
            ),
        )
    for i in range(5):
        a, up = 2 * np.pi * i / 5 + b.between(0, 0.5), b.between(0.15, 1.0)
        flat = size * 1.1 * np.cos(up)
        place = (flat * np.cos(a), flat * np.sin(a), top + size * 0.75 + size * np.sin(up) * 0.95)
        crown.subpart("flower", "blossom").put(petal, sphere(0.085, place, 16))


def _clock(b: Builder) -> None:
    case_paint = b.paint("plastic")
    face_paint = b.paint("plain", "white", "beige", "yellow", "pink")
    dark = b.paint("plastic", "black", "blue", "red", "purple")
    accent = b.paint("plastic")
    metal = b.paint("metal")
    r, depth = b.between(0.36, 0.42), b.between(0.22, 0.28)
    z = r + 0.13
    case = b.part("case", "body", "housing").put(
        case_paint, cylinder(r, -depth / 2, depth / 2 - 0.02, 36, 0.03).turned("y", 90).moved(z=z)
    )
    ring = lathe(
        [(r + 0.01, -0.01), (r + 0.03, 0.0), (r + 0.03, 0.06), (r - 0.07, 0.07), (r - 0.08, 0.0)], 36
    )
    case.subpart("frame", "ring").put(accent, ring.turned("y", 90).moved(depth / 2 - 0.03, 0, z))
    feet = case.subpart("feet", "stand")
    for side in (-1, 1):
        feet.put(
            metal, sweep([(0, side * r * 0.55, z - r * 0.72), (0, side * r * 0.72, 0.05)], [0.06, 0.085])
        )
    case.subpart("key", "winder").put(
        metal,
        box((0.10, 0.24, 0.11), (-depth / 2 - 0.07, 0, z), 0.03),
        cylinder(0.05, 0, 0.06).turned("y", -90).moved(-depth / 2, 0, z),
    )
    case.subpart("back cover", "battery cover").put(
        b.paint("plain"),
        cylinder(r * 0.72, -0.03, 0.0, 32, 0.01).turned("y", 90).moved(-depth / 2 + 0.005, 0, z),
    )
    x = depth / 2 - 0.015
    face = b.part("face", "dial").put(
        face_paint, cylinder(r - 0.07, 0, 0.03, 36).turned("y", 90).moved(x - 0.02, 0, z)
    )
    marks = face.subpart("hour marks", "numbers")
    for i in range(4):
        marks.put(dark, box((0.03, 0.075, 0.13), (x + 0.015, 0, r - 0.16)).turned("x", 90 * i).moved(z=z))
    hands = face.subpart("hands", "pointers")
    for angle, length, width in ((b.between(0, 360), 0.56, 0.07), (b.between(0, 360), 0.36, 0.09)):
        hands.put(
            accent,
            box((0.03, width, r * length), (x + 0.045, 0, r * length / 2 - 0.03), 0.01)
            .turned("x", angle)
            .moved(z=z),
        )
    hands.put(accent, cylinder(0.07, 0, 0.05, 16, 0.01).turned("y", 90).moved(x + 0.02, 0, z))
    for side in (-1, 1):
        place = (0, side * r * 0.62, z + r * 0.86)
        dome = lathe([(0, 0), (0.19, 0), (0.175, 0.09), (0.10, 0.16), (0, 0.18)]).turned("x", -side * 32)
        bell = b.part("bell", "alarm bell").put(metal, dome.moved(*place))
        top = np.array(place) + np.array([0, side * np.sin(np.radians(32)), np.cos(np.radians(32))]) * 0.19
        bell.subpart("knob", "button").put(dark, sphere(0.078, tuple(top)))


MAKERS: dict[str, Maker] = {
    "chair": Maker(_chair, ("dining chair", "side chair")),
    "cabinet": Maker(_cabinet, ("cupboard", "sideboard")),
    "lamp": Maker(_lamp, ("table lamp", "light")),
    "shelf": Maker(_shelf, ("shelving unit", "book rack")),
    "plant": Maker(_plant, ("potted plant", "flower plant")),
    "clock": Maker(_clock, ("alarm clock", "timepiece")),
}
