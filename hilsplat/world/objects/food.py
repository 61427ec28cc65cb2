"""Food and its containers: each function draws one class of object."""

import numpy as np

from hilsplat.world.objects.builder import Builder, Maker
from hilsplat.world.shapes import arc, box, cylinder, ellipsoid, extrude, lathe, ring, sphere, sweep


def _frying_pan(b: Builder) -> None:
    metal, inner = b.paint("metal"), b.paint("plain", "black", "grey", "teal", "brown")
    r, h = b.between(0.40, 0.45), b.between(0.13, 0.17)
    pan = b.part("pan", "body", "dish").put(metal, lathe([(0, 0), (r * 0.82, 0), (r, h)], 36))
    pan.subpart("inside", "cooking surface", at="of").put(
        inner, lathe([(r - 0.02, h - 0.01), (r * 0.80, 0.035), (0, 0.03)], 36)
    )
    pan.subpart("rim", "edge", at="of").put(
        b.paint("ceramic"), ring(r + 0.005, 0.042, (0, 0, h), segments=36)
    )
    white = b.paint("snow", "white")
    egg = b.part("fried egg", "egg").put(
        white,
        *[
            ellipsoid((size, size * 0.85, 0.035), (x, y, 0.055))
            for size, x, y in ((0.20, -0.05, -0.03), (0.14, 0.07, 0.07), (0.13, -0.06, 0.12))
        ],
    )
    egg.subpart("yolk", "egg yellow").put(
        b.paint("plastic", "yellow", "orange"), ellipsoid((0.13, 0.13, 0.085), (-0.02, 0.02, 0.085))
    )
    bacon = b.part("bacon", "bacon strip")
    strip = b.paint("plain", "red", "brown", "pink")
    fat = b.paint("plain", "beige", "white", "yellow", "orange")
    for k in range(5):
        x = -0.18 + 0.09 * k
        bacon.put(strip, box((0.095, 0.13, 0.05), (x, -0.26 + 0.02 * (k % 2), 0.075 + 0.02 * (k % 2)), 0.01))
    bacon.subpart("fat", "fat stripe").put(fat, box((0.47, 0.075, 0.05), (0, -0.25, 0.115), 0.01))
    path = [(r * 0.9, 0, h * 0.7), (r + 0.12, 0, h + 0.07), (r + 0.22, 0, h + 0.11)]
    handle = b.part("handle").put(b.paint("metal"), sweep(path, [0.07, 0.065, 0.065]))
    end = r + 0.46
    handle.subpart("grip", at="of").put(
        b.paint("plastic"),
        sweep([(r + 0.17, 0, h + 0.10), (r + 0.32, 0, h + 0.15), (end, 0, h + 0.16)], [0.08, 0.105, 0.08]),
    )
    handle.subpart("hanging ring", "ring").put(b.paint("metal"), ring(0.085, 0.04, (end + 0.08, 0, h + 0.16)))


