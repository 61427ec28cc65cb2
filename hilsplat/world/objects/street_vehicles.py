"""Car, truck and bus. They face +x, with their base at z = 0; lengths are metres."""

import numpy as np

from hilsplat.world.objects.builder import Builder, Maker, Node
from hilsplat.world.objects.street_paints import glass, lacquer, lit, panel, plain, rubber, wheel
from hilsplat.world.paints import Paint
from hilsplat.world.shapes import box, cylinder, ellipsoid, extrude


def _wheels(b: Builder, places: list[float], half_width: float, radius: float, width: float) -> None:
    tyre, metal = rubber(b), b.paint("metal", "grey", "white")
    for x in places:
        for side in (-1, 1):
            y = side * (half_width - 0.4 * width)
            node = b.part("wheel", "tyre", "tire").put(tyre, wheel(x, y, radius, width))
            cap = cylinder(0.62 * radius, -0.03, 0.03, 18, 0.01).turned("x", 90)
            node.subpart("rim", "hubcap").put(metal, cap.moved(x, y + side * (width / 2 + 0.01), radius))


def _lights_and_plates(b: Builder, node: Node, front: float, back: float, w: float, z: float) -> None:
    """Add headlights, tail lights and licence plates to the two ends of a body."""
    head = node.subpart("headlights", "front lights")
    tail = node.subpart("tail lights", "rear lights")
    bright, red = lit(plain(b, "white")), plain(b, "red")
    for side in (-1, 1):
        head.put(bright, ellipsoid((0.07, 0.19, 0.12), (front, side * w * 0.36, z), 16, 8))
        tail.put(red, box((0.08, 0.28, 0.2), (back, side * w * 0.38, z + 0.03), 0.03))
    plate, yellow = node.subpart("licence plate", "license plate", "number plate"), plain(b, "yellow")
    for x in (front, back):
        plate.put(yellow, panel(0.09, 0.56, 0.18, x, 0, z - 0.05))


def _car(b: Builder) -> None:
    paint = lacquer(b, "red", "orange", "yellow", "green", "teal", "blue", "white", "grey", "purple")
    metal, pane = b.paint("metal", "grey", "black"), glass(b)
    length, w = b.between(4.1, 4.7), b.between(1.78, 1.9)
    low, belt, top = 0.3, b.between(0.90, 0.98), b.between(1.46, 1.6)
    half = length / 2
    outline = [(-half, low), (half, low), (half, belt - 0.22), (half - 0.1, belt - 0.14)]
    body = b.part("body", "chassis").put(
        paint, extrude([*outline, (half - 1.1, belt), (-half + 0.05, belt)], w)
    )
    bumper = body.subpart("bumper")
    for end in (-1, 1):
        bumper.put(metal, box((0.2, w * 1.02, 0.2), (end * (half - 0.01), 0, low + 0.1), 0.05))
    _lights_and_plates(b, body, half - 0.02, -half, w, belt - 0.26)
    door = body.subpart("door", "doors")
    leaf, middle = lacquer(b, paint.colour), (low + belt) / 2 + 0.03
    for side in (-1, 1):
        for x, reach in ((0.10, 1.0), (-1.0, 0.9)):
            door.put(leaf, box((reach, 0.05, belt - low - 0.2), (x, side * w / 2, middle), 0.02))
    estate = b.chance(0.4)
    back = -half + (0.12 if estate else 0.75)
    rear_top = back + (0.25 if estate else 0.6)
    front, front_top = half - 1.15, half - 1.95
    shell = [(back, belt - 0.02), (front, belt - 0.02), (front_top, top), (rear_top, top)]
    cabin = b.part("cabin", "top").put(paint, extrude(shell, w * 0.86))
    roof, roof_paint = cabin.subpart("roof"), lacquer(b, "black", "white", "grey")
    roof.put(
        roof_paint, box((front_top - rear_top, w * 0.84, 0.07), ((front_top + rear_top) / 2, 0, top), 0.03)
    )
    windows = cabin.subpart("windows", "side windows")
    low_z, high_z = belt + 0.06, top - 0.1
    pillar = (front + back) / 2 - 0.1
    for first, last in ((back + 0.2, pillar - 0.05), (pillar + 0.05, front - 0.12)):
        slant = 0.62 * (front - front_top) if last > pillar + 0.1 else 0.0
        lean = 0.62 * (rear_top - back) if first < pillar - 0.1 else 0.0
        shape = [(first, low_z), (last, low_z), (last - slant, high_z), (first + lean, high_z)]
        windows.put(pane, extrude(shape, w * 0.86 + 0.04))
    shield = cabin.subpart("windshield", "windscreen")
    for x_low, x_high in ((front, front_top), (back, rear_top)):
        tilt = np.degrees(np.arctan2(x_high - x_low, top - belt))
        tall = np.hypot(x_high - x_low, top - belt)
        sheet = box((0.05, w * 0.74, tall * 0.74)).turned("y", tilt)
        shield.put(pane, sheet.moved((x_low + x_high) / 2, 0, (belt + top) / 2 + 0.01))
    _wheels(b, [-0.3 * length, 0.3 * length], w / 2, b.between(0.33, 0.37), 0.24)


