"""Full-size seats, beds, tables, a lamp and a rug, in metres. Backs face -x, fronts +x."""

import numpy as np

from hilsplat.world.objects.builder import CORNERS, Builder, Maker
from hilsplat.world.paints import Paint
from hilsplat.world.shapes import Mesh, box, cylinder, ellipsoid, joined, lathe, sweep


def _legs(b: Builder, x: float, y: float, top: float, paint: Paint, foot_paint: Paint, width: float) -> None:
    """Add four square legs at (+-x, +-y), each with a foot in another colour."""
    foot_height = max(0.05, 0.22 * top)
    for px in (-x, x):
        for py in (-y, y):
            leg = b.part("leg").put(
                paint, box((width, width, top - foot_height), (px, py, (top + foot_height) / 2), 0.008)
            )
            leg.subpart("foot", "leg tip").put(
                foot_paint, box((width * 1.3, width * 1.3, foot_height), (px, py, foot_height / 2), 0.01)
            )


def _pillow(size: tuple[float, float, float]) -> Mesh:
    """Return a soft pillow about the origin: a bevelled box and a bulge."""
    x, y, z = size
    return joined(box(size, bevel=0.42 * min(size)), ellipsoid((0.44 * x, 0.44 * y, 0.62 * z)))


def _bed(b: Builder) -> None:
    wood, sheet, blanket_paint = b.paint("wood"), b.paint("plain"), b.paint("cloth")
    length, width = b.between(1.85, 2.0), b.between(1.1, 1.45)
    frame_z, mattress = 0.32, b.between(0.17, 0.22)
    frame = b.part("frame", "bedstead").put(wood, box((length, width, 0.2), (0, 0, 0.22), 0.02))
    for x, y in CORNERS:
        frame.put(wood, box((0.09, 0.09, 0.14), (x * (length / 2 - 0.06), y * (width / 2 - 0.06), 0.07)))
    top = b.between(0.85, 1.0)
    frame.subpart("headboard", "head end").put(
        b.paint("cloth"), box((0.07, width + 0.06, top - 0.1), (-length / 2 - 0.03, 0, (top + 0.1) / 2), 0.03)
    )
    frame.subpart("footboard", "foot end").put(
        b.paint("wood"), box((0.05, width + 0.02, 0.44), (length / 2 + 0.02, 0, 0.25), 0.02)
    )
    middle = frame_z + mattress / 2
    bedding = b.part("mattress").put(
        sheet, box((length - 0.04, width - 0.05, mattress), (0, 0, middle), 0.05)
    )
    share = b.between(0.56, 0.64)
    start = length / 2 - share * length
    size = (share * length - 0.03, width + 0.02, mattress + 0.02)
    place = (start + share * length / 2 - 0.02, 0, middle + 0.025)
    bedding.subpart("blanket", "duvet", "comforter").put(blanket_paint, box(size, place, 0.05))
    bedding.subpart("fold", "turned sheet").put(
        b.paint("plain"), box((0.2, width + 0.03, mattress + 0.05), (start, 0, middle + 0.025), 0.05)
    )
    case, trim = b.paint("cloth"), b.paint("plain")
    for y in (-1, 1):
        w = width * 0.42
        z = frame_z + mattress + 0.07
        pillow = b.part("pillow", "head pillow").put(
            case, _pillow((0.4, w, 0.15)).moved(-length / 2 + 0.27, y * width * 0.235, z)
        )
        pillow.subpart("band", "ribbon").put(
            trim, box((0.44, w * 0.2, 0.19), (-length / 2 + 0.27, y * width * 0.235, z + 0.005), 0.07)
        )


def _sofa(b: Builder) -> None:
    cloth, cushion, wood = b.paint("cloth"), b.paint("plain"), b.paint("wood")
    depth, seats = b.between(0.82, 0.92), 2 if b.chance(0.5) else 3
    inner, arm_w = seats * b.between(0.54, 0.62), b.between(0.14, 0.2)
    width, seat_z, top = inner + 2 * arm_w, b.between(0.28, 0.32), b.between(0.78, 0.88)
    for x, y in CORNERS:
        profile = [(0, 0), (0.03, 0), (0.045, 0.1), (0, 0.1)]
        b.part("leg", "foot").put(
            wood, lathe(profile, 16).moved(x * (depth / 2 - 0.08), y * (width / 2 - 0.08), 0)
        )
    seat = b.part("seat", "base").put(
        cloth, box((depth - 0.02, inner + 0.02, seat_z - 0.09), (0, 0, (seat_z + 0.09) / 2), 0.02)
    )
    front = depth / 2 - 0.01
    for i in range(seats):
        y = (i - (seats - 1) / 2) * inner / seats
        seat.subpart("cushion", "seat cushion").put(
            cushion, box((depth - 0.24, inner / seats - 0.012, 0.16), (0.12, y, seat_z + 0.075), 0.045)
        )
    back = b.part("back", "backrest").put(
        cloth,
        box((0.18, width - 2 * arm_w + 0.02, top - 0.09), (-depth / 2 + 0.09, 0, (top + 0.09) / 2), 0.04),
    )
    back_paint = b.paint("cloth")
    for i in range(seats):
        y = (i - (seats - 1) / 2) * inner / seats
        back.subpart("back cushion", "back pad").put(
            back_paint,
            box(
                (0.15, inner / seats - 0.03, top - seat_z - 0.15),
                (-depth / 2 + 0.25, y, (top + seat_z) / 2 + 0.1),
                0.06,
            ),
        )
    pad_paint = b.paint("wood")
    arm_z = b.between(0.54, 0.62)
    for side in (-1, 1):
        y = side * (width - arm_w) / 2
        arm = b.part("arm", "armrest").put(
            cloth, box((depth, arm_w, arm_z - 0.09), (0, y, (arm_z + 0.09) / 2), 0.035)
        )
        arm.subpart("arm pad", "arm cover").put(
            pad_paint, box((depth * 0.7, arm_w + 0.03, 0.05), (0.08, y, arm_z + 0.005), 0.015)
        )
    side = -1 if b.chance(0.5) else 1
    place = (front - 0.42, side * (inner / 2 - 0.19), seat_z + 0.34)
    pillow = b.part("pillow", "throw pillow").put(
        b.paint("cloth"), _pillow((0.13, 0.38, 0.38)).turned("y", -14).moved(*place)
    )
    pillow.subpart("button", "knot").put(
        b.paint("plain"), ellipsoid((0.04, 0.075, 0.075), (0.08, 0, 0)).turned("y", -14).moved(*place)
    )


