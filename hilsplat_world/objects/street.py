"""Full-size street objects and their paints. Lengths are in metres; fronts face +x; the base is at z = 0."""

from dataclasses import replace

import numpy as np

from hilsplat_world.objects.builder import Builder, Node
from hilsplat_world.paints import COLOURS, Colour, Paint, each_channel
from hilsplat_world.shapes import (
    Mesh,
    Number,
    box,
    cylinder,
    disc,
    ellipsoid,
    extrude,
    lathe,
    roller,
    sphere,
    sweep,
)

PASTELS = {
    "beige": (0.86, 0.78, 0.62),
    "yellow": (0.9, 0.8, 0.5),
    "pink": (0.86, 0.66, 0.62),
    "orange": (0.86, 0.6, 0.42),
    "teal": (0.55, 0.72, 0.7),
    "blue": (0.58, 0.68, 0.8),
    "green": (0.64, 0.74, 0.58),
    "white": (0.9, 0.89, 0.85),
    "red": (0.72, 0.38, 0.32),
    "grey": (0.66, 0.66, 0.66),
}
"""sRGB values of plastered walls by colour word."""

FOLIAGE = {
    "green": ((0.2, 0.46, 0.14), (0.42, 0.62, 0.22)),
    "orange": ((0.78, 0.42, 0.12), (0.88, 0.62, 0.22)),
}
"""sRGB values of leaves in shade and in light, by colour word."""


def _faded(colour: Colour, factor: float) -> Colour:
    return each_channel(colour, lambda value: factor * value)


def lacquer(b: Builder, colours: str) -> Paint:
    """Return a glossy vehicle paint in one of the colours."""
    paint = b.paint(f"plain {colours}")
    return replace(paint, second=_faded(paint.first, 0.86), specular=0.4, shininess=50.0)


def glass(b: Builder) -> Paint:
    """Return dark, glossy glass, slightly cloudy so that a window pane has some visible detail."""
    paint = b.paint("plain black")
    paint = replace(paint, first=(0.15, 0.19, 0.26), second=(0.36, 0.45, 0.55), scale=7.0)
    paint = replace(paint, specular=0.6, shininess=60.0, choices=("black", "grey", "blue", "teal"))
    return paint.shaded(1.0)  # recomputes the colour word


def rubber(b: Builder) -> Paint:
    """Return the paint of tyres."""
    return replace(b.paint("plain black"), specular=0.05)


def lit(paint: Paint) -> Paint:
    """Make a paint self-luminous: the shader does not shade a paint without shininess."""
    return replace(paint, specular=0.0, shininess=0.0)


def foliage(b: Builder, colours: str) -> Paint:
    """Return the paint of leaves, with clumps of light and shade."""
    paint = b.paint(f"plain {colours}")
    shade, light = FOLIAGE[paint.colour]
    return replace(paint, first=shade, second=light, scale=20.0, grain=0.36, specular=0.03)


def plain(b: Builder, colour: str) -> Paint:
    """Return a plain paint in exactly the listed colour."""
    return replace(b.paint(f"plain {colour}"), first=COLOURS[colour])


def panel(thickness: Number, width: Number, height: Number, x: Number, y: Number, z: Number) -> Mesh:
    """Return a thin upright plate that faces x, with its centre at (x, y, z)."""
    return box((thickness, width, height), (x, y, z), min(0.02, 0.3 * thickness))


def tree(b: Builder) -> None:
    bark, leaves = b.paint("wood brown"), foliage(b, "green green green orange")
    tall, spread = b.between(2.3, 2.6), b.between(1.15, 1.45)
    lean = b.between(-0.12, 0.12)
    path = [(0, 0, 0), (lean, 0, tall / 2), (0, lean, tall + 0.5)]
    trunk = b.part("trunk, stem", bark, sweep(path, [0.2, 0.16, 0.13], 14))
    trunk.subpart("grate, pit cover", "metal grey", box((0.9, 0.9, 0.06), (0, 0, 0.03)))
    trunk.subpart("bark guard, trunk guard", "plain white beige teal", cylinder(0.235, 0.5, 1.1, 14))
    middle = tall + 0.9 * spread
    shape = ellipsoid((0.74 * spread, 0.74 * spread, 0.8 * spread), (0, 0, middle), 18, 10)
    crown = b.part("crown, foliage, leaves", leaves, shape)
    fruit = crown.subpart("blossoms, flowers")
    petals = b.paint("plain pink white yellow red")
    for i in range(26):
        up = np.arcsin(1 - 2 * (i + 0.5) / 26)
        around = 2.399963 * i + b.between(-0.3, 0.3)
        radius = spread * b.between(0.28, 0.42)
        away = 0.66 * spread
        x, y = away * np.cos(up) * np.cos(around), away * np.cos(up) * np.sin(around)
        centre = np.array([x, y, middle + 1.08 * away * np.sin(up)])
        crown.put(leaves, sphere(radius, tuple(centre), 14))
        if i % 3 == 1:
            outwards = centre - np.array([0.0, 0.0, middle])
            outwards /= np.linalg.norm(outwards)
            fruit.put(petals, sphere(0.17, tuple(centre + 0.93 * radius * outwards), 10))


