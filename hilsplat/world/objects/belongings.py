"""Things that people carry or keep: each function draws one class of object."""

import numpy as np

from hilsplat.world.objects.builder import CORNERS, Builder, Maker
from hilsplat.world.shapes import arc, box, cylinder, disc, ellipsoid, extrude, lathe, loft, ring, sweep


def _backpack(b: Builder) -> None:
    cloth, second, strap_paint = b.paint("cloth"), b.paint("cloth"), b.paint("cloth")
    metal = b.paint("metal")
    w, d, h = b.between(0.52, 0.60), b.between(0.28, 0.33), b.between(0.68, 0.76)
    bag = b.part("bag", "main compartment", "body").put(cloth, box((d, w, h), (0, 0, h / 2), 0.09))
    bag.subpart("bottom", "base", at="of").put(
        b.paint("plastic"), box((d + 0.03, w + 0.03, 0.15), (0, 0, 0.075), 0.04)
    )
    sides = bag.subpart("side pockets", "bottle pockets")
    for side in (-1, 1):
        sides.put(
            b.paint("cloth") if side < 0 else strap_paint,
            box((d * 0.66, 0.11, h * 0.34), (0, side * (w / 2 + 0.03), h * 0.32), 0.03),
        )
    flap = b.part("flap", "top flap", "lid").put(
        second,
        box((d + 0.07, w + 0.05, 0.13), (0.02, 0, h + 0.0), 0.05),
        box((0.06, w * 0.96, h * 0.24), (d / 2 + 0.03, 0, h * 0.90), 0.02),
    )
    buckles = flap.subpart("buckles", "clasps")
    for side in (-1, 1):
        buckles.put(metal, box((0.06, 0.11, 0.20), (d / 2 + 0.07, side * w * 0.27, h * 0.76), 0.015))
    flap.subpart("loop", "carry loop", at="of").put(strap_paint, ring(0.10, 0.038, (-0.02, 0, h + 0.10), "x"))
    pocket = b.part("front pocket", "pocket").put(
        b.paint("cloth"), box((0.15, w * 0.72, h * 0.40), (d / 2 + 0.06, 0, h * 0.36), 0.05)
    )
    pocket.subpart("zipper", "zip").put(
        metal, box((0.05, w * 0.58, 0.075), (d / 2 + 0.13, 0, h * 0.49), 0.015)
    )
    pocket.subpart("badge", "patch").put(
        b.paint("plain"), disc(0.09, 0.0, 0.03, 22, 0.008).moved(d / 2 + 0.125, 0, h * 0.30)
    )
    for side in (-1, 1):
        y = side * w * 0.27
        path = [
            (-d / 2 + 0.02, y, h * 0.92),
            (-d / 2 - 0.13, y, h * 0.78),
            (-d / 2 - 0.15, y, h * 0.45),
            (-d / 2 - 0.02, y, h * 0.16),
        ]
        strap = b.part("strap", "shoulder strap").put(strap_paint, sweep(path, [0.06, 0.075, 0.075, 0.05]))
        strap.subpart("pad", "padding").put(
            second, ellipsoid((0.075, 0.10, 0.17), (-d / 2 - 0.15, y, h * 0.60))
        )
    roll = b.part("bedroll", "sleeping mat").put(
        b.paint("cloth"),
        cylinder(0.115, -w * 0.60, w * 0.60, 24, 0.02).turned("x", 90).moved(0.0, 0, h + 0.16),
    )
    bands = roll.subpart("bands", "roll straps")
    for side in (-1, 1):
        bands.put(
            b.paint("cloth", "brown", "black", "red", "yellow", "white"),
            cylinder(0.13, -0.05, 0.05, 24).turned("x", 90).moved(0, side * w * 0.38, h + 0.16),
        )


