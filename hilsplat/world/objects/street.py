"""Paints, street furniture, plants and buildings, in metres. Fronts face +x; the base is at z = 0."""

from dataclasses import replace

import numpy as np

from hilsplat.world.objects.builder import Builder, Node
from hilsplat.world.paints import COLOURS, Colour, Paint, each_channel
from hilsplat.world.shapes import Mesh, Number, box, cylinder, disc, ellipsoid, extrude, lathe, sphere, sweep

PASTELS = {
    "beige": (0.86, 0.78, 0.62),
    "yellow": (0.90, 0.80, 0.50),
    "pink": (0.86, 0.66, 0.62),
    "orange": (0.86, 0.60, 0.42),
    "teal": (0.55, 0.72, 0.70),
    "blue": (0.58, 0.68, 0.80),
    "green": (0.64, 0.74, 0.58),
    "white": (0.90, 0.89, 0.85),
    "red": (0.72, 0.38, 0.32),
    "grey": (0.66, 0.66, 0.66),
}
"""sRGB of plastered walls by colour word."""

FOLIAGE = {
    "green": ((0.20, 0.46, 0.14), (0.42, 0.62, 0.22)),
    "orange": ((0.78, 0.42, 0.12), (0.88, 0.62, 0.22)),
}
"""sRGB of leaves, in shade and in light, by colour word."""


def _faded(colour: Colour, factor: float) -> Colour:
    return each_channel(colour, lambda value: factor * value)


def lacquer(b: Builder, colours: str) -> Paint:
    """Return a glossy paint in one of the colours, as on vehicles."""
    paint = b.paint(f"plain {colours}")
    return replace(paint, second=_faded(paint.first, 0.86), specular=0.4, shininess=50.0)


def glass(b: Builder) -> Paint:
    """Return dark, glossy, slightly cloudy glass, so that a window pane has some visible detail."""
    paint = b.paint("plain black")
    paint = replace(paint, first=(0.15, 0.19, 0.26), second=(0.36, 0.45, 0.55), scale=7.0)
    paint = replace(paint, specular=0.6, shininess=60.0, choices=("black", "grey", "blue", "teal"))
    return paint.shaded(1.0)  # recomputes the colour word


def rubber(b: Builder) -> Paint:
    """Return the paint of tyres."""
    return replace(b.paint("plain black"), specular=0.05)


def lit(paint: Paint) -> Paint:
    """Return the paint as self-luminous, because the shader does not shade a paint without shininess."""
    return replace(paint, specular=0.0, shininess=0.0)


def foliage(b: Builder, colours: str) -> Paint:
    """Return the paint of leaves, with clumps of light and shade."""
    paint = b.paint(f"plain {colours}")
    shade, light = FOLIAGE[paint.colour]
    return replace(paint, first=shade, second=light, scale=20.0, grain=0.36, specular=0.03)


def plain(b: Builder, colour: str) -> Paint:
    """Return a plain paint in exactly the listed colour."""
    return replace(b.paint(f"plain {colour}"), first=COLOURS[colour])


def post(radius: Number, height: Number) -> Mesh:
    """Return an upright pole."""
    return cylinder(radius, 0.0, height, 14)


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
    pole = b.part("pole, post", metal, post(0.055, tall))
    pole.subpart("base, foot", "stone grey beige", cylinder(0.16, 0, 0.2, 14, 0.02))
    plate = b.part("plate, panel, board")
    form = str(b.rng.choice(["round", "octagon", "triangle", "square"]))
    size = b.between(0.40, 0.46)
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
    pole = b.part("pole, post", "metal grey white", post(0.075, tall))
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
    slats = boards.subpart("slats, pickets")
    count = int(length / 0.22)
    for i in range(count):
        y = length * ((i + 0.5) / count - 0.5)
        slats.put(wood, box((0.05, 0.13, 0.94), (0.04, y, 0.55)))
    stone = b.paint("stone grey brown")
    for y in (-length / 2, length / 2):
        pillar = b.part("post, fence post", stone, box((0.22, 0.22, 1.2), (0, y, 0.6), 0.02))
        pillar.subpart("cap, top", "plain red black white", box((0.32, 0.32, 0.12), (0, y, 1.24), 0.03))


DEPTH = 6.0


def _wall(b: Builder, avoid: str = "") -> Paint:
    """Return the paint of a brick or stained wall, not of the colour to avoid."""
    if b.chance(0.35):
        colours = [word for word in ("red", "brown", "beige", "orange", "grey") if word != avoid]
        return b.paint(f"brick {' '.join(colours)}", scale=1.9)
    paint = b.paint(f"plain {' '.join(word for word in PASTELS if word != avoid)}")
    first = PASTELS[paint.colour]
    stained = replace(paint, first=first, second=_faded(first, 0.84), scale=5.0, grain=0.34)
    return stained.shaded(1.0)  # recomputes the colour word


def _block(w: float, bottom: float, top: float, out: float = 0.0) -> Mesh:
    """Return a storey of the house whose front projects beyond x = 0 by `out`."""
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
    """Add a sloping cloth over a shop window."""
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
    """Add a gabled roof with its ridge along the street, or a flat one with a parapet."""
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