def bush(b: Builder) -> None:
    leaves = foliage(b, "green")
    w, length = 0.62, b.between(1.1, 1.7)
    shape = box((w, length, 0.5), (0, 0, 0.25), 0.03)
    pot = b.part("planter, flower box", "stone grey beige white brown", shape)
    pot.subpart("rim, edge", "wood brown orange", box((w + 0.1, length + 0.1, 0.1), (0, 0, 0.5), 0.02))
    green = b.part("foliage, leaves")
    flowers = green.subpart("flowers, blossoms")
    petals = b.paint("plain red yellow pink purple white orange")
    count = 5
    for i in range(count):
        y = length * ((i + 0.5) / count - 0.5)
        radius = b.between(0.27, 0.36)
        z = 0.62 + b.between(0.0, 0.2)
        green.put(leaves, sphere(radius, (b.between(-0.05, 0.05), y, z), 14))
        for x in (-0.15, 0.16):
            flowers.put(petals, sphere(0.1, (x, y + b.between(-0.1, 0.1), z + 0.86 * radius), 10))


def sign(b: Builder) -> None:
    metal = b.paint("metal grey")
    tall = b.between(2.1, 2.4)
    pole = b.part("pole, post", metal, cylinder(0.055, 0, tall, 14))
    pole.subpart("base, foot", "stone grey beige", cylinder(0.16, 0, 0.2, 14, 0.02))
    plate = b.part("plate, panel, board")
    form = str(b.rng.choice(["round", "octagon", "triangle", "square"]))
    size = b.between(0.4, 0.46)
    symbol = plate.subpart("symbol, pictogram")
    colours, mark, corners, turn = {
        "round": (("red", "blue"), "white", 28, 0.0),
        "octagon": (("red",), "white", 8, np.pi / 8),
        "triangle": (("yellow",), "black", 3, np.pi / 2),
        "square": (("blue", "green"), "white", 4, np.pi / 4),
    }[form]
    angle = turn + np.linspace(0, 2 * np.pi, corners, endpoint=False)
    radius = size * (1.2 if corners in (3, 4) else 1.0)

    def outline(factor: float) -> list[tuple[float, float]]:
        return [(factor * radius * float(np.cos(a)), factor * radius * float(np.sin(a))) for a in angle]

    z = tall - 0.25
    shape = extrude(outline(1.0), 0.05).turned("z", 90).moved(0.08, 0, z)
    plate.put(plain(b, str(b.rng.choice(colours))), shape)
    if form in ("octagon", "square"):
        symbol.put(plain(b, mark), panel(0.03, 1.2 * size, 0.2, 0.115, 0, z))
        symbol.put(plain(b, mark), panel(0.03, 0.2, 0.9 * size, 0.116, 0, z))
    else:
        symbol.put(plain(b, mark), extrude(outline(0.52), 0.03).turned("z", 90).moved(0.115, 0, z))


def traffic_light(b: Builder) -> None:
    tall = b.between(2.5, 2.8)
    pole = b.part("pole, post", "metal grey white", cylinder(0.075, 0, tall, 14))
    pole.subpart("base, foot", "stone beige grey", box((0.36, 0.36, 0.42), (0, 0, 0.21), 0.03))
    z, dark = tall - 0.45, b.paint("plain yellow green black")
    housing = b.part("housing, signal head", dark, box((0.3, 0.42, 1.16), (0.14, 0, z), 0.05))
    bright = int(b.rng.integers(3))
    for i, colour in enumerate(("red", "yellow", "green")):
        paint = plain(b, colour)
        shape = disc(0.155, -0.03, 0.04, 18, 0.01).moved(0.3, 0, z + 0.36 - 0.36 * i)
        housing.subpart(f"{colour} lamp, {colour} light", lit(paint) if i == bright else paint, shape)
    visor = housing.subpart("visor, hood")
    for i in range(3):
        visor.put(plain(b, "black"), box((0.2, 0.36, 0.04), (0.38, 0, z + 0.36 - 0.36 * i + 0.165)))