def _table(b: Builder) -> None:
    wood, leg_paint, foot = b.paint("wood"), b.paint("plain"), b.paint("metal")
    depth, width, height = b.between(0.52, 0.62), b.between(0.85, 1.05), b.between(0.42, 0.5)
    top = b.part("top", "board").put(wood, box((depth, width, 0.05), (0, 0, height - 0.025), 0.012))
    edge = top.subpart("edge", "rim")
    paint = b.paint("plain")
    for side in (-1, 1):
        edge.put(
            paint, box((0.035, width + 0.05, 0.07), (side * (depth / 2 + 0.008), 0, height - 0.032), 0.01)
        )
        edge.put(
            paint, box((depth + 0.05, 0.035, 0.07), (0, side * (width / 2 + 0.008), height - 0.032), 0.01)
        )
    top.subpart("runner", "tablecloth").put(
        b.paint("cloth"), box((depth * 0.46, width * 0.86, 0.012), (0, 0, height + 0.002), 0.003)
    )
    _legs(b, depth / 2 - 0.07, width / 2 - 0.07, height - 0.05, leg_paint, foot, 0.07)


def _desk(b: Builder) -> None:
    wood, front, metal = b.paint("wood"), b.paint("plain"), b.paint("metal")
    depth, width, height = b.between(0.6, 0.7), b.between(1.15, 1.35), b.between(0.72, 0.76)
    top = b.part("top", "board").put(wood, box((depth, width, 0.045), (0, 0, height - 0.0225), 0.01))
    top.subpart("pad", "writing mat").put(
        b.paint("cloth"), box((0.32, width * 0.42, 0.012), (depth / 2 - 0.18, -width * 0.1, height + 0.002))
    )
    unit_w = 0.38
    y = width / 2 - unit_w / 2 - 0.03
    unit = b.part("drawers", "drawer unit").put(
        b.paint("wood"), box((depth - 0.08, unit_w, height - 0.05), (0, y, (height - 0.045) / 2), 0.01)
    )
    each = (height - 0.1) / 3
    for i in range(3):
        z = 0.04 + each * (i + 0.5)
        unit.subpart("drawer", "drawer front").put(
            front, box((0.03, unit_w - 0.05, each - 0.03), (depth / 2 - 0.03, y, z), 0.008)
        )
        unit.subpart("handle", "pull").put(
            metal, box((0.035, 0.16, 0.035), (depth / 2 - 0.005, y, z + 0.02), 0.008)
        )
    leg_paint, foot_paint = b.paint("metal"), b.paint("plain")
    for x in (-1, 1):
        place = (x * (depth / 2 - 0.06), -width / 2 + 0.06)
        leg = b.part("leg").put(
            leg_paint, box((0.06, 0.06, height - 0.15), (*place, (height + 0.06) / 2), 0.008)
        )
        leg.subpart("foot", "leg tip").put(foot_paint, box((0.085, 0.085, 0.11), (*place, 0.055), 0.01))


def _nightstand(b: Builder) -> None:
    wood, front, metal = b.paint("wood"), b.paint("plain"), b.paint("metal")
    depth, width, height = b.between(0.38, 0.44), b.between(0.42, 0.5), b.between(0.5, 0.58)
    body = b.part("body", "case").put(
        wood, box((depth, width, height - 0.16), (0, 0, height / 2 + 0.05), 0.01)
    )
    body.subpart("top", "board").put(
        b.paint("stone"), box((depth + 0.05, width + 0.05, 0.045), (0, 0, height - 0.022), 0.012)
    )
    each = (height - 0.2) / 2
    for i in range(2):
        z = 0.155 + each * (i + 0.5)
        drawer = b.part("drawer").put(
            front, box((0.03, width - 0.07, each - 0.025), (depth / 2 + 0.012, 0, z), 0.008)
        )
        drawer.subpart("handle", "pull").put(
            metal, box((0.04, width * 0.36, 0.045), (depth / 2 + 0.04, 0, z), 0.01)
        )
    _legs(b, depth / 2 - 0.05, width / 2 - 0.05, 0.14, b.paint("wood"), b.paint("plain"), 0.055)


