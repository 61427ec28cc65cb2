"""Toy animals: each function draws one class of object."""

import numpy as np

from hilsplat.world.objects.builder import Builder, Maker
from hilsplat.world.shapes import box, cylinder, ellipsoid, lathe, ring, sphere, sweep


def _duck(b: Builder) -> None:
    rubber = b.paints.draw("snow", "yellow", "orange", "white", "pink", "teal")
    bill_paint, dark = b.paints.draw("plain", "orange", "red"), b.paints.draw("plastic", "black")
    length, head_r = b.between(0.40, 0.46), b.between(0.22, 0.26)
    body = b.part("body", "belly")
    b.put(body, rubber, ellipsoid((length, 0.33, 0.27), (0, 0, 0.27)))
    tail = b.subpart(body, "tail", "tail feathers", at="of")
    b.put(
        tail,
        b.paints.draw("plain"),
        sweep(
            [(-length * 0.72, 0, 0.34), (-length * 1.0, 0, 0.46), (-length * 1.14, 0, 0.58)],
            [0.2, 0.13, 0.03],
        ),
    )
    head = b.part("head")
    x, z = length * 0.52, 0.46 + head_r * 0.9
    b.put(head, rubber, sphere(head_r, (x, 0, z)))
    bill = b.subpart(head, "bill", "beak")
    b.put(
        bill,
        bill_paint,
        ellipsoid((0.16, 0.135, 0.05), (x + head_r + 0.05, 0, z - 0.03)),
        ellipsoid((0.12, 0.11, 0.04), (x + head_r + 0.03, 0, z - 0.085)),
    )
    eyes = b.subpart(head, "eyes")
    for side in (-1, 1):
        b.put(eyes, dark, sphere(0.058, (x + head_r * 0.72, side * head_r * 0.55, z + head_r * 0.36)))
    hat = b.part("cap", "sailor hat")
    cloth = b.paints.draw("cloth")
    top = z + head_r * 0.86
    b.put(hat, cloth, lathe([(0.13, top - 0.02), (0.19, top + 0.07), (0.15, top + 0.13), (0, top + 0.14)]))
    brim = b.subpart(hat, "brim", "edge", at="of")
    b.put(brim, b.paints.draw("cloth"), ring(0.15, 0.05, (0, 0, top)), cylinder(0.15, top - 0.03, top + 0.03))
    hat_x = x - 0.02  # the cap is slightly behind the middle
    b.shift((hat, brim), hat_x, 0, 0)
    wing_paint, tips = b.paints.draw("plain"), b.paints.draw("plain")
    for side in (-1, 1):
        wing = b.part("wing")
        b.put(wing, wing_paint, ellipsoid((0.23, 0.06, 0.14), (-0.02, side * 0.315, 0.33)))
        b.put(
            b.subpart(wing, "tip", "feathers", at="of"),
            tips,
            ellipsoid((0.13, 0.065, 0.09), (-0.22, side * 0.31, 0.38)),
        )