def _burger(b: Builder) -> None:
    bread = b.paint("plain", "orange", "beige", "brown")
    seeds = b.paint("snow", "white", "beige", "black", "yellow")
    meat, cheese = b.paint("plain", "brown", "red", "black"), b.paint("plain", "yellow", "orange")
    r = b.between(0.38, 0.42)
    plate = b.part("plate", "dish").put(
        b.paint("ceramic"), lathe([(0, 0), (r * 0.9, 0), (r + 0.12, 0.06), (r + 0.10, 0.075), (0, 0.05)], 36)
    )
    plate.subpart("rim", "edge", at="of").put(
        b.paint("ceramic"),
        lathe([(r + 0.03, 0.04), (r + 0.17, 0.065), (r + 0.17, 0.095), (r + 0.04, 0.085)], 36),
    )
    low = b.part("bottom bun", "lower bun").put(
        bread, lathe([(0, 0.05), (r * 0.92, 0.05), (r, 0.10), (r, 0.17), (0, 0.18)], 32)
    )
    low.subpart("lettuce", "salad leaf").put(
        b.paint("plain", "green"),
        *[
            ellipsoid((0.15, 0.18, 0.04)).turned("y", 14).moved(r * 0.94, 0, 0.20).turned("z", a)
            for a in range(0, 360, 45)
        ],
    )
    profile = [(0, 0.19), (r * 0.98, 0.20), (r * 1.04, 0.25), (r * 1.04, 0.31), (r * 0.96, 0.35), (0, 0.36)]
    patty = b.part("patty", "meat").put(meat, lathe(profile, 32))
    slab = box((r * 1.62, r * 1.62, 0.045), (0, 0, 0.365), 0.01)
    drip = [
        extrude([(-0.16, 0), (0.16, 0), (0, -0.14)], 0.04)
        .turned("z", 90)
        .moved(r * 0.98, 0, 0.385)
        .turned("z", a)
        for a in (0, 90, 180, 270)
    ]
    patty.subpart("cheese", "cheese slice").put(cheese, slab, *drip)
    patty.subpart("tomato", "tomato slices").put(
        b.paint("plastic", "red", "pink", "purple"),
        *[
            cylinder(0.20, 0.385, 0.445, 24, 0.02).moved(r * 0.60 * np.cos(a), r * 0.60 * np.sin(a))
            for a in (0.5, 2.6, 4.7)
        ],
    )
    profile = [(0, 0.44), (r * 0.98, 0.45), (r * 1.02, 0.52), (r * 0.92, 0.64), (r * 0.6, 0.75), (0, 0.80)]
    top = b.part("top bun", "upper bun").put(bread, lathe(profile, 32))
    top.subpart("seeds", "sesame").put(
        seeds,
        *[
            ellipsoid((0.055, 0.045, 0.03)).turned("y", 38).moved(r * 0.68, 0, 0.73).turned("z", a)
            for a in range(0, 360, 45)
        ],
        *[
            ellipsoid((0.05, 0.06, 0.03), (r * 0.28 * np.cos(a), r * 0.28 * np.sin(a), 0.785))
            for a in (0.4, 2.5, 4.6)
        ],
    )
    pick = b.part("skewer", "toothpick").put(b.paint("wood"), cylinder(0.03, 0.75, 1.12, 14))
    pick.subpart("flag", "paper flag").put(b.paint("cloth"), box((0.04, 0.24, 0.17), (0, 0.12, 1.02), 0.008))
    pick.subpart("olive", "ball").put(
        b.paint("plastic", "green", "red", "purple"), sphere(0.085, (0, 0, 0.86))
    )


def _fruit_basket(b: Builder) -> None:
    straw, trim = b.paint("cloth", "beige", "brown", "orange", "white"), b.paint("wood")
    r, h = b.between(0.38, 0.42), b.between(0.24, 0.28)
    profile = [(0, 0), (r * 0.74, 0), (r * 0.92, h * 0.5), (r, h), (r - 0.05, h), (r * 0.7, 0.10), (0, 0.10)]
    basket = b.part("bowl", "basket").put(straw, lathe(profile, 36))
    basket.subpart("rim", "edge", at="of").put(trim, ring(r - 0.01, 0.052, (0, 0, h), segments=36))
    basket.subpart("band", "stripe").put(
        b.paint("cloth"),
        lathe([(r * 0.80, h * 0.24), (r * 0.88, h * 0.25), (r * 0.965, h * 0.56), (r * 0.93, h * 0.57)], 36),
    )
    path = [(0, y, h + z) for y, _, z in arc((r, 0.50), 0, 180)]
    handle = b.part("handle").put(trim, sweep(path, 0.042))
    handle.subpart("ribbon", "bow").put(
        b.paint("cloth"),
        sphere(0.075, (0, 0, h + 0.50)),
        *[ellipsoid((0.055, 0.14, 0.09)).turned("x", s * 15).moved(0, s * 0.16, h + 0.51) for s in (-1, 1)],
    )
    apple_paint = b.paint("plastic", "red", "green", "yellow", "pink")
    stem = b.paint("plain", "green", "brown", "black")
    for x, y in ((0.17, -0.17), (0.20, 0.14)):
        z = h + 0.07
        apple = b.part("apple").put(apple_paint, ellipsoid((0.16, 0.16, 0.15), (x, y, z)))
        apple.subpart("leaf", "stalk").put(
            stem,
            cylinder(0.022, z + 0.12, z + 0.22, 10).moved(x, y),
            ellipsoid((0.10, 0.06, 0.025), (x + 0.07, y, z + 0.19)),
        )
    orange = b.part("orange", "tangerine").put(
        b.paint("plain", "orange"), sphere(0.15, (-0.19, -0.13, h + 0.06))
    )
    orange.subpart("sticker", "label").put(
        b.paint("plain", "blue", "white", "green"),
        ellipsoid((0.105, 0.105, 0.035)).turned("y", -30).moved(-0.26, -0.13, h + 0.178),
    )
    curve = [
        (-0.19 + 0.13 * np.sin(a), 0.02 + 0.30 * np.sin(1.2 * a) * 0.8, h + 0.30 - 0.24 * np.cos(a))
        for a in np.linspace(-1.1, 1.1, 9)
    ]
    banana = b.part("banana", "bananas").put(
        b.paint("plain", "yellow", "green"),
        sweep(curve, [0.05, 0.07, 0.085, 0.09, 0.09, 0.09, 0.085, 0.07, 0.05]),
    )
    dark = b.paint("plain", "brown", "black")
    banana.subpart("tips", "ends", at="of").put(
        dark, sphere(0.068, tuple(curve[0])), sphere(0.068, tuple(curve[-1]))
    )


