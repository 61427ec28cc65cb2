"""Pedestrian and cyclist. They face +x, with their base at z = 0; lengths are metres."""

import numpy as np

from hilsplat.world.objects.builder import Builder, Maker
from hilsplat.world.objects.street_paints import limb, plain, rubber
from hilsplat.world.paints import Paint
from hilsplat.world.shapes import box, cylinder, ellipsoid, sphere, sweep

SKIN = ("beige", "brown", "pink")


def _head(b: Builder, skin: Paint, x: float, z: float, radius: float) -> None:
    """Add a head with hair or a hat, centred at (x, 0, z)."""
    head = b.part("head").put(
        skin, ellipsoid((radius * 0.92, radius * 0.85, radius * 1.1), (x, 0, z), 18, 10)
    )
    head.put(skin, cylinder(radius * 0.5, z - radius * 1.5, z - radius * 0.6, 12).moved(x, 0, 0))
    shape = ellipsoid((radius * 1.02, radius * 1.02, radius * 0.85), (x - 0.06, 0, z + radius * 0.48), 18, 10)
    hair = head.subpart("hair").put(b.paint("plain", "brown", "black", "orange", "grey", "yellow"), shape)
    if b.chance(0.4):
        hair.put(
            b.paint("plain", "black"), ellipsoid((0.1, 0.13, 0.24), (x - radius * 0.95, 0, z - 0.08), 14, 8)
        )
    head.subpart("glasses", "sunglasses").put(
        plain(b, "black"),
        box((0.06, radius * 1.5, radius * 0.34), (x + radius * 0.86, 0, z + radius * 0.1), 0.02),
    )


def _pedestrian(b: Builder) -> None:
    skin = b.paint("plain", *SKIN)
    coat = b.paint("cloth", "red", "orange", "yellow", "green", "teal", "blue", "purple", "pink", "white")
    trousers = b.paint("plain", "blue", "black", "brown", "grey", "beige", "green")
    tall = b.between(1.62, 1.86)
    hip, shoulder = 0.49 * tall, 0.80 * tall
    stride = b.between(0.12, 0.26)
    spine = [(0, 0, hip - 0.08), (0, 0, hip + 0.2), (0, 0, shoulder - 0.12), (0, 0, shoulder + 0.03)]
    torso = b.part("torso", "upper body").put(
        coat, sweep(spine, [0.21, 0.22, 0.25, 0.13], 16).scaled(0.78, 1.0, 1.0)
    )
    torso.subpart("belt").put(
        plain(b, "black"), cylinder(0.24, hip + 0.03, hip + 0.13, 18, 0.01).scaled(0.78, 1.0, 1.0)
    )
    bag_paint = b.paint("cloth", "orange", "brown", "purple", "teal", "yellow", "red")
    if b.chance(0.6):
        torso.subpart("backpack", "bag", "rucksack").put(
            bag_paint, box((0.2, 0.38, 0.5), (-0.27, 0, shoulder - 0.32), 0.06)
        )
    else:
        bag = torso.subpart("shoulder bag", "bag", "handbag").put(
            bag_paint, box((0.32, 0.14, 0.3), (0.02, -0.36, hip + 0.05), 0.04)
        )
        strap = [(0.03, -0.36, hip + 0.18), (0.12, -0.2, shoulder - 0.18), (0.0, 0.12, shoulder + 0.02)]
        bag.put(bag_paint, sweep(strap, 0.025, 8))
    _head(b, skin, 0.02, shoulder + 0.25, 0.15)
    shoes = b.paint("plain", "white", "red", "brown", "black", "orange")
    for side in (-1, 1):
        swing = side * stride
        hand = (0.9 * swing + 0.05, side * 0.33, hip + 0.02)
        arm_path = [(0, side * 0.22, shoulder - 0.05), (0.2 * swing, side * 0.31, (shoulder + hip) / 2), hand]
        arm = b.part("arm", "sleeve").put(coat, limb(arm_path, [0.085, 0.075, 0.06]))
        arm.subpart("hand").put(skin, sphere(0.075, (hand[0], hand[1], hand[2] - 0.04), 12))
        foot = (-1.2 * swing, side * 0.12)
        leg_path = [(0, side * 0.11, hip), (-0.4 * swing, side * 0.12, 0.27 * tall), (*foot, 0.1)]
        leg = b.part("leg", "trousers").put(trousers, limb(leg_path, [0.13, 0.1, 0.075]))
        leg.subpart("shoe", "foot").put(
            shoes, box((0.31, 0.14, 0.13), (foot[0] + 0.06, foot[1], 0.065), 0.04)
        )


