"""Toys and models: each function draws one class of object."""

import numpy as np

from hilsplat.world.objects.builder import CORNERS, Builder, Maker
from hilsplat.world.shapes import box, cylinder, ellipsoid, extrude, lathe, sphere, sweep


def _bear(b: Builder) -> None:
    fur = b.paint("fur", "brown", "beige", "grey", "white", "orange", "pink")
    light, dark, cloth = b.paint("fur"), b.paint("plastic", "black"), b.paint("cloth")
    body_r, head_r = b.between(0.25, 0.30), b.between(0.21, 0.25)
    body = b.part("body", "torso").put(fur, ellipsoid((body_r * 0.9, body_r, body_r * 1.15), (0, 0, 0.34)))
    body.subpart("belly", "tummy").put(
        light, ellipsoid((0.10, body_r * 0.72, body_r * 0.8), (body_r * 0.9 - 0.055, 0, 0.33))
    )
    neck_z = 0.34 + body_r * 1.02
    knot_x = body_r * 0.62 + 0.10
    bow = body.subpart("bow", "bow tie").put(cloth, sphere(0.05, (knot_x, 0, neck_z)))
    for side in (-1, 1):
        bow.put(cloth, ellipsoid((0.045, 0.10, 0.075), (knot_x - 0.01, side * 0.115, neck_z)))
    z = neck_z + head_r * 0.86
    head = b.part("head").put(fur, ellipsoid((head_r * 0.95, head_r, head_r * 0.92), (0.03, 0, z)))
    ear, nose, eye = head.subpart("ears"), head.subpart("muzzle", "snout"), head.subpart("eyes")
    for side in (-1, 1):
        ear.put(light, ellipsoid((0.055, 0.10, 0.10), (0.0, side * head_r * 0.78, z + head_r * 0.72)))
        eye.put(dark, sphere(0.055, (0.03 + head_r * 0.78, side * head_r * 0.42, z + head_r * 0.30)))
    nose.put(light, ellipsoid((0.12, 0.13, 0.10), (0.03 + head_r * 0.82, 0, z - head_r * 0.28)))
    nose.put(dark, ellipsoid((0.03, 0.045, 0.03), (0.03 + head_r * 0.82 + 0.10, 0, z - head_r * 0.16)))
    for side in (-1, 1):
        path = [
            (0.02, side * body_r * 0.75, 0.46),
            (0.10, side * body_r * 1.2, 0.38),
            (0.20, side * body_r * 1.25, 0.28),
        ]
        arm = b.part("arm").put(fur, sweep(path, [0.075, 0.085, 0.075]))
        arm.subpart("paw", "hand").put(light, sphere(0.092, (0.22, side * body_r * 1.25, 0.26)))
        leg = b.part("leg").put(
            fur, sweep([(0.05, side * 0.15, 0.12), (0.2, side * 0.19, 0.11), (0.34, side * 0.21, 0.11)], 0.11)
        )
        leg.subpart("foot", "sole").put(light, ellipsoid((0.06, 0.115, 0.13), (0.36, side * 0.21, 0.13)))


