"""Toys, toy animals and toy vehicles: each function draws one class of object."""

import numpy as np

from hilsplat_world.objects.builder import CORNERS, Builder
from hilsplat_world.shapes import (
    Mesh,
    Number,
    Point,
    box,
    cylinder,
    disc,
    ellipsoid,
    extrude,
    joined,
    lathe,
    loft,
    ring,
    roller,
    sphere,
    sweep,
)


def bear(b: Builder) -> None:
    fur = b.paint("fur brown beige grey white orange pink")
    light, dark, cloth = b.paints("fur", "plastic black", "cloth")
    body_r, head_r = b.between(0.25, 0.3), b.between(0.21, 0.25)
    body = b.part("body, torso", fur, ellipsoid((body_r * 0.9, body_r, body_r * 1.15), (0, 0, 0.34)))
    shape = ellipsoid((0.1, body_r * 0.72, body_r * 0.8), (body_r * 0.9 - 0.055, 0, 0.33))
    body.subpart("belly, tummy", light, shape)
    neck_z = 0.34 + body_r * 1.02
    knot_x = body_r * 0.62 + 0.1
    loops = ellipsoid((0.045, 0.1, 0.075)).both_sides(knot_x - 0.01, 0.115, neck_z)
    body.subpart("bow, bow tie", cloth, sphere(0.05, (knot_x, 0, neck_z)), loops)
    z = neck_z + head_r * 0.86
    head = b.part("head", fur, ellipsoid((head_r * 0.95, head_r, head_r * 0.92), (0.03, 0, z)))
    ear, nose, eye = head.subpart("ears"), head.subpart("muzzle, snout"), head.subpart("eyes")
    for side in (-1, 1):
        ear.put(light, ellipsoid((0.055, 0.1, 0.1), (0.0, side * head_r * 0.78, z + head_r * 0.72)))
        eye.put(dark, sphere(0.055, (0.03 + head_r * 0.78, side * head_r * 0.42, z + head_r * 0.3)))
    nose.put(light, ellipsoid((0.12, 0.13, 0.1), (0.03 + head_r * 0.82, 0, z - head_r * 0.28)))
    nose.put(dark, ellipsoid((0.03, 0.045, 0.03), (0.03 + head_r * 0.82 + 0.1, 0, z - head_r * 0.16)))
    for side in (-1, 1):
        path = [(0.02, side * body_r * 0.75, 0.46), (0.1, side * body_r * 1.2, 0.38)]
        path += [(0.2, side * body_r * 1.25, 0.28)]
        arm = b.part("arm", fur, sweep(path, [0.075, 0.085, 0.075]))
        arm.subpart("paw, hand", light, sphere(0.092, (0.22, side * body_r * 1.25, 0.26)))
        path = [(0.05, side * 0.15, 0.12), (0.2, side * 0.19, 0.11), (0.34, side * 0.21, 0.11)]
        leg = b.part("leg", fur, sweep(path, 0.11))
        leg.subpart("foot, sole", light, ellipsoid((0.06, 0.115, 0.13), (0.36, side * 0.21, 0.13)))


def snowman(b: Builder) -> None:
    snow, hat_paint = b.paints("snow white", "cloth black blue purple brown red green")
    scarf_paint, dark = b.paints("cloth", "stone black")
    r0, r1, r2 = b.between(0.3, 0.34), b.between(0.23, 0.26), b.between(0.18, 0.2)
    z0, z1 = r0 * 0.92, r0 * 1.75 + r1 * 0.75
    z2 = z1 + r1 * 0.85 + r2 * 0.75
    base = b.part("base, bottom ball", snow, sphere(r0, (0, 0, z0)))
    boots = b.paint("plastic")
    base.subpart("feet, boots", boots, ellipsoid((0.14, 0.1, 0.08)).both_sides(r0 * 0.8, 0.14, 0.075))
    body = b.part("body, middle ball", snow, sphere(r1, (0, 0, z1)))
    shapes = [sphere(0.068, (r1 * np.cos(up), 0, z1 + r1 * np.sin(up))) for up in (-0.28, 0.38)]
    body.subpart("buttons", dark, *shapes)
    neck = z1 + r1 * 0.88
    path = [(0.175 * np.cos(a), 0.175 * np.sin(a), neck) for a in np.linspace(0, 2 * np.pi, 22)]
    end = box((0.06, 0.11, 0.24), bevel=0.02).turned("y", -14).moved(r1 * 0.92, 0.11, neck - 0.15)
    body.subpart("scarf, shawl", scarf_paint, sweep(path, 0.06), end)
    head = b.part("head", snow, sphere(r2, (0, 0, z2)))
    head.subpart("eyes", dark, sphere(0.07).both_sides(r2 * 0.78, r2 * 0.46, z2 + r2 * 0.22))
    carrot = lathe([(0, -0.02), (0.075, -0.02), (0.065, 0.08), (0, 0.3)]).turned("y", 90)
    head.subpart("nose, carrot", "plain orange", carrot.moved(r2 * 0.88, 0, z2 - 0.015))
    top = z2 + r2 * 0.62
    hat = b.part("hat, top hat", hat_paint, cylinder(r2 * 0.8, top + 0.02, top + 0.27, bevel=0.015))
    hat.subpart("brim, hat edge", hat_paint, cylinder(r2 * 1.35, top - 0.01, top + 0.05, bevel=0.015))
    profile = [(r2 * 0.8, top + 0.05), (r2 * 0.86, top + 0.05)]
    profile += [(r2 * 0.86, top + 0.13), (r2 * 0.8, top + 0.13)]
    hat.subpart("band, ribbon", "cloth", lathe(profile))
    for side in (-1, 1):
        elbow = np.array([0.06, side * (r1 + 0.16), z1 + 0.08])
        stick = [(0, side * r1 * 0.85, z1 + 0.03), elbow, elbow + np.array([0.06, side * 0.05, 0.1])]
        arm = b.part("arm, stick", "wood brown", sweep(stick, 0.035))
        arm.subpart("mitten, glove", boots, sphere(0.085, tuple(elbow + np.array([0.07, side * 0.06, 0.14]))))


