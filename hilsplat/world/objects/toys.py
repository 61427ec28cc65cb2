"""Toys and models: each function draws one class of object."""

import numpy as np

from hilsplat.world.objects.builder import Builder, Maker
from hilsplat.world.shapes import box, cylinder, ellipsoid, extrude, lathe, sphere, sweep


def _bear(b: Builder) -> None:
    fur = b.paints.draw("fur", "brown", "beige", "grey", "white", "orange", "pink")
    light, dark, cloth = b.paints.draw("fur"), b.paints.draw("plastic", "black"), b.paints.draw("cloth")
    body_r, head_r = b.between(0.25, 0.30), b.between(0.21, 0.25)
    body = b.part("body", "torso")
    b.put(body, fur, ellipsoid((body_r * 0.9, body_r, body_r * 1.15), (0, 0, 0.34)))
    belly = b.subpart(body, "belly", "tummy")
    b.put(belly, light, ellipsoid((0.10, body_r * 0.72, body_r * 0.8), (body_r * 0.9 - 0.055, 0, 0.33)))
    neck_z = 0.34 + body_r * 1.02
    bow = b.subpart(body, "bow", "bow tie")
    knot_x = body_r * 0.62 + 0.10
    b.put(bow, cloth, sphere(0.05, (knot_x, 0, neck_z)))
    for side in (-1, 1):
        b.put(bow, cloth, ellipsoid((0.045, 0.10, 0.075), (knot_x - 0.01, side * 0.115, neck_z)))
    head = b.part("head")
    z = neck_z + head_r * 0.86
    b.put(head, fur, ellipsoid((head_r * 0.95, head_r, head_r * 0.92), (0.03, 0, z)))
    ear, nose, eye = b.subpart(head, "ears"), b.subpart(head, "muzzle", "snout"), b.subpart(head, "eyes")
    for side in (-1, 1):
        b.put(ear, light, ellipsoid((0.055, 0.10, 0.10), (0.0, side * head_r * 0.78, z + head_r * 0.72)))
        b.put(eye, dark, sphere(0.055, (0.03 + head_r * 0.78, side * head_r * 0.42, z + head_r * 0.30)))
    b.put(nose, light, ellipsoid((0.12, 0.13, 0.10), (0.03 + head_r * 0.82, 0, z - head_r * 0.28)))
    b.put(nose, dark, ellipsoid((0.03, 0.045, 0.03), (0.03 + head_r * 0.82 + 0.10, 0, z - head_r * 0.16)))
    for side in (-1, 1):
        arm = b.part("arm")
        b.put(
            arm,
            fur,
            sweep(
                [
                    (0.02, side * body_r * 0.75, 0.46),
                    (0.10, side * body_r * 1.2, 0.38),
                    (0.20, side * body_r * 1.25, 0.28),
                ],
                [0.075, 0.085, 0.075],
            ),
        )
        b.put(b.subpart(arm, "paw", "hand"), light, sphere(0.092, (0.22, side * body_r * 1.25, 0.26)))
        leg = b.part("leg")
        b.put(
            leg,
            fur,
            sweep([(0.05, side * 0.15, 0.12), (0.2, side * 0.19, 0.11), (0.34, side * 0.21, 0.11)], 0.11),
        )
        b.put(
            b.subpart(leg, "foot", "sole"), light, ellipsoid((0.06, 0.115, 0.13), (0.36, side * 0.21, 0.13))
        )


