"""Miniature garden objects: each function draws one class of object."""

import numpy as np

from hilsplat.world.objects.builder import Builder, Maker
from hilsplat.world.shapes import box, cylinder, disc, ellipsoid, extrude, lathe, sphere, sweep


def _cactus(b: Builder) -> None:
    green, pot_paint = b.paint("plain", "green", "teal"), b.paint("ceramic")
    petal = b.paint("plain", "pink", "red", "yellow", "orange", "purple", "white")
    r, h = b.between(0.145, 0.17), b.between(0.72, 0.85)
    pot = b.part("pot", "planter").put(pot_paint, lathe([(0, 0), (0.22, 0), (0.30, 0.30), (0, 0.28)]))
    pot.subpart("rim", "edge", at="of").put(
        b.paint("ceramic"), lathe([(0.29, 0.22), (0.355, 0.23), (0.355, 0.34), (0.25, 0.34), (0.24, 0.29)])
    )
    pot.subpart("soil", "sand", at="in").put(
        b.paint("plain", "brown", "beige", "grey", "black"), lathe([(0.27, 0.29), (0.15, 0.33), (0, 0.34)])
    )
    pot.subpart("saucer", "dish", at="under").put(
        b.paint("ceramic"), lathe([(0, 0), (0.30, 0), (0.35, 0.06), (0.2, 0.06)])
    )
    stem = b.part("stem", "trunk", "column").put(
        green,
        sweep([(0, 0, 0.28), (0, 0, h), (0, 0, h + r * 0.7)], [r, r, r * 0.62]),
        ellipsoid((r * 0.62, r * 0.62, r * 0.4), (0, 0, h + r * 0.7)),
    )
    ribs = stem.subpart("ribs", "ridges")
    rib = b.paint("plain", "yellow", "green", "white", "beige", "teal")
    for k in range(6):
        ribs.put(
            rib,
            sweep([(r, 0, 0.34), (r, 0, h - 0.05), (r * 0.7, 0, h + r * 0.55)], 0.032).turned("z", 60 * k),
        )
    top = h + r * 0.95
    stem.subpart("flower", "blossom").put(
        petal,
        *[
            ellipsoid((0.10, 0.065, 0.035)).turned("y", -30).moved(0.10, 0, top + 0.03).turned("z", 72 * k)
            for k in range(5)
        ],
        sphere(0.07, (0, 0, top + 0.04)),
    )
    tip_paint = b.paint("plain", "yellow", "beige", "pink", "red", "white")
    for side, low in ((-1, 0.52), (1, 0.62)):
        low = low * h / 0.8
        out = r + b.between(0.17, 0.21)
        path = [
            (0, side * r * 0.8, low),
            (0, side * (out - 0.03), low + 0.015),
            (0, side * out, low + 0.10),
            (0, side * out, low + 0.30),
        ]
        arm = b.part("arm", "branch").put(green, sweep(path, [0.085, 0.09, 0.095, 0.085]))
        arm.subpart("tip", "bud", at="of").put(
            tip_paint, ellipsoid((0.105, 0.105, 0.10), (0, side * out, low + 0.31))
        )