def street_lamp(b: Builder) -> None:
    paint = b.paint("metal green black grey blue")
    tall = b.between(4.0, 4.6)
    path = [(0, 0, 0), (0, 0, tall - 0.5), (0.12, 0, tall - 0.12), (0.5, 0, tall), (0.9, 0, tall)]
    pole = b.part("pole, post", paint, sweep(path, [0.09, 0.07, 0.06, 0.05, 0.05], 12))
    profile = [(0, 0), (0.24, 0), (0.22, 0.3), (0.12, 0.6), (0, 0.6)]
    pole.subpart("base, foot", "stone grey beige", lathe(profile, 14))
    head = b.part("head, lantern", "plain white grey", box((0.8, 0.34, 0.16), (1.1, 0, tall + 0.02), 0.05))
    shape = ellipsoid((0.28, 0.13, 0.11), (1.15, 0, tall - 0.07), 14, 8)
    head.subpart("bulb, light bulb", lit(plain(b, "yellow")), shape)


def fence(b: Builder) -> None:
    wood = b.paint("wood") if b.chance(0.5) else b.paint("plain white green teal red")
    rails = b.paint("wood beige") if wood.kind != "wood" else b.paint("plain white beige")
    length = b.between(2.6, 3.6)
    shapes = [box((0.05, length, 0.1), (0, 0, 0.28)), box((0.05, length, 0.1), (0, 0, 0.78))]
    boards = b.part("panel, boards", rails, *shapes)
    count = int(length / 0.22)
    places = [(0.04, length * ((i + 0.5) / count - 0.5), 0.55) for i in range(count)]
    boards.subpart("slats, pickets", wood, *[box((0.05, 0.13, 0.94), position) for position in places])
    stone = b.paint("stone grey brown")
    for y in (-length / 2, length / 2):
        pillar = b.part("post, fence post", stone, box((0.22, 0.22, 1.2), (0, y, 0.6), 0.02))
        pillar.subpart("cap, top", "plain red black white", box((0.32, 0.32, 0.12), (0, y, 1.24), 0.03))


DEPTH = 6.0


def _wall(b: Builder, avoid: str = "") -> Paint:
    """Return the paint of a brick or stained wall, in a colour other than `avoid`."""
    if b.chance(0.35):
        colours = [word for word in ("red", "brown", "beige", "orange", "grey") if word != avoid]
        return b.paint(f"brick {' '.join(colours)}", scale=1.9)
    paint = b.paint(f"plain {' '.join(word for word in PASTELS if word != avoid)}")
    first = PASTELS[paint.colour]
    stained = replace(paint, first=first, second=_faded(first, 0.84), scale=5.0, grain=0.34)
    return stained.shaded(1.0)  # recomputes the colour word


def _block(w: float, bottom: float, top: float, out: float = 0.0) -> Mesh:
    """Return a storey of a house; its front projects beyond x = 0 by `out`."""
    return box((DEPTH + out, w, top - bottom), ((out - DEPTH) / 2, 0, (bottom + top) / 2))