def _snowman(b: Builder) -> None:
    snow, hat_paint = (
        b.paints.draw("snow", "white"),
        b.paints.draw("cloth", "black", "blue", "purple", "brown", "red", "green"),
    )
    scarf_paint, dark = b.paints.draw("cloth"), b.paints.draw("stone", "black")
    r0, r1, r2 = b.between(0.30, 0.34), b.between(0.23, 0.26), b.between(0.18, 0.20)
    z0, z1 = r0 * 0.92, r0 * 1.75 + r1 * 0.75
    z2 = z1 + r1 * 0.85 + r2 * 0.75
    base = b.part("base", "bottom ball")
    b.put(base, snow, sphere(r0, (0, 0, z0)))
    pads = b.subpart(base, "feet", "boots")
    boots = b.paints.draw("plastic")
    for side in (-1, 1):
        b.put(pads, boots, ellipsoid((0.14, 0.10, 0.08), (r0 * 0.80, side * 0.14, 0.075)))
    body = b.part("body", "middle ball")
    b.put(body, snow, sphere(r1, (0, 0, z1)))
    buttons = b.subpart(body, "buttons")
    for up in (-0.28, 0.38):
        b.put(buttons, dark, sphere(0.068, (r1 * np.cos(up), 0, z1 + r1 * np.sin(up))))
    scarf = b.subpart(body, "scarf", "shawl")
    neck = z1 + r1 * 0.88
    b.put(
        scarf,
        scarf_paint,
        sweep([(0.175 * np.cos(a), 0.175 * np.sin(a), neck) for a in np.linspace(0, 2 * np.pi, 22)], 0.06),
    )
    b.put(
        scarf,
        scarf_paint,
        box((0.06, 0.11, 0.24), (0, 0, 0), 0.02).turned("y", -14).moved(r1 * 0.92, 0.11, neck - 0.15),
    )
    head = b.part("head")
    b.put(head, snow, sphere(r2, (0, 0, z2)))
    eyes = b.subpart(head, "eyes")
    for side in (-1, 1):
        b.put(eyes, dark, sphere(0.07, (r2 * 0.78, side * r2 * 0.46, z2 + r2 * 0.22)))
    nose = b.subpart(head, "nose", "carrot")
    carrot = lathe([(0, -0.02), (0.075, -0.02), (0.065, 0.08), (0, 0.30)]).turned("y", 90)
    b.put(nose, b.paints.draw("plain", "orange"), carrot.moved(r2 * 0.88, 0, z2 - 0.015))
    hat = b.part("hat", "top hat")
    top = z2 + r2 * 0.62
    b.put(hat, hat_paint, cylinder(r2 * 0.80, top + 0.02, top + 0.27, bevel=0.015))
    brim = b.subpart(hat, "brim", "hat edge")
    b.put(brim, hat_paint, cylinder(r2 * 1.35, top - 0.01, top + 0.05, bevel=0.015))
    band = b.subpart(hat, "band", "ribbon")
    b.put(
        band,
        b.paints.draw("cloth"),
        lathe(
            [(r2 * 0.8, top + 0.05), (r2 * 0.86, top + 0.05), (r2 * 0.86, top + 0.13), (r2 * 0.8, top + 0.13)]
        ),
    )
    for side in (-1, 1):
        arm = b.part("arm", "stick")
        elbow = np.array([0.06, side * (r1 + 0.16), z1 + 0.08])
        b.put(
            arm,
            b.paints.draw("wood", "brown"),
            sweep(
                [(0, side * r1 * 0.85, z1 + 0.03), elbow, elbow + np.array([0.06, side * 0.05, 0.10])], 0.035
            ),
        )
        mitten = b.subpart(arm, "mitten", "glove")
        b.put(mitten, boots, sphere(0.085, tuple(elbow + np.array([0.07, side * 0.06, 0.14]))))