def _windmill(b: Builder) -> None:
    wall = b.paint(str(b.rng.choice(["brick", "stone", "plain"])))
    roof_paint = b.paint("plain")
    wood = b.paint("wood")
    h, r = b.between(0.72, 0.82), b.between(0.27, 0.31)
    base = b.part("base", "terrace", "platform").put(b.paint("stone"), cylinder(r * 1.45, 0, 0.11, 36, 0.02))
    base.subpart("stairs", "steps", at="of").put(
        b.paint("plain"),
        box((0.20, 0.34, 0.08), (r * 1.45, 0, 0.04), 0.01),
        box((0.13, 0.26, 0.15), (r * 1.33, 0, 0.075), 0.01),
    )
    tower = b.part("tower", "mill body").put(wall, lathe([(r, 0.10), (r * 0.68, h)], 32))
    tower.subpart("door", "entrance").put(b.paint("wood"), box((0.10, 0.26, 0.33), (r * 0.90, 0, 0.27), 0.01))
    windows = tower.subpart("windows")
    glass = b.paint("plastic", "yellow", "white", "blue", "black")
    for a in (75, 180, 285):
        windows.put(glass, box((0.08, 0.18, 0.20), (r * 0.83, 0, h * 0.55), 0.01).turned("z", a))
    tower.subpart("gallery", "balcony", "railing").put(
        b.paint("plain"),
        lathe([(r * 0.75, h - 0.17), (r * 0.98, h - 0.15), (r * 0.98, h - 0.07), (r * 0.7, h - 0.06)], 32),
    )
    cap = b.part("roof", "mill cap").put(
        roof_paint,
        lathe([(0, h - 0.01), (r * 0.82, h), (r * 0.72, h + 0.10), (r * 0.4, h + 0.24), (0, h + 0.30)], 28),
    )
    cap.subpart("ball", "finial").put(b.paint("metal"), sphere(0.085, (0, 0, h + 0.34)))
    cap.subpart("tail vane", "weather vane", "tail").put(
        b.paint("plastic"), box((0.26, 0.05, 0.17), (-r * 0.95, 0, h + 0.09), 0.012)
    )
    x, z = r * 0.80 + 0.10, h + 0.10
    hub = b.part("hub", "axle").put(wood, disc(0.135, -0.20, 0.08, 24, 0.02).moved(x, 0, z))
    hub.subpart("cap", "nut").put(b.paint("plastic"), ellipsoid((0.09, 0.11, 0.11), (x + 0.12, 0, z)))
    frame, cloth, turn = b.paint("wood"), b.paint("cloth"), b.between(15, 75)
    for k in range(4):
        angle = turn + 90 * k
        blade = b.part("blade", "vane").put(
            frame, box((0.05, 0.075, 0.62), (0, 0, 0.32), 0.012).turned("x", angle).moved(x, 0, z)
        )
        blade.subpart("sail", "canvas").put(
            cloth, box((0.035, 0.17, 0.44), (0.01, 0.10, 0.40), 0.008).turned("x", angle).moved(x, 0, z)
        )


def _birdhouse(b: Builder) -> None:
    wood, roof_paint, dark = b.paint("wood"), b.paint("plain"), b.paint("plain", "black")
    w, h, low = b.between(0.44, 0.50), b.between(0.40, 0.46), 0.42
    rise, half = 0.24, w / 2
    post = b.part("post", "pole").put(b.paint("wood"), box((0.11, 0.11, low), (0, 0, low / 2), 0.015))
    post.subpart("base", "foot", at="of").put(b.paint("stone"), cylinder(0.27, 0, 0.085, 32, 0.02))
    outline = [(-half, low), (half, low), (half, low + h), (0, low + h + rise), (-half, low + h)]
    body = b.part("box", "nest box", "walls").put(wood, extrude(outline, w * 0.86).turned("z", 90))
    x = w * 0.43
    body.subpart("hole", "entrance").put(dark, disc(0.10, -0.01, 0.015, 28).moved(x, 0, low + h * 0.70))
    body.subpart("perch", "stick").put(
        b.paint("plain"), disc(0.058, -0.02, 0.22, 16, 0.01).moved(x, 0, low + h * 0.30)
    )
    body.subpart("heart", "back window").put(
        b.paint("plain", "red", "pink", "yellow"),
        disc(0.10, -0.03, 0.02, 24).moved(-x - 0.0, 0, low + h * 0.55),
    )
    roof = b.part("roof")
    slope, angle = float(np.hypot(half, rise)), float(np.degrees(np.arctan2(rise, half)))
    for side in (-1, 1):
        slab = box((w * 1.14, slope + 0.12, 0.05), (0, 0, 0), 0.012).turned("x", -side * angle)
        roof.put(roof_paint, slab.moved(0, side * (half / 2 + 0.035), low + h + rise / 2 + 0.015))
    roof.subpart("ridge", "ridge beam").put(
        b.paint("wood"), box((w * 1.18, 0.10, 0.075), (0, 0, low + h + rise + 0.035), 0.02)
    )
    feather = b.paint("plain", "red", "blue", "yellow", "orange", "teal", "purple")
    z = low + h + rise + 0.18
    path = [(-0.10, 0, z), (-0.28, 0, z + 0.06)]
    bird = b.part("bird", "little bird").put(
        feather,
        ellipsoid((0.155, 0.115, 0.115), (0, 0, z)),
        sphere(0.095, (0.12, 0, z + 0.115)),
        sweep(path, [0.075, 0.04]),
    )
    bird.subpart("beak", "bill").put(
        b.paint("plain", "orange", "yellow", "black"),
        lathe([(0, 0), (0.075, 0), (0, 0.17)], 14).turned("y", 90).moved(0.195, 0, z + 0.11),
    )
    bird.subpart("wings").put(
        b.paint("plain"), *[ellipsoid((0.12, 0.045, 0.07), (-0.04, s * 0.11, z + 0.02)) for s in (-1, 1)]
    )