def _snowman(b: Builder) -> None:
    snow = b.paint("snow", "white")
    hat_paint = b.paint("cloth", "black", "blue", "purple", "brown", "red", "green")
    scarf_paint, dark = b.paint("cloth"), b.paint("stone", "black")
    r0, r1, r2 = b.between(0.30, 0.34), b.between(0.23, 0.26), b.between(0.18, 0.20)
    z0, z1 = r0 * 0.92, r0 * 1.75 + r1 * 0.75
    z2 = z1 + r1 * 0.85 + r2 * 0.75
    base = b.part("base", "bottom ball").put(snow, sphere(r0, (0, 0, z0)))
    pads = base.subpart("feet", "boots")
    boots = b.paint("plastic")
    for side in (-1, 1):
        pads.put(boots, ellipsoid((0.14, 0.10, 0.08), (r0 * 0.80, side * 0.14, 0.075)))
    body = b.part("body", "middle ball").put(snow, sphere(r1, (0, 0, z1)))
    buttons = body.subpart("buttons")
    for up in (-0.28, 0.38):
        buttons.put(dark, sphere(0.068, (r1 * np.cos(up), 0, z1 + r1 * np.sin(up))))
    neck = z1 + r1 * 0.88
    scarf = body.subpart("scarf", "shawl").put(
        scarf_paint,
        sweep([(0.175 * np.cos(a), 0.175 * np.sin(a), neck) for a in np.linspace(0, 2 * np.pi, 22)], 0.06),
    )
    scarf.put(
        scarf_paint,
        box((0.06, 0.11, 0.24), (0, 0, 0), 0.02).turned("y", -14).moved(r1 * 0.92, 0.11, neck - 0.15),
    )
    head = b.part("head").put(snow, sphere(r2, (0, 0, z2)))
    eyes = head.subpart("eyes")
    for side in (-1, 1):
        eyes.put(dark, sphere(0.07, (r2 * 0.78, side * r2 * 0.46, z2 + r2 * 0.22)))
    carrot = lathe([(0, -0.02), (0.075, -0.02), (0.065, 0.08), (0, 0.30)]).turned("y", 90)
    head.subpart("nose", "carrot").put(b.paint("plain", "orange"), carrot.moved(r2 * 0.88, 0, z2 - 0.015))
    top = z2 + r2 * 0.62
    hat = b.part("hat", "top hat").put(hat_paint, cylinder(r2 * 0.80, top + 0.02, top + 0.27, bevel=0.015))
    hat.subpart("brim", "hat edge").put(hat_paint, cylinder(r2 * 1.35, top - 0.01, top + 0.05, bevel=0.015))
    profile = [
        (r2 * 0.8, top + 0.05),
        (r2 * 0.86, top + 0.05),
        (r2 * 0.86, top + 0.13),
        (r2 * 0.8, top + 0.13),
    ]
    hat.subpart("band", "ribbon").put(b.paint("cloth"), lathe(profile))
    for side in (-1, 1):
        elbow = np.array([0.06, side * (r1 + 0.16), z1 + 0.08])
        path = [(0, side * r1 * 0.85, z1 + 0.03), elbow, elbow + np.array([0.06, side * 0.05, 0.10])]
        arm = b.part("arm", "stick").put(b.paint("wood", "brown"), sweep(path, 0.035))
        arm.subpart("mitten", "glove").put(
            boots, sphere(0.085, tuple(elbow + np.array([0.07, side * 0.06, 0.14])))
        )


def _robot(b: Builder) -> None:
    shell = b.paint("metal")
    metal = b.paint("metal", "grey", "white", "beige")
    dark = b.paint("plastic", "black")
    glow, accent = b.paint("plastic", "yellow", "red", "teal", "green"), b.paint("plastic")
    w, h = b.between(0.40, 0.48), b.between(0.40, 0.48)
    low = 0.30
    body = b.part("body", "torso").put(shell, box((0.32, w, h), (0, 0, low + h / 2), 0.03))
    body.subpart("screen", "display").put(
        dark, box((0.05, w * 0.62, h * 0.36), (0.16, 0, low + h * 0.70), 0.015)
    )
    dial = body.subpart("buttons", "dials")
    for side in (-1, 1):
        dial.put(glow, sphere(0.072, (0.16, side * w * 0.22, low + h * 0.25)))
    body.subpart("backpack", "battery").put(
        accent, box((0.12, w * 0.6, h * 0.6), (-0.20, 0, low + h * 0.52), 0.03)
    )
    z = low + h + 0.05
    head = b.part("head").put(
        metal, cylinder(0.09, low + h - 0.01, z + 0.02), box((0.28, w * 0.78, 0.27), (0, 0, z + 0.135), 0.03)
    )
    eyes = head.subpart("eyes")
    for side in (-1, 1):
        eyes.put(
            glow,
            cylinder(0.075, -0.03, 0.04, 20, 0.01).turned("y", 90).moved(0.15, side * w * 0.19, z + 0.17),
        )
    head.subpart("mouth", "grille").put(dark, box((0.06, w * 0.54, 0.10), (0.14, 0, z + 0.06), 0.012))
    head.subpart("antenna", "aerial").put(
        accent, cylinder(0.025, z + 0.26, z + 0.40, 12), sphere(0.07, (0, 0, z + 0.43))
    )
    for side in (-1, 1):
        y = side * (w / 2 + 0.085)
        arm = b.part("arm").put(
            metal,
            sphere(0.095, (0, y, low + h * 0.84)),
            sweep([(0, y, low + h * 0.8), (0.05, y, low + h * 0.35), (0.12, y, low + 0.05)], 0.06),
        )
        arm.subpart("hand", "claw").put(accent, box((0.16, 0.18, 0.17), (0.14, y, low - 0.01), 0.035))
        leg = b.part("leg").put(metal, cylinder(0.075, 0.05, low + 0.01).moved(0, side * w * 0.25, 0))
        leg.subpart("foot", "shoe").put(dark, box((0.30, 0.19, 0.13), (0.05, side * w * 0.26, 0.065), 0.035))


