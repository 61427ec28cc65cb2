"""Miniature garden objects: each function draws one class of object."""

import numpy as np

from hilsplat.world.objects.builder import Builder, Maker
from hilsplat.world.shapes import box, cylinder, disc, ellipsoid, extrude, lathe, sphere, sweep


def _cactus(b: Builder) -> None:
    green, pot_paint = b.paints.draw("plain", "green", "teal"), b.paints.draw("ceramic")
    petal = b.paints.draw("plain", "pink", "red", "yellow", "orange", "purple", "white")
    r, h = b.between(0.145, 0.17), b.between(0.72, 0.85)
    pot = b.part("pot", "planter")
    b.put(pot, pot_paint, lathe([(0, 0), (0.22, 0), (0.30, 0.30), (0, 0.28)]))
    b.put(
        b.subpart(pot, "rim", "edge", at="of"),
        b.paints.draw("ceramic"),
        lathe([(0.29, 0.22), (0.355, 0.23), (0.355, 0.34), (0.25, 0.34), (0.24, 0.29)]),
    )
    b.put(
        b.subpart(pot, "soil", "sand", at="in"),
        b.paints.draw("plain", "brown", "beige", "grey", "black"),
        lathe([(0.27, 0.29), (0.15, 0.33), (0, 0.34)]),
    )
    b.put(
        b.subpart(pot, "saucer", "dish", at="under"),
        b.paints.draw("ceramic"),
        lathe([(0, 0), (0.30, 0), (0.35, 0.06), (0.2, 0.06)]),
    )
    stem = b.part("stem", "trunk", "column")
    b.put(
        stem,
        green,
        sweep([(0, 0, 0.28), (0, 0, h), (0, 0, h + r * 0.7)], [r, r, r * 0.62]),
        ellipsoid((r * 0.62, r * 0.62, r * 0.4), (0, 0, h + r * 0.7)),
    )
    ribs = b.subpart(stem, "ribs", "ridges")
    rib = b.paints.draw("plain", "yellow", "green", "white", "beige", "teal")
    for k in range(6):
        b.put(
            ribs,
            rib,
            sweep([(r, 0, 0.34), (r, 0, h - 0.05), (r * 0.7, 0, h + r * 0.55)], 0.032).turned("z", 60 * k),
        )
    flower = b.subpart(stem, "flower", "blossom")
    top = h + r * 0.95
    b.put(
        flower,
        petal,
        *[
            ellipsoid((0.10, 0.065, 0.035)).turned("y", -30).moved(0.10, 0, top + 0.03).turned("z", 72 * k)
            for k in range(5)
        ],
        sphere(0.07, (0, 0, top + 0.04)),
    )
    tip_paint = b.paints.draw("plain", "yellow", "beige", "pink", "red", "white")
    for side, low in ((-1, 0.52), (1, 0.62)):
        arm = b.part("arm", "branch")
        low = low * h / 0.8
        out = r + b.between(0.17, 0.21)
        path = [
            (0, side * r * 0.8, low),
            (0, side * (out - 0.03), low + 0.015),
            (0, side * out, low + 0.10),
            (0, side * out, low + 0.30),
        ]
        b.put(arm, green, sweep(path, [0.085, 0.09, 0.095, 0.085]))
        b.put(
            b.subpart(arm, "tip", "bud", at="of"),
            tip_paint,
            ellipsoid((0.105, 0.105, 0.10), (0, side * out, low + 0.31)),
        )