def _penguin(b: Builder) -> None:
    coat = b.paints.draw("fur", "black", "blue", "grey", "teal", "purple")
    front = b.paints.draw("snow", "white", "beige")
    orange = b.paints.draw("plain", "orange", "yellow", "red")
    r, h = b.between(0.28, 0.32), b.between(0.36, 0.42)
    body = b.part("body", "torso")
    b.put(body, coat, ellipsoid((r * 0.92, r, h), (0, 0, h + 0.06)))
    belly = b.subpart(body, "belly", "tummy", "chest")
    b.put(belly, front, ellipsoid((r * 0.5, r * 0.78, h * 0.82), (r * 0.5, 0, h * 0.95 + 0.04)))
    tail = b.subpart(body, "tail")
    b.put(tail, b.paints.draw("fur"), sweep([(-r * 0.6, 0, 0.22), (-r * 1.25, 0, 0.07)], [0.15, 0.06]))
    z = 2 * h + 0.10
    head = b.part("head")
    b.put(head, coat, sphere(r * 0.76, (0.02, 0, z)))
    face = b.subpart(head, "face", "cheeks")
    for side in (-1, 1):
        b.put(face, front, ellipsoid((0.10, 0.11, 0.12), (r * 0.48, side * 0.085, z + 0.01)))
    eyes = b.subpart(head, "eyes")
    for side in (-1, 1):
        b.put(
            eyes, b.paints.draw("plastic", "black"), sphere(0.062, (r * 0.48 + 0.075, side * 0.09, z + 0.04))
        )
    beak = b.subpart(head, "beak", "bill")
    b.put(
        beak,
        orange,
        lathe([(0, 0), (0.105, 0), (0.08, 0.1), (0, 0.23)]).turned("y", 90).moved(r * 0.55, 0, z - 0.06),
    )
    scarf = b.part("scarf", "shawl")
    cloth = b.paints.draw("cloth")
    neck = z - r * 0.60
    b.put(scarf, cloth, ring(r * 0.68, 0.075, (0.0, 0, neck)))
    end = b.subpart(scarf, "end", "fringe", at="of")
    b.put(end, b.paints.draw("cloth"), box((0.07, 0.16, 0.32), (r * 0.84, 0.16, neck - 0.14), 0.025))
    tip_paint = b.paints.draw("fur")
    for side in (-1, 1):
        flipper = b.part("flipper", "wing")
        wing = ellipsoid((0.12, 0.05, 0.27)).turned("x", side * 28)
        y = side * (r + 0.07)
        b.put(flipper, coat, wing.moved(0.0, y, h + 0.13))
        tip = ellipsoid((0.12, 0.065, 0.14)).turned("x", side * 28)
        b.put(b.subpart(flipper, "tip", at="of"), tip_paint, tip.moved(0.0, y + side * 0.075, h - 0.01))
    feet = b.part("feet", "webbed feet")
    toes = b.subpart(feet, "toes")
    for side in (-1, 1):
        b.put(feet, orange, ellipsoid((0.20, 0.13, 0.06), (0.14, side * 0.16, 0.06)))
        for turn in (-1, 0, 1):
            b.put(
                toes,
                b.paints.draw("plain", "yellow", "brown", "black"),
                sphere(0.06, (0.33, side * 0.16 + turn * 0.085, 0.055), 16),
            )


def _turtle(b: Builder) -> None:
    skin = b.paints.draw("plain", "green", "teal", "beige", "brown", "yellow")
    shell_paint = b.paints.draw("collage", "brown", "orange", "green", "purple", "red")
    r = b.between(0.40, 0.46)
    shell = b.part("shell", "carapace")
    b.put(
        shell,
        shell_paint,
        lathe([(r, 0.17), (r * 0.97, 0.26), (r * 0.72, 0.42), (r * 0.35, 0.51), (0, 0.53)]),
    )
    edge = b.subpart(shell, "rim", "border", at="of")
    b.put(
        edge,
        b.paints.draw("ceramic"),
        lathe([(0, 0.12), (r * 1.02, 0.12), (r * 1.10, 0.17), (r * 1.04, 0.24), (r * 0.96, 0.24)], 36),
    )
    plates = b.subpart(shell, "plates", "scales")
    paint = b.paints.draw("ceramic")
    b.put(plates, paint, ellipsoid((0.155, 0.155, 0.05), (0, 0, 0.515)))
    for i in range(6):
        a = np.pi * i / 3 + 0.3
        plate = ellipsoid((0.125, 0.135, 0.045)).turned("y", 42).moved(r * 0.68, 0, 0.42)
        b.put(plates, paint, plate.turned("z", np.degrees(a)))
    head = b.part("head")
    b.put(
        head,
        skin,
        sweep([(r * 0.7, 0, 0.18), (r * 1.15, 0, 0.25), (r * 1.35, 0, 0.34)], [0.11, 0.10, 0.11]),
        ellipsoid((0.17, 0.145, 0.14), (r * 1.35 + 0.05, 0, 0.37)),
    )
    eyes = b.subpart(head, "eyes")
    for side in (-1, 1):
        b.put(
            eyes,
            b.paints.draw("plastic", "black", "white"),
            sphere(0.078, (r * 1.35 + 0.10, side * 0.10, 0.43)),
        )
    scarf = b.subpart(head, "collar", "neckband")
    b.put(
        scarf, b.paints.draw("cloth"), ring(0.105, 0.065, axis="x").turned("y", -30).moved(r * 1.17, 0, 0.26)
    )
    claw = b.paints.draw("plastic")
    for x in (-1, 1):
        for side in (-1, 1):
            leg = b.part("leg")
            a = side * (42 if x > 0 else 135)
            limb = sweep([(r * 0.7, 0, 0.17), (r * 1.05, 0, 0.12), (r * 1.22, 0, 0.10)], [0.10, 0.105, 0.10])
            b.put(leg, skin, limb.turned("z", a))
            foot = ellipsoid((0.13, 0.15, 0.09), (r * 1.34, 0, 0.09))
            b.put(b.subpart(leg, "foot", "flipper", at="of"), claw, foot.turned("z", a))
    tail = b.part("tail")
    b.put(
        tail,
        skin,
        sweep([(-r * 0.9, 0, 0.17), (-r * 1.2, 0, 0.13), (-r * 1.48, 0, 0.10)], [0.12, 0.10, 0.06]),
    )