def robot(b: Builder) -> None:
    shell, metal, dark = b.paints("metal", "metal grey white beige", "plastic black")
    glow, accent = b.paints("plastic yellow red teal green", "plastic")
    w, h = b.between(0.4, 0.48), b.between(0.4, 0.48)
    low = 0.3
    body = b.part("body, torso", shell, box((0.32, w, h), (0, 0, low + h / 2), 0.03))
    body.subpart("screen, display", dark, box((0.05, w * 0.62, h * 0.36), (0.16, 0, low + h * 0.7), 0.015))
    body.subpart("buttons, dials", glow, sphere(0.072).both_sides(0.16, w * 0.22, low + h * 0.25))
    body.subpart("backpack, battery", accent, box((0.12, w * 0.6, h * 0.6), (-0.2, 0, low + h * 0.52), 0.03))
    z = low + h + 0.05
    shapes = [cylinder(0.09, low + h - 0.01, z + 0.02), box((0.28, w * 0.78, 0.27), (0, 0, z + 0.135), 0.03)]
    head = b.part("head", metal, *shapes)
    head.subpart("eyes", glow, disc(0.075, -0.03, 0.04, 20, 0.01).both_sides(0.15, w * 0.19, z + 0.17))
    head.subpart("mouth, grille", dark, box((0.06, w * 0.54, 0.1), (0.14, 0, z + 0.06), 0.012))
    shapes = [cylinder(0.025, z + 0.26, z + 0.4, 12), sphere(0.07, (0, 0, z + 0.43))]
    head.subpart("antenna, aerial", accent, *shapes)
    for side in (-1, 1):
        y = side * (w / 2 + 0.085)
        shapes = [sphere(0.095, (0, y, low + h * 0.84))]
        shapes += [sweep([(0, y, low + h * 0.8), (0.05, y, low + h * 0.35), (0.12, y, low + 0.05)], 0.06)]
        arm = b.part("arm", metal, *shapes)
        arm.subpart("hand, claw", accent, box((0.16, 0.18, 0.17), (0.14, y, low - 0.01), 0.035))
        leg = b.part("leg", metal, cylinder(0.075, 0.05, low + 0.01).moved(0, side * w * 0.25, 0))
        leg.subpart("foot, shoe", dark, box((0.3, 0.19, 0.13), (0.05, side * w * 0.26, 0.065), 0.035))