def _windmill(b: Builder) -> None:
    wall, roof_paint, wood = (
        b.paints.draw(str(b.rng.choice(["brick", "stone", "plain"]))),
        b.paints.draw("plain"),
        b.paints.draw("wood"),
    )
    h, r = b.between(0.72, 0.82), b.between(0.27, 0.31)
    base = b.part("base", "terrace", "platform")
    b.put(base, b.paints.draw("stone"), cylinder(r * 1.45, 0, 0.11, 36, 0.02))
    b.put(
        b.subpart(base, "stairs", "steps", at="of"),
        b.paints.draw("plain"),
        box((0.20, 0.34, 0.08), (r * 1.45, 0, 0.04), 0.01),
        box((0.13, 0.26, 0.15), (r * 1.33, 0, 0.075), 0.01),
    )
    tower = b.part("tower", "mill body")
    b.put(tower, wall, lathe([(r, 0.10), (r * 0.68, h)], 32))
    b.put(
        b.subpart(tower, "door", "entrance"),
        b.paints.draw("wood"),
        box((0.10, 0.26, 0.33), (r * 0.90, 0, 0.27), 0.01),
    )
    windows = b.subpart(tower, "windows")
    glass = b.paints.draw("plastic", "yellow", "white", "blue", "black")
    for a in (75, 180, 285):
        b.put(windows, glass, box((0.08, 0.18, 0.20), (r * 0.83, 0, h * 0.55), 0.01).turned("z", a))
    b.put(
        b.subpart(tower, "gallery", "balcony", "railing"),
        b.paints.draw("plain"),
        lathe([(r * 0.75, h - 0.17), (r * 0.98, h - 0.15), (r * 0.98, h - 0.07), (r * 0.7, h - 0.06)], 32),
    )
    cap = b.part("roof", "mill cap")
    b.put(
        cap,
        roof_paint,
        lathe([(0, h - 0.01), (r * 0.82, h), (r * 0.72, h + 0.10), (r * 0.4, h + 0.24), (0, h + 0.30)], 28),
    )
    b.put(b.subpart(cap, "ball", "finial"), b.paints.draw("metal"), sphere(0.085, (0, 0, h + 0.34)))
    b.put(
        b.subpart(cap, "tail vane", "weather vane", "tail"),
        b.paints.draw("plastic"),
        box((0.26, 0.05, 0.17), (-r * 0.95, 0, h + 0.09), 0.012),
    )
    x, z = r * 0.80 + 0.10, h + 0.10
    hub = b.part("hub", "axle")
    b.put(hub, wood, disc(0.135, -0.20, 0.08, 24, 0.02).moved(x, 0, z))
    b.put(
        b.subpart(hub, "cap", "nut"),
        b.paints.draw("plastic"),
        ellipsoid((0.09, 0.11, 0.11), (x + 0.12, 0, z)),
    )
    frame, cloth, turn = b.paints.draw("wood"), b.paints.draw("cloth"), b.between(15, 75)
    for k in range(4):
        blade = b.part("blade", "vane")
        angle = turn + 90 * k
        b.put(blade, frame, box((0.05, 0.075, 0.62), (0, 0, 0.32), 0.012).turned("x", angle).moved(x, 0, z))
        b.put(
            b.subpart(blade, "sail", "canvas"),
            cloth,
            box((0.035, 0.17, 0.44), (0.01, 0.10, 0.40), 0.008).turned("x", angle).moved(x, 0, z),
        )


def _birdhouse(b: Builder) -> None:
    wood, roof_paint, dark = b.paints.draw("wood"), b.paints.draw("plain"), b.paints.draw("plain", "black")
    w, h, low = b.between(0.44, 0.50), b.between(0.40, 0.46), 0.42
    rise, half = 0.24, w / 2
    post = b.part("post", "pole")
    b.put(post, b.paints.draw("wood"), box((0.11, 0.11, low), (0, 0, low / 2), 0.015))
    b.put(
        b.subpart(post, "base", "foot", at="of"), b.paints.draw("stone"), cylinder(0.27, 0, 0.085, 32, 0.02)
    )
    body = b.part("box", "nest box", "walls")
    b.put(
        body,
        wood,
        extrude(
            [(-half, low), (half, low), (half, low + h), (0, low + h + rise), (-half, low + h)], w * 0.86
        ).turned("z", 90),
    )
    x = w * 0.43
    b.put(b.subpart(body, "hole", "entrance"), dark, disc(0.10, -0.01, 0.015, 28).moved(x, 0, low + h * 0.70))
    b.put(
        b.subpart(body, "perch", "stick"),
        b.paints.draw("plain"),
        disc(0.058, -0.02, 0.22, 16, 0.01).moved(x, 0, low + h * 0.30),
    )
    b.put(
        b.subpart(body, "heart", "back window"),
        b.paints.draw("plain", "red", "pink", "yellow"),
        disc(0.10, -0.03, 0.02, 24).moved(-x - 0.0, 0, low + h * 0.55),
    )
    roof = b.part("roof")
    slope, angle = float(np.hypot(half, rise)), float(np.degrees(np.arctan2(rise, half)))
    for side in (-1, 1):
        slab = box((w * 1.14, slope + 0.12, 0.05), (0, 0, 0), 0.012).turned("x", -side * angle)
        b.put(roof, roof_paint, slab.moved(0, side * (half / 2 + 0.035), low + h + rise / 2 + 0.015))
    b.put(
        b.subpart(roof, "ridge", "ridge beam"),
        b.paints.draw("wood"),
        box((w * 1.18, 0.10, 0.075), (0, 0, low + h + rise + 0.035), 0.02),
    )
    bird = b.part("bird", "little bird")
    feather = b.paints.draw("plain", "red", "blue", "yellow", "orange", "teal", "purple")
    z = low + h + rise + 0.18
    b.put(
        bird,
        feather,
        ellipsoid((0.155, 0.115, 0.115), (0, 0, z)),
        sphere(0.095, (0.12, 0, z + 0.115)),
        sweep([(-0.10, 0, z), (-0.28, 0, z + 0.06)], [0.075, 0.04]),
    )
    b.put(
        b.subpart(bird, "beak", "bill"),
        b.paints.draw("plain", "orange", "yellow", "black"),
        lathe([(0, 0), (0.075, 0), (0, 0.17)], 14).turned("y", 90).moved(0.195, 0, z + 0.11),
    )
    b.put(
        b.subpart(bird, "wings"),
        b.paints.draw("plain"),
        *[ellipsoid((0.12, 0.045, 0.07), (-0.04, s * 0.11, z + 0.02)) for s in (-1, 1)],
    )