def building(b: Builder) -> None:
    w, ground, storey = b.between(6.5, 10.0), b.between(3.0, 3.4), b.between(2.6, 2.9)
    storeys = 1 + int(b.rng.integers(2))
    eaves = ground + storeys * storey + 0.3
    shop = b.chance(0.6)
    base = b.paint("stone grey beige brown", scale=0.8) if b.chance(0.5) else _wall(b)
    low = b.part("ground floor, shop front", base, _block(w, 0.0, ground, 0.12))
    front = 0.12
    bays = max(2, round(w / 2.4))
    pitch = w / bays
    centres = [w * ((i + 0.5) / bays - 0.5) for i in range(bays)]
    entrance = int(b.rng.integers(bays))
    pane, frame = glass(b), plain(b, "white")
    leaf = lacquer(b, "green red blue teal brown purple")
    y = centres[entrance]
    door = low.subpart("door, entrance", leaf, panel(0.14, 1.15, 2.3, front, y, 1.15))
    door.put(frame, panel(0.16, 0.14, 0.14, front + 0.02, y + 0.4, 1.1))
    low.subpart("step, doorstep", "stone white grey", box((0.4, 1.5, 0.16), (front + 0.1, y, 0.08), 0.02))
    display = low.subpart("shop window, display window" if shop else "ground floor window")
    for i, y in enumerate(centres):
        if i == entrance:
            continue
        wide, high, z = (0.8 * pitch, 1.7, 1.5) if shop else (0.5 * pitch, 1.3, 1.7)
        display.put(frame, panel(0.1, wide + 0.2, high + 0.2, front, y, z))
        display.put(pane, panel(0.14, wide, high, front, y, z))
    if shop:
        letters = b.paint("plain white yellow")
        shape = panel(0.2, 0.7 * w, 0.55, front, 0, ground - 0.42)
        board = low.subpart("shop sign, sign board", lacquer(b, "blue green red purple black"), shape)
        count = int(0.7 * w / 0.55)
        for i in range(count):
            if b.chance(0.85):
                at = 0.62 * w * ((i + 0.5) / count - 0.5)
                size = (b.between(0.14, 0.34), b.between(0.2, 0.36))
                board.put(letters, panel(0.24, *size, front, at, ground - 0.42))
        if b.chance(0.6):
            _awning(b, low, front, centres[(entrance + 1) % bays], pitch)
    heights = [ground + floor * storey + 0.55 * storey for floor in range(storeys)]
    _upper_floors(b, _block(w, ground, eaves), ground, heights, centres, pane, base.colour)
    _roof(b, w, eaves)


def _awning(b: Builder, low: Node, front: float, y: float, pitch: float) -> None:
    node = low.subpart("awning, canopy")
    first = plain(b, "white")
    second = b.paint("plain red green blue orange")
    strips = 6
    for i in range(strips):
        wide = 0.94 * pitch / strips
        sheet = box((1.0, wide, 0.05)).turned("y", 24)
        node.put((first, second)[i % 2], sheet.moved(front + 0.42, y + (i + 0.5 - strips / 2) * wide, 2.46))


def _upper_floors(
    b: Builder, shape: Mesh, ground: float, heights: list[float], ys: list[float], pane: Paint, avoid: str
) -> None:
    """Add the facade above the ground floor: windows at the given heights, shutters, a balcony."""
    facade = b.part("facade, upper floors, front wall", _wall(b, avoid), shape)
    windows = facade.subpart("windows, window panes")
    shutters = facade.subpart("shutters, window shutters")
    frame = plain(b, "white")
    wood = lacquer(b, "green blue brown red teal")
    rail = plain(b, "black")
    chosen = int(b.rng.integers(len(ys)))
    for floor, z in enumerate(heights):
        for i, y in enumerate(ys):
            high, wide = (2.0, 1.15) if i == chosen and floor == 0 else (1.45, 1.0)
            down = 0.25 if i == chosen and floor == 0 else 0.0
            windows.put(frame, panel(0.12, wide + 0.2, high + 0.2, 0.0, y, z - down))
            for side in (-1, 1):
                at = y + side * 0.25 * wide
                windows.put(pane, panel(0.18, 0.46 * wide, 0.92 * high, 0.0, at, z - down))
            for side in (-1, 1):
                shutters.put(wood, panel(0.16, 0.34, high + 0.1, 0.0, y + side * (wide / 2 + 0.28), z - down))
    y, floor_z = ys[chosen], ground + 0.12
    shape = box((0.9, 2.1, 0.16), (0.45, y, floor_z))
    balcony = facade.subpart("balcony, terrace", "stone grey beige", shape)
    for side in (-1, 1):
        balcony.put(rail, box((0.86, 0.06, 0.06), (0.45, y + side * 1.02, floor_z + 0.98)))
        for x in (0.15, 0.5):
            balcony.put(rail, box((0.05, 0.05, 0.95), (x, y + side * 1.02, floor_z + 0.5)))
    balcony.put(rail, box((0.06, 2.1, 0.06), (0.86, y, floor_z + 0.98)))
    for i in range(9):
        balcony.put(rail, box((0.05, 0.05, 0.95), (0.86, y + 2.04 * (i / 8 - 0.5), floor_z + 0.5)))