def rocket(b: Builder) -> None:
    hull = b.paint("plain white grey beige teal blue orange")
    nose_paint, fin_paint, glass = b.paints("plastic", "plastic", "plastic blue teal black yellow")
    band_paint, metal = b.paints("plastic", "metal")
    r, low, high = b.between(0.21, 0.25), 0.32, b.between(0.8, 0.88)
    profile = [(0, low), (r * 0.85, low), (r, low + 0.15), (r, high - 0.1), (r * 0.92, high)]
    body = b.part("body, hull", hull, lathe(profile))
    pane = disc(0.095, -0.03, 0.035, 20, 0.015).moved(r, 0, high - 0.16)
    body.subpart("windows, portholes", glass, *[pane.turned("z", a) for a in (0, 120, 240)])
    profile = [(r * 0.98, low + 0.12), (r * 1.07, low + 0.13), (r * 1.07, low + 0.24), (r, low + 0.25)]
    body.subpart("band, stripe", band_paint, lathe(profile))
    tip_z = high + b.between(0.28, 0.36)
    profile = [(r * 0.92, high), (r * 0.78, high + 0.12), (r * 0.38, tip_z - 0.05), (0, tip_z)]
    nose = b.part("nose cone, nose", nose_paint, lathe(profile))
    nose.subpart("tip, point", "plastic", sphere(0.095, (0, 0, tip_z)))
    outline = [(r * 0.7, low + 0.03), (r + 0.26, 0.0), (r + 0.26, 0.2), (r * 0.8, low + 0.36)]
    for angle in (60, 180, 300):
        fin = b.part("fin, wing", fin_paint, extrude(outline, 0.06).turned("z", angle))
        shape = box((0.14, 0.13, 0.24), (r + 0.25, 0, 0.12), 0.03).turned("z", angle)
        fin.subpart("foot, landing pad", band_paint, shape)
    profile = [(0, low - 0.13), (r * 1.12, low - 0.13), (r * 0.7, low + 0.03)]
    engine = b.part("engine, nozzle", metal, lathe(profile))
    profile = [(0, 0.0), (r * 0.75, 0.06), (r * 1.05, low - 0.14), (0, low - 0.125)]
    engine.subpart("flame, fire", "plain orange yellow red", lathe(profile))


def car(b: Builder) -> None:
    body_paint, glass, tyre = b.paints("plastic", "plastic black grey blue teal", "plastic black")
    metal, lamp = b.paints("metal", "plastic yellow white orange")
    length, w = b.between(1.05, 1.2), b.between(0.5, 0.58)
    low, belt, roof = 0.12, b.between(0.34, 0.4), b.between(0.62, 0.7)
    body = b.part("body, chassis", body_paint, box((length, w, belt - low), (0, 0, (belt + low) / 2), 0.05))
    shape = box((length * 0.27, w * 0.82, 0.06), (length * 0.345, 0, belt + 0.01), 0.025)
    body.subpart("hood, bonnet", "plastic", shape)
    shape = ellipsoid((0.08, 0.11, 0.095)).both_sides(length / 2, w * 0.31, belt - 0.08)
    body.subpart("headlights, front lights", lamp, shape)
    shapes = [box((0.11, w * 1.06, 0.105), (end * length * 0.505, 0, low + 0.045), 0.025) for end in (-1, 1)]
    body.subpart("bumper, fender", metal, *shapes)
    back, front = -length * 0.4, length * 0.2
    outline = [(back, belt - 0.01), (front, belt - 0.01), (front - 0.14, roof), (back + 0.09, roof)]
    cabin = b.part("cabin, top", body_paint, extrude(outline, w * 0.86))
    shape = box((front - back - 0.2, w * 0.84, 0.05), ((front + back) / 2 - 0.025, 0, roof + 0.015), 0.02)
    cabin.subpart("roof, rooftop", "plastic", shape)
    side_outline = [(back + 0.09, belt + 0.035), (front - 0.1, belt + 0.035)]
    side_outline += [(front - 0.19, roof - 0.04), (back + 0.14, roof - 0.04)]
    cabin.subpart("windows, side windows", glass, extrude(side_outline, w * 0.86 + 0.03))
    tilt = np.degrees(np.arctan2(0.14, roof - belt))
    pane = box((0.03, w * 0.72, (roof - belt) * 0.86)).turned("y", -tilt)
    cabin.subpart("windshield, front window", glass, pane.moved(front - 0.07, 0, (roof + belt) / 2))
    radius = b.between(0.165, 0.185)
    rubber = roller(radius, -0.07, 0.07, 24, 0.025)
    cap = roller(radius * 0.68, -0.025, 0.025, 20, 0.008)
    for x, y in CORNERS:
        wheel = b.part("wheel, tire", tyre, rubber.moved(x * length * 0.3, y * (w / 2 - 0.01), radius))
        wheel.subpart("rim, hubcap", metal, cap.moved(x * length * 0.3, y * (w / 2 + 0.065), radius))