def _robot(b: Builder) -> None:
    shell, metal, dark = (
        b.paints.draw("metal"),
        b.paints.draw("metal", "grey", "white", "beige"),
        b.paints.draw("plastic", "black"),
    )
    glow, accent = b.paints.draw("plastic", "yellow", "red", "teal", "green"), b.paints.draw("plastic")
    w, h = b.between(0.40, 0.48), b.between(0.40, 0.48)
    low = 0.30
    body = b.part("body", "torso")
    b.put(body, shell, box((0.32, w, h), (0, 0, low + h / 2), 0.03))
    screen = b.subpart(body, "screen", "display")
    b.put(screen, dark, box((0.05, w * 0.62, h * 0.36), (0.16, 0, low + h * 0.70), 0.015))
    dial = b.subpart(body, "buttons", "dials")
    for side in (-1, 1):
        b.put(dial, glow, sphere(0.072, (0.16, side * w * 0.22, low + h * 0.25)))
    pack = b.subpart(body, "backpack", "battery")
    b.put(pack, accent, box((0.12, w * 0.6, h * 0.6), (-0.20, 0, low + h * 0.52), 0.03))
    head = b.part("head")
    z = low + h + 0.05
    b.put(
        head,
        metal,
        cylinder(0.09, low + h - 0.01, z + 0.02),
        box((0.28, w * 0.78, 0.27), (0, 0, z + 0.135), 0.03),
    )
    eyes = b.subpart(head, "eyes")
    for side in (-1, 1):
        b.put(
            eyes,
            glow,
            cylinder(0.075, -0.03, 0.04, 20, 0.01).turned("y", 90).moved(0.15, side * w * 0.19, z + 0.17),
        )
    mouth = b.subpart(head, "mouth", "grille")
    b.put(mouth, dark, box((0.06, w * 0.54, 0.10), (0.14, 0, z + 0.06), 0.012))
    antenna = b.subpart(head, "antenna", "aerial")
    b.put(antenna, accent, cylinder(0.025, z + 0.26, z + 0.40, 12), sphere(0.07, (0, 0, z + 0.43)))
    for side in (-1, 1):
        arm = b.part("arm")
        y = side * (w / 2 + 0.085)
        b.put(
            arm,
            metal,
            sphere(0.095, (0, y, low + h * 0.84)),
            sweep([(0, y, low + h * 0.8), (0.05, y, low + h * 0.35), (0.12, y, low + 0.05)], 0.06),
        )
        b.put(b.subpart(arm, "hand", "claw"), accent, box((0.16, 0.18, 0.17), (0.14, y, low - 0.01), 0.035))
        leg = b.part("leg")
        b.put(leg, metal, cylinder(0.075, 0.05, low + 0.01).moved(0, side * w * 0.25, 0))
        b.put(
            b.subpart(leg, "foot", "shoe"),
            dark,
            box((0.30, 0.19, 0.13), (0.05, side * w * 0.26, 0.065), 0.035),
        )


def _rocket(b: Builder) -> None:
    hull, nose_paint, fin_paint = (
        b.paints.draw("plain", "white", "grey", "beige", "teal", "blue", "orange"),
        b.paints.draw("plastic"),
        b.paints.draw("plastic"),
    )
    glass, band_paint, metal = (
        b.paints.draw("plastic", "blue", "teal", "black", "yellow"),
        b.paints.draw("plastic"),
        b.paints.draw("metal"),
    )
    r, low, high = b.between(0.21, 0.25), 0.32, b.between(0.80, 0.88)
    body = b.part("body", "hull")
    b.put(body, hull, lathe([(0, low), (r * 0.85, low), (r, low + 0.15), (r, high - 0.1), (r * 0.92, high)]))
    window = b.subpart(body, "windows", "portholes")
    for a in (0, 120, 240):
        pane = cylinder(0.095, -0.03, 0.035, 20, 0.015).turned("y", 90).moved(r, 0, high - 0.16)
        b.put(window, glass, pane.turned("z", a))
    band = b.subpart(body, "band", "stripe")
    b.put(
        band,
        band_paint,
        lathe([(r * 0.98, low + 0.12), (r * 1.07, low + 0.13), (r * 1.07, low + 0.24), (r, low + 0.25)]),
    )
    nose = b.part("nose cone", "nose")
    tip_z = high + b.between(0.28, 0.36)
    b.put(
        nose,
        nose_paint,
        lathe([(r * 0.92, high), (r * 0.78, high + 0.12), (r * 0.38, tip_z - 0.05), (0, tip_z)]),
    )
    b.put(b.subpart(nose, "tip", "point"), b.paints.draw("plastic"), sphere(0.095, (0, 0, tip_z)))
    for i in range(3):
        angle = 60 + 120 * i
        fin = b.part("fin", "wing")
        outline = [(r * 0.7, low + 0.03), (r + 0.26, 0.0), (r + 0.26, 0.20), (r * 0.8, low + 0.36)]
        b.put(fin, fin_paint, extrude(outline, 0.06).turned("z", angle))
        pad = b.subpart(fin, "foot", "landing pad")
        b.put(pad, band_paint, box((0.14, 0.13, 0.24), (r + 0.25, 0, 0.12), 0.03).turned("z", angle))
    engine = b.part("engine", "nozzle")
    b.put(engine, metal, lathe([(0, low - 0.13), (r * 1.12, low - 0.13), (r * 0.7, low + 0.03)]))
    b.put(
        b.subpart(engine, "flame", "fire"),
        b.paints.draw("plain", "orange", "yellow", "red"),
        lathe([(0, 0.0), (r * 0.75, 0.06), (r * 1.05, low - 0.14), (0, low - 0.125)]),
    )