def _roof(b: Builder, w: float, eaves: float) -> None:
    """Add a gabled roof with its ridge along the street, or a flat roof with a parapet."""
    roof = b.part("roof")
    tiles = b.paint("brick red brown orange grey black", scale=1.7)
    chimney, dormer = roof.subpart("chimney"), roof.subpart("dormer window, skylight")
    brick = b.paint("brick red brown beige", scale=2.2)
    side = b.between(-0.35, 0.35) * w
    if b.chance(0.65):
        rise = b.between(1.6, 2.3)
        outline = [(-DEPTH - 0.25, eaves), (0.45, eaves), (-DEPTH / 2, eaves + rise)]
        roof.put(tiles, extrude(outline, w + 0.05))
        stack, base = -1.4, eaves + 0.4
        for y in [0.0] if w < 8 else [-0.25 * w, 0.25 * w]:
            dormer.put(plain(b, "white"), box((1.7, 1.25, 1.1), (-1.1, y, eaves + 0.62), 0.03))
            dormer.put(glass(b), panel(0.1, 0.9, 0.75, -0.24, y, eaves + 0.66))
    else:
        rise = 0.55
        shape = box((DEPTH + 0.5, w + 0.04, rise), (0.2 - DEPTH / 2, 0, eaves + rise / 2))
        roof.put("stone grey white", shape)
        stack, base = -1.2, eaves + rise
        dormer.put(lit(plain(b, "white")), box((1.2, 1.6, 0.35), (-1.0, -side, base + 0.17), 0.05))
    chimney.put(brick, box((0.7, 0.9, rise + 1.4), (stack, side, base + (rise + 1.4) / 2 - 0.4)))
    for y in (-0.2, 0.2):
        chimney.put(plain(b, "orange"), cylinder(0.13, 0, 0.4, 12).moved(stack, side + y, base + rise + 1.0))


def _wheels(b: Builder, places: list[float], half_width: float, radius: float, width: float) -> None:
    tyre, metal = rubber(b), b.paint("metal grey white")
    for x in places:
        for side in (-1, 1):
            y = side * (half_width - 0.4 * width)
            shape = roller(radius, -width / 2, width / 2, 20, 0.03).moved(x, y, radius)
            node = b.part("wheel, tyre, tire", tyre, shape)
            cap = roller(0.62 * radius, -0.03, 0.03, 18, 0.01)
            node.subpart("rim, hubcap", metal, cap.moved(x, y + side * (width / 2 + 0.01), radius))


def _lights_and_plates(b: Builder, node: Node, front: float, back: float, w: float, z: float) -> None:
    head = node.subpart("headlights, front lights")
    tail = node.subpart("tail lights, rear lights")
    bright, red = lit(plain(b, "white")), plain(b, "red")
    for side in (-1, 1):
        head.put(bright, ellipsoid((0.07, 0.19, 0.12), (front, side * w * 0.36, z), 16, 8))
        tail.put(red, box((0.08, 0.28, 0.2), (back, side * w * 0.38, z + 0.03), 0.03))
    plates = [panel(0.09, 0.56, 0.18, x, 0, z - 0.05) for x in (front, back)]
    node.subpart("licence plate, license plate, number plate", plain(b, "yellow"), *plates)


def car(b: Builder) -> None:
    paint = lacquer(b, "red orange yellow green teal blue white grey purple")
    metal, pane = b.paint("metal grey black"), glass(b)
    length, w = b.between(4.1, 4.7), b.between(1.78, 1.9)
    low, belt, top = 0.3, b.between(0.9, 0.98), b.between(1.46, 1.6)
    half = length / 2
    outline = [(-half, low), (half, low), (half, belt - 0.22), (half - 0.1, belt - 0.14)]
    body = b.part("body, chassis", paint, extrude([*outline, (half - 1.1, belt), (-half + 0.05, belt)], w))
    shapes = [box((0.2, w * 1.02, 0.2), (end * (half - 0.01), 0, low + 0.1), 0.05) for end in (-1, 1)]
    body.subpart("bumper", metal, *shapes)
    _lights_and_plates(b, body, half - 0.02, -half, w, belt - 0.26)
    door = body.subpart("door, doors")
    leaf, middle = lacquer(b, paint.colour), (low + belt) / 2 + 0.03
    for side in (-1, 1):
        for x, reach in ((0.1, 1.0), (-1.0, 0.9)):
            door.put(leaf, box((reach, 0.05, belt - low - 0.2), (x, side * w / 2, middle), 0.02))
    estate = b.chance(0.4)
    back = -half + (0.12 if estate else 0.75)
    rear_top = back + (0.25 if estate else 0.6)
    front, front_top = half - 1.15, half - 1.95
    shell = [(back, belt - 0.02), (front, belt - 0.02), (front_top, top), (rear_top, top)]
    cabin = b.part("cabin, top", paint, extrude(shell, w * 0.86))
    shape = box((front_top - rear_top, w * 0.84, 0.07), ((front_top + rear_top) / 2, 0, top), 0.03)
    cabin.subpart("roof", lacquer(b, "black white grey"), shape)
    windows = cabin.subpart("windows, side windows")
    low_z, high_z = belt + 0.06, top - 0.1
    pillar = (front + back) / 2 - 0.1
    for first, last in ((back + 0.2, pillar - 0.05), (pillar + 0.05, front - 0.12)):
        slant = 0.62 * (front - front_top) if last > pillar + 0.1 else 0.0
        lean = 0.62 * (rear_top - back) if first < pillar - 0.1 else 0.0
        outline = [(first, low_z), (last, low_z), (last - slant, high_z), (first + lean, high_z)]
        windows.put(pane, extrude(outline, w * 0.86 + 0.04))
    shield = cabin.subpart("windshield, windscreen")
    for x_low, x_high in ((front, front_top), (back, rear_top)):
        tilt = np.degrees(np.arctan2(x_high - x_low, top - belt))
        tall = np.hypot(x_high - x_low, top - belt)
        sheet = box((0.05, w * 0.74, tall * 0.74)).turned("y", tilt)
        shield.put(pane, sheet.moved((x_low + x_high) / 2, 0, (belt + top) / 2 + 0.01))
    _wheels(b, [-0.3 * length, 0.3 * length], w / 2, b.between(0.33, 0.37), 0.24)