def house(b: Builder) -> None:
    brick = b.paint(str(b.rng.choice(["brick", "stone", "plain"])))
    roof_paint = b.paint("brick red brown grey orange teal blue")
    wood, glass = b.paints("wood", "plastic")
    d, w, h = b.between(0.55, 0.66), b.between(0.66, 0.8), b.between(0.45, 0.52)
    rise = b.between(0.3, 0.38)
    gable = extrude([(-w / 2, h), (w / 2, h), (0, h + rise)], d).turned("z", 90)
    walls = b.part("walls, building", brick, box((d, w, h), (0, 0, h / 2)), gable)
    walls.subpart("door, front door", wood, box((0.05, 0.19, 0.34), (d / 2 + 0.01, 0.0, 0.17), 0.01))
    window = walls.subpart("windows")
    for side in (-1, 1):
        window.put(glass, box((0.05, 0.15, 0.17), (d / 2 + 0.01, side * w * 0.32, h * 0.62), 0.01))
        window.put(glass, box((d * 0.36, 0.05, 0.18), (0, side * (w / 2 + 0.01), h * 0.55), 0.01))
    window.put(glass, box((0.05, 0.2, 0.18), (-d / 2 - 0.01, 0, h * 0.55), 0.01))
    roof = b.part("roof")
    slope = np.hypot(w / 2, rise)
    angle = np.degrees(np.arctan2(rise, w / 2))
    for side in (-1, 1):
        slab = box((d + 0.12, slope + 0.12, 0.06), bevel=0.012).turned("x", -side * angle)
        outward = np.array([0, side * np.sin(np.radians(angle)), np.cos(np.radians(angle))]) * 0.03
        middle = np.array([0, side * w / 4, h + rise / 2]) + outward
        middle += np.array([0, side * np.cos(np.radians(angle)), -np.sin(np.radians(angle))]) * 0.04
        roof.put(roof_paint, slab.moved(*middle))
        if side == 1:
            sky = box((0.22, 0.2, 0.04), bevel=0.01).turned("x", -angle)
            light = middle + np.array([0, np.sin(np.radians(angle)), np.cos(np.radians(angle))]) * 0.035
    roof.subpart("skylight, roof window", "plastic", sky.moved(*(light + np.array([d * 0.12, 0, 0]))))
    roof.subpart("ridge", "plain", box((d + 0.15, 0.1, 0.075), (0, 0, h + rise + 0.055), 0.025))
    x, y, top = -d * 0.22, -w * 0.22, h + rise + 0.18
    chimney = b.part("chimney", "brick", box((0.15, 0.15, 0.48), (x, y, top - 0.24)))
    chimney.subpart("cap, top", "stone", box((0.21, 0.21, 0.085), (x, y, top), 0.015))


def duck(b: Builder) -> None:
    rubber = b.paint("snow yellow orange white pink teal")
    bill_paint, dark = b.paints("plain orange red", "plastic black")
    length, head_r = b.between(0.4, 0.46), b.between(0.22, 0.26)
    body = b.part("body, belly", rubber, ellipsoid((length, 0.33, 0.27), (0, 0, 0.27)))
    path = [(-length * 0.72, 0, 0.34), (-length * 1.0, 0, 0.46), (-length * 1.14, 0, 0.58)]
    body.subpart("tail, tail feathers", "plain", sweep(path, [0.2, 0.13, 0.03]), at="of")
    x, z = length * 0.52, 0.46 + head_r * 0.9
    head = b.part("head", rubber, sphere(head_r, (x, 0, z)))
    shapes = [ellipsoid((0.16, 0.135, 0.05), (x + head_r + 0.05, 0, z - 0.03))]
    shapes += [ellipsoid((0.12, 0.11, 0.04), (x + head_r + 0.03, 0, z - 0.085))]
    head.subpart("bill, beak", bill_paint, *shapes)
    eyes = sphere(0.058).both_sides(x + head_r * 0.72, head_r * 0.55, z + head_r * 0.36)
    head.subpart("eyes", dark, eyes)
    top = z + head_r * 0.86
    hat_x = x - 0.02  # the cap is slightly behind the middle
    crown = lathe([(0.13, top - 0.02), (0.19, top + 0.07), (0.15, top + 0.13), (0, top + 0.14)])
    hat = b.part("cap, sailor hat", "cloth", crown.moved(hat_x))
    brim = joined(ring(0.15, 0.05, (0, 0, top)), cylinder(0.15, top - 0.03, top + 0.03))
    hat.subpart("brim, edge", "cloth", brim.moved(hat_x), at="of")
    wing_paint, tips = b.paints("plain", "plain")
    for side in (-1, 1):
        wing = b.part("wing", wing_paint, ellipsoid((0.23, 0.06, 0.14), (-0.02, side * 0.315, 0.33)))
        shape = ellipsoid((0.13, 0.065, 0.09), (-0.22, side * 0.31, 0.38))
        wing.subpart("tip, feathers", tips, shape, at="of")