def _watering_can(b: Builder) -> None:
    tin, second = b.paint("metal"), b.paint("plastic")
    r, h = b.between(0.30, 0.34), b.between(0.46, 0.52)
    body = b.part("body", "tank", "can").put(tin, lathe([(0, 0.02), (r, 0.02), (r * 0.88, h), (0, h)], 32))
    body.subpart("base", "bottom ring", at="of").put(
        b.paint("plastic"), lathe([(0, 0), (r * 1.07, 0), (r * 1.07, 0.10), (r * 0.98, 0.11)], 32)
    )
    body.subpart("band", "stripe").put(
        b.paint("plain"),
        lathe([(r * 0.94, h * 0.46), (r * 0.995, h * 0.47), (r * 0.96, h * 0.74), (r * 0.90, h * 0.75)], 32),
    )
    profile = [
        (r * 0.90, h - 0.05),
        (r * 0.94, h - 0.04),
        (r * 0.94, h + 0.03),
        (r * 0.5, h + 0.05),
        (0, h + 0.05),
    ]
    body.subpart("collar", "top cover", at="of").put(second, lathe(profile, 32))
    start, end = np.array([r * 0.80, 0, 0.14]), np.array([r + 0.40, 0, h + 0.12])
    spout = b.part("spout", "pipe").put(
        b.paint("metal"), sweep([start, start + np.array([0.14, 0, 0.05]), end], [0.085, 0.075, 0.055])
    )
    way = (end - start) / np.linalg.norm(end - start)
    tilt = float(np.degrees(np.arctan2(way[0], way[2])))
    rose = lathe([(0, 0), (0.06, 0), (0.145, 0.13), (0.145, 0.17), (0, 0.19)], 24).turned("y", tilt)
    spout.subpart("rose", "sprinkler head", "nozzle").put(b.paint("plastic"), rose.moved(*(end - 0.03 * way)))
    path = [
        (-r * 0.86, 0, 0.16),
        (-r - 0.20, 0, 0.26),
        (-r - 0.17, 0, h * 0.9),
        (-r * 0.35, 0, h + 0.27),
        (r * 0.35, 0, h + 0.22),
        (r * 0.62, 0, h + 0.02),
    ]
    handle = b.part("handle").put(second, sweep(path, 0.045))
    handle.subpart("grip", at="of").put(
        b.paint("wood"),
        sweep([path[2], tuple(np.add(path[2], path[3]) / 2 + np.array([-0.02, 0, 0.03])), path[3]], 0.068),
    )
    bloom = b.part("flower", "daisy")
    petals = [ellipsoid((0.03, 0.11, 0.075), (0, 0.15, 0)).turned("x", 60 * k) for k in range(6)]
    for node, paint, meshes in (
        (bloom, b.paint("plain", "white", "pink", "yellow", "orange"), petals),
        (
            bloom.subpart("centre", "middle", at="of"),
            b.paint("plain", "yellow", "orange", "brown", "black"),
            [ellipsoid((0.075, 0.10, 0.10))],
        ),
    ):
        for side in (-1, 1):
            node.put(
                paint, *[mesh.turned("z", side * 90).moved(0, side * r * 0.97, h * 0.28) for mesh in meshes]
            )


MAKERS: dict[str, Maker] = {
    "cactus": Maker(_cactus, ("saguaro", "potted cactus")),
    "windmill": Maker(_windmill, ("mill", "toy windmill")),
    "birdhouse": Maker(_birdhouse, ("nesting box", "bird house")),
    "watering can": Maker(_watering_can, ("garden can", "sprinkling can")),
}
