"""Toy vehicles: each function draws one class of object."""

from hilsplat.world.objects.builder import Builder
from hilsplat.world.shapes import (
    Mesh,
    Number,
    Point,
    box,
    cylinder,
    disc,
    ellipsoid,
    extrude,
    lathe,
    loft,
    roller,
    sweep,
)


def train(b: Builder) -> None:
    tank, cab_paint, metal = b.paint("plastic"), b.paint("plain"), b.paint("metal")
    dark = b.paint("plain black grey brown")
    r, length = b.between(0.19, 0.22), b.between(0.60, 0.70)
    axis = 0.24 + r
    frame = b.part("frame, chassis", dark, box((length + 0.42, 0.34, 0.12), (0, 0, 0.21), 0.02))
    front = length / 2 + 0.20
    sections = [
        [(front, -0.22, 0.04), (front, 0.22, 0.04), (front, 0.16, 0.27), (front, -0.16, 0.27)],
    ]
    low, high = front + 0.20, front + 0.06
    sections += [[(low, -0.06, 0.04), (low, 0.06, 0.04), (high, 0.05, 0.25), (high, -0.05, 0.25)]]
    frame.subpart("cowcatcher, plough", "plastic", loft(sections))
    back = -length / 2 + 0.22
    boiler = b.part("boiler, tank", tank, disc(r, back, front - 0.04).moved(z=axis))
    shape = disc(r * 0.80, front - 0.05, front + 0.02, bevel=0.02).moved(z=axis)
    boiler.subpart("front plate, smokebox door", metal, shape)
    bands = boiler.subpart("bands, rings")
    band = b.paint("metal")
    for share in (0.25, 0.62):
        x = back + share * (front - back)
        bands.put(band, disc(r + 0.022, x - 0.05, x + 0.05).moved(z=axis))
    shape = lathe([(0.13, 0), (0.13, 0.08), (0.08, 0.16), (0, 0.18)]).moved(0.04, 0, axis + r - 0.03)
    boiler.subpart("dome, bell", "metal", shape)
    cx, top = front - 0.16, axis + r
    shape = lathe([(0, -0.05), (0.075, -0.05), (0.075, 0.08), (0.115, 0.2), (0, 0.2)]).moved(cx, 0, top)
    chimney = b.part("chimney, funnel, smokestack", dark, shape)
    shape = cylinder(0.145, top + 0.17, top + 0.255, bevel=0.015).moved(cx)
    chimney.subpart("rim, crown", "ceramic", shape, at="of")
    x, height = -length / 2 - 0.01, b.between(0.52, 0.60)
    cabin = b.part("cabin, cab", cab_paint, box((0.36, 0.44, height), (x, 0, 0.25 + height / 2), 0.015))
    cabin.subpart("roof, top", "plain", box((0.48, 0.56, 0.08), (x, 0, 0.28 + height), 0.03), at="of")
    glass = b.paint("plastic blue teal yellow white black")
    windows = cabin.subpart("windows", glass, box((0.22, 0.47, 0.20), (x, 0, 0.25 + height * 0.66), 0.01))
    windows.put(glass, box((0.39, 0.26, 0.18), (x, 0, 0.25 + height * 0.67), 0.01))
    wheel_r, tyre, hub = 0.165, b.paint("plain"), b.paint("metal")
    for i in range(3):
        for side in (-1, 1):
            wx, y = (i - 1) * 0.34, side * 0.22
            wheel = b.part("wheel", tyre, roller(wheel_r, -0.045, 0.045, 24, 0.012).moved(wx, y, wheel_r))
            shape = roller(wheel_r * 0.68, -0.03, 0.03, 20, 0.01).moved(wx, y + side * 0.04, wheel_r)
            wheel.subpart("hub, wheel centre", hub, shape, at="of")


