"""Full-size furniture, kitchen units, screens and fixtures, in metres.

Fronts face +x; the backs of fixtures (doors, windows, curtains, pictures, mirrors) are at x = 0.
"""

import numpy as np

from hilsplat_world.objects.builder import CORNERS, Builder
from hilsplat_world.paints import Paint
from hilsplat_world.shapes import (
    Mesh,
    box,
    cylinder,
    disc,
    ellipsoid,
    extrude,
    joined,
    lathe,
    roller,
    sphere,
    sweep,
)


def _legs(b: Builder, x: float, y: float, top: float, paints: list[Paint], width: float) -> None:
    """Add four square legs at (+-x, +-y), each with a foot; `paints` contains the paints of leg and foot."""
    foot_height = max(0.05, 0.22 * top)
    shape = box((width, width, top - foot_height), (0, 0, (top + foot_height) / 2), 0.008)
    foot = box((width * 1.3, width * 1.3, foot_height), (0, 0, foot_height / 2), 0.01)
    for side_x, side_y in CORNERS:
        leg = b.part("leg", paints[0], shape.moved(side_x * x, side_y * y))
        leg.subpart("foot, leg tip", paints[1], foot.moved(side_x * x, side_y * y))


def _pillow(size: tuple[float, float, float]) -> Mesh:
    """Return a soft pillow centred at the origin: a bevelled box and a bulge."""
    x, y, z = size
    return joined(box(size, bevel=0.42 * min(size)), ellipsoid((0.44 * x, 0.44 * y, 0.62 * z)))


def bed(b: Builder) -> None:
    wood, sheet, blanket_paint = b.paints("wood", "plain", "cloth")
    length, width = b.between(1.85, 2.0), b.between(1.1, 1.45)
    frame_z, mattress = 0.32, b.between(0.17, 0.22)
    leg = box((0.09, 0.09, 0.14), (0, 0, 0.07))
    legs = [leg.moved(x * (length / 2 - 0.06), y * (width / 2 - 0.06)) for x, y in CORNERS]
    frame = b.part("frame, bedstead", wood, box((length, width, 0.2), (0, 0, 0.22), 0.02), *legs)
    top = b.between(0.85, 1.0)
    shape = box((0.07, width + 0.06, top - 0.1), (-length / 2 - 0.03, 0, (top + 0.1) / 2), 0.03)
    frame.subpart("headboard, head end", "cloth", shape)
    shape = box((0.05, width + 0.02, 0.44), (length / 2 + 0.02, 0, 0.25), 0.02)
    frame.subpart("footboard, foot end", "wood", shape)
    middle = frame_z + mattress / 2
    bedding = b.part("mattress", sheet, box((length - 0.04, width - 0.05, mattress), (0, 0, middle), 0.05))
    share = b.between(0.56, 0.64)
    start = length / 2 - share * length
    size = (share * length - 0.03, width + 0.02, mattress + 0.02)
    position = (start + share * length / 2 - 0.02, 0, middle + 0.025)
    bedding.subpart("blanket, duvet, comforter", blanket_paint, box(size, position, 0.05))
    shape = box((0.2, width + 0.03, mattress + 0.05), (start, 0, middle + 0.025), 0.05)
    bedding.subpart("fold, turned sheet", "plain", shape)
    case, trim = b.paints("cloth", "plain")
    w, z = width * 0.42, frame_z + mattress + 0.07
    for y in (-1, 1):
        shape = _pillow((0.4, w, 0.15)).moved(-length / 2 + 0.27, y * width * 0.235, z)
        pillow = b.part("pillow, head pillow", case, shape)
        shape = box((0.44, w * 0.2, 0.19), (-length / 2 + 0.27, y * width * 0.235, z + 0.005), 0.07)
        pillow.subpart("band, ribbon", trim, shape)