def penguin(b: Builder) -> None:
    coat, front = b.paints("fur black blue grey teal purple", "snow white beige")
    orange = b.paint("plain orange yellow red")
    r, h = b.between(0.28, 0.32), b.between(0.36, 0.42)
    body = b.part("body, torso", coat, ellipsoid((r * 0.92, r, h), (0, 0, h + 0.06)))
    shape = ellipsoid((r * 0.5, r * 0.78, h * 0.82), (r * 0.5, 0, h * 0.95 + 0.04))
    body.subpart("belly, tummy, chest", front, shape)
    body.subpart("tail", "fur", sweep([(-r * 0.6, 0, 0.22), (-r * 1.25, 0, 0.07)], [0.15, 0.06]))
    z = 2 * h + 0.1
    head = b.part("head", coat, sphere(r * 0.76, (0.02, 0, z)))
    head.subpart("face, cheeks", front, ellipsoid((0.1, 0.11, 0.12)).both_sides(r * 0.48, 0.085, z + 0.01))
    eyes = head.subpart("eyes")
    for side in (-1, 1):
        eyes.put("plastic black", sphere(0.062, (r * 0.48 + 0.075, side * 0.09, z + 0.04)))
    shape = lathe([(0, 0), (0.105, 0), (0.08, 0.1), (0, 0.23)]).turned("y", 90).moved(r * 0.55, 0, z - 0.06)
    head.subpart("beak, bill", orange, shape)
    neck = z - r * 0.6
    scarf = b.part("scarf, shawl", "cloth", ring(r * 0.68, 0.075, (0.0, 0, neck)))
    shape = box((0.07, 0.16, 0.32), (r * 0.84, 0.16, neck - 0.14), 0.025)
    scarf.subpart("end, fringe", "cloth", shape, at="of")
    tip_paint = b.paint("fur")
    for side in (-1, 1):
        wing = ellipsoid((0.12, 0.05, 0.27)).turned("x", side * 28)
        y = side * (r + 0.07)
        flipper = b.part("flipper, wing", coat, wing.moved(0.0, y, h + 0.13))
        tip = ellipsoid((0.12, 0.065, 0.14)).turned("x", side * 28)
        flipper.subpart("tip", tip_paint, tip.moved(0.0, y + side * 0.075, h - 0.01), at="of")
    feet = b.part("feet, webbed feet")
    toes = feet.subpart("toes")
    for side in (-1, 1):
        feet.put(orange, ellipsoid((0.2, 0.13, 0.06), (0.14, side * 0.16, 0.06)))
        for turn in (-1, 0, 1):
            toes.put("plain yellow brown black", sphere(0.06, (0.33, side * 0.16 + turn * 0.085, 0.055), 16))


def turtle(b: Builder) -> None:
    skin = b.paint("plain green teal beige brown yellow")
    shell_paint = b.paint("collage brown orange green purple red")
    r = b.between(0.4, 0.46)
    profile = [(r, 0.17), (r * 0.97, 0.26), (r * 0.72, 0.42), (r * 0.35, 0.51), (0, 0.53)]
    shell = b.part("shell, carapace", shell_paint, lathe(profile))
    profile = [(0, 0.12), (r * 1.02, 0.12), (r * 1.1, 0.17), (r * 1.04, 0.24), (r * 0.96, 0.24)]
    shell.subpart("rim, border", "ceramic", lathe(profile, 36), at="of")
    plate = ellipsoid((0.125, 0.135, 0.045)).turned("y", 42).moved(r * 0.68, 0, 0.42)
    plates = [plate.turned("z", np.degrees(np.pi * i / 3 + 0.3)) for i in range(6)]
    shell.subpart("plates, scales", "ceramic", ellipsoid((0.155, 0.155, 0.05), (0, 0, 0.515)), *plates)
    shapes = [sweep([(r * 0.7, 0, 0.18), (r * 1.15, 0, 0.25), (r * 1.35, 0, 0.34)], [0.11, 0.1, 0.11])]
    shapes += [ellipsoid((0.17, 0.145, 0.14), (r * 1.35 + 0.05, 0, 0.37))]
    head = b.part("head", skin, *shapes)
    eyes = head.subpart("eyes")
    for side in (-1, 1):
        eyes.put("plastic black white", sphere(0.078, (r * 1.35 + 0.1, side * 0.1, 0.43)))
    shape = ring(0.105, 0.065, axis="x").turned("y", -30).moved(r * 1.17, 0, 0.26)
    head.subpart("collar, neckband", "cloth", shape)
    claw = b.paint("plastic")
    for x, y in CORNERS:
        a = y * (42 if x > 0 else 135)
        limb = sweep([(r * 0.7, 0, 0.17), (r * 1.05, 0, 0.12), (r * 1.22, 0, 0.1)], [0.1, 0.105, 0.1])
        leg = b.part("leg", skin, limb.turned("z", a))
        foot = ellipsoid((0.13, 0.15, 0.09), (r * 1.34, 0, 0.09))
        leg.subpart("foot, flipper", claw, foot.turned("z", a), at="of")
    path = [(-r * 0.9, 0, 0.17), (-r * 1.2, 0, 0.13), (-r * 1.48, 0, 0.1)]
    b.part("tail", skin, sweep(path, [0.12, 0.1, 0.06]))


