"""Vehicles, a pedestrian and a cyclist, in metres. Fronts face +x; the base is at z = 0."""

import numpy as np

from hilsplat.world.objects.builder import Builder, Node
from hilsplat.world.objects.street import glass, lacquer, lit, panel, plain, rubber
from hilsplat.world.paints import Paint
from hilsplat.world.shapes import box, cylinder, ellipsoid, extrude, roller, sphere, sweep


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
    """Add headlights, tail lights and licence plates to the two ends of a body."""
    head = node.subpart("headlights, front lights")
    tail = node.subpart("tail lights, rear lights")
    bright, red = lit(plain(b, "white")), plain(b, "red")
    for side in (-1, 1):
        head.put(bright, ellipsoid((0.07, 0.19, 0.12), (front, side * w * 0.36, z), 16, 8))
        tail.put(red, box((0.08, 0.28, 0.2), (back, side * w * 0.38, z + 0.03), 0.03))
    plate, yellow = node.subpart("licence plate, license plate, number plate"), plain(b, "yellow")
    plate.put(yellow, *[panel(0.09, 0.56, 0.18, x, 0, z - 0.05) for x in (front, back)])


def car(b: Builder) -> None:
    paint = lacquer(b, "red orange yellow green teal blue white grey purple")
    metal, pane = b.paint("metal grey black"), glass(b)
    length, w = b.between(4.1, 4.7), b.between(1.78, 1.9)
    low, belt, top = 0.3, b.between(0.90, 0.98), b.between(1.46, 1.6)
    half = length / 2
    outline = [(-half, low), (half, low), (half, belt - 0.22), (half - 0.1, belt - 0.14)]
    body = b.part("body, chassis", paint, extrude([*outline, (half - 1.1, belt), (-half + 0.05, belt)], w))
    shapes = [box((0.2, w * 1.02, 0.2), (end * (half - 0.01), 0, low + 0.1), 0.05) for end in (-1, 1)]
    body.subpart("bumper", metal, *shapes)
    _lights_and_plates(b, body, half - 0.02, -half, w, belt - 0.26)
    door = body.subpart("door, doors")
    leaf, middle = lacquer(b, paint.colour), (low + belt) / 2 + 0.03
    for side in (-1, 1):
        for x, reach in ((0.10, 1.0), (-1.0, 0.9)):
            door.put(leaf, box((reach, 0.05, belt - low - 0.2), (x, side * w / 2, middle), 0.02))
    estate = b.chance(0.4)
    back = -half + (0.12 if estate else 0.75)
    rear_top = back + (0.25 if estate else 0.6)
    front, front_top = half - 1.15, half - 1.95
    shell = [(back, belt - 0.02), (front, belt - 0.02), (front_top, top), (rear_top, top)]
    cabin = b.part("cabin, top", paint, extrude(shell, w * 0.86))
    roof, roof_paint = cabin.subpart("roof"), lacquer(b, "black white grey")
    shape = box((front_top - rear_top, w * 0.84, 0.07), ((front_top + rear_top) / 2, 0, top), 0.03)
    roof.put(roof_paint, shape)
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
    """Return a paint that contrasts with another."""
    light = sum(paint.first) > 1.5
    return lacquer(b, "red blue green purple" if light else "white yellow beige")


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
            if side == -1 and i in (2, bays - 1):  # the doors are on the kerb's side
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
    hip, shoulder = 0.49 * tall, 0.80 * tall
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
    trousers = b.paint("plain black blue grey brown")
    metal = b.paint("plain red teal yellow green white orange")
    dark = rubber(b)
    radius, reach = 0.36, 0.56
    cycle = b.part("bicycle, bike")
    seat, bar, crank = (-0.2, 0, 0.98), (0.42, 0, 1.08), (-0.05, 0, 0.38)
    for path in (
        [seat, crank],
        [crank, (0.36, 0, 0.86)],
        [(-0.16, 0, 0.84), (0.36, 0, 0.86)],
        [(-reach, 0, radius), crank],
        [(-reach, 0, radius), (-0.17, 0, 0.86)],
        [bar, (reach, 0, radius)],
    ):
        cycle.put(metal, sweep(path, 0.035, 8))
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