def sofa(b: Builder) -> None:
    cloth, cushion, wood = b.paints("cloth", "plain", "wood")
    depth, seats = b.between(0.82, 0.92), 2 if b.chance(0.5) else 3
    inner, arm_w = seats * b.between(0.54, 0.62), b.between(0.14, 0.2)
    width, seat_z, top = inner + 2 * arm_w, b.between(0.28, 0.32), b.between(0.78, 0.88)
    leg = lathe([(0, 0), (0.03, 0), (0.045, 0.1), (0, 0.1)], 16)
    for x, y in CORNERS:
        b.part("leg, foot", wood, leg.moved(x * (depth / 2 - 0.08), y * (width / 2 - 0.08), 0))
    shape = box((depth - 0.02, inner + 0.02, seat_z - 0.09), (0, 0, (seat_z + 0.09) / 2), 0.02)
    seat = b.part("seat, base", cloth, shape)
    front = depth / 2 - 0.01
    middles = [(i - (seats - 1) / 2) * inner / seats for i in range(seats)]
    for y in middles:
        shape = box((depth - 0.24, inner / seats - 0.012, 0.16), (0.12, y, seat_z + 0.075), 0.045)
        seat.subpart("cushion, seat cushion", cushion, shape)
    shape = box((0.18, width - 2 * arm_w + 0.02, top - 0.09), (-depth / 2 + 0.09, 0, (top + 0.09) / 2), 0.04)
    back = b.part("back, backrest", cloth, shape)
    back_paint = b.paint("cloth")
    for y in middles:
        size = (0.15, inner / seats - 0.03, top - seat_z - 0.15)
        shape = box(size, (-depth / 2 + 0.25, y, (top + seat_z) / 2 + 0.1), 0.06)
        back.subpart("back cushion, back pad", back_paint, shape)
    pad_paint = b.paint("wood")
    arm_z = b.between(0.54, 0.62)
    for side in (-1, 1):
        y = side * (width - arm_w) / 2
        shape = box((depth, arm_w, arm_z - 0.09), (0, y, (arm_z + 0.09) / 2), 0.035)
        arm = b.part("arm, armrest", cloth, shape)
        shape = box((depth * 0.7, arm_w + 0.03, 0.05), (0.08, y, arm_z + 0.005), 0.015)
        arm.subpart("arm pad, arm cover", pad_paint, shape)
    side = -1 if b.chance(0.5) else 1
    position = (front - 0.42, side * (inner / 2 - 0.19), seat_z + 0.34)
    shape = _pillow((0.13, 0.38, 0.38)).turned("y", -14).moved(*position)
    pillow = b.part("pillow, throw pillow", "cloth", shape)
    shape = ellipsoid((0.04, 0.075, 0.075), (0.08, 0, 0)).turned("y", -14).moved(*position)
    pillow.subpart("button, knot", "plain", shape)


def table(b: Builder) -> None:
    wood, leg_paint, foot = b.paints("wood", "plain", "metal")
    depth, width, height = b.between(0.52, 0.62), b.between(0.85, 1.05), b.between(0.42, 0.5)
    top = b.part("top, board", wood, box((depth, width, 0.05), (0, 0, height - 0.025), 0.012))
    edges = []
    for side in (-1, 1):
        edges.append(box((0.035, width + 0.05, 0.07), (side * (depth / 2 + 0.008), 0, height - 0.032), 0.01))
        edges.append(box((depth + 0.05, 0.035, 0.07), (0, side * (width / 2 + 0.008), height - 0.032), 0.01))
    top.subpart("edge, rim", "plain", *edges)
    shape = box((depth * 0.46, width * 0.86, 0.012), (0, 0, height + 0.002), 0.003)
    top.subpart("runner, tablecloth", "cloth", shape)
    _legs(b, depth / 2 - 0.07, width / 2 - 0.07, height - 0.05, [leg_paint, foot], 0.07)


