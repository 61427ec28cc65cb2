"""Toy animals: each function draws one class of object."""

import numpy as np

from hilsplat.world.objects.builder import CORNERS, Builder, Maker
from hilsplat.world.shapes import box, cylinder, ellipsoid, joined, lathe, ring, sphere, sweep


def _duck(b: Builder) -> None:
    rubber = b.paint("snow", "yellow", "orange", "white", "pink", "teal")
    bill_paint, dark = b.paint("plain", "orange", "red"), b.paint("plastic", "black")
    length, head_r = b.between(0.40, 0.46), b.between(0.22, 0.26)
    body = b.part("body", "belly").put(rubber, ellipsoid((length, 0.33, 0.27), (0, 0, 0.27)))
    path = [(-length * 0.72, 0, 0.34), (-length * 1.0, 0, 0.46), (-length * 1.14, 0, 0.58)]
    body.subpart("tail", "tail feathers", at="of").put(b.paint("plain"), sweep(path, [0.2, 0.13, 0.03]))
    x, z = length * 0.52, 0.46 + head_r * 0.9
    head = b.part("head").put(rubber, sphere(head_r, (x, 0, z)))
    head.subpart("bill", "beak").put(
        bill_paint,
        ellipsoid((0.16, 0.135, 0.05), (x + head_r + 0.05, 0, z - 0.03)),
        ellipsoid((0.12, 0.11, 0.04), (x + head_r + 0.03, 0, z - 0.085)),
    )
    eyes = head.subpart("eyes")
    for side in (-1, 1):
        eyes.put(dark, sphere(0.058, (x + head_r * 0.72, side * head_r * 0.55, z + head_r * 0.36)))
    top = z + head_r * 0.86
    hat_x = x - 0.02  # the cap is slightly behind the middle
    crown = lathe([(0.13, top - 0.02), (0.19, top + 0.07), (0.15, top + 0.13), (0, top + 0.14)])
    hat = b.part("cap", "sailor hat").put(b.paint("cloth"), crown.moved(hat_x))
    brim = joined(ring(0.15, 0.05, (0, 0, top)), cylinder(0.15, top - 0.03, top + 0.03))
    hat.subpart("brim", "edge", at="of").put(b.paint("cloth"), brim.moved(hat_x))
    wing_paint, tips = b.paint("plain"), b.paint("plain")
    for side in (-1, 1):
        wing = b.part("wing").put(wing_paint, ellipsoid((0.23, 0.06, 0.14), (-0.02, side * 0.315, 0.33)))
        wing.subpart("tip", "feathers", at="of").put(
            tips, ellipsoid((0.13, 0.065, 0.09), (-0.22, side * 0.31, 0.38))
        )