def _rocket(b: Builder) -> None:
    hull = b.paint("plain", "white", "grey", "beige", "teal", "blue", "orange")
    nose_paint = b.paint("plastic")
    fin_paint = b.paint("plastic")
    glass = b.paint("plastic", "blue", "teal", "black", "yellow")
    band_paint = b.paint("plastic")
    metal = b.paint("metal")
    r, low, high = b.between(0.21, 0.25), 0.32, b.between(0.80, 0.88)
    body = b.part("body", "hull").put(
        hull, lathe([(0, low), (r * 0.85, low), (r, low + 0.15), (r, high - 0.1), (r * 0.92, high)])
    )
    window = body.subpart("windows", "portholes")
    for a in (0, 120, 240):
        pane = cylinder(0.095, -0.03, 0.035, 20, 0.015).turned("y", 90).moved(r, 0, high - 0.16)
        window.put(glass, pane.turned("z", a))
    body.subpart("band", "stripe").put(
        band_paint,
        lathe([(r * 0.98, low + 0.12), (r * 1.07, low + 0.13), (r * 1.07, low + 0.24), (r, low + 0.25)]),
    )
    tip_z = high + b.between(0.28, 0.36)
    nose = b.part("nose cone", "nose").put(
        nose_paint, lathe([(r * 0.92, high), (r * 0.78, high + 0.12), (r * 0.38, tip_z - 0.05), (0, tip_z)])
    )
    nose.subpart("tip", "point").put(b.paint("plastic"), sphere(0.095, (0, 0, tip_z)))
    for i in range(3):
        angle = 60 + 120 * i
        outline = [(r * 0.7, low + 0.03), (r + 0.26, 0.0), (r + 0.26, 0.20), (r * 0.8, low + 0.36)]
        fin = b.part("fin", "wing").put(fin_paint, extrude(outline, 0.06).turned("z", angle))
        fin.subpart("foot", "landing pad").put(
            band_paint, box((0.14, 0.13, 0.24), (r + 0.25, 0, 0.12), 0.03).turned("z", angle)
        )
    engine = b.part("engine", "nozzle").put(
        metal, lathe([(0, low - 0.13), (r * 1.12, low - 0.13), (r * 0.7, low + 0.03)])
    )
    engine.subpart("flame", "fire").put(
        b.paint("plain", "orange", "yellow", "red"),
        lathe([(0, 0.0), (r * 0.75, 0.06), (r * 1.05, low - 0.14), (0, low - 0.125)]),
    )