def desk(b: Builder) -> None:
    wood, front, metal = b.paints("wood", "plain", "metal")
    depth, width, height = b.between(0.6, 0.7), b.between(1.15, 1.35), b.between(0.72, 0.76)
    top = b.part("top, board", wood, box((depth, width, 0.045), (0, 0, height - 0.0225), 0.01))
    shape = box((0.32, width * 0.42, 0.012), (depth / 2 - 0.18, -width * 0.1, height + 0.002))
    top.subpart("pad, writing mat", "cloth", shape)
    unit_w = 0.38
    y = width / 2 - unit_w / 2 - 0.03
    shape = box((depth - 0.08, unit_w, height - 0.05), (0, y, (height - 0.045) / 2), 0.01)
    unit = b.part("drawers, drawer unit", "wood", shape)
    drawer_h = (height - 0.1) / 3
    for i in range(3):
        z = 0.04 + drawer_h * (i + 0.5)
        shape = box((0.03, unit_w - 0.05, drawer_h - 0.03), (depth / 2 - 0.03, y, z), 0.008)
        unit.subpart("drawer, drawer front", front, shape)
        shape = box((0.035, 0.16, 0.035), (depth / 2 - 0.005, y, z + 0.02), 0.008)
        unit.subpart("handle, pull", metal, shape)
    leg_paint, foot_paint = b.paints("metal", "plain")
    for x in (-1, 1):
        spot = (x * (depth / 2 - 0.06), -width / 2 + 0.06)
        leg = b.part("leg", leg_paint, box((0.06, 0.06, height - 0.15), (*spot, (height + 0.06) / 2), 0.008))
        leg.subpart("foot, leg tip", foot_paint, box((0.085, 0.085, 0.11), (*spot, 0.055), 0.01))


def nightstand(b: Builder) -> None:
    wood, front, metal = b.paints("wood", "plain", "metal")
    depth, width, height = b.between(0.38, 0.44), b.between(0.42, 0.5), b.between(0.5, 0.58)
    body = b.part("body, case", wood, box((depth, width, height - 0.16), (0, 0, height / 2 + 0.05), 0.01))
    shape = box((depth + 0.05, width + 0.05, 0.045), (0, 0, height - 0.022), 0.012)
    body.subpart("top, board", "stone", shape)
    drawer_h = (height - 0.2) / 2
    for i in range(2):
        z = 0.155 + drawer_h * (i + 0.5)
        shape = box((0.03, width - 0.07, drawer_h - 0.025), (depth / 2 + 0.012, 0, z), 0.008)
        drawer = b.part("drawer", front, shape)
        shape = box((0.04, width * 0.36, 0.045), (depth / 2 + 0.04, 0, z), 0.01)
        drawer.subpart("handle, pull", metal, shape)
    _legs(b, depth / 2 - 0.05, width / 2 - 0.05, 0.14, b.paints("wood", "plain"), 0.055)


def floor_lamp(b: Builder) -> None:
    metal, cloth, accent = b.paints("metal", "cloth", "ceramic")
    height, radius = b.between(1.45, 1.65), b.between(0.2, 0.25)
    base = b.part("base, foot", accent, lathe([(0, 0), (0.19, 0), (0.19, 0.03), (0.06, 0.06), (0, 0.06)]))
    base.subpart("button, switch", "plastic", ellipsoid((0.045, 0.055, 0.03), (0.13, 0, 0.045)))
    pole = b.part("pole, stem", metal, cylinder(0.022, 0.05, height - 0.1, 16))
    pole.subpart("ball, joint", "ceramic", ellipsoid((0.06, 0.06, 0.07), (0, 0, height * 0.45)))
    low, upper = height - 0.34, radius * b.between(0.6, 0.75)
    profile = [(radius, low), (upper, height), (upper - 0.01, height), (radius - 0.01, low), (radius, low)]
    shade = b.part("shade, lampshade", cloth, lathe(profile))
    higher = radius + (upper - radius) * 0.09 / 0.34
    profile = [(radius - 0.012, low - 0.012), (radius + 0.013, low - 0.012)]
    profile += [(higher + 0.013, low + 0.09), (higher - 0.004, low + 0.095)]
    shade.subpart("border, trim", "plain", lathe(profile))
    profile = [(0, height - 0.03), (upper - 0.005, height - 0.015)]
    profile += [(0.04, height + 0.01), (0.045, height + 0.05), (0, height + 0.08)]
    shade.subpart("finial, top knob", accent, lathe(profile))


def rug(b: Builder) -> None:
    width, depth = b.between(1.35, 1.6), b.between(0.95, 1.1)
    border = b.part("border, edge", "plain", box((depth, width, 0.012), (0, 0, 0.006), 0.004))
    tassel = box((depth / 24, 0.07, 0.008))
    places = [((i - 7) / 15 * depth, side * (width / 2 + 0.03)) for side in (-1, 1) for i in range(15)]
    border.subpart("fringe, tassels", "plain", *[tassel.moved(x, y, 0.004) for x, y in places])
    field = b.part("field, middle", "cloth", box((depth - 0.24, width - 0.24, 0.014), (0, 0, 0.008), 0.003))
    field.subpart("medallion, star", "plain", cylinder(0.2, 0.005, 0.018, 8))