def _contrasting(b: Builder, paint: Paint) -> Paint:
    """Return a paint that contrasts with another."""
    light = sum(paint.first) > 1.5
    return lacquer(b, *(("red", "blue", "green", "purple") if light else ("white", "yellow", "beige")))


def _truck(b: Builder) -> None:
    paint = lacquer(b, "red", "orange", "yellow", "green", "blue", "teal", "white")
    load = lacquer(b, "white", "beige", "grey", "yellow", "teal", "pink")
    metal, pane = b.paint("metal", "grey", "black"), glass(b)
    w, cab = 2.2, 1.75
    length, high = b.between(5.6, 6.4), b.between(2.7, 3.05)
    half, floor, tall = length / 2, 0.85, b.between(2.25, 2.45)
    frame = b.part("chassis", "frame").put(metal, box((length - 0.1, 1.7, 0.28), (0, 0, 0.66)))
    guard = frame.subpart("bumper")
    for x in (half - 0.02, -half + 0.05):
        guard.put(plain(b, "grey"), box((0.22, w, 0.24), (x, 0, 0.55), 0.05))
    x0, x1 = half - cab, half
    outline = [(x0, 0.5), (x1, 0.5), (x1, 1.35), (x1 - 0.32, tall), (x0, tall)]
    cabin = b.part("cabin", "cab").put(paint, extrude(outline, w * 0.96))
    tilt = np.degrees(np.arctan2(-0.32, tall - 1.35))
    sheet = box((0.06, w * 0.84, (tall - 1.35) * 0.84)).turned("y", tilt)
    cabin.subpart("windshield", "windscreen").put(pane, sheet.moved(x1 - 0.15, 0, (1.35 + tall) / 2))
    cabin.subpart("windows", "side windows").put(
        pane, box((0.85, w * 0.96 + 0.05, 0.62), (x1 - 1.0, 0, tall - 0.55), 0.02)
    )
    _lights_and_plates(b, cabin, x1, x0, w * 0.9, 0.98)
    c0, c1 = -half, x0 - 0.12
    middle, centre_z = (c0 + c1) / 2, (floor + high) / 2
    cargo = b.part("cargo box", "container").put(
        load, box((c1 - c0, w, high - floor), (middle, 0, centre_z), 0.04)
    )
    band, doors = _contrasting(b, load), _contrasting(b, load)
    cargo.subpart("stripe", "logo").put(
        band, box((0.72 * (c1 - c0), w + 0.05, 0.55), (middle, 0, floor + 0.95), 0.02)
    )
    rear = cargo.subpart("rear door", "back door")
    for side in (-1, 1):
        rear.put(doors, panel(0.07, 0.44 * w, 0.86 * (high - floor), c0, side * 0.24 * w, centre_z))
    _wheels(b, [half - 1.0, -half + 1.1], w / 2, b.between(0.44, 0.48), 0.3)


def _bus(b: Builder) -> None:
    paint = lacquer(b, "red", "orange", "yellow", "green", "blue", "teal", "purple")
    pane, second = glass(b), lacquer(b, "white", "beige", "grey")
    length, w = b.between(8.2, 9.4), 2.3
    low, high = 0.42, b.between(2.75, 2.95)
    half, belt = length / 2, 1.3
    body = b.part("body", "hull").put(paint, box((length, w, high - low), (0, 0, (low + high) / 2), 0.12))
    windows = body.subpart("windows", "side windows")
    door = body.subpart("door", "doors")
    bays = 6
    pitch = (length - 1.3) / bays
    for side in (-1, 1):
        for i in range(bays):
            x = -half + 0.75 + (i + 0.5) * pitch
            if side == -1 and i in (2, bays - 1):  # the doors are on the kerb's side
                door.put(second, box((1.0, 0.09, 1.9), (x, -w / 2, low + 1.05), 0.02))
            else:
                windows.put(pane, box((0.86 * pitch, 0.07, 0.9), (x, side * w / 2, belt + 0.52), 0.02))
    shield = body.subpart("windshield", "windscreen")
    for end in (-1, 1):
        shield.put(pane, panel(0.09, w * 0.84, 1.0, end * half, 0, belt + 0.46))
    body.subpart("destination sign", "display").put(
        lit(plain(b, "orange")), panel(0.12, w * 0.6, 0.26, half, 0, high - 0.24)
    )
    body.subpart("stripe").put(second, box((length - 0.5, w + 0.04, 0.24), (0, 0, belt - 0.16), 0.02))
    _lights_and_plates(b, body, half - 0.01, -half, w * 0.9, 0.86)
    roof = b.part("roof", "top").put(second, box((length - 0.25, w - 0.2, 0.14), (0, 0, high + 0.04), 0.05))
    unit, metal = roof.subpart("air conditioner", "ventilation"), b.paint("metal", "grey")
    unit.put(metal, box((1.7, 1.4, 0.26), (b.between(-2, 1), 0, high + 0.2), 0.05))
    _wheels(b, [half - 1.9, -half + 2.0], w / 2, 0.48, 0.3)


MAKERS: dict[str, Maker] = {
    "car": Maker(_car, ("vehicle", "automobile")),
    "truck": Maker(_truck, ("vehicle", "lorry")),
    "bus": Maker(_bus, ("vehicle", "coach")),
}