def _watering_can(b: Builder) -> None:
    tin, second = b.paints.draw("metal"), b.paints.draw("plastic")
    r, h = b.between(0.30, 0.34), b.between(0.46, 0.52)
    body = b.part("body", "tank", "can")
    b.put(body, tin, lathe([(0, 0.02), (r, 0.02), (r * 0.88, h), (0, h)], 32))
    b.put(
        b.subpart(body, "base", "bottom ring", at="of"),
        b.paints.draw("plastic"),
        lathe([(0, 0), (r * 1.07, 0), (r * 1.07, 0.10), (r * 0.98, 0.11)], 32),
    )
    b.put(
        b.subpart(body, "band", "stripe"),
        b.paints.draw("plain"),
        lathe([(r * 0.94, h * 0.46), (r * 0.995, h * 0.47), (r * 0.96, h * 0.74), (r * 0.90, h * 0.75)], 32),
    )
    b.put(
        b.subpart(body, "collar", "top cover", at="of"),
        second,
        lathe(
            [
                (r * 0.90, h - 0.05),
                (r * 0.94, h - 0.04),
                (r * 0.94, h + 0.03),
                (r * 0.5, h + 0.05),
                (0, h + 0.05),
            ],
            32,
        ),
    )
    spout = b.part("spout", "pipe")
    start, end = np.array([r * 0.80, 0, 0.14]), np.array([r + 0.40, 0, h + 0.12])
    b.put(
        spout,
        b.paints.draw("metal"),
        sweep([start, start + np.array([0.14, 0, 0.05]), end], [0.085, 0.075, 0.055]),
    )
    way = (end - start) / np.linalg.norm(end - start)
    tilt = float(np.degrees(np.arctan2(way[0], way[2])))
    rose = lathe([(0, 0), (0.06, 0), (0.145, 0.13), (0.145, 0.17), (0, 0.19)], 24).turned("y", tilt)
    b.put(
        b.subpart(spout, "rose", "sprinkler head", "nozzle"),
        b.paints.draw("plastic"),
        rose.moved(*(end - 0.03 * way)),
    )
    handle = b.part("handle")
    path = [
        (-r * 0.86, 0, 0.16),
        (-r - 0.20, 0, 0.26),
        (-r - 0.17, 0, h * 0.9),
        (-r * 0.35, 0, h + 0.27),
        (r * 0.35, 0, h + 0.22),
        (r * 0.62, 0, h + 0.02),
    ]
    b.put(handle, second, sweep(path, 0.045))
    b.put(
        b.subpart(handle, "grip", at="of"),
        b.paints.draw("wood"),
        sweep([path[2], tuple(np.add(path[2], path[3]) / 2 + np.array([-0.02, 0, 0.03])), path[3]], 0.068),
    )
    bloom = b.part("flower", "daisy")
    petals = [ellipsoid((0.03, 0.11, 0.075), (0, 0.15, 0)).turned("x", 60 * k) for k in range(6)]
    for node, paint, meshes in (
        (bloom, b.paints.draw("plain", "white", "pink", "yellow", "orange"), petals),
        (
            b.subpart(bloom, "centre", "middle", at="of"),
            b.paints.draw("plain", "yellow", "orange", "brown", "black"),
            [ellipsoid((0.075, 0.10, 0.10))],
        ),
    ):
        for side in (-1, 1):
            b.put(
                node,
                paint,
                *[mesh.turned("z", side * 90).moved(0, side * r * 0.97, h * 0.28) for mesh in meshes],
            )


MAKERS: dict[str, Maker] = {
    "cactus": Maker(_cactus, ("saguaro", "potted cactus")),
    "windmill": Maker(_windmill, ("mill", "toy windmill")),
    "birdhouse": Maker(_birdhouse, ("nesting box", "bird house")),
    "watering can": Maker(_watering_can, ("garden can", "sprinkling can")),
}
"""Classes drawn by this module."""