def stool(b: Builder) -> None:
    wood, cloth, foot_paint = b.paints("wood", "cloth", "plain")
    r, height = b.between(0.2, 0.24), b.between(0.46, 0.58)
    seat = b.part("seat, top", wood, cylinder(r, height - 0.09, height - 0.04, 36, bevel=0.01))
    seat.subpart("cushion, pad", cloth, cylinder(r * 0.94, height - 0.05, height, 36, bevel=0.02))
    angle = np.linspace(0, 2 * np.pi, 25)
    hoop = np.stack([0.84 * r * np.cos(angle), 0.84 * r * np.sin(angle), np.full(25, height * 0.36)], axis=1)
    b.part("ring, footrest", "metal", sweep(hoop, 0.016, 10))
    leg_paint = b.paint("plain")
    for x, y in CORNERS:
        corner = np.array([x, y]) / np.sqrt(2)
        ends = ((0.7, height - 0.08), (0.9, 0.1), (0.96, 0.0))
        top, knee, floor = (np.array([*(corner * r * out), z]) for out, z in ends)
        leg = b.part("leg", leg_paint, sweep([knee, (knee + top) / 2, top], 0.024))
        leg.subpart("foot, leg tip", foot_paint, sweep([floor, (knee + floor) / 2, knee], 0.032))


def door(b: Builder) -> None:
    frame_paint, leaf_paint, metal = b.paints("plain", "wood", "metal")
    width, height = b.between(0.84, 0.92), b.between(2.0, 2.06)
    posts = box((0.06, 0.09, height), bevel=0.01).both_sides(0.03, width / 2 + 0.045, height / 2)
    frame = b.part("frame, casing", frame_paint, posts)
    frame.subpart("lintel, head", "wood", box((0.07, width + 0.24, 0.11), (0.035, 0, height + 0.055), 0.012))
    leaf = b.part("leaf, wing", leaf_paint, box((0.04, width, height - 0.005), (0.02, 0, height / 2)))
    panel_paint = b.paint("plain")
    for y in (-1.0, 1.0):
        for low, high in ((0.14, 0.44), (0.5, 0.94)):
            size = (0.02, width * 0.36, (high - low) * height)
            position = (0.042, y * width * 0.23, (low + high) / 2 * height)
            leaf.subpart("panel, inlay", panel_paint, box(size, position, 0.008))
    y = -width / 2 + 0.07
    handle = b.part("handle, latch", metal, box((0.02, 0.055, 0.22), (0.048, y, 1.02), 0.006))
    path = [(0.05, y, 1.05), (0.1, y, 1.05), (0.105, y + 0.06, 1.05), (0.1, y + 0.15, 1.05)]
    handle.subpart("lever, knob", "metal", sweep(path, 0.018))


def window(b: Builder) -> None:
    frame_paint, sky = b.paints("plain", "plain blue teal white")
    width, height = b.between(1.15, 1.35), b.between(1.1, 1.25)
    frame = b.part("frame, casing")
    for side in (-1, 1):
        frame.put(frame_paint, box((0.06, 0.08, height), (0.03, side * (width / 2 - 0.04), height / 2), 0.01))
        shape = box((0.06, width, 0.08), (0.03, 0, height / 2 + side * (height / 2 - 0.04)), 0.01)
        frame.put(frame_paint, shape)
    frame.subpart("sill, ledge", "stone", box((0.11, width + 0.08, 0.05), (0.055, 0, 0.0), 0.01))
    bar_paint, hill_paint, metal = b.paints("wood", "plain green brown", "metal")
    w, h = width / 2 - 0.08, height - 0.16
    for side in (-1, 1):
        sash = b.part("sash, wing")
        y = side * (w / 2 + 0.002)
        for edge in (-1, 1):
            sash.put(bar_paint, box((0.045, 0.05, h), (0.025, y + edge * (w / 2 - 0.025), height / 2), 0.006))
            sash.put(bar_paint, box((0.045, w, 0.05), (0.025, y, height / 2 + edge * (h / 2 - 0.025)), 0.006))
        sash.subpart("pane, glass", sky, box((0.016, w - 0.08, h - 0.08), (0.012, y, height / 2)))
        shape = box((0.016, w - 0.085, h * b.between(0.22, 0.32)), (0.015, y, 0.13 + h * 0.14))
        sash.subpart("view, landscape", hill_paint, shape)
        shape = box((0.04, 0.035, 0.14), (0.055, side * 0.028, height / 2), 0.008)
        sash.subpart("catch, window handle", metal, shape)