def _boot(b: Builder) -> None:
    leather, upper, sole_paint = b.paint("plain"), b.paint("cloth"), b.paint("plastic")
    length, w, h = b.between(0.80, 0.90), b.between(0.30, 0.34), b.between(0.72, 0.82)
    heel_x, toe_x = -length * 0.36, length * 0.58

    def outline(z: float, grow: float, toe: float) -> list[tuple[float, float, float]]:
        angle = np.linspace(0, 2 * np.pi, 21)[:-1]
        x, y = np.cos(angle), np.sin(angle)
        middle, reach = (heel_x + toe) / 2, (toe - heel_x) / 2
        return [
            (
                middle + reach * grow * (np.sign(c) * abs(c) ** 0.75),
                w / 2 * grow * (np.sign(s) * abs(s) ** 0.8),
                z,
            )
            for c, s in zip(x, y, strict=True)
        ]

    sole = b.part("sole", "bottom").put(
        sole_paint, loft([outline(0.06, 1.05, toe_x), outline(0.13, 1.08, toe_x)])
    )
    sole.subpart("heel", at="of").put(
        b.paint("plastic"), box((0.30, w * 1.02, 0.13), (heel_x + 0.15, 0, 0.065), 0.02)
    )
    sections = [
        outline(0.12, 1.0, toe_x),
        outline(0.24, 0.98, toe_x * 0.97),
        outline(0.34, 0.88, toe_x * 0.72),
        outline(0.42, 0.80, toe_x * 0.36),
    ]
    foot = b.part("foot", "vamp").put(leather, loft(sections))
    foot.subpart("toe cap", "toe", at="of").put(
        b.paint("plastic"), ellipsoid((0.22, w * 0.50, 0.185), (toe_x - 0.17, 0, 0.15))
    )
    cx = heel_x + 0.20
    profile = [(0.175, 0.20), (0.165, 0.42), (0.19, h), (0.15, h), (0.14, 0.5), (0, 0.45)]
    shaft = b.part("shaft", "leg").put(upper, lathe(profile).scaled(1.1, 0.9, 1).moved(cx))
    shaft.subpart("cuff", "fur trim").put(
        b.paint("fur"), ring(0.185, 0.07, (0, 0, h - 0.03)).scaled(1.1, 0.92, 1).moved(cx)
    )
    shaft.subpart("pull tab", "heel loop").put(
        b.paint("cloth"), box((0.06, 0.14, 0.26), (heel_x + 0.005, 0, h * 0.66), 0.02)
    )
    laces = b.part("laces", "shoelaces")
    paint = b.paint("cloth")
    for k in range(4):
        z = 0.37 + 0.085 * k
        x = cx + 0.20 + (0.14 - 0.13 * k if k < 2 else 0.0)
        laces.put(
            paint, sweep([(x - 0.03, -w * 0.34, z), (x + 0.02, 0, z + 0.03), (x - 0.03, w * 0.34, z)], 0.032)
        )
    bow = laces.subpart("bow", "knot")
    bx = cx + 0.26
    for side in (-1, 1):
        bow.put(
            b.paint("cloth") if side < 0 else paint,
            ellipsoid((0.05, 0.12, 0.07)).turned("x", side * 20).moved(bx, side * 0.12, h - 0.13),
        )
    b.turn(-40)


def _lantern(b: Builder) -> None:
    metal = b.paint("metal")
    glass = b.paint("plastic", "yellow", "white", "orange", "teal")
    glow = b.paint("plain", "red", "orange", "yellow")
    r, h = b.between(0.25, 0.29), b.between(0.40, 0.46)
    low = 0.20
    base = b.part("base", "oil tank", "foot").put(
        metal, lathe([(0, 0), (r * 1.15, 0), (r * 1.15, 0.05), (r * 0.95, 0.10), (r * 0.95, low), (0, low)])
    )
    base.subpart("band", "ring").put(
        b.paint("ceramic"), lathe([(r * 0.95, 0.11), (r * 1.06, 0.12), (r * 1.06, 0.185), (r * 0.95, 0.195)])
    )
    base.subpart("knob", "wick wheel").put(
        b.paint("plastic"), disc(0.075, 0, 0.16, 20, 0.02).moved(r * 0.92, 0, 0.085)
    )
    lamp = b.part("glass", "globe", "window").put(
        glass,
        lathe([(r * 0.62, low), (r * 0.80, low + h * 0.35), (r * 0.80, low + h * 0.6), (r * 0.60, low + h)]),
    )
    flame = lamp.subpart("flame", "light")
    for a in range(0, 360, 90):
        # The flame is on each side of the glass, because the inside of an opaque globe is never visible.
        shape = (
            lathe([(0, -0.02), (0.085, 0.06), (0.06, 0.14), (0, 0.25)])
            .scaled(0.30, 1, 1)
            .moved(r * 0.80, 0, low + h * 0.28)
        )
        flame.put(glow, shape.turned("z", a + 45))
    cage = b.part("cage", "bars", "guard")
    bar = b.paint("plain", "black", "grey", "brown", "red", "blue")
    for a in range(0, 360, 90):
        cage.put(bar, box((0.05, 0.05, h), (r * 0.92, 0, low + h / 2), 0.012).turned("z", a))
    cage.subpart("hoop", "middle ring").put(b.paint("metal"), ring(r * 0.95, 0.032, (0, 0, low + h * 0.16)))
    roof, top = b.part("roof", "cap", "hood"), low + h
    profile = [
        (0, top - 0.01),
        (r * 1.2, top),
        (r * 1.12, top + 0.06),
        (r * 0.55, top + 0.20),
        (0, top + 0.21),
    ]
    roof.put(metal, lathe(profile))
    roof.subpart("chimney", "vent").put(
        b.paint("plastic"),
        lathe([(0.085, 0), (0.085, 0.08), (0.14, 0.09), (0.14, 0.145), (0, 0.17)]).moved(z=top + 0.17),
    )
    path = [(0, y, top + 0.08 + z) for y, _, z in arc((r * 1.22, 0.42), -4, 184)]
    handle = b.part("handle", "bail").put(b.paint("metal"), sweep(path, 0.03))
    grip = [(0, y, top + 0.08 + z) for y, _, z in arc((r * 1.22, 0.42), 58, 122)]
    handle.subpart("grip", at="of").put(b.paint("wood"), sweep(grip, 0.065))