def _floor_lamp(b: Builder) -> None:
    metal, cloth, accent = b.paint("metal"), b.paint("cloth"), b.paint("ceramic")
    height, radius = b.between(1.45, 1.65), b.between(0.2, 0.25)
    base = b.part("base", "foot").put(
        accent, lathe([(0, 0), (0.19, 0), (0.19, 0.03), (0.06, 0.06), (0, 0.06)])
    )
    base.subpart("button", "switch").put(
        b.paint("plastic"), ellipsoid((0.045, 0.055, 0.03), (0.13, 0, 0.045))
    )
    pole = b.part("pole", "stem").put(metal, cylinder(0.022, 0.05, height - 0.1, 16))
    pole.subpart("ball", "joint").put(
        b.paint("ceramic"), ellipsoid((0.06, 0.06, 0.07), (0, 0, height * 0.45))
    )
    low, upper = height - 0.34, radius * b.between(0.6, 0.75)
    shade = b.part("shade", "lampshade").put(
        cloth,
        lathe([(radius, low), (upper, height), (upper - 0.01, height), (radius - 0.01, low), (radius, low)]),
    )
    higher = radius + (upper - radius) * 0.09 / 0.34
    profile = [
        (radius - 0.012, low - 0.012),
        (radius + 0.013, low - 0.012),
        (higher + 0.013, low + 0.09),
        (higher - 0.004, low + 0.095),
    ]
    shade.subpart("border", "trim").put(b.paint("plain"), lathe(profile))
    profile = [
        (0, height - 0.03),
        (upper - 0.005, height - 0.015),
        (0.04, height + 0.01),
        (0.045, height + 0.05),
        (0, height + 0.08),
    ]
    shade.subpart("finial", "top knob").put(accent, lathe(profile))


def _rug(b: Builder) -> None:
    width, depth = b.between(1.35, 1.6), b.between(0.95, 1.1)
    border = b.part("border", "edge").put(b.paint("plain"), box((depth, width, 0.012), (0, 0, 0.006), 0.004))
    fringe, fringe_paint = border.subpart("fringe", "tassels"), b.paint("plain")
    for side in (-1, 1):
        for i in range(15):
            x = (i - 7) / 15 * depth
            fringe.put(fringe_paint, box((depth / 24, 0.07, 0.008), (x, side * (width / 2 + 0.03), 0.004)))
    field = b.part("field", "middle").put(
        b.paint("cloth"), box((depth - 0.24, width - 0.24, 0.014), (0, 0, 0.008), 0.003)
    )
    field.subpart("medallion", "star").put(b.paint("plain"), cylinder(0.2, 0.005, 0.018, 8))


def _stool(b: Builder) -> None:
    wood, cloth, foot_paint = b.paint("wood"), b.paint("cloth"), b.paint("plain")
    r, height = b.between(0.2, 0.24), b.between(0.46, 0.58)
    seat = b.part("seat", "top").put(wood, cylinder(r, height - 0.09, height - 0.04, 36, bevel=0.01))
    seat.subpart("cushion", "pad").put(cloth, cylinder(r * 0.94, height - 0.05, height, 36, bevel=0.02))
    angle = np.linspace(0, 2 * np.pi, 25)
    hoop = np.stack([0.84 * r * np.cos(angle), 0.84 * r * np.sin(angle), np.full(25, height * 0.36)], axis=1)
    b.part("ring", "footrest").put(b.paint("metal"), sweep(list(hoop), 0.016, 10))
    leg_paint = b.paint("plain")
    for x, y in CORNERS:
        corner = np.array([x, y]) / np.sqrt(2)
        top, knee, floor = (
            np.array([*(corner * r * out), z]) for out, z in ((0.7, height - 0.08), (0.9, 0.1), (0.96, 0.0))
        )
        leg = b.part("leg").put(leg_paint, sweep([knee, (knee + top) / 2, top], 0.024))
        leg.subpart("foot", "leg tip").put(foot_paint, sweep([floor, (knee + floor) / 2, knee], 0.032))


MAKERS: dict[str, Maker] = {
    "bed": Maker(_bed, ("sleeping bed",)),
    "sofa": Maker(_sofa, ("couch", "settee")),
    "table": Maker(_table, ("coffee table", "low table")),
    "desk": Maker(_desk, ("writing desk", "work desk")),
    "nightstand": Maker(_nightstand, ("bedside table", "night table")),
    "lamp": Maker(_floor_lamp, ("floor lamp", "standing lamp", "light")),
    "rug": Maker(_rug, ("carpet", "mat")),
    "stool": Maker(_stool, ("footstool", "bar stool")),
}