def _contrasting(b: Builder, paint: Paint) -> Paint:
    return lacquer(b, "red blue green purple" if sum(paint.first) > 1.5 else "white yellow beige")


def truck(b: Builder) -> None:
    paint = lacquer(b, "red orange yellow green blue teal white")
    load = lacquer(b, "white beige grey yellow teal pink")
    metal, pane = b.paint("metal grey black"), glass(b)
    w, cab = 2.2, 1.75
    length, high = b.between(5.6, 6.4), b.between(2.7, 3.05)
    half, floor, tall = length / 2, 0.85, b.between(2.25, 2.45)
    frame = b.part("chassis, frame", metal, box((length - 0.1, 1.7, 0.28), (0, 0, 0.66)))
    guard = frame.subpart("bumper")
    for x in (half - 0.02, -half + 0.05):
        guard.put(plain(b, "grey"), box((0.22, w, 0.24), (x, 0, 0.55), 0.05))
    x0, x1 = half - cab, half
    outline = [(x0, 0.5), (x1, 0.5), (x1, 1.35), (x1 - 0.32, tall), (x0, tall)]
    cabin = b.part("cabin, cab", paint, extrude(outline, w * 0.96))
    tilt = np.degrees(np.arctan2(-0.32, tall - 1.35))
    sheet = box((0.06, w * 0.84, (tall - 1.35) * 0.84)).turned("y", tilt)
    cabin.subpart("windshield, windscreen", pane, sheet.moved(x1 - 0.15, 0, (1.35 + tall) / 2))
    shape = box((0.85, w * 0.96 + 0.05, 0.62), (x1 - 1.0, 0, tall - 0.55), 0.02)
    cabin.subpart("windows, side windows", pane, shape)
    _lights_and_plates(b, cabin, x1, x0, w * 0.9, 0.98)
    c0, c1 = -half, x0 - 0.12
    middle, centre_z = (c0 + c1) / 2, (floor + high) / 2
    cargo = b.part("cargo box, container", load, box((c1 - c0, w, high - floor), (middle, 0, centre_z), 0.04))
    band, doors = _contrasting(b, load), _contrasting(b, load)
    shape = box((0.72 * (c1 - c0), w + 0.05, 0.55), (middle, 0, floor + 0.95), 0.02)
    cargo.subpart("stripe, logo", band, shape)
    shapes = [panel(0.07, 0.44 * w, 0.86 * (high - floor), c0, side * 0.24 * w, centre_z) for side in (-1, 1)]
    cargo.subpart("rear door, back door", doors, *shapes)
    _wheels(b, [half - 1.0, -half + 1.1], w / 2, b.between(0.44, 0.48), 0.3)