def _cyclist(b: Builder) -> None:
    skin = b.paint("plain", *SKIN)
    shirt = b.paint("cloth", "red", "orange", "yellow", "green", "blue", "purple", "pink", "white")
    trousers = b.paint("plain", "black", "blue", "grey", "brown")
    metal = b.paint("plain", "red", "teal", "yellow", "green", "white", "orange")
    dark = rubber(b)
    radius, reach = 0.36, 0.56
    cycle = b.part("bicycle", "bike")
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
    rings = cycle.subpart("wheels", "tyres")
    for x in (-reach, reach):
        circle = [
            (x + radius * np.cos(a), 0.0, radius + 0.02 + radius * np.sin(a))
            for a in np.linspace(0, 2 * np.pi, 22)
        ]
        rings.put(dark, sweep(circle, 0.04, 8))
        for a in np.linspace(0, np.pi, 5)[:-1]:
            dx, dz = radius * np.cos(a), radius * np.sin(a)
            rings.put(dark, sweep([(x - dx, 0, radius - dz), (x + dx, 0, radius + dz)], 0.012, 6))
    cycle.subpart("saddle", "seat").put(
        plain(b, "brown"), ellipsoid((0.17, 0.1, 0.06), (seat[0] - 0.02, 0, seat[2] + 0.02), 14, 8)
    )
    cycle.subpart("handlebar", "handlebars").put(
        plain(b, "black"),
        sweep([(0.36, -0.3, 1.1), (0.44, -0.14, 1.12), (0.44, 0.14, 1.12), (0.36, 0.3, 1.1)], 0.03, 8),
    )
    torso = b.part("torso", "upper body").put(
        shirt,
        limb([(-0.2, 0, 1.04), (-0.1, 0, 1.3), (0.05, 0, 1.54), (0.1, 0, 1.62)], [0.2, 0.22, 0.22, 0.12]),
    )
    pack = box((0.2, 0.36, 0.46), (0, 0, 0), 0.06).turned("y", 28).moved(-0.27, 0, 1.42)
    torso.subpart("backpack", "bag", "rucksack").put(
        b.paint("cloth", "orange", "brown", "purple", "teal", "yellow"), pack
    )
    _head(b, skin, 0.2, 1.8, 0.15)
    for side in (-1, 1):
        arm_path = [(0.05, side * 0.2, 1.52), (0.2, side * 0.3, 1.3), (0.36, side * 0.28, 1.16)]
        arm = b.part("arm", "sleeve").put(shirt, limb(arm_path, [0.085, 0.075, 0.06]))
        arm.subpart("hand").put(skin, sphere(0.07, (0.37, side * 0.27, 1.13), 12))
        low = 0.2 if side > 0 else 0.5
        leg_path = [
            (-0.18, side * 0.12, 1.02),
            (0.2, side * 0.15, 0.62 + 0.5 * low),
            (-0.02, side * 0.16, low + 0.07),
        ]
        leg = b.part("leg", "trousers").put(trousers, limb(leg_path, [0.13, 0.1, 0.07]))
        leg.subpart("shoe", "foot").put(
            plain(b, "white"), box((0.28, 0.12, 0.11), (0.03, side * 0.16, low), 0.035)
        )


MAKERS: dict[str, Maker] = {
    "pedestrian": Maker(_pedestrian, ("person", "walker")),
    "cyclist": Maker(_cyclist, ("bicyclist", "bike rider")),
}