def _car(b: Builder) -> None:
    body_paint = b.paint("plastic")
    glass = b.paint("plastic", "black", "grey", "blue", "teal")
    tyre = b.paint("plastic", "black")
    metal, lamp = b.paint("metal"), b.paint("plastic", "yellow", "white", "orange")
    length, w = b.between(1.05, 1.2), b.between(0.50, 0.58)
    low, belt, roof = 0.12, b.between(0.34, 0.40), b.between(0.62, 0.70)
    body = b.part("body", "chassis").put(
        body_paint, box((length, w, belt - low), (0, 0, (belt + low) / 2), 0.05)
    )
    body.subpart("hood", "bonnet").put(
        b.paint("plastic"), box((length * 0.27, w * 0.82, 0.06), (length * 0.345, 0, belt + 0.01), 0.025)
    )
    lights = body.subpart("headlights", "front lights")
    for side in (-1, 1):
        lights.put(lamp, ellipsoid((0.08, 0.11, 0.095), (length / 2, side * w * 0.31, belt - 0.08)))
    bumper = body.subpart("bumper", "fender")
    for end in (-1, 1):
        bumper.put(metal, box((0.11, w * 1.06, 0.105), (end * length * 0.505, 0, low + 0.045), 0.025))
    back, front = -length * 0.40, length * 0.20
    outline = [(back, belt - 0.01), (front, belt - 0.01), (front - 0.14, roof), (back + 0.09, roof)]
    cabin = b.part("cabin", "top").put(body_paint, extrude(outline, w * 0.86))
    cabin.subpart("roof", "rooftop").put(
        b.paint("plastic"),
        box((front - back - 0.20, w * 0.84, 0.05), ((front + back) / 2 - 0.025, 0, roof + 0.015), 0.02),
    )
    side_outline = [
        (back + 0.09, belt + 0.035),
        (front - 0.10, belt + 0.035),
        (front - 0.19, roof - 0.04),
        (back + 0.14, roof - 0.04),
    ]
    cabin.subpart("windows", "side windows").put(glass, extrude(side_outline, w * 0.86 + 0.03))
    tilt = np.degrees(np.arctan2(0.14, roof - belt))
    pane = box((0.03, w * 0.72, (roof - belt) * 0.86), (0, 0, 0)).turned("y", -tilt)
    cabin.subpart("windshield", "front window").put(glass, pane.moved(front - 0.07, 0, (roof + belt) / 2))
    radius = b.between(0.165, 0.185)
    for x, y in CORNERS:
        rubber = cylinder(radius, -0.07, 0.07, 24, 0.025).turned("x", 90)
        wheel = b.part("wheel", "tire").put(tyre, rubber.moved(x * length * 0.30, y * (w / 2 - 0.01), radius))
        cap = cylinder(radius * 0.68, -0.025, 0.025, 20, 0.008).turned("x", 90)
        wheel.subpart("rim", "hubcap").put(metal, cap.moved(x * length * 0.30, y * (w / 2 + 0.065), radius))


def _house(b: Builder) -> None:
    brick = b.paint(str(b.rng.choice(["brick", "stone", "plain"])))
    roof_paint = b.paint("brick", "red", "brown", "grey", "orange", "teal", "blue")
    wood, glass = b.paint("wood"), b.paint("plastic")
    d, w, h = b.between(0.55, 0.66), b.between(0.66, 0.8), b.between(0.45, 0.52)
    rise = b.between(0.30, 0.38)
    walls = b.part("walls", "building").put(brick, box((d, w, h), (0, 0, h / 2)))
    gable = extrude([(-w / 2, h), (w / 2, h), (0, h + rise)], d).turned("z", 90)
    walls.put(brick, gable)
    walls.subpart("door", "front door").put(wood, box((0.05, 0.19, 0.34), (d / 2 + 0.01, 0.0, 0.17), 0.01))
    window = walls.subpart("windows")
    for side in (-1, 1):
        window.put(glass, box((0.05, 0.15, 0.17), (d / 2 + 0.01, side * w * 0.32, h * 0.62), 0.01))
        window.put(glass, box((d * 0.36, 0.05, 0.18), (0, side * (w / 2 + 0.01), h * 0.55), 0.01))
    window.put(glass, box((0.05, 0.20, 0.18), (-d / 2 - 0.01, 0, h * 0.55), 0.01))
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
        roof.put(roof_paint, slab.moved(*middle))
        if side == 1:
            sky = box((0.22, 0.2, 0.04), (0, 0, 0), 0.01).turned("x", -angle)
            light = middle + np.array([0, np.sin(np.radians(angle)), np.cos(np.radians(angle))]) * 0.035
    roof.subpart("skylight", "roof window").put(
        b.paint("plastic"), sky.moved(*(light + np.array([d * 0.12, 0, 0])))
    )
    roof.subpart("ridge").put(b.paint("plain"), box((d + 0.15, 0.10, 0.075), (0, 0, h + rise + 0.055), 0.025))
    x, y, top = -d * 0.22, -w * 0.22, h + rise + 0.18
    chimney = b.part("chimney").put(b.paint("brick"), box((0.15, 0.15, 0.48), (x, y, top - 0.24)))
    chimney.subpart("cap", "top").put(b.paint("stone"), box((0.21, 0.21, 0.085), (x, y, top), 0.015))


MAKERS: dict[str, Maker] = {
    "bear": Maker(_bear, ("teddy bear", "teddy", "stuffed bear")),
    "snowman": Maker(_snowman, ("snow figure",)),
    "robot": Maker(_robot, ("toy robot", "android")),
    "rocket": Maker(_rocket, ("toy rocket", "spaceship")),
    "car": Maker(_car, ("toy car", "automobile")),
    "house": Maker(_house, ("toy house", "cottage")),
}