def rabbit(b: Builder) -> None:
    fur = b.paint("fur white grey beige brown pink")
    light, dark = b.paints("fur pink beige white", "plastic black")
    r = b.between(0.26, 0.3)
    body = b.part("body, torso", fur, ellipsoid((r * 1.15, r, r * 1.15), (-0.04, 0, r * 1.12)))
    body.subpart("tail, cotton tail", "snow", sphere(0.13, (-r * 1.2 - 0.03, 0, r * 0.72)))
    body.subpart("belly, tummy", light, ellipsoid((0.1, r * 0.68, r * 0.78), (r * 0.95 - 0.04, 0, r * 1.05)))
    hx, hz = r * 0.42, r * 2.2 + 0.14
    head = b.part("head", fur, ellipsoid((0.23, 0.22, 0.21), (hx, 0, hz)))
    head.subpart("eyes", dark, sphere(0.065).both_sides(hx + 0.16, 0.115, hz + 0.075))
    head.subpart("muzzle, snout", light, ellipsoid((0.1, 0.12, 0.085), (hx + 0.18, 0, hz - 0.07)))
    inner = b.paint("fur pink orange purple beige")
    for side in (-1, 1):
        tilt = -side * b.between(8, 16)
        outer = ellipsoid((0.06, 0.095, 0.28), (0, 0, 0.24)).turned("x", tilt)
        ear = b.part("ear", fur, outer.moved(hx - 0.04, side * 0.1, hz + 0.1))
        inside = ellipsoid((0.045, 0.065, 0.21), (0.03, 0, 0.25)).turned("x", tilt)
        ear.subpart("lining, inside", inner, inside.moved(hx - 0.04, side * 0.1, hz + 0.1), at="of")
    pad = b.paint("fur")
    for side in (-1, 1):
        leg = b.part("leg", fur, ellipsoid((0.21, 0.12, 0.2), (0.02, side * r * 0.92, 0.2)))
        leg.subpart("foot, paw", pad, ellipsoid((0.22, 0.1, 0.075), (0.2, side * r * 0.95, 0.075)), at="of")
    profile = [(0, 0), (0.06, 0.08), (0.1, 0.3), (0.07, 0.36), (0, 0.37)]
    shape = lathe(profile).turned("x", 62).moved(r * 1.12 + 0.05, 0.19, r * 1.05)
    carrot = b.part("carrot", "plain orange", shape)
    top = lathe([(0, 0), (0.08, 0.04), (0.085, 0.13), (0, 0.2)]).turned("x", 62)
    up = np.array([0, -np.sin(np.radians(62)), np.cos(np.radians(62))]) * 0.35
    shape = top.moved(r * 1.12 + 0.05, 0.19 + up[1], r * 1.05 + up[2])
    carrot.subpart("greens, leaves", "plain green", shape, at="of")


def train(b: Builder) -> None:
    tank, cab_paint, metal, dark = b.paints("plastic", "plain", "metal", "plain black grey brown")
    r, length = b.between(0.19, 0.22), b.between(0.6, 0.7)
    axis = 0.24 + r
    frame = b.part("frame, chassis", dark, box((length + 0.42, 0.34, 0.12), (0, 0, 0.21), 0.02))
    front = length / 2 + 0.2
    wide = [(front, -0.22, 0.04), (front, 0.22, 0.04), (front, 0.16, 0.27), (front, -0.16, 0.27)]
    low, high = front + 0.2, front + 0.06
    narrow = [(low, -0.06, 0.04), (low, 0.06, 0.04), (high, 0.05, 0.25), (high, -0.05, 0.25)]
    frame.subpart("cowcatcher, plough", "plastic", loft([wide, narrow]))
    back = -length / 2 + 0.22
    boiler = b.part("boiler, tank", tank, disc(r, back, front - 0.04).moved(z=axis))
    shape = disc(r * 0.8, front - 0.05, front + 0.02, bevel=0.02).moved(z=axis)
    boiler.subpart("front plate, smokebox door", metal, shape)
    places = [back + share * (front - back) for share in (0.25, 0.62)]
    bands = [disc(r + 0.022, x - 0.05, x + 0.05).moved(z=axis) for x in places]
    boiler.subpart("bands, rings", "metal", *bands)
    shape = lathe([(0.13, 0), (0.13, 0.08), (0.08, 0.16), (0, 0.18)]).moved(0.04, 0, axis + r - 0.03)
    boiler.subpart("dome, bell", "metal", shape)
    cx, top = front - 0.16, axis + r
    shape = lathe([(0, -0.05), (0.075, -0.05), (0.075, 0.08), (0.115, 0.2), (0, 0.2)]).moved(cx, 0, top)
    chimney = b.part("chimney, funnel, smokestack", dark, shape)
    shape = cylinder(0.145, top + 0.17, top + 0.255, bevel=0.015).moved(cx)
    chimney.subpart("rim, crown", "ceramic", shape, at="of")
    x, height = -length / 2 - 0.01, b.between(0.52, 0.6)
    cabin = b.part("cabin, cab", cab_paint, box((0.36, 0.44, height), (x, 0, 0.25 + height / 2), 0.015))
    cabin.subpart("roof, top", "plain", box((0.48, 0.56, 0.08), (x, 0, 0.28 + height), 0.03), at="of")
    glass = b.paint("plastic blue teal yellow white black")
    across = box((0.22, 0.47, 0.2), (x, 0, 0.25 + height * 0.66), 0.01)
    cabin.subpart("windows", glass, across, box((0.39, 0.26, 0.18), (x, 0, 0.25 + height * 0.67), 0.01))
    tyre, hub = b.paints("plain", "metal")
    wheel_r = 0.165
    for i in range(3):
        for side in (-1, 1):
            wx, y = (i - 1) * 0.34, side * 0.22
            wheel = b.part("wheel", tyre, roller(wheel_r, -0.045, 0.045, 24, 0.012).moved(wx, y, wheel_r))
            shape = roller(wheel_r * 0.68, -0.03, 0.03, 20, 0.01).moved(wx, y + side * 0.04, wheel_r)
            wheel.subpart("hub, wheel centre", hub, shape, at="of")