def _rabbit(b: Builder) -> None:
    fur = b.paints.draw("fur", "white", "grey", "beige", "brown", "pink")
    light, dark = b.paints.draw("fur", "pink", "beige", "white"), b.paints.draw("plastic", "black")
    r = b.between(0.26, 0.30)
    body = b.part("body", "torso")
    b.put(body, fur, ellipsoid((r * 1.15, r, r * 1.15), (-0.04, 0, r * 1.12)))
    b.put(
        b.subpart(body, "tail", "cotton tail"),
        b.paints.draw("snow"),
        sphere(0.13, (-r * 1.2 - 0.03, 0, r * 0.72)),
    )
    b.put(
        b.subpart(body, "belly", "tummy"),
        light,
        ellipsoid((0.10, r * 0.68, r * 0.78), (r * 0.95 - 0.04, 0, r * 1.05)),
    )
    head = b.part("head")
    hx, hz = r * 0.42, r * 2.2 + 0.14
    b.put(head, fur, ellipsoid((0.23, 0.22, 0.21), (hx, 0, hz)))
    eyes, nose = b.subpart(head, "eyes"), b.subpart(head, "muzzle", "snout")
    for side in (-1, 1):
        b.put(eyes, dark, sphere(0.065, (hx + 0.16, side * 0.115, hz + 0.075)))
    b.put(nose, light, ellipsoid((0.10, 0.12, 0.085), (hx + 0.18, 0, hz - 0.07)))
    inner = b.paints.draw("fur", "pink", "orange", "purple", "beige")
    for side in (-1, 1):
        ear = b.part("ear")
        tilt = -side * b.between(8, 16)
        outer = ellipsoid((0.06, 0.095, 0.28), (0, 0, 0.24)).turned("x", tilt)
        b.put(ear, fur, outer.moved(hx - 0.04, side * 0.10, hz + 0.10))
        inside = ellipsoid((0.045, 0.065, 0.21), (0.03, 0, 0.25)).turned("x", tilt)
        b.put(
            b.subpart(ear, "lining", "inside", at="of"),
            inner,
            inside.moved(hx - 0.04, side * 0.10, hz + 0.10),
        )
    pad = b.paints.draw("fur")
    for side in (-1, 1):
        leg = b.part("leg")
        b.put(leg, fur, ellipsoid((0.21, 0.12, 0.20), (0.02, side * r * 0.92, 0.20)))
        b.put(
            b.subpart(leg, "foot", "paw", at="of"),
            pad,
            ellipsoid((0.22, 0.10, 0.075), (0.20, side * r * 0.95, 0.075)),
        )
    carrot = b.part("carrot")
    b.put(
        carrot,
        b.paints.draw("plain", "orange"),
        lathe([(0, 0), (0.06, 0.08), (0.10, 0.30), (0.07, 0.36), (0, 0.37)])
        .turned("x", 62)
        .moved(r * 1.12 + 0.05, 0.19, r * 1.05),
    )
    top = lathe([(0, 0), (0.08, 0.04), (0.085, 0.13), (0, 0.20)]).turned("x", 62)
    up = np.array([0, -np.sin(np.radians(62)), np.cos(np.radians(62))]) * 0.35
    b.put(
        b.subpart(carrot, "greens", "leaves", at="of"),
        b.paints.draw("plain", "green"),
        top.moved(r * 1.12 + 0.05, 0.19 + up[1], r * 1.05 + up[2]),
    )


MAKERS: dict[str, Maker] = {
    "duck": Maker(_duck, ("rubber duck", "duckling")),
    "penguin": Maker(_penguin, ("toy penguin",)),
    "turtle": Maker(_turtle, ("tortoise",)),
    "rabbit": Maker(_rabbit, ("bunny", "hare")),
}
"""Classes drawn by this module."""
