"""Toy vehicles: each function draws one class of object."""

from hilsplat.world.objects.builder import Builder, Maker
from hilsplat.world.shapes import box, cylinder, disc, ellipsoid, extrude, lathe, loft, sweep


def _train(b: Builder) -> None:
    tank, cab_paint, metal = b.paints.draw("plastic"), b.paints.draw("plain"), b.paints.draw("metal")
    dark = b.paints.draw("plain", "black", "grey", "brown")
    r, length = b.between(0.19, 0.22), b.between(0.60, 0.70)
    axis = 0.24 + r
    frame = b.part("frame", "chassis")
    b.put(frame, dark, box((length + 0.42, 0.34, 0.12), (0, 0, 0.21), 0.02))
    catcher = b.subpart(frame, "cowcatcher", "plough")
    front = length / 2 + 0.20
    b.put(
        catcher,
        b.paints.draw("plastic"),
        loft(
            [
                [(front, -0.22, 0.04), (front, 0.22, 0.04), (front, 0.16, 0.27), (front, -0.16, 0.27)],
                [
                    (front + 0.20, -0.06, 0.04),
                    (front + 0.20, 0.06, 0.04),
                    (front + 0.06, 0.05, 0.25),
                    (front + 0.06, -0.05, 0.25),
                ],
            ]
        ),
    )
    boiler = b.part("boiler", "tank")
    back = -length / 2 + 0.22
    b.put(boiler, tank, disc(r, back, front - 0.04).moved(z=axis))
    plate = b.subpart(boiler, "front plate", "smokebox door")
    b.put(plate, metal, disc(r * 0.80, front - 0.05, front + 0.02, bevel=0.02).moved(z=axis))
    bands = b.subpart(boiler, "bands", "rings")
    band = b.paints.draw("metal")
    for share in (0.25, 0.62):
        x = back + share * (front - back)
        b.put(bands, band, disc(r + 0.022, x - 0.05, x + 0.05).moved(z=axis))
    dome = b.subpart(boiler, "dome", "bell")
    b.put(
        dome,
        b.paints.draw("metal"),
        lathe([(0.13, 0), (0.13, 0.08), (0.08, 0.16), (0, 0.18)]).moved(0.04, 0, axis + r - 0.03),
    )
    chimney = b.part("chimney", "funnel", "smokestack")
    cx, top = front - 0.16, axis + r
    b.put(
        chimney,
        dark,
        lathe([(0, -0.05), (0.075, -0.05), (0.075, 0.08), (0.115, 0.2), (0, 0.2)]).moved(cx, 0, top),
    )
    b.put(
        b.subpart(chimney, "rim", "crown", at="of"),
        b.paints.draw("ceramic"),
        cylinder(0.145, top + 0.17, top + 0.255, bevel=0.015).moved(cx),
    )
    cabin = b.part("cabin", "cab")
    x, height = -length / 2 - 0.01, b.between(0.52, 0.60)
    b.put(cabin, cab_paint, box((0.36, 0.44, height), (x, 0, 0.25 + height / 2), 0.015))
    b.put(
        b.subpart(cabin, "roof", "top", at="of"),
        b.paints.draw("plain"),
        box((0.48, 0.56, 0.08), (x, 0, 0.28 + height), 0.03),
    )
    windows = b.subpart(cabin, "windows")
    glass = b.paints.draw("plastic", "blue", "teal", "yellow", "white", "black")
    b.put(windows, glass, box((0.22, 0.47, 0.20), (x, 0, 0.25 + height * 0.66), 0.01))
    b.put(windows, glass, box((0.39, 0.26, 0.18), (x, 0, 0.25 + height * 0.67), 0.01))
    wheel_r, tyre, hub = 0.165, b.paints.draw("plain"), b.paints.draw("metal")
    for i in range(3):
        for side in (-1, 1):
            wheel = b.part("wheel")
            wx, y = (i - 1) * 0.34, side * 0.22
            b.put(
                wheel, tyre, cylinder(wheel_r, -0.045, 0.045, 24, 0.012).turned("x", 90).moved(wx, y, wheel_r)
            )
            b.put(
                b.subpart(wheel, "hub", "wheel centre", at="of"),
                hub,
                cylinder(wheel_r * 0.68, -0.03, 0.03, 20, 0.01)
                .turned("x", 90)
                .moved(wx, y + side * 0.04, wheel_r),
            )