def sailboat(b: Builder) -> None:
    hull_paint, wood = b.paints("plain", "wood")
    length, beam = b.between(0.95, 1.1), b.between(0.36, 0.42)

    def section(x: float, lower: float, upper: float, low: float, high: float) -> list[Point]:
        """Return a cross-section with the given half widths at its lower and upper edges."""
        return [(x, -lower, low), (x, lower, low), (x, upper, high), (x, -upper, high)]

    stations = [(-0.5, 0.78, 0.07, 0.32), (-0.2, 1.0, 0.0, 0.3), (0.18, 0.86, 0.0, 0.31)]
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
        deck.append(section(x * length * 0.94, w * beam * 0.44, w * beam * 0.4, high - 0.02, high + 0.03))
    hull.subpart("stripe, band", "plastic", loft(stripe))
    hull.subpart("deck, floor", wood, loft(deck))
    hull.subpart("rudder, tiller", "wood", box((0.16, 0.08, 0.42), (-length / 2 - 0.06, 0, 0.23), 0.015))
    house = b.part("cabin, deckhouse", "plain", box((0.26, beam * 0.5, 0.17), (-length * 0.22, 0, 0.4), 0.02))
    shape = box((0.31, beam * 0.58, 0.055), (-length * 0.22, 0, 0.5), 0.02)
    house.subpart("roof, top", "plastic", shape, at="of")
    mast_x, top = length * 0.06, b.between(1.2, 1.35)
    mast = b.part("mast, pole", "wood", cylinder(0.035, 0.28, top + 0.12, 16).moved(mast_x))
    flag = extrude([(-0.01, 0), (-0.01, 0.17), (-0.26, 0.085)], 0.04)
    mast.subpart("flag, pennant", "cloth", flag.moved(mast_x, 0, top - 0.04))
    main, low = b.part("mainsail, big sail"), 0.62
    cloth, patch = b.paints("cloth", "cloth")
    tall, foot = top - 0.1 - low, length * 0.5
    main.put(cloth, extrude([(0, 0), (-foot, 0), (0, tall)], 0.035).moved(mast_x - 0.04, 0, low))
    cut = 0.34
    outline = [(0, 0.02), (-foot * 0.93, 0.02)]
    outline += [(-foot * (1 - cut) * 0.95, tall * cut * 0.8), (0, tall * cut * 0.8)]
    main.subpart("panel, sail panel", patch, extrude(outline, 0.055).moved(mast_x - 0.045, 0, low))
    tall, foot = tall * 0.85, length * 0.36
    shape = extrude([(0, 0), (foot, 0), (0, tall)], 0.035).moved(mast_x + 0.05, 0, low - 0.1)
    jib = b.part("jib, front sail", "cloth", shape)
    shape = roller(0.115, -0.035, 0.035, 20).moved(mast_x + 0.05 + foot * 0.28, 0, low - 0.1 + tall * 0.3)
    jib.subpart("emblem, badge", "plain", shape)
    b.turn(55)  # so that the sails look broad from the front