def curtain(b: Builder) -> None:
    cloth, metal, trim = b.paints("cloth", "metal", "plain")
    opening, drop, folds = b.between(1.49, 1.55), b.between(1.38, 1.46), 4
    fold = b.between(0.085, 0.1)
    reach = opening / 2 + folds * fold + 0.05
    rod = b.part("rod, rail", metal, roller(0.018, -reach, reach, 14).moved(0.075, 0, drop + 0.05))
    for side in (-1, 1):
        rod.put(metal, box((0.075, 0.02, 0.02), (0.037, side * (reach - 0.02), drop + 0.05)))
        shape = sphere(0.04, (0.075, side * (reach + 0.02), drop + 0.05), 16)
        rod.subpart("finial, rod end", "ceramic", shape)
    hem_height = 0.11
    for side in (-1, 1):
        panel = b.part("panel, drape")
        hem = panel.subpart("hem, border")
        for i in range(folds):
            y = side * (opening / 2 + (i + 0.5) * fold)
            oval = (0.036 * b.between(0.8, 1.1) / 0.06, fold * 0.6 / 0.06, 1.0)
            panel.put(cloth, cylinder(0.06, hem_height, drop + 0.065, 18).scaled(*oval).moved(0.075, y, 0))
            hem.put(trim, cylinder(0.063, 0, hem_height + 0.004, 18).scaled(*oval).moved(0.075, y, 0))
        middle = side * (opening / 2 + folds * fold / 2)
        shape = box((0.1, folds * fold + 0.035, 0.075), (0.075, middle, drop * 0.42), 0.02)
        panel.subpart("tie, tieback", "plain", shape)


def picture(b: Builder) -> None:
    wood, accent = b.paints("wood", "metal")
    width, height = b.between(0.6, 0.85), b.between(0.48, 0.62)
    border = 0.055
    frame = b.part("frame, border")
    for side in (-1.0, 1.0):
        frame.put(wood, box((0.04, border, height), (0.02, side * (width - border) / 2, height / 2), 0.012))
        shape = box((0.04, width, border), (0.02, 0, height / 2 + side * (height - border) / 2), 0.012)
        frame.put(wood, shape)
    places = [(0.024, y * (width - border) / 2, height / 2 + z * (height - border) / 2) for y, z in CORNERS]
    corners = [box((0.05, border * 1.35, border * 1.35), corner, 0.012) for corner in places]
    frame.subpart("corners, ornaments", accent, *corners)
    shape = box((0.02, width - border, height - border), (0.01, 0, height / 2))
    canvas = b.part("canvas, painting", "plain blue pink yellow beige teal white", shape)
    low, inner_w, inner_h = border, width - 2 * border, height - 2 * border
    peak = b.between(0.4, 0.6)
    ridge = np.array([(0.0, 0.0), (1.0, 0.0), (0.86, 0.22), (peak, 0.62), (0.16, 0.3)])
    outline = [(float((u - 0.5) * inner_w), float(low + v * inner_h)) for u, v in ridge]
    canvas.subpart("hill, mountain", "plain", extrude(outline, 0.01).turned("z", 90).moved(0.021))
    side = 0.3 if peak < 0.5 else -0.3
    shape = disc(inner_h * 0.14, 0, 0.012, 28).moved(0.018, side * inner_w, low + inner_h * 0.76)
    canvas.subpart("sun, moon", "plain", shape)