def _sailboat(b: Builder) -> None:
    hull_paint, wood = b.paints.draw("plain"), b.paints.draw("wood")
    length, beam = b.between(0.95, 1.1), b.between(0.36, 0.42)

    def section(x: float, width: float, low: float, high: float) -> list[tuple[float, float, float]]:
        half = width / 2
        return [(x, -half * 0.45, low), (x, half * 0.45, low), (x, half, high), (x, -half, high)]

    stations = [
        (-0.5, 0.78, 0.07, 0.32),
        (-0.2, 1.0, 0.0, 0.30),
        (0.18, 0.86, 0.0, 0.31),
        (0.42, 0.34, 0.08, 0.35),
        (0.52, 0.04, 0.16, 0.38),
    ]
    hull = b.part("hull", "body")
    b.put(hull, hull_paint, loft([section(x * length, w * beam, low, high) for x, w, low, high in stations]))
    stripe = b.subpart(hull, "stripe", "band")
    lifted = [
        (x * length * 1.012, (w + 0.045) * beam * 1.03, high - 0.075, high - 0.015)
        for x, w, low, high in stations
    ]
    b.put(
        stripe,
        b.paints.draw("plastic"),
        loft(
            [
                [(x, -w * 0.475, low), (x, w * 0.475, low), (x, w / 2, high), (x, -w / 2, high)]
                for x, w, low, high in lifted
            ]
        ),
    )
    deck = b.subpart(hull, "deck", "floor")
    b.put(
        deck,
        wood,
        loft(
            [
                [
                    (x * length * 0.94, -w * beam * 0.44, high - 0.02),
                    (x * length * 0.94, w * beam * 0.44, high - 0.02),
                    (x * length * 0.94, w * beam * 0.40, high + 0.03),
                    (x * length * 0.94, -w * beam * 0.40, high + 0.03),
                ]
                for x, w, _, high in stations
            ]
        ),
    )
    rudder = b.subpart(hull, "rudder", "tiller")
    b.put(rudder, b.paints.draw("wood"), box((0.16, 0.08, 0.42), (-length / 2 - 0.06, 0, 0.23), 0.015))
    house = b.part("cabin", "deckhouse")
    b.put(house, b.paints.draw("plain"), box((0.26, beam * 0.5, 0.17), (-length * 0.22, 0, 0.40), 0.02))
    b.put(
        b.subpart(house, "roof", "top", at="of"),
        b.paints.draw("plastic"),
        box((0.31, beam * 0.58, 0.055), (-length * 0.22, 0, 0.50), 0.02),
    )
    mast_x, top = length * 0.06, b.between(1.20, 1.35)
    mast = b.part("mast", "pole")
    b.put(mast, b.paints.draw("wood"), cylinder(0.035, 0.28, top + 0.12, 16))
    flag = b.subpart(mast, "flag", "pennant")
    b.put(
        flag,
        b.paints.draw("cloth"),
        extrude([(-0.01, 0), (-0.01, 0.17), (-0.26, 0.085)], 0.04).moved(0, 0, top - 0.04),
    )
    b.shift((mast, flag), mast_x, 0, 0)
    main, low = b.part("mainsail", "big sail"), 0.62
    cloth, patch = b.paints.draw("cloth"), b.paints.draw("cloth")
    tall, foot = top - 0.10 - low, length * 0.50
    b.put(main, cloth, extrude([(0, 0), (-foot, 0), (0, tall)], 0.035).moved(mast_x - 0.04, 0, low))
    cut = 0.34
    b.put(
        b.subpart(main, "panel", "sail panel"),
        patch,
        extrude(
            [
                (0, 0.02),
                (-foot * 0.93, 0.02),
                (-foot * (1 - cut) * 0.95, tall * cut * 0.8),
                (0, tall * cut * 0.8),
            ],
            0.055,
        ).moved(mast_x - 0.045, 0, low),
    )
    jib = b.part("jib", "front sail")
    tall, foot = tall * 0.85, length * 0.36
    b.put(
        jib,
        b.paints.draw("cloth"),
        extrude([(0, 0), (foot, 0), (0, tall)], 0.035).moved(mast_x + 0.05, 0, low - 0.10),
    )
    b.put(
        b.subpart(jib, "emblem", "badge"),
        b.paints.draw("plain"),
        cylinder(0.115, -0.035, 0.035, 20)
        .turned("x", 90)
        .moved(mast_x + 0.05 + foot * 0.28, 0, low - 0.10 + tall * 0.30),
    )
    b.turn(55)  # so that the sails are broad from the front