def bus(b: Builder) -> None:
    paint = lacquer(b, "red orange yellow green blue teal purple")
    pane, second = glass(b), lacquer(b, "white beige grey")
    length, w = b.between(8.2, 9.4), 2.3
    low, high = 0.42, b.between(2.75, 2.95)
    half, belt = length / 2, 1.3
    body = b.part("body, hull", paint, box((length, w, high - low), (0, 0, (low + high) / 2), 0.12))
    windows = body.subpart("windows, side windows")
    door = body.subpart("door, doors")
    bays = 6
    pitch = (length - 1.3) / bays
    for side in (-1, 1):
        for i in range(bays):
            x = -half + 0.75 + (i + 0.5) * pitch
            if side == -1 and i in (2, bays - 1):  # the doors are on the kerb side
                door.put(second, box((1.0, 0.09, 1.9), (x, -w / 2, low + 1.05), 0.02))
            else:
                windows.put(pane, box((0.86 * pitch, 0.07, 0.9), (x, side * w / 2, belt + 0.52), 0.02))
    shapes = [panel(0.09, w * 0.84, 1.0, end * half, 0, belt + 0.46) for end in (-1, 1)]
    body.subpart("windshield, windscreen", pane, *shapes)
    shape = panel(0.12, w * 0.6, 0.26, half, 0, high - 0.24)
    body.subpart("destination sign, display", lit(plain(b, "orange")), shape)
    body.subpart("stripe", second, box((length - 0.5, w + 0.04, 0.24), (0, 0, belt - 0.16), 0.02))
    _lights_and_plates(b, body, half - 0.01, -half, w * 0.9, 0.86)
    roof = b.part("roof, top", second, box((length - 0.25, w - 0.2, 0.14), (0, 0, high + 0.04), 0.05))
    unit, metal = roof.subpart("air conditioner, ventilation"), b.paint("metal grey")
    unit.put(metal, box((1.7, 1.4, 0.26), (b.between(-2, 1), 0, high + 0.2), 0.05))
    _wheels(b, [half - 1.9, -half + 2.0], w / 2, 0.48, 0.3)


def _head(b: Builder, skin: Paint, x: float, z: float, radius: float) -> None:
    """Add a head with hair or a hat, centred at (x, 0, z)."""
    head = b.part("head", skin, ellipsoid((radius * 0.92, radius * 0.85, radius * 1.1), (x, 0, z), 18, 10))
    head.put(skin, cylinder(radius * 0.5, z - radius * 1.5, z - radius * 0.6, 12).moved(x, 0, 0))
    shape = ellipsoid((radius * 1.02, radius * 1.02, radius * 0.85), (x - 0.06, 0, z + radius * 0.48), 18, 10)
    hair = head.subpart("hair", "plain brown black orange grey yellow", shape)
    if b.chance(0.4):
        hair.put("plain black", ellipsoid((0.1, 0.13, 0.24), (x - radius * 0.95, 0, z - 0.08), 14, 8))
    shape = box((0.06, radius * 1.5, radius * 0.34), (x + radius * 0.86, 0, z + radius * 0.1), 0.02)
    head.subpart("glasses, sunglasses", plain(b, "black"), shape)


def pedestrian(b: Builder) -> None:
    skin = b.paint("plain beige brown pink")
    coat = b.paint("cloth red orange yellow green teal blue purple pink white")
    trousers = b.paint("plain blue black brown grey beige green")
    tall = b.between(1.62, 1.86)
    hip, shoulder = 0.49 * tall, 0.8 * tall
    stride = b.between(0.12, 0.26)
    spine = [(0, 0, hip - 0.08), (0, 0, hip + 0.2), (0, 0, shoulder - 0.12), (0, 0, shoulder + 0.03)]
    shape = sweep(spine, [0.21, 0.22, 0.25, 0.13], 16).scaled(0.78, 1.0, 1.0)
    torso = b.part("torso, upper body", coat, shape)
    shape = cylinder(0.24, hip + 0.03, hip + 0.13, 18, 0.01).scaled(0.78, 1.0, 1.0)
    torso.subpart("belt", plain(b, "black"), shape)
    bag_paint = b.paint("cloth orange brown purple teal yellow red")
    if b.chance(0.6):
        shape = box((0.2, 0.38, 0.5), (-0.27, 0, shoulder - 0.32), 0.06)
        torso.subpart("backpack, bag, rucksack", bag_paint, shape)
    else:
        shape = box((0.32, 0.14, 0.3), (0.02, -0.36, hip + 0.05), 0.04)
        bag = torso.subpart("shoulder bag, bag, handbag", bag_paint, shape)
        strap = [(0.03, -0.36, hip + 0.18), (0.12, -0.2, shoulder - 0.18), (0.0, 0.12, shoulder + 0.02)]
        bag.put(bag_paint, sweep(strap, 0.025, 8))
    _head(b, skin, 0.02, shoulder + 0.25, 0.15)
    shoes = b.paint("plain white red brown black orange")
    for side in (-1, 1):
        swing = side * stride
        hand = (0.9 * swing + 0.05, side * 0.33, hip + 0.02)
        arm_path = [(0, side * 0.22, shoulder - 0.05), (0.2 * swing, side * 0.31, (shoulder + hip) / 2), hand]
        arm = b.part("arm, sleeve", coat, sweep(arm_path, [0.085, 0.075, 0.06], 10))
        arm.subpart("hand", skin, sphere(0.075, (hand[0], hand[1], hand[2] - 0.04), 12))
        foot = (-1.2 * swing, side * 0.12)
        leg_path = [(0, side * 0.11, hip), (-0.4 * swing, side * 0.12, 0.27 * tall), (*foot, 0.1)]
        leg = b.part("leg, trousers", trousers, sweep(leg_path, [0.13, 0.1, 0.075], 10))
        leg.subpart("shoe, foot", shoes, box((0.31, 0.14, 0.13), (foot[0] + 0.06, foot[1], 0.065), 0.04))