def mirror(b: Builder) -> None:
    rim_paint, glass = b.paints("metal", "plain grey white blue teal")
    r = b.between(0.26, 0.32)
    profile = [(r - 0.04, 0), (r, 0), (r, 0.03), (r - 0.02, 0.045), (r - 0.05, 0.04), (r - 0.05, 0.0)]
    rim = b.part("frame, rim", rim_paint, lathe(profile, 48).turned("y", 90).moved(0, 0, r))
    angles = [np.pi / 4 * i for i in range(8)]
    places = [(0.035, (r - 0.025) * np.cos(a), r + (r - 0.025) * np.sin(a)) for a in angles]
    rim.subpart("beads, studs", "ceramic", *[sphere(0.034, position, 16) for position in places])
    pane = b.part("glass, looking glass", glass, disc(r - 0.045, 0.0, 0.02, 40).moved(0, 0, r))
    shape = box((0.008, 0.07, r * 1.1), (0.02, 0, 0)).turned("x", 32).moved(0, 0.02, r)
    pane.subpart("glint, reflection", "plain white yellow beige", shape)


def bookshelf(b: Builder) -> None:
    wood, back_paint = b.paints("wood", "plain")
    depth, width, height = b.between(0.28, 0.32), b.between(0.8, 1.0), b.between(1.45, 1.75)
    sides = box((depth, 0.045, height), bevel=0.008).both_sides(0, width / 2 - 0.022, height / 2)
    frame = b.part("frame, case", wood, sides)
    shape = box((0.03, width - 0.09, height - 0.03), (-depth / 2 + 0.015, 0, height / 2))
    frame.subpart("back wall, backboard", back_paint, shape)
    rows = 4
    gap = (height - 0.08) / rows
    heights = [0.06 + i * gap - (0.02 if i == rows else 0) for i in range(rows + 1)]
    boards = [box((depth + 0.012, width - 0.08, 0.04), (0.006, 0, z), 0.008) for z in heights]
    frame.subpart("boards, shelf boards", "wood", *boards)
    crate_row = int(b.rng.integers(0, 2))
    for i in range(rows):
        bottom = 0.08 + i * gap
        if i == crate_row:
            _crates(b, depth, width, bottom, gap)
        else:
            _book_row(b, depth, width, bottom, gap - 0.04)


def _book_row(b: Builder, depth: float, width: float, bottom: float, clear: float) -> None:
    """Add a row of books that fills part of a shelf from one end; the last book leans slightly."""
    books = b.part("books, row of books")
    end = width / 2 - 0.06 - (b.between(0.1, 0.35) if b.chance(0.7) else 0.0)
    y, mirror = -width / 2 + 0.055, -1 if b.chance(0.5) else 1
    while True:
        thick, tall = b.between(0.045, 0.075), clear * b.between(0.62, 0.88)
        if y + thick > end:
            break
        deep = depth * b.between(0.68, 0.8)
        position = (-depth / 2 + 0.04 + deep / 2, mirror * (y + thick / 2), bottom + tall / 2)
        shape = box((deep, thick, tall), position, 0.006)
        books.subpart("book", b.paint("cloth" if b.chance(0.3) else "plain"), shape)
        y += thick + 0.004


def _crates(b: Builder, depth: float, width: float, bottom: float, gap: float) -> None:
    cloth, label = b.paints("cloth", "plain")
    crate_w, crate_h = (width - 0.16) / 2, gap * b.between(0.62, 0.76)
    for side in (-1, 1):
        y = side * (crate_w / 2 + 0.015)
        shape = box((depth * 0.82, crate_w, crate_h), (0.01, y, bottom + crate_h / 2), 0.012)
        crate = b.part("box, storage box, basket", cloth, shape)
        size = (0.025, crate_w * 0.45, crate_h * 0.4)
        position = (0.01 + depth * 0.41, y, bottom + crate_h * 0.55)
        crate.subpart("label, tag", label, box(size, position, 0.005))


def refrigerator(b: Builder) -> None:
    body_paint, metal = b.paints("plain white grey beige teal red blue", "metal")
    depth, width, height = b.between(0.56, 0.62), b.between(0.56, 0.64), b.between(1.55, 1.75)
    body = b.part("body, case", body_paint, box((depth - 0.06, width, height), (-0.03, 0, height / 2), 0.02))
    shape = box((0.03, width - 0.06, 0.08), (depth / 2 - 0.055, 0, 0.05), 0.006)
    body.subpart("grille, vent", "metal", shape)
    split = height * b.between(0.62, 0.68)
    door_paint, freezer_paint = b.paints("plain", "plain")
    for names, grip, low, high, paint in (
        ("door, fridge door", "handle, grip", 0.11, split - 0.01, door_paint),
        ("freezer, freezer door", "freezer handle, freezer grip", split + 0.01, height - 0.01, freezer_paint),
    ):
        shape = box((0.06, width - 0.01, high - low), (depth / 2 - 0.03, 0, (low + high) / 2), 0.018)
        door = b.part(names, paint, shape)
        tall = min(0.34, 0.55 * (high - low))
        z = low + 0.06 + tall / 2 if paint is freezer_paint else high - 0.08 - tall / 2
        door.subpart(grip, metal, box((0.06, 0.045, tall), (depth / 2 + 0.025, -width / 2 + 0.075, z), 0.015))
        if paint is door_paint:
            front = door
    for i in range(2):
        y, z = b.between(-0.02, 0.2), split - 0.3 - 0.28 * i
        front.subpart("magnet, note", "plain", box((0.02, 0.12, 0.14), (depth / 2 + 0.004, y, z), 0.004))