def _ice_cream(b: Builder) -> None:
    waffle, cup = b.paint("plain", "orange", "brown", "beige"), b.paint("ceramic")
    r, h = b.between(0.24, 0.28), b.between(0.50, 0.58)
    profile = [
        (0, 0),
        (r * 1.25, 0),
        (r * 1.25, 0.05),
        (r * 0.55, 0.10),
        (r * 0.55, 0.22),
        (r * 0.9, 0.34),
        (r * 0.7, 0.34),
        (0, 0.25),
    ]
    stand = b.part("holder", "stand").put(cup, lathe(profile, 32))
    stand.subpart("ring", "band", at="of").put(b.paint("metal"), ring(r * 0.62, 0.055, (0, 0, 0.16)))
    low = 0.24
    cone = b.part("cone", "waffle").put(waffle, lathe([(0, low), (r * 0.45, low + 0.05), (r, low + h)], 32))
    profile = [
        (r * 0.86, low + h - 0.12),
        (r * 1.08, low + h - 0.10),
        (r * 1.14, low + h + 0.03),
        (r * 0.8, low + h + 0.03),
    ]
    cone.subpart("rim", "edge", at="of").put(b.paint("plain"), lathe(profile, 32))
    z = low + h + 0.10
    taste, crumb = b.paint("snow"), b.paint("plastic")
    for side in (-1, 1):
        scoop = b.part("scoop", "ball", "lower scoop").put(taste, sphere(r * 0.72, (0, side * r * 0.55, z)))
        sprinkles = scoop.subpart("sprinkles", "crumbs")
        for a, e in ((0.2, 0.1), (1.1, 0.5), (2.2, 0.1), (3.3, 0.5), (4.3, 0.1), (5.3, 0.4)):
            place = (
                r * 0.72 * np.cos(a) * np.cos(e),
                side * r * 0.55 + r * 0.72 * np.sin(a) * np.cos(e),
                z + r * 0.72 * np.sin(e),
            )
            sprinkles.put(crumb, sphere(0.055, place, 10))
    top = b.part("top scoop", "upper scoop").put(b.paint("snow"), sphere(r * 0.74, (0, 0, z + r * 0.85)))
    profile = [(r * 0.80, -0.06), (r * 0.74, 0.05), (r * 0.45, 0.17), (0, 0.21)]
    top.subpart("sauce", "syrup").put(
        b.paint("plastic", "brown", "red", "purple", "black"),
        lathe(profile, 28).moved(z=z + r * 0.86 + 0.02),
        *[
            ellipsoid((0.06, 0.06, 0.10), (r * 0.72 * np.cos(a), r * 0.72 * np.sin(a), z + r * 0.72))
            for a in (0.3, 1.6, 2.8, 4.1, 5.2)
        ],
    )
    top.subpart("cherry", "berry").put(
        b.paint("plastic", "red", "pink", "green"), sphere(0.10, (0, 0, z + r * 1.62 + 0.02))
    )
    wafer = b.part("wafer", "wafer stick").put(
        b.paint("plain", "beige", "brown", "yellow"),
        cylinder(0.055, 0, 0.46, 16).turned("y", -24).moved(-0.10, 0.03, z + 0.16),
    )
    wafer.subpart("tip", "end", at="of").put(
        b.paint("plain"), cylinder(0.07, 0.34, 0.48, 16, 0.01).turned("y", -24).moved(-0.10, 0.03, z + 0.16)
    )


MAKERS: dict[str, Maker] = {
    "frying pan": Maker(_frying_pan, ("skillet",)),
    "burger": Maker(_burger, ("hamburger", "cheeseburger")),
    "fruit basket": Maker(_fruit_basket, ("fruit bowl", "basket of fruit")),
    "ice cream": Maker(_ice_cream, ("ice cream sundae", "gelato")),
}