def airplane(b: Builder) -> None:
    skin, wing_paint, tip_paint = b.paints("plain", "plastic", "plastic")
    dark, metal = b.paints("plastic black grey brown", "metal")
    r, length = b.between(0.15, 0.175), b.between(1.05, 1.2)
    z = 0.36
    profile = [(0, 0), (r * 0.35, 0.01), (r * 0.72, length * 0.35), (r, length * 0.62)]
    profile += [(r, length * 0.88), (r * 0.8, length * 0.97), (0, length)]
    body = b.part("fuselage, body", skin, lathe(profile).turned("y", 90).moved(-length * 0.58, 0, z))
    shape = ellipsoid((0.2, 0.115, 0.13), (length * 0.13, 0, z + r * 0.82))
    body.subpart("cockpit, windows, canopy", "plastic blue teal black white", shape)
    body.subpart("band, stripe", "plain", disc(r * 0.9, -length * 0.2, -length * 0.09).moved(z=z))
    x = length * 0.42
    shapes = [box((0.045, 0.09, 0.56), (x + 0.07, 0, 0), 0.015).turned("x", a).moved(z=z) for a in (30, 120)]
    propeller = b.part("propeller, airscrew", metal, *shapes)
    shape = lathe([(0, 0), (0.125, 0), (0.09, 0.13), (0, 0.19)]).turned("y", 90).moved(x + 0.02, 0, z)
    propeller.subpart("hub, spinner", "plastic", shape)
    span = b.between(0.5, 0.58)

    def wing_part(side: int, low: Number, high: Number, grow: float) -> Mesh:
        """Return a part of a wing, between two fractions of the span."""
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
        wing.subpart("tip, end", tip_paint, wing_part(side, 0.7, 1.02, 1.15), at="of")
        y = side * (r * 0.6 + span * 0.42)
        shape = disc(0.115, -0.14, 0.27, bevel=0.03).moved(0.05, y, z - 0.05)
        wing.subpart("engine, motor", metal, shape, at="under")
    back = -length * 0.58
    tail = b.part("tail, tail unit", wing_paint, box((0.19, 0.56, 0.045), (back + 0.1, 0, z + 0.03), 0.015))
    outline = [(back, z + 0.03), (back + 0.26, z + 0.03), (back + 0.1, z + 0.34), (back - 0.03, z + 0.34)]
    tail.subpart("rudder, tail fin", "plain", extrude(outline, 0.055))
    gear = b.part("landing gear, undercarriage")
    wheels = gear.subpart("wheels, tires")
    for side in (-1, 1):
        gear.put(metal, sweep([(0.16, side * 0.08, z - 0.1), (0.18, side * 0.2, 0.13)], 0.05))
        wheels.put(dark, roller(0.13, -0.06, 0.06, 20, 0.015).moved(0.18, side * 0.24, 0.13))
    gear.put(metal, sweep([(back + 0.16, 0, z - 0.04), (back + 0.13, 0, 0.06)], 0.03))
    wheels.put(dark, roller(0.06, -0.03, 0.03, 16).moved(back + 0.13, 0, 0.06))


def tractor(b: Builder) -> None:
    paint, tyre, hub = b.paints("plastic", "plain black grey", "plastic")
    glass, metal = b.paints("plastic blue teal white black", "metal")
    big, small = b.between(0.28, 0.32), b.between(0.16, 0.19)
    hood = b.part("hood, engine cover, bonnet", paint, box((0.5, 0.32, 0.26), (0.3, 0, 0.42), 0.03))
    hood.subpart("grille, radiator", metal, box((0.05, 0.25, 0.19), (0.56, 0, 0.42), 0.015), at="of")
    lights = hood.subpart("headlights, lamps")
    for side in (-1, 1):
        lights.put("plastic yellow white", disc(0.09, -0.04, 0.06, 20, 0.015).moved(0.48, side * 0.19, 0.54))
    pipe = b.part("exhaust pipe, exhaust", metal, cylinder(0.045, 0.53, 0.84, 16).moved(0.36, 0.0, 0))
    pipe.subpart("cap, end", "plastic", cylinder(0.095, 0.78, 0.91, 18, 0.015).moved(0.36, 0, 0), at="of")
    cabin = b.part("cabin, cab", "plain", box((0.46, 0.42, 0.56), (-0.16, 0, 0.62), 0.02))
    cabin.subpart("roof, top", "plastic", box((0.56, 0.52, 0.085), (-0.16, 0, 0.92), 0.03), at="of")
    shapes = [box(size, (-0.16, 0, 0.73), 0.01) for size in ((0.3, 0.45, 0.23), (0.49, 0.3, 0.23))]
    cabin.subpart("windows", glass, *shapes)
    frame = b.part("frame, chassis", "plain black grey brown", box((0.95, 0.24, 0.16), (0.06, 0, 0.25), 0.02))
    frame.subpart("hitch, tow hook", metal, box((0.2, 0.14, 0.1), (-0.5, 0, 0.24), 0.025), at="of")
    for radius, x, y, wide in ((big, -0.22, 0.31, 0.15), (small, 0.36, 0.24, 0.11)):
        words = "rear wheel, big wheel" if radius == big else "front wheel, small wheel"
        for side in (-1, 1):
            shape = roller(radius, -wide / 2, wide / 2, 28, 0.03).moved(x, side * y, radius)
            wheel = b.part(words, tyre, shape)
            cap = roller(radius * 0.6, -0.03, 0.03, 22, 0.01)
            wheel.subpart("hub, rim", hub, cap.moved(x, side * (y + wide / 2), radius), at="of")