def sailboat(b: Builder) -> None:
    hull_paint, wood = b.paint("plain"), b.paint("wood")
    length, beam = b.between(0.95, 1.1), b.between(0.36, 0.42)

    def section(x: float, lower: float, upper: float, low: float, high: float) -> list[Point]:
        """Return a cross-section with the given half widths at its lower and upper edge."""
        return [(x, -lower, low), (x, lower, low), (x, upper, high), (x, -upper, high)]

    stations = [(-0.5, 0.78, 0.07, 0.32), (-0.2, 1.0, 0.0, 0.30), (0.18, 0.86, 0.0, 0.31)]
    stations += [(0.42, 0.34, 0.08, 0.35), (0.52, 0.04, 0.16, 0.38)]
    sections = []
    for x, w, low, high in stations:
        half = w * beam / 2
        sections.append(section(x * length, half * 0.45, half, low, high))
    hull = b.part("hull, body", hull_paint, loft(sections))
    stripe, deck = [], []
    for x, w, _, high in stations:
        wide = (w + 0.045) * beam * 1.03
        stripe.append(section(x * length * 1.012, wide * 0.475, wide / 2, high - 0.075, high - 0.015))
        deck.append(section(x * length * 0.94, w * beam * 0.44, w * beam * 0.40, high - 0.02, high + 0.03))
    hull.subpart("stripe, band", "plastic", loft(stripe))
    hull.subpart("deck, floor", wood, loft(deck))
    hull.subpart("rudder, tiller", "wood", box((0.16, 0.08, 0.42), (-length / 2 - 0.06, 0, 0.23), 0.015))
    shape = box((0.26, beam * 0.5, 0.17), (-length * 0.22, 0, 0.40), 0.02)
    house = b.part("cabin, deckhouse", "plain", shape)
    shape = box((0.31, beam * 0.58, 0.055), (-length * 0.22, 0, 0.50), 0.02)
    house.subpart("roof, top", "plastic", shape, at="of")
    mast_x, top = length * 0.06, b.between(1.20, 1.35)
    mast = b.part("mast, pole", "wood", cylinder(0.035, 0.28, top + 0.12, 16).moved(mast_x))
    flag = extrude([(-0.01, 0), (-0.01, 0.17), (-0.26, 0.085)], 0.04)
    mast.subpart("flag, pennant", "cloth", flag.moved(mast_x, 0, top - 0.04))
    main, low = b.part("mainsail, big sail"), 0.62
    cloth, patch = b.paint("cloth"), b.paint("cloth")
    tall, foot = top - 0.10 - low, length * 0.50
    main.put(cloth, extrude([(0, 0), (-foot, 0), (0, tall)], 0.035).moved(mast_x - 0.04, 0, low))
    cut = 0.34
    outline = [(0, 0.02), (-foot * 0.93, 0.02)]
    outline += [(-foot * (1 - cut) * 0.95, tall * cut * 0.8), (0, tall * cut * 0.8)]
    main.subpart("panel, sail panel", patch, extrude(outline, 0.055).moved(mast_x - 0.045, 0, low))
    tall, foot = tall * 0.85, length * 0.36
    shape = extrude([(0, 0), (foot, 0), (0, tall)], 0.035).moved(mast_x + 0.05, 0, low - 0.10)
    jib = b.part("jib, front sail", "cloth", shape)
    shape = roller(0.115, -0.035, 0.035, 20).moved(mast_x + 0.05 + foot * 0.28, 0, low - 0.10 + tall * 0.30)
    jib.subpart("emblem, badge", "plain", shape)
    b.turn(55)  # so that the sails are broad from the front