def _car(b: Builder) -> None:
    body_paint, glass, tyre = (
        b.paints.draw("plastic"),
        b.paints.draw("plastic", "black", "grey", "blue", "teal"),
        b.paints.draw("plastic", "black"),
    )
    metal, lamp = b.paints.draw("metal"), b.paints.draw("plastic", "yellow", "white", "orange")
    length, w = b.between(1.05, 1.2), b.between(0.50, 0.58)
    low, belt, roof = 0.12, b.between(0.34, 0.40), b.between(0.62, 0.70)
    body = b.part("body", "chassis")
    b.put(body, body_paint, box((length, w, belt - low), (0, 0, (belt + low) / 2), 0.05))
    hood = b.subpart(body, "hood", "bonnet")
    b.put(
        hood,
        b.paints.draw("plastic"),
        box((length * 0.27, w * 0.82, 0.06), (length * 0.345, 0, belt + 0.01), 0.025),
    )
    lights = b.subpart(body, "headlights", "front lights")
    for side in (-1, 1):
        b.put(lights, lamp, ellipsoid((0.08, 0.11, 0.095), (length / 2, side * w * 0.31, belt - 0.08)))
    bumper = b.subpart(body, "bumper", "fender")
    for end in (-1, 1):
        b.put(bumper, metal, box((0.11, w * 1.06, 0.105), (end * length * 0.505, 0, low + 0.045), 0.025))
    cabin = b.part("cabin", "top")
    back, front = -length * 0.40, length * 0.20
    outline = [(back, belt - 0.01), (front, belt - 0.01), (front - 0.14, roof), (back + 0.09, roof)]
    b.put(cabin, body_paint, extrude(outline, w * 0.86))
    roof_rack = b.subpart(cabin, "roof", "rooftop")
    b.put(
        roof_rack,
        b.paints.draw("plastic"),
        box((front - back - 0.20, w * 0.84, 0.05), ((front + back) / 2 - 0.025, 0, roof + 0.015), 0.02),
    )
    windows = b.subpart(cabin, "windows", "side windows")
    side_outline = [
        (back + 0.09, belt + 0.035),
        (front - 0.10, belt + 0.035),
        (front - 0.19, roof - 0.04),
        (back + 0.14, roof - 0.04),
    ]
    b.put(windows, glass, extrude(side_outline, w * 0.86 + 0.03))
    shield = b.subpart(cabin, "windshield", "front window")
    tilt = np.degrees(np.arctan2(0.14, roof - belt))
    pane = box((0.03, w * 0.72, (roof - belt) * 0.86), (0, 0, 0)).turned("y", -tilt)
    b.put(shield, glass, pane.moved(front - 0.07, 0, (roof + belt) / 2))
    radius = b.between(0.165, 0.185)
    for x in (-1, 1):
        for side in (-1, 1):
            wheel = b.part("wheel", "tire")
            rubber = cylinder(radius, -0.07, 0.07, 24, 0.025).turned("x", 90)
            b.put(wheel, tyre, rubber.moved(x * length * 0.30, side * (w / 2 - 0.01), radius))
            cap = cylinder(radius * 0.68, -0.025, 0.025, 20, 0.008).turned("x", 90)
            b.put(
                b.subpart(wheel, "rim", "hubcap"),
                metal,
                cap.moved(x * length * 0.30, side * (w / 2 + 0.065), radius),
            )


