"""Toy vehicles: each function draws one class of object."""

from hilsplat.world.objects.builder import Builder, Maker
from hilsplat.world.shapes import box, cylinder, disc, ellipsoid, extrude, lathe, loft, sweep


def _train(b: Builder) -> None:
    tank, cab_paint, metal = b.paint("plastic"), b.paint("plain"), b.paint("metal")
    dark = b.paint("plain", "black", "grey", "brown")
    r, length = b.between(0.19, 0.22), b.between(0.60, 0.70)
    axis = 0.24 + r
    frame = b.part("frame", "chassis").put(dark, box((length + 0.42, 0.34, 0.12), (0, 0, 0.21), 0.02))
    front = length / 2 + 0.20
    sections = [
        [(front, -0.22, 0.04), (front, 0.22, 0.04), (front, 0.16, 0.27), (front, -0.16, 0.27)],
        [
            (front + 0.20, -0.06, 0.04),
            (front + 0.20, 0.06, 0.04),
            (front + 0.06, 0.05, 0.25),
            (front + 0.06, -0.05, 0.25),
        ],
    ]
    frame.subpart("cowcatcher", "plough").put(b.paint("plastic"), loft(sections))
    back = -length / 2 + 0.22
    boiler = b.part("boiler", "tank").put(tank, disc(r, back, front - 0.04).moved(z=axis))
    boiler.subpart("front plate", "smokebox door").put(
        metal, disc(r * 0.80, front - 0.05, front + 0.02, bevel=0.02).moved(z=axis)
    )
    bands = boiler.subpart("bands", "rings")
    band = b.paint("metal")
    for share in (0.25, 0.62):
        x = back + share * (front - back)
        bands.put(band, disc(r + 0.022, x - 0.05, x + 0.05).moved(z=axis))
    boiler.subpart("dome", "bell").put(
        b.paint("metal"),
        lathe([(0.13, 0), (0.13, 0.08), (0.08, 0.16), (0, 0.18)]).moved(0.04, 0, axis + r - 0.03),
    )
    cx, top = front - 0.16, axis + r
    chimney = b.part("chimney", "funnel", "smokestack").put(
        dark, lathe([(0, -0.05), (0.075, -0.05), (0.075, 0.08), (0.115, 0.2), (0, 0.2)]).moved(cx, 0, top)
    )
    chimney.subpart("rim", "crown", at="of").put(
        b.paint("ceramic"), cylinder(0.145, top + 0.17, top + 0.255, bevel=0.015).moved(cx)
    )
    x, height = -length / 2 - 0.01, b.between(0.52, 0.60)
    cabin = b.part("cabin", "cab").put(cab_paint, box((0.36, 0.44, height), (x, 0, 0.25 + height / 2), 0.015))
    cabin.subpart("roof", "top", at="of").put(
        b.paint("plain"), box((0.48, 0.56, 0.08), (x, 0, 0.28 + height), 0.03)
    )
    glass = b.paint("plastic", "blue", "teal", "yellow", "white", "black")
    windows = cabin.subpart("windows").put(glass, box((0.22, 0.47, 0.20), (x, 0, 0.25 + height * 0.66), 0.01))
    windows.put(glass, box((0.39, 0.26, 0.18), (x, 0, 0.25 + height * 0.67), 0.01))
    wheel_r, tyre, hub = 0.165, b.paint("plain"), b.paint("metal")
    for i in range(3):
        for side in (-1, 1):
            wx, y = (i - 1) * 0.34, side * 0.22
            wheel = b.part("wheel").put(
                tyre, cylinder(wheel_r, -0.045, 0.045, 24, 0.012).turned("x", 90).moved(wx, y, wheel_r)
            )
            wheel.subpart("hub", "wheel centre", at="of").put(
                hub,
                cylinder(wheel_r * 0.68, -0.03, 0.03, 20, 0.01)
                .turned("x", 90)
                .moved(wx, y + side * 0.04, wheel_r),
            )