def counter(b: Builder) -> None:
    front, metal, case = b.paints("plain", "metal", "wood")
    depth, units, height = b.between(0.54, 0.6), 3, b.between(0.84, 0.9)
    unit_w = b.between(0.46, 0.52)
    width = units * unit_w
    shape = box((depth - 0.05, width, height - 0.14), (-0.025, 0, 0.1 + (height - 0.14) / 2), 0.01)
    body = b.part("body, base cabinet", case, shape)
    body.subpart("plinth, kickboard", "stone", box((depth - 0.1, width - 0.02, 0.1), (-0.04, 0, 0.05)))
    shape = box((depth + 0.03, width + 0.04, 0.045), (0.0, 0, height - 0.022), 0.01)
    top = b.part("top, worktop, countertop", "stone", shape)
    shape = box((0.03, width + 0.03, 0.16), (-depth / 2, 0, height + 0.075), 0.006)
    top.subpart("backsplash, splashback", "ceramic", shape)
    drawer_paint = b.paint("plain")
    for i in range(units):
        y = (i - (units - 1) / 2) * unit_w
        low = 0.12
        if i == 0:
            for k in range(2):
                tall = (height - 0.18 - low) / 2
                z = low + (k + 0.5) * (tall + 0.02)
                shape = box((0.03, unit_w - 0.03, tall), (depth / 2 - 0.04, y, z), 0.008)
                drawer = b.part("drawer", drawer_paint, shape)
                shape = box((0.035, 0.2, 0.035), (depth / 2 - 0.01, y, z + 0.04), 0.008)
                drawer.subpart("drawer handle, drawer pull", metal, shape)
        else:
            tall = height - 0.16 - low
            shape = box((0.03, unit_w - 0.03, tall), (depth / 2 - 0.04, y, low + tall / 2), 0.008)
            door = b.part("door", front, shape)
            shape = box((0.035, 0.04, 0.2), (depth / 2 - 0.01, y - unit_w * 0.33, low + tall * 0.72), 0.008)
            door.subpart("door handle, door knob", metal, shape)


def sink(b: Builder) -> None:
    white, metal, accent = b.paints("ceramic", "metal", "plain")
    r, h = b.between(0.18, 0.21), b.between(0.13, 0.16)
    profile = [(0, 0), (r * 0.6, 0), (r * 0.9, h * 0.5), (r, h), (r - 0.02, h)]
    profile += [(r * 0.84, h * 0.55), (r * 0.5, 0.03), (0, 0.03)]
    basin = b.part("basin, bowl", white, lathe(profile, 40))
    profile = [(r - 0.025, h - 0.01), (r + 0.012, h - 0.012), (r + 0.012, h + 0.012), (r - 0.025, h + 0.012)]
    basin.subpart("rim, edge", "plain", lathe(profile, 40))
    basin.subpart("drain, plug", accent, cylinder(0.045, 0.02, 0.04, 20))
    x, top = -r - 0.05, b.between(0.26, 0.32)
    spout = [(x, 0, 0), (x, 0, top - 0.06), (x + 0.03, 0, top - 0.01)]
    spout += [(x + 0.09, 0, top), (x + 0.15, 0, top - 0.015), (x + 0.165, 0, top - 0.06)]
    shapes = [sweep(spout, 0.022, 16), cylinder(0.045, 0, 0.03, 20).moved(x, 0, 0)]
    faucet = b.part("faucet, tap", metal, *shapes)
    knob_paint = b.paint("plastic")
    for side in (-1, 1):
        faucet.subpart("knob, valve", knob_paint, sphere(0.034, (x, side * 0.06, 0.06), 16))