def airplane(b: Builder) -> None:
    skin, wing_paint, tip_paint = b.paint("plain"), b.paint("plastic"), b.paint("plastic")
    dark, metal = b.paint("plastic black grey brown"), b.paint("metal")
    r, length = b.between(0.15, 0.175), b.between(1.05, 1.2)
    z = 0.36
    profile = [(0, 0), (r * 0.35, 0.01), (r * 0.72, length * 0.35), (r, length * 0.62)]
    profile += [(r, length * 0.88), (r * 0.8, length * 0.97), (0, length)]
    hull = lathe(profile).turned("y", 90).moved(-length * 0.58, 0, z)
    body = b.part("fuselage, body", skin, hull)
    shape = ellipsoid((0.20, 0.115, 0.13), (length * 0.13, 0, z + r * 0.82))
    body.subpart("cockpit, windows, canopy", "plastic blue teal black white", shape)
    body.subpart("band, stripe", "plain", disc(r * 0.90, -length * 0.20, -length * 0.09).moved(z=z))
    x = length * 0.42
    shapes = [box((0.045, 0.09, 0.56), (x + 0.07, 0, 0), 0.015).turned("x", a).moved(z=z) for a in (30, 120)]
    propeller = b.part("propeller, airscrew", metal, *shapes)
    shape = lathe([(0, 0), (0.125, 0), (0.09, 0.13), (0, 0.19)]).turned("y", 90).moved(x + 0.02, 0, z)
    propeller.subpart("hub, spinner", "plastic", shape)
    span = b.between(0.50, 0.58)

    def wing_part(side: int, low: Number, high: Number, grow: float) -> Mesh:
        """Return a part of a wing, between two shares of its span."""
        sections = []
        for share in (low, high):
            chord, thick = 0.34 - 0.12 * share, 0.032 * grow + 0.012
            middle, y, up = 0.05 - 0.05 * share, side * (r * 0.6 + share * span), z - 0.04 + 0.06 * share
            back, front = middle - chord / 2 * grow, middle + chord / 2 * grow
            lower, upper = up - thick, up + thick
            sections.append([(back, y, lower), (front, y, lower), (front, y, upper), (back, y, upper)])
        return loft(sections)

    for side in (-1, 1):
        wing = b.part("wing", wing_paint, wing_part(side, 0, 1, 1.0))
        wing.subpart("tip, end", tip_paint, wing_part(side, 0.70, 1.02, 1.15), at="of")
        y = side * (r * 0.6 + span * 0.42)
        shape = disc(0.115, -0.14, 0.27, bevel=0.03).moved(0.05, y, z - 0.05)
        wing.subpart("engine, motor", metal, shape, at="under")
    back = -length * 0.58
    tail = b.part("tail, tail unit", wing_paint, box((0.19, 0.56, 0.045), (back + 0.10, 0, z + 0.03), 0.015))
    outline = [(back, z + 0.03), (back + 0.26, z + 0.03), (back + 0.10, z + 0.34), (back - 0.03, z + 0.34)]
    tail.subpart("rudder, tail fin", "plain", extrude(outline, 0.055))
    gear = b.part("landing gear, undercarriage")
    wheels = gear.subpart("wheels, tires")
    for side in (-1, 1):
        gear.put(metal, sweep([(0.16, side * 0.08, z - 0.10), (0.18, side * 0.20, 0.13)], 0.05))
        wheels.put(dark, roller(0.13, -0.06, 0.06, 20, 0.015).moved(0.18, side * 0.24, 0.13))
    gear.put(metal, sweep([(back + 0.16, 0, z - 0.04), (back + 0.13, 0, 0.06)], 0.03))
    wheels.put(dark, roller(0.06, -0.03, 0.03, 16).moved(back + 0.13, 0, 0.06))


def tractor(b: Builder) -> None:
    paint = b.paint("plastic")
    tyre = b.paint("plain black grey")
    hub = b.paint("plastic")
    glass, metal = b.paint("plastic blue teal white black"), b.paint("metal")
    big, small = b.between(0.28, 0.32), b.between(0.16, 0.19)
    hood = b.part("hood, engine cover, bonnet", paint, box((0.50, 0.32, 0.26), (0.30, 0, 0.42), 0.03))
    hood.subpart("grille, radiator", metal, box((0.05, 0.25, 0.19), (0.56, 0, 0.42), 0.015), at="of")
    lights = hood.subpart("headlights, lamps")
    for side in (-1, 1):
        lights.put("plastic yellow white", disc(0.09, -0.04, 0.06, 20, 0.015).moved(0.48, side * 0.19, 0.54))
    pipe = b.part("exhaust pipe, exhaust", metal, cylinder(0.045, 0.53, 0.84, 16).moved(0.36, 0.0, 0))
    pipe.subpart("cap, end", "plastic", cylinder(0.095, 0.78, 0.91, 18, 0.015).moved(0.36, 0, 0), at="of")
    cabin = b.part("cabin, cab", "plain", box((0.46, 0.42, 0.56), (-0.16, 0, 0.62), 0.02))
    cabin.subpart("roof, top", "plastic", box((0.56, 0.52, 0.085), (-0.16, 0, 0.92), 0.03), at="of")
    shapes = [box((0.30, 0.45, 0.23), (-0.16, 0, 0.73), 0.01)]
    shapes += [box((0.49, 0.30, 0.23), (-0.16, 0, 0.73), 0.01)]
    cabin.subpart("windows", glass, *shapes)
    frame = b.part("frame, chassis", "plain black grey brown", box((0.95, 0.24, 0.16), (0.06, 0, 0.25), 0.02))
    frame.subpart("hitch, tow hook", metal, box((0.20, 0.14, 0.10), (-0.50, 0, 0.24), 0.025), at="of")
    for radius, x, y, wide in ((big, -0.22, 0.31, 0.15), (small, 0.36, 0.24, 0.11)):
        words = "rear wheel, big wheel" if radius == big else "front wheel, small wheel"
        for side in (-1, 1):
            shape = roller(radius, -wide / 2, wide / 2, 28, 0.03).moved(x, side * y, radius)
            wheel = b.part(words, tyre, shape)
            cap = roller(radius * 0.60, -0.03, 0.03, 22, 0.01)
            wheel.subpart("hub, rim", hub, cap.moved(x, side * (y + wide / 2), radius), at="of")
