"""Street furniture and plants. Objects face +x, with their base at z = 0; lengths are metres."""

import numpy as np

from hilsplat.world.objects import street_buildings, street_people, street_vehicles
from hilsplat.world.objects.builder import Builder, Maker
from hilsplat.world.objects.street_paints import foliage, lit, panel, plain, post
from hilsplat.world.shapes import box, cylinder, ellipsoid, extrude, lathe, sphere, sweep


def _tree(b: Builder) -> None:
    bark, leaves = b.paint("wood", "brown"), foliage(b, "green", "green", "green", "orange")
    tall, spread = b.between(2.3, 2.6), b.between(1.15, 1.45)
    lean = b.between(-0.12, 0.12)
    trunk = b.part("trunk", "stem").put(
        bark, sweep([(0, 0, 0), (lean, 0, tall / 2), (0, lean, tall + 0.5)], [0.2, 0.16, 0.13], 14)
    )
    trunk.subpart("grate", "pit cover").put(b.paint("metal", "grey"), box((0.9, 0.9, 0.06), (0, 0, 0.03)))
    trunk.subpart("bark guard", "trunk guard").put(
        b.paint("plain", "white", "beige", "teal"), cylinder(0.235, 0.5, 1.1, 14)
    )
    middle = tall + 0.9 * spread
    crown = b.part("crown", "foliage", "leaves").put(
        leaves, ellipsoid((0.74 * spread, 0.74 * spread, 0.8 * spread), (0, 0, middle), 18, 10)
    )
    fruit = crown.subpart("blossoms", "flowers")
    petals = b.paint("plain", "pink", "white", "yellow", "red")
    for i in range(26):
        up = np.arcsin(1 - 2 * (i + 0.5) / 26)
        around = 2.399963 * i + b.between(-0.3, 0.3)
        radius = spread * b.between(0.28, 0.42)
        away = 0.66 * spread
        centre = (
            away * np.cos(up) * np.cos(around),
            away * np.cos(up) * np.sin(around),
            middle + 1.08 * away * np.sin(up),
        )
        crown.put(leaves, sphere(radius, centre, 14))
        if i % 3 == 1:
            fruit.put(
                petals, sphere(0.17, tuple(np.array(centre) + 0.93 * radius * _outwards(centre, middle)), 10)
            )


def _outwards(point: tuple[float, float, float], middle: float) -> np.ndarray:
    """Return the unit vector from (0, 0, middle) to a point."""
    away = np.array(point) - np.array([0.0, 0.0, middle])
    return away / np.linalg.norm(away)


def _bush(b: Builder) -> None:
    leaves = foliage(b, "green")
    w, length = 0.62, b.between(1.1, 1.7)
    pot = b.part("planter", "flower box").put(
        b.paint("stone", "grey", "beige", "white", "brown"), box((w, length, 0.5), (0, 0, 0.25), 0.03)
    )
    pot.subpart("rim", "edge").put(
        b.paint("wood", "brown", "orange"), box((w + 0.1, length + 0.1, 0.1), (0, 0, 0.5), 0.02)
    )
    green = b.part("foliage", "leaves")
    flowers = green.subpart("flowers", "blossoms")
    petals = b.paint("plain", "red", "yellow", "pink", "purple", "white", "orange")
    count = 5
    for i in range(count):
        y = length * ((i + 0.5) / count - 0.5)
        radius = b.between(0.27, 0.36)
        z = 0.62 + b.between(0.0, 0.2)
        green.put(leaves, sphere(radius, (b.between(-0.05, 0.05), y, z), 14))
        for x in (-0.15, 0.16):
            flowers.put(petals, sphere(0.1, (x, y + b.between(-0.1, 0.1), z + 0.86 * radius), 10))


def _sign(b: Builder) -> None:
    metal = b.paint("metal", "grey")
    tall = b.between(2.1, 2.4)
    pole = b.part("pole", "post").put(metal, post(0.055, tall))
    pole.subpart("base", "foot").put(b.paint("stone", "grey", "beige"), cylinder(0.16, 0, 0.2, 14, 0.02))
    plate = b.part("plate", "panel", "board")
    shape = str(b.rng.choice(["round", "octagon", "triangle", "square"]))
    size = b.between(0.40, 0.46)
    symbol = plate.subpart("symbol", "pictogram")
    colour, mark = {
        "round": (("red", "blue"), "white"),
        "octagon": (("red",), "white"),
        "triangle": (("yellow",), "black"),
        "square": (("blue", "green"), "white"),
    }[shape]
    corners = {"round": 28, "octagon": 8, "triangle": 3, "square": 4}[shape]
    turn = {"octagon": np.pi / 8, "triangle": np.pi / 2, "square": np.pi / 4}.get(shape, 0.0)
    angle = turn + np.linspace(0, 2 * np.pi, corners, endpoint=False)
    radius = size * (1.2 if corners in (3, 4) else 1.0)

    def outline(factor: float) -> list[tuple[float, float]]:
        return [(factor * radius * float(np.cos(a)), factor * radius * float(np.sin(a))) for a in angle]

    z = tall - 0.25
    plate.put(
        plain(b, str(b.rng.choice(colour))), extrude(outline(1.0), 0.05).turned("z", 90).moved(0.08, 0, z)
    )
    if shape in ("octagon", "square"):
        symbol.put(plain(b, mark), panel(0.03, 1.2 * size, 0.2, 0.115, 0, z))
        symbol.put(plain(b, mark), panel(0.03, 0.2, 0.9 * size, 0.116, 0, z))
    else:
        symbol.put(plain(b, mark), extrude(outline(0.52), 0.03).turned("z", 90).moved(0.115, 0, z))