def _house(b: Builder) -> None:
    brick, roof_paint = (
        b.paints.draw(str(b.rng.choice(["brick", "stone", "plain"]))),
        b.paints.draw("brick", "red", "brown", "grey", "orange", "teal", "blue"),
    )
    wood, glass = b.paints.draw("wood"), b.paints.draw("plastic")
    d, w, h = b.between(0.55, 0.66), b.between(0.66, 0.8), b.between(0.45, 0.52)
    rise = b.between(0.30, 0.38)
    walls = b.part("walls", "building")
    b.put(walls, brick, box((d, w, h), (0, 0, h / 2)))
    gable = extrude([(-w / 2, h), (w / 2, h), (0, h + rise)], d).turned("z", 90)
    b.put(walls, brick, gable)
    door = b.subpart(walls, "door", "front door")
    b.put(door, wood, box((0.05, 0.19, 0.34), (d / 2 + 0.01, 0.0, 0.17), 0.01))
    window = b.subpart(walls, "windows")
    for side in (-1, 1):
        b.put(window, glass, box((0.05, 0.15, 0.17), (d / 2 + 0.01, side * w * 0.32, h * 0.62), 0.01))
        b.put(window, glass, box((d * 0.36, 0.05, 0.18), (0, side * (w / 2 + 0.01), h * 0.55), 0.01))
    b.put(window, glass, box((0.05, 0.20, 0.18), (-d / 2 - 0.01, 0, h * 0.55), 0.01))
    roof = b.part("roof")
    slope = np.hypot(w / 2, rise)
    angle = np.degrees(np.arctan2(rise, w / 2))
    for side in (-1, 1):
        slab = box((d + 0.12, slope + 0.12, 0.06), (0, 0, 0), 0.012)
        slab = slab.turned("x", -side * angle)
        outward = np.array([0, side * np.sin(np.radians(angle)), np.cos(np.radians(angle))]) * 0.03
        middle = np.array([0, side * w / 4, h + rise / 2]) + outward
        down = np.array([0, side * np.cos(np.radians(angle)), -np.sin(np.radians(angle))]) * 0.04
        middle += down
        b.put(roof, roof_paint, slab.moved(*middle))
        if side == 1:
            sky = box((0.22, 0.2, 0.04), (0, 0, 0), 0.01).turned("x", -angle)
            light = middle + np.array([0, np.sin(np.radians(angle)), np.cos(np.radians(angle))]) * 0.035
    skylight = b.subpart(roof, "skylight", "roof window")
    b.put(skylight, b.paints.draw("plastic"), sky.moved(*(light + np.array([d * 0.12, 0, 0]))))
    ridge = b.subpart(roof, "ridge")
    b.put(ridge, b.paints.draw("plain"), box((d + 0.15, 0.10, 0.075), (0, 0, h + rise + 0.055), 0.025))
    chimney = b.part("chimney")
    x, y, top = -d * 0.22, -w * 0.22, h + rise + 0.18
    b.put(chimney, b.paints.draw("brick"), box((0.15, 0.15, 0.48), (x, y, top - 0.24)))
    b.put(
        b.subpart(chimney, "cap", "top"), b.paints.draw("stone"), box((0.21, 0.21, 0.085), (x, y, top), 0.015)
    )


MAKERS: dict[str, Maker] = {
    "bear": Maker(_bear, ("teddy bear", "teddy", "stuffed bear")),
    "snowman": Maker(_snowman, ("snow figure",)),
    "robot": Maker(_robot, ("toy robot", "android")),
    "rocket": Maker(_rocket, ("toy rocket", "spaceship")),
    "car": Maker(_car, ("toy car", "automobile")),
    "house": Maker(_house, ("toy house", "cottage")),
}
"""Classes drawn by this module."""