def _penguin(b: Builder) -> None:
    coat = b.paint("fur", "black", "blue", "grey", "teal", "purple")
    front = b.paint("snow", "white", "beige")
    orange = b.paint("plain", "orange", "yellow", "red")
    r, h = b.between(0.28, 0.32), b.between(0.36, 0.42)
    body = b.part("body", "torso").put(coat, ellipsoid((r * 0.92, r, h), (0, 0, h + 0.06)))
    body.subpart("belly", "tummy", "chest").put(
        front, ellipsoid((r * 0.5, r * 0.78, h * 0.82), (r * 0.5, 0, h * 0.95 + 0.04))
    )
    body.subpart("tail").put(b.paint("fur"), sweep([(-r * 0.6, 0, 0.22), (-r * 1.25, 0, 0.07)], [0.15, 0.06]))
    z = 2 * h + 0.10
    head = b.part("head").put(coat, sphere(r * 0.76, (0.02, 0, z)))
    face = head.subpart("face", "cheeks")
    for side in (-1, 1):
        face.put(front, ellipsoid((0.10, 0.11, 0.12), (r * 0.48, side * 0.085, z + 0.01)))
    eyes = head.subpart("eyes")
    for side in (-1, 1):
        eyes.put(b.paint("plastic", "black"), sphere(0.062, (r * 0.48 + 0.075, side * 0.09, z + 0.04)))
    head.subpart("beak", "bill").put(
        orange,
        lathe([(0, 0), (0.105, 0), (0.08, 0.1), (0, 0.23)]).turned("y", 90).moved(r * 0.55, 0, z - 0.06),
    )
    cloth = b.paint("cloth")
    neck = z - r * 0.60
    scarf = b.part("scarf", "shawl").put(cloth, ring(r * 0.68, 0.075, (0.0, 0, neck)))
    scarf.subpart("end", "fringe", at="of").put(
        b.paint("cloth"), box((0.07, 0.16, 0.32), (r * 0.84, 0.16, neck - 0.14), 0.025)
    )
    tip_paint = b.paint("fur")
    for side in (-1, 1):
        wing = ellipsoid((0.12, 0.05, 0.27)).turned("x", side * 28)
        y = side * (r + 0.07)
        flipper = b.part("flipper", "wing").put(coat, wing.moved(0.0, y, h + 0.13))
        tip = ellipsoid((0.12, 0.065, 0.14)).turned("x", side * 28)
        flipper.subpart("tip", at="of").put(tip_paint, tip.moved(0.0, y + side * 0.075, h - 0.01))
    feet = b.part("feet", "webbed feet")
    toes = feet.subpart("toes")
    for side in (-1, 1):
        feet.put(orange, ellipsoid((0.20, 0.13, 0.06), (0.14, side * 0.16, 0.06)))
        for turn in (-1, 0, 1):
            toes.put(
                b.paint("plain", "yellow", "brown", "black"),
                sphere(0.06, (0.33, side * 0.16 + turn * 0.085, 0.055), 16),
            )


def _turtle(b: Builder) -> None:
    skin = b.paint("plain", "green", "teal", "beige", "brown", "yellow")
    shell_paint = b.paint("collage", "brown", "orange", "green", "purple", "red")
    r = b.between(0.40, 0.46)
    shell = b.part("shell", "carapace").put(
        shell_paint, lathe([(r, 0.17), (r * 0.97, 0.26), (r * 0.72, 0.42), (r * 0.35, 0.51), (0, 0.53)])
    )
    shell.subpart("rim", "border", at="of").put(
        b.paint("ceramic"),
        lathe([(0, 0.12), (r * 1.02, 0.12), (r * 1.10, 0.17), (r * 1.04, 0.24), (r * 0.96, 0.24)], 36),
    )
    paint = b.paint("ceramic")
    plates = shell.subpart("plates", "scales").put(paint, ellipsoid((0.155, 0.155, 0.05), (0, 0, 0.515)))
    for i in range(6):
        a = np.pi * i / 3 + 0.3
        plate = ellipsoid((0.125, 0.135, 0.045)).turned("y", 42).moved(r * 0.68, 0, 0.42)
        plates.put(paint, plate.turned("z", np.degrees(a)))
    head = b.part("head").put(
        skin,
        sweep([(r * 0.7, 0, 0.18), (r * 1.15, 0, 0.25), (r * 1.35, 0, 0.34)], [0.11, 0.10, 0.11]),
        ellipsoid((0.17, 0.145, 0.14), (r * 1.35 + 0.05, 0, 0.37)),
    )
    eyes = head.subpart("eyes")
    for side in (-1, 1):
        eyes.put(b.paint("plastic", "black", "white"), sphere(0.078, (r * 1.35 + 0.10, side * 0.10, 0.43)))
    head.subpart("collar", "neckband").put(
        b.paint("cloth"), ring(0.105, 0.065, axis="x").turned("y", -30).moved(r * 1.17, 0, 0.26)
    )
    claw = b.paint("plastic")
    for x, y in CORNERS:
        a = y * (42 if x > 0 else 135)
        limb = sweep([(r * 0.7, 0, 0.17), (r * 1.05, 0, 0.12), (r * 1.22, 0, 0.10)], [0.10, 0.105, 0.10])
        leg = b.part("leg").put(skin, limb.turned("z", a))
        foot = ellipsoid((0.13, 0.15, 0.09), (r * 1.34, 0, 0.09))
        leg.subpart("foot", "flipper", at="of").put(claw, foot.turned("z", a))
    b.part("tail").put(
        skin, sweep([(-r * 0.9, 0, 0.17), (-r * 1.2, 0, 0.13), (-r * 1.48, 0, 0.10)], [0.12, 0.10, 0.06])
    )