def _sailboat(b: Builder) -> None:
    hull_paint, wood = b.paint("plain"), b.paint("wood")
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
    hull = b.part("hull", "body").put(
        hull_paint, loft([section(x * length, w * beam, low, high) for x, w, low, high in stations])
    )
    lifted = [
        (x * length * 1.012, (w + 0.045) * beam * 1.03, high - 0.075, high - 0.015)
        for x, w, low, high in stations
    ]
    sections = [
        [(x, -w * 0.475, low), (x, w * 0.475, low), (x, w / 2, high), (x, -w / 2, high)]
        for x, w, low, high in lifted
    ]
    hull.subpart("stripe", "band").put(b.paint("plastic"), loft(sections))
    sections = [
        [
            (x * length * 0.94, -w * beam * 0.44, high - 0.02),
            (x * length * 0.94, w * beam * 0.44, high - 0.02),
            (x * length * 0.94, w * beam * 0.40, high + 0.03),
            (x * length * 0.94, -w * beam * 0.40, high + 0.03),
        ]
        for x, w, _, high in stations
    ]
    hull.subpart("deck", "floor").put(wood, loft(sections))
    hull.subpart("rudder", "tiller").put(
        b.paint("wood"), box((0.16, 0.08, 0.42), (-length / 2 - 0.06, 0, 0.23), 0.015)
    )
    house = b.part("cabin", "deckhouse").put(
        b.paint("plain"), box((0.26, beam * 0.5, 0.17), (-length * 0.22, 0, 0.40), 0.02)
    )
    house.subpart("roof", "top", at="of").put(
        b.paint("plastic"), box((0.31, beam * 0.58, 0.055), (-length * 0.22, 0, 0.50), 0.02)
    )
    mast_x, top = length * 0.06, b.between(1.20, 1.35)
    mast = b.part("mast", "pole").put(b.paint("wood"), cylinder(0.035, 0.28, top + 0.12, 16).moved(mast_x))
    flag = extrude([(-0.01, 0), (-0.01, 0.17), (-0.26, 0.085)], 0.04)
    mast.subpart("flag", "pennant").put(b.paint("cloth"), flag.moved(mast_x, 0, top - 0.04))
    main, low = b.part("mainsail", "big sail"), 0.62
    cloth, patch = b.paint("cloth"), b.paint("cloth")
    tall, foot = top - 0.10 - low, length * 0.50
    main.put(cloth, extrude([(0, 0), (-foot, 0), (0, tall)], 0.035).moved(mast_x - 0.04, 0, low))
    cut = 0.34
    outline = [
        (0, 0.02),
        (-foot * 0.93, 0.02),
        (-foot * (1 - cut) * 0.95, tall * cut * 0.8),
        (0, tall * cut * 0.8),
    ]
    main.subpart("panel", "sail panel").put(patch, extrude(outline, 0.055).moved(mast_x - 0.045, 0, low))
    tall, foot = tall * 0.85, length * 0.36
    jib = b.part("jib", "front sail").put(
        b.paint("cloth"), extrude([(0, 0), (foot, 0), (0, tall)], 0.035).moved(mast_x + 0.05, 0, low - 0.10)
    )
    jib.subpart("emblem", "badge").put(
        b.paint("plain"),
        cylinder(0.115, -0.035, 0.035, 20)
        .turned("x", 90)
        .moved(mast_x + 0.05 + foot * 0.28, 0, low - 0.10 + tall * 0.30),
    )
    b.turn(55)  # so that the sails are broad from the front