def _chest(b: Builder) -> None:
    wood = b.paint("wood")
    metal = b.paint("metal")
    gold = b.paint("metal", "yellow", "orange")
    d, w, h = b.between(0.46, 0.54), b.between(0.74, 0.84), b.between(0.34, 0.40)
    chest = b.part("box", "trunk", "body").put(
        wood,
        box((d, w, 0.06), (0, 0, 0.05)),
        *[box((0.05, w, h), (s * (d / 2 - 0.025), 0, h / 2 + 0.02)) for s in (-1, 1)],
        *[box((d, 0.05, h), (0, s * (w / 2 - 0.025), h / 2 + 0.02)) for s in (-1, 1)],
    )
    bands = chest.subpart("bands", "straps", "iron bands")
    for side, x in CORNERS:
        bands.put(
            metal, box((0.05, 0.105, h + 0.02), (x * (d / 2 + 0.005), side * w * 0.33, h / 2 + 0.02), 0.01)
        )
    chest.subpart("lock", "padlock").put(
        b.paint("metal"), box((0.08, 0.19, 0.20), (d / 2 + 0.02, 0, h - 0.08), 0.03)
    )
    handles = chest.subpart("handles", "side rings")
    for side in (-1, 1):
        handles.put(b.paint("metal"), ring(0.10, 0.035, (0, side * (w / 2 + 0.03), h * 0.52), "y"))
    lid, r = b.part("lid", "cover"), d / 2
    half = [(r * np.cos(a), r * np.sin(a) * 0.8) for a in np.linspace(0, np.pi, 13)]
    back = (-d / 2, h + 0.02)

    def opened(mesh):
        """Rotate a mesh by 50 degrees about the hinge at the upper back edge."""
        return mesh.moved(r, 0, 0).turned("y", -50).moved(back[0], 0, back[1])

    lid.put(b.paint("wood"), opened(extrude(half, w)))
    lid.subpart("lining", "inside", at="of").put(
        b.paint("cloth"), opened(box((d * 0.84, w * 0.88, 0.03), (0, 0, -0.01)))
    )
    lid_bands = lid.subpart("hoops", "lid bands")
    wider = [(x * 1.04, z * 1.05) for x, z in half]
    for side in (-1, 1):
        lid_bands.put(metal, opened(extrude(wider, 0.105).moved(0, side * w * 0.33, 0)))
    treasure = b.part("gold", "coins", "gold coins").put(
        gold, ellipsoid((d * 0.42, w * 0.44, 0.16), (0, 0, h - 0.04))
    )
    gems = treasure.subpart("gems", "jewels")
    jewel = b.paint("ceramic", "red", "green", "blue", "purple", "teal", "pink")
    for x, y in ((0.10, -0.20), (0.12, 0.06), (0.05, 0.25), (-0.02, -0.04)):
        gems.put(jewel, ellipsoid((0.08, 0.085, 0.075), (x, y * w / 0.8, h + 0.06 + 0.05 * (0.12 - x)), 8, 4))


MAKERS: dict[str, Maker] = {
    "backpack": Maker(_backpack, ("rucksack", "school bag")),
    "boot": Maker(_boot, ("winter boot", "ankle boot")),
    "lantern": Maker(_lantern, ("oil lantern", "storm lantern")),
    "treasure chest": Maker(_chest, ("pirate chest", "money chest")),
}