def _rabbit(b: Builder) -> None:
    fur = b.paint("fur", "white", "grey", "beige", "brown", "pink")
    light, dark = b.paint("fur", "pink", "beige", "white"), b.paint("plastic", "black")
    r = b.between(0.26, 0.30)
    body = b.part("body", "torso").put(fur, ellipsoid((r * 1.15, r, r * 1.15), (-0.04, 0, r * 1.12)))
    body.subpart("tail", "cotton tail").put(b.paint("snow"), sphere(0.13, (-r * 1.2 - 0.03, 0, r * 0.72)))
    body.subpart("belly", "tummy").put(
        light, ellipsoid((0.10, r * 0.68, r * 0.78), (r * 0.95 - 0.04, 0, r * 1.05))
    )
    hx, hz = r * 0.42, r * 2.2 + 0.14
    head = b.part("head").put(fur, ellipsoid((0.23, 0.22, 0.21), (hx, 0, hz)))
    eyes, nose = head.subpart("eyes"), head.subpart("muzzle", "snout")
    for side in (-1, 1):
        eyes.put(dark, sphere(0.065, (hx + 0.16, side * 0.115, hz + 0.075)))
    nose.put(light, ellipsoid((0.10, 0.12, 0.085), (hx + 0.18, 0, hz - 0.07)))
    inner = b.paint("fur", "pink", "orange", "purple", "beige")
    for side in (-1, 1):
        tilt = -side * b.between(8, 16)
        outer = ellipsoid((0.06, 0.095, 0.28), (0, 0, 0.24)).turned("x", tilt)
        ear = b.part("ear").put(fur, outer.moved(hx - 0.04, side * 0.10, hz + 0.10))
        inside = ellipsoid((0.045, 0.065, 0.21), (0.03, 0, 0.25)).turned("x", tilt)
        ear.subpart("lining", "inside", at="of").put(inner, inside.moved(hx - 0.04, side * 0.10, hz + 0.10))
    pad = b.paint("fur")
    for side in (-1, 1):
        leg = b.part("leg").put(fur, ellipsoid((0.21, 0.12, 0.20), (0.02, side * r * 0.92, 0.20)))
        leg.subpart("foot", "paw", at="of").put(
            pad, ellipsoid((0.22, 0.10, 0.075), (0.20, side * r * 0.95, 0.075))
        )
    profile = [(0, 0), (0.06, 0.08), (0.10, 0.30), (0.07, 0.36), (0, 0.37)]
    carrot = b.part("carrot").put(
        b.paint("plain", "orange"), lathe(profile).turned("x", 62).moved(r * 1.12 + 0.05, 0.19, r * 1.05)
    )
    top = lathe([(0, 0), (0.08, 0.04), (0.085, 0.13), (0, 0.20)]).turned("x", 62)
    up = np.array([0, -np.sin(np.radians(62)), np.cos(np.radians(62))]) * 0.35
    carrot.subpart("greens", "leaves", at="of").put(
        b.paint("plain", "green"), top.moved(r * 1.12 + 0.05, 0.19 + up[1], r * 1.05 + up[2])
    )


MAKERS: dict[str, Maker] = {
    "duck": Maker(_duck, ("rubber duck", "duckling")),
    "penguin": Maker(_penguin, ("toy penguin",)),
    "turtle": Maker(_turtle, ("tortoise",)),
    "rabbit": Maker(_rabbit, ("bunny", "hare")),
}