def _airplane(b: Builder) -> None:
    skin, wing_paint, tip_paint = b.paint("plain"), b.paint("plastic"), b.paint("plastic")
    dark, metal = b.paint("plastic", "black", "grey", "brown"), b.paint("metal")
    r, length = b.between(0.15, 0.175), b.between(1.05, 1.2)
    z = 0.36
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
    body = b.part("fuselage", "body").put(skin, hull.turned("y", 90).moved(-length * 0.58, 0, z))
    glass = b.paint("plastic", "blue", "teal", "black", "white")
    body.subpart("cockpit", "windows", "canopy").put(
        glass, ellipsoid((0.20, 0.115, 0.13), (length * 0.13, 0, z + r * 0.82))
    )
    body.subpart("band", "stripe").put(
        b.paint("plain"), disc(r * 0.90, -length * 0.20, -length * 0.09).moved(z=z)
    )
    x = length * 0.42
    propeller = b.part("propeller", "airscrew").put(
        metal,
        *[box((0.045, 0.09, 0.56), (x + 0.07, 0, 0), 0.015).turned("x", a).moved(z=z) for a in (30, 120)],
    )
    propeller.subpart("hub", "spinner").put(
        b.paint("plastic"),
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
        wing = b.part("wing").put(wing_paint, loft(_mirrored(wing_part(0, 1, 1.0), side)))
        wing.subpart("tip", "end", at="of").put(tip_paint, loft(_mirrored(wing_part(0.70, 1.02, 1.15), side)))
        y = side * (r * 0.6 + span * 0.42)
        wing.subpart("engine", "motor", at="under").put(
            metal, disc(0.115, -0.14, 0.27, bevel=0.03).moved(0.05, y, z - 0.05)
        )
    back = -length * 0.58
    tail = b.part("tail", "tail unit").put(
        wing_paint, box((0.19, 0.56, 0.045), (back + 0.10, 0, z + 0.03), 0.015)
    )
    outline = [(back, z + 0.03), (back + 0.26, z + 0.03), (back + 0.10, z + 0.34), (back - 0.03, z + 0.34)]
    tail.subpart("rudder", "tail fin").put(b.paint("plain"), extrude(outline, 0.055))
    gear = b.part("landing gear", "undercarriage")
    wheels = gear.subpart("wheels", "tires")
    for side in (-1, 1):
        gear.put(metal, sweep([(0.16, side * 0.08, z - 0.10), (0.18, side * 0.20, 0.13)], 0.05))
        wheels.put(
            dark, cylinder(0.13, -0.06, 0.06, 20, 0.015).turned("x", 90).moved(0.18, side * 0.24, 0.13)
        )
    gear.put(metal, sweep([(back + 0.16, 0, z - 0.04), (back + 0.13, 0, 0.06)], 0.03))
    wheels.put(dark, cylinder(0.06, -0.03, 0.03, 16).turned("x", 90).moved(back + 0.13, 0, 0.06))


def _mirrored(
    sections: list[list[tuple[float, float, float]]], side: int
) -> list[list[tuple[float, float, float]]]:
    return [[(x, side * y, z) for x, y, z in section] for section in sections]


def _tractor(b: Builder) -> None:
    paint = b.paint("plastic")
    tyre = b.paint("plain", "black", "grey")
    hub = b.paint("plastic")
    glass, metal = b.paint("plastic", "blue", "teal", "white", "black"), b.paint("metal")
    big, small = b.between(0.28, 0.32), b.between(0.16, 0.19)
    hood = b.part("hood", "engine cover", "bonnet").put(paint, box((0.50, 0.32, 0.26), (0.30, 0, 0.42), 0.03))
    hood.subpart("grille", "radiator", at="of").put(metal, box((0.05, 0.25, 0.19), (0.56, 0, 0.42), 0.015))
    lights = hood.subpart("headlights", "lamps")
    for side in (-1, 1):
        lights.put(
            b.paint("plastic", "yellow", "white"),
            disc(0.09, -0.04, 0.06, 20, 0.015).moved(0.48, side * 0.19, 0.54),
        )
    pipe = b.part("exhaust pipe", "exhaust").put(metal, cylinder(0.045, 0.53, 0.84, 16).moved(0.36, 0.0, 0))
    pipe.subpart("cap", "end", at="of").put(
        b.paint("plastic"), cylinder(0.095, 0.78, 0.91, 18, 0.015).moved(0.36, 0, 0)
    )
    cabin = b.part("cabin", "cab").put(b.paint("plain"), box((0.46, 0.42, 0.56), (-0.16, 0, 0.62), 0.02))
    cabin.subpart("roof", "top", at="of").put(
        b.paint("plastic"), box((0.56, 0.52, 0.085), (-0.16, 0, 0.92), 0.03)
    )
    cabin.subpart("windows").put(
        glass,
        box((0.30, 0.45, 0.23), (-0.16, 0, 0.73), 0.01),
        box((0.49, 0.30, 0.23), (-0.16, 0, 0.73), 0.01),
    )
    frame = b.part("frame", "chassis").put(
        b.paint("plain", "black", "grey", "brown"), box((0.95, 0.24, 0.16), (0.06, 0, 0.25), 0.02)
    )
    frame.subpart("hitch", "tow hook", at="of").put(metal, box((0.20, 0.14, 0.10), (-0.50, 0, 0.24), 0.025))
    for radius, x, y, wide in ((big, -0.22, 0.31, 0.15), (small, 0.36, 0.24, 0.11)):
        word = "rear wheel" if radius == big else "front wheel"
        for side in (-1, 1):
            wheel = b.part(word, "big wheel" if radius == big else "small wheel").put(
                tyre,
                cylinder(radius, -wide / 2, wide / 2, 28, 0.03).turned("x", 90).moved(x, side * y, radius),
            )
            cap = cylinder(radius * 0.60, -0.03, 0.03, 22, 0.01).turned("x", 90)
            wheel.subpart("hub", "rim", at="of").put(hub, cap.moved(x, side * (y + wide / 2), radius))


MAKERS: dict[str, Maker] = {
    "train": Maker(_train, ("locomotive", "steam engine", "toy train")),
    "sailboat": Maker(_sailboat, ("sailing boat", "toy boat")),
    "airplane": Maker(_airplane, ("plane", "aircraft")),
    "tractor": Maker(_tractor, ("toy tractor", "farm tractor")),
}