def cyclist(b: Builder) -> None:
    skin = b.paint("plain beige brown pink")
    shirt = b.paint("cloth red orange yellow green blue purple pink white")
    trousers, metal = b.paints("plain black blue grey brown", "plain red teal yellow green white orange")
    dark = rubber(b)
    radius, reach = 0.36, 0.56
    seat, bar, crank = (-0.2, 0, 0.98), (0.42, 0, 1.08), (-0.05, 0, 0.38)
    paths = (
        [seat, crank],
        [crank, (0.36, 0, 0.86)],
        [(-0.16, 0, 0.84), (0.36, 0, 0.86)],
        [(-reach, 0, radius), crank],
        [(-reach, 0, radius), (-0.17, 0, 0.86)],
        [bar, (reach, 0, radius)],
    )
    cycle = b.part("bicycle, bike", metal, *[sweep(path, 0.035, 8) for path in paths])
    rings = cycle.subpart("wheels, tyres")
    for x in (-reach, reach):
        angle = np.linspace(0, 2 * np.pi, 22)
        circle = [(x + radius * np.cos(a), 0.0, radius + 0.02 + radius * np.sin(a)) for a in angle]
        rings.put(dark, sweep(circle, 0.04, 8))
        for a in np.linspace(0, np.pi, 5)[:-1]:
            dx, dz = radius * np.cos(a), radius * np.sin(a)
            rings.put(dark, sweep([(x - dx, 0, radius - dz), (x + dx, 0, radius + dz)], 0.012, 6))
    shape = ellipsoid((0.17, 0.1, 0.06), (seat[0] - 0.02, 0, seat[2] + 0.02), 14, 8)
    cycle.subpart("saddle, seat", plain(b, "brown"), shape)
    bar_path = [(0.36, -0.3, 1.1), (0.44, -0.14, 1.12), (0.44, 0.14, 1.12), (0.36, 0.3, 1.1)]
    cycle.subpart("handlebar, handlebars", plain(b, "black"), sweep(bar_path, 0.03, 8))
    spine = [(-0.2, 0, 1.04), (-0.1, 0, 1.3), (0.05, 0, 1.54), (0.1, 0, 1.62)]
    torso = b.part("torso, upper body", shirt, sweep(spine, [0.2, 0.22, 0.22, 0.12], 10))
    pack = box((0.2, 0.36, 0.46), (0, 0, 0), 0.06).turned("y", 28).moved(-0.27, 0, 1.42)
    torso.subpart("backpack, bag, rucksack", "cloth orange brown purple teal yellow", pack)
    _head(b, skin, 0.2, 1.8, 0.15)
    for side in (-1, 1):
        arm_path = [(0.05, side * 0.2, 1.52), (0.2, side * 0.3, 1.3), (0.36, side * 0.28, 1.16)]
        arm = b.part("arm, sleeve", shirt, sweep(arm_path, [0.085, 0.075, 0.06], 10))
        arm.subpart("hand", skin, sphere(0.07, (0.37, side * 0.27, 1.13), 12))
        low = 0.2 if side > 0 else 0.5
        leg_path = [(-0.18, side * 0.12, 1.02), (0.2, side * 0.15, 0.62 + 0.5 * low)]
        leg_path += [(-0.02, side * 0.16, low + 0.07)]
        leg = b.part("leg, trousers", trousers, sweep(leg_path, [0.13, 0.1, 0.07], 10))
        leg.subpart("shoe, foot", plain(b, "white"), box((0.28, 0.12, 0.11), (0.03, side * 0.16, low), 0.035))