def _airplane(b: Builder) -> None:
    skin, wing_paint, tip_paint = b.paints.draw("plain"), b.paints.draw("plastic"), b.paints.draw("plastic")
    dark, metal = b.paints.draw("plastic", "black", "grey", "brown"), b.paints.draw("metal")
    r, length = b.between(0.15, 0.175), b.between(1.05, 1.2)
    z = 0.36
    body = b.part("fuselage", "body")
    hull = lathe(
        [
            (0, 0),
            (r * 0.35, 0.01),
            (r * 0.72, length * 0.35),
            (r, length * 0.62),
            (r, length * 0.88),
            (r * 0.8, length * 0.97),
            (0, length),
        ]
    )
    b.put(body, skin, hull.turned("y", 90).moved(-length * 0.58, 0, z))
    window = b.subpart(body, "cockpit", "windows", "canopy")
    glass = b.paints.draw("plastic", "blue", "teal", "black", "white")
    b.put(window, glass, ellipsoid((0.20, 0.115, 0.13), (length * 0.13, 0, z + r * 0.82)))
    band = b.subpart(body, "band", "stripe")
    b.put(band, b.paints.draw("plain"), disc(r * 0.90, -length * 0.20, -length * 0.09).moved(z=z))
    propeller = b.part("propeller", "airscrew")
    x = length * 0.42
    b.put(
        propeller,
        metal,
        *[box((0.045, 0.09, 0.56), (x + 0.07, 0, 0), 0.015).turned("x", a).moved(z=z) for a in (30, 120)],
    )
    b.put(
        b.subpart(propeller, "hub", "spinner"),
        b.paints.draw("plastic"),
        lathe([(0, 0), (0.125, 0), (0.09, 0.13), (0, 0.19)]).turned("y", 90).moved(x + 0.02, 0, z),
    )
    span = b.between(0.50, 0.58)

    def wing_part(low: float | int, high: float | int, grow: float) -> list[list[tuple[float, float, float]]]:
        rows = []
        for share in (low, high):
            chord, thick = 0.34 - 0.12 * share, 0.032 * grow + 0.012
            middle, y, up = 0.05 - 0.05 * share, r * 0.6 + share * span, z - 0.04 + 0.06 * share
            half = chord / 2 * grow
            rows.append(
                [
                    (middle - half, y, up - thick),
                    (middle + half, y, up - thick),
                    (middle + half, y, up + thick),
                    (middle - half, y, up + thick),
                ]
            )
        return rows

    for side in (-1, 1):
        wing = b.part("wing")
        b.put(wing, wing_paint, loft(_mirrored(wing_part(0, 1, 1.0), side)))
        b.put(
            b.subpart(wing, "tip", "end", at="of"),
            tip_paint,
            loft(_mirrored(wing_part(0.70, 1.02, 1.15), side)),
        )
        engine = b.subpart(wing, "engine", "motor", at="under")
        y = side * (r * 0.6 + span * 0.42)
        b.put(engine, metal, disc(0.115, -0.14, 0.27, bevel=0.03).moved(0.05, y, z - 0.05))
    tail = b.part("tail", "tail unit")
    back = -length * 0.58
    b.put(tail, wing_paint, box((0.19, 0.56, 0.045), (back + 0.10, 0, z + 0.03), 0.015))
    b.put(
        b.subpart(tail, "rudder", "tail fin"),
        b.paints.draw("plain"),
        extrude(
            [(back, z + 0.03), (back + 0.26, z + 0.03), (back + 0.10, z + 0.34), (back - 0.03, z + 0.34)],
            0.055,
        ),
    )
    gear = b.part("landing gear", "undercarriage")
    wheels = b.subpart(gear, "wheels", "tires")
    for side in (-1, 1):
        b.put(gear, metal, sweep([(0.16, side * 0.08, z - 0.10), (0.18, side * 0.20, 0.13)], 0.05))
        b.put(
            wheels,
            dark,
            cylinder(0.13, -0.06, 0.06, 20, 0.015).turned("x", 90).moved(0.18, side * 0.24, 0.13),
        )
    b.put(gear, metal, sweep([(back + 0.16, 0, z - 0.04), (back + 0.13, 0, 0.06)], 0.03))
    b.put(wheels, dark, cylinder(0.06, -0.03, 0.03, 16).turned("x", 90).moved(back + 0.13, 0, 0.06))