def _traffic_light(b: Builder) -> None:
    tall = b.between(2.5, 2.8)
    pole = b.part("pole", "post").put(b.paint("metal", "grey", "white"), post(0.075, tall))
    pole.subpart("base", "foot").put(
        b.paint("stone", "beige", "grey"), box((0.36, 0.36, 0.42), (0, 0, 0.21), 0.03)
    )
    z, dark = tall - 0.45, b.paint("plain", "yellow", "green", "black")
    housing = b.part("housing", "signal head").put(dark, box((0.3, 0.42, 1.16), (0.14, 0, z), 0.05))
    bright = int(b.rng.integers(3))
    for i, colour in enumerate(("red", "yellow", "green")):
        paint = plain(b, colour)
        disc = cylinder(0.155, -0.03, 0.04, 18, 0.01).turned("y", 90)
        housing.subpart(f"{colour} lamp", f"{colour} light").put(
            lit(paint) if i == bright else paint, disc.moved(0.3, 0, z + 0.36 - 0.36 * i)
        )
    visor = housing.subpart("visor", "hood")
    for i in range(3):
        visor.put(plain(b, "black"), box((0.2, 0.36, 0.04), (0.38, 0, z + 0.36 - 0.36 * i + 0.165)))


def _street_lamp(b: Builder) -> None:
    paint = b.paint("metal", "green", "black", "grey", "blue")
    tall = b.between(4.0, 4.6)
    path = [(0, 0, 0), (0, 0, tall - 0.5), (0.12, 0, tall - 0.12), (0.5, 0, tall), (0.9, 0, tall)]
    pole = b.part("pole", "post").put(paint, sweep(path, [0.09, 0.07, 0.06, 0.05, 0.05], 12))
    pole.subpart("base", "foot").put(
        b.paint("stone", "grey", "beige"), lathe([(0, 0), (0.24, 0), (0.22, 0.3), (0.12, 0.6), (0, 0.6)], 14)
    )
    head = b.part("head", "lantern").put(
        b.paint("plain", "white", "grey"), box((0.8, 0.34, 0.16), (1.1, 0, tall + 0.02), 0.05)
    )
    head.subpart("bulb", "light bulb").put(
        lit(plain(b, "yellow")), ellipsoid((0.28, 0.13, 0.11), (1.15, 0, tall - 0.07), 14, 8)
    )


def _fence(b: Builder) -> None:
    wood = b.paint("wood") if b.chance(0.5) else b.paint("plain", "white", "green", "teal", "red")
    rails = b.paint("wood", "beige") if wood.kind != "wood" else b.paint("plain", "white", "beige")
    length = b.between(2.6, 3.6)
    boards = b.part("panel", "boards").put(
        rails, box((0.05, length, 0.1), (0, 0, 0.28)), box((0.05, length, 0.1), (0, 0, 0.78))
    )
    slats = boards.subpart("slats", "pickets")
    count = int(length / 0.22)
    for i in range(count):
        y = length * ((i + 0.5) / count - 0.5)
        slats.put(wood, box((0.05, 0.13, 0.94), (0.04, y, 0.55)))
    stone = b.paint("stone", "grey", "brown")
    for y in (-length / 2, length / 2):
        pillar = b.part("post", "fence post").put(stone, box((0.22, 0.22, 1.2), (0, y, 0.6), 0.02))
        pillar.subpart("cap", "top").put(
            b.paint("plain", "red", "black", "white"), box((0.32, 0.32, 0.12), (0, y, 1.24), 0.03)
        )


MAKERS: dict[str, Maker] = {
    **street_vehicles.MAKERS,
    **street_people.MAKERS,
    **street_buildings.MAKERS,
    "tree": Maker(_tree, ("vegetation", "street tree")),
    "bush": Maker(_bush, ("vegetation", "shrub")),
    "traffic sign": Maker(_sign, ("sign", "road sign")),
    "traffic light": Maker(_traffic_light, ("traffic signal", "stoplight")),
    "street lamp": Maker(_street_lamp, ("lamp post", "street light")),
    "fence": Maker(_fence, ("railing", "picket fence")),
}
"""All classes of a street."""