def tv_stand(b: Builder) -> None:
    wood, front, metal = b.paints("wood", "plain", "metal")
    depth, width, height = b.between(0.4, 0.46), b.between(1.1, 1.3), b.between(0.44, 0.5)
    body = b.part("body, case", wood, box((depth, width, height - 0.1), (0, 0, height / 2 + 0.02), 0.01))
    body.subpart("top, board", "stone", box((depth + 0.04, width + 0.04, 0.04), (0, 0, height - 0.02), 0.01))
    places = [(x * (depth / 2 - 0.06), y * (width / 2 - 0.07), 0.04) for x, y in CORNERS]
    body.subpart("feet, legs", "metal", *[box((0.06, 0.06, 0.08), corner) for corner in places])
    tall = height - 0.16
    for side in (-1, 1):
        y, w = side * width * 0.33, width * 0.3
        door = b.part("door", front, box((0.03, w, tall), (depth / 2 + 0.01, y, 0.09 + tall / 2), 0.008))
        shape = sphere(0.032, (depth / 2 + 0.045, y - side * w * 0.36, 0.09 + tall / 2), 16)
        door.subpart("knob, door knob", metal, shape)
    shape = box((0.02, width * 0.32, tall), (depth / 2 + 0.004, 0, 0.09 + tall / 2))
    shelf = b.part("shelf, compartment", "plain", shape)
    shape = box((0.06, width * 0.26, 0.09), (depth / 2 + 0.015, 0, 0.16), 0.01)
    shelf.subpart("player, video player", "metal", shape)


def television(b: Builder) -> None:
    dark, accent = b.paints("plastic black grey brown", "metal")
    width = b.between(0.86, 1.0)
    tall, low = width * 0.58, 0.1
    case = b.part("case, frame", dark, box((0.06, width, tall), (0, 0, low + tall / 2), 0.012))
    case.subpart("bar, speaker bar", "plain", box((0.05, width * 0.9, 0.045), (0.02, 0, low + 0.03), 0.01))
    middle = low + tall / 2 + 0.022
    shape = box((0.02, width - 0.06, tall - 0.09), (0.028, 0, middle))
    screen = b.part("screen, display", "plain blue teal purple", shape)
    shape = disc(tall * 0.14, 0.0, 0.012, 28).moved(0.034, width * 0.2, middle + tall * 0.16)
    screen.subpart("sun, ball", "plain yellow orange white red", shape)
    shape = box((0.012, width - 0.06, tall * 0.24), (0.036, 0, middle - (tall - 0.09) / 2 + tall * 0.12))
    screen.subpart("hill, meadow", "plain green brown pink", shape)
    base = b.part("base, foot", accent, box((0.2, width * 0.4, 0.025), (0, 0, 0.0125), 0.008))
    base.subpart("neck, column", "plain", box((0.045, 0.1, low), (-0.01, 0, 0.02 + low / 2), 0.008))


def monitor(b: Builder) -> None:
    dark = b.paint("plastic black grey white")
    width = b.between(0.5, 0.58)
    tall, low = width * 0.62, 0.14
    case = b.part("case, frame", dark, box((0.045, width, tall), (0, 0, low + tall / 2), 0.01))
    case.subpart("bar, button bar", "plain", box((0.035, width * 0.6, 0.035), (0.012, 0, low + 0.022), 0.008))
    middle = low + tall / 2 + 0.02
    shape = box((0.016, width - 0.05, tall - 0.08), (0.02, 0, middle))
    screen = b.part("screen, display", "plain blue green purple teal", shape)
    shape = box((0.012, width * 0.36, tall * 0.56), (0.026, -width * 0.16, middle))
    screen.subpart("page, document", "cloth white beige yellow pink", shape)
    shape = box((0.012, width * 0.17, width * 0.17), (0.026, width * 0.26, middle))
    screen.subpart("icon, symbol", "plain", shape)
    base = b.part("base, foot", "metal", cylinder(0.11, 0, 0.022, 28))
    base.subpart("neck, column", "metal", box((0.035, 0.07, low + 0.02), (-0.03, 0, 0.02 + low / 2), 0.008))