def _mirrored(
    sections: list[list[tuple[float, float, float]]], side: int
) -> list[list[tuple[float, float, float]]]:
    return [[(x, side * y, z) for x, y, z in section] for section in sections]


def _tractor(b: Builder) -> None:
    paint, tyre, hub = (
        b.paints.draw("plastic"),
        b.paints.draw("plain", "black", "grey"),
        b.paints.draw("plastic"),
    )
    glass, metal = b.paints.draw("plastic", "blue", "teal", "white", "black"), b.paints.draw("metal")
    big, small = b.between(0.28, 0.32), b.between(0.16, 0.19)
    hood = b.part("hood", "engine cover", "bonnet")
    b.put(hood, paint, box((0.50, 0.32, 0.26), (0.30, 0, 0.42), 0.03))
    grille = b.subpart(hood, "grille", "radiator", at="of")
    b.put(grille, metal, box((0.05, 0.25, 0.19), (0.56, 0, 0.42), 0.015))
    lights = b.subpart(hood, "headlights", "lamps")
    for side in (-1, 1):
        b.put(
            lights,
            b.paints.draw("plastic", "yellow", "white"),
            disc(0.09, -0.04, 0.06, 20, 0.015).moved(0.48, side * 0.19, 0.54),
        )
    pipe = b.part("exhaust pipe", "exhaust")
    b.put(pipe, metal, cylinder(0.045, 0.53, 0.84, 16).moved(0.36, 0.0, 0))
    b.put(
        b.subpart(pipe, "cap", "end", at="of"),
        b.paints.draw("plastic"),
        cylinder(0.095, 0.78, 0.91, 18, 0.015).moved(0.36, 0, 0),
    )
    cabin = b.part("cabin", "cab")
    b.put(cabin, b.paints.draw("plain"), box((0.46, 0.42, 0.56), (-0.16, 0, 0.62), 0.02))
    b.put(
        b.subpart(cabin, "roof", "top", at="of"),
        b.paints.draw("plastic"),
        box((0.56, 0.52, 0.085), (-0.16, 0, 0.92), 0.03),
    )
    windows = b.subpart(cabin, "windows")
    b.put(
        windows,
        glass,
        box((0.30, 0.45, 0.23), (-0.16, 0, 0.73), 0.01),
        box((0.49, 0.30, 0.23), (-0.16, 0, 0.73), 0.01),
    )
    frame = b.part("frame", "chassis")
    b.put(
        frame,
        b.paints.draw("plain", "black", "grey", "brown"),
        box((0.95, 0.24, 0.16), (0.06, 0, 0.25), 0.02),
    )
    b.put(
        b.subpart(frame, "hitch", "tow hook", at="of"),
        metal,
        box((0.20, 0.14, 0.10), (-0.50, 0, 0.24), 0.025),
    )
    for radius, x, y, wide in ((big, -0.22, 0.31, 0.15), (small, 0.36, 0.24, 0.11)):
        word = "rear wheel" if radius == big else "front wheel"
        for side in (-1, 1):
            wheel = b.part(word, "big wheel" if radius == big else "small wheel")
            b.put(
                wheel,
                tyre,
                cylinder(radius, -wide / 2, wide / 2, 28, 0.03).turned("x", 90).moved(x, side * y, radius),
            )
            cap = cylinder(radius * 0.60, -0.03, 0.03, 22, 0.01).turned("x", 90)
            b.put(b.subpart(wheel, "hub", "rim", at="of"), hub, cap.moved(x, side * (y + wide / 2), radius))


MAKERS: dict[str, Maker] = {
    "train": Maker(_train, ("locomotive", "steam engine", "toy train")),
    "sailboat": Maker(_sailboat, ("sailing boat", "toy boat")),
    "airplane": Maker(_airplane, ("plane", "aircraft")),
    "tractor": Maker(_tractor, ("toy tractor", "farm tractor")),
}
"""Classes drawn by this module."""
