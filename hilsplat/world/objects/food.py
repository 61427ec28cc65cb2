"""Food and its containers: each function draws one class of object."""

import numpy as np

from hilsplat.world.objects.builder import Builder, Maker
from hilsplat.world.shapes import arc, box, cylinder, ellipsoid, extrude, lathe, ring, sphere, sweep


def _frying_pan(b: Builder) -> None:
    metal, inner = b.paints.draw("metal"), b.paints.draw("plain", "black", "grey", "teal", "brown")
    r, h = b.between(0.40, 0.45), b.between(0.13, 0.17)
    pan = b.part("pan", "body", "dish")
    b.put(pan, metal, lathe([(0, 0), (r * 0.82, 0), (r, h)], 36))
    inside = b.subpart(pan, "inside", "cooking surface", at="of")
    b.put(inside, inner, lathe([(r - 0.02, h - 0.01), (r * 0.80, 0.035), (0, 0.03)], 36))
    b.put(
        b.subpart(pan, "rim", "edge", at="of"),
        b.paints.draw("ceramic"),
        ring(r + 0.005, 0.042, (0, 0, h), segments=36),
    )
    egg = b.part("fried egg", "egg")
    white = b.paints.draw("snow", "white")
    b.put(
        egg,
        white,
        *[
            ellipsoid((size, size * 0.85, 0.035), (x, y, 0.055))
            for size, x, y in ((0.20, -0.05, -0.03), (0.14, 0.07, 0.07), (0.13, -0.06, 0.12))
        ],
    )
    b.put(
        b.subpart(egg, "yolk", "egg yellow"),
        b.paints.draw("plastic", "yellow", "orange"),
        ellipsoid((0.13, 0.13, 0.085), (-0.02, 0.02, 0.085)),
    )
    bacon = b.part("bacon", "bacon strip")
    strip, fat = (
        b.paints.draw("plain", "red", "brown", "pink"),
        b.paints.draw("plain", "beige", "white", "yellow", "orange"),
    )
    for k in range(5):
        x = -0.18 + 0.09 * k
        b.put(
            bacon, strip, box((0.095, 0.13, 0.05), (x, -0.26 + 0.02 * (k % 2), 0.075 + 0.02 * (k % 2)), 0.01)
        )
    b.put(b.subpart(bacon, "fat", "fat stripe"), fat, box((0.47, 0.075, 0.05), (0, -0.25, 0.115), 0.01))
    handle = b.part("handle")
    b.put(
        handle,
        b.paints.draw("metal"),
        sweep(
            [(r * 0.9, 0, h * 0.7), (r + 0.12, 0, h + 0.07), (r + 0.22, 0, h + 0.11)], [0.07, 0.065, 0.065]
        ),
    )
    end = r + 0.46
    b.put(
        b.subpart(handle, "grip", at="of"),
        b.paints.draw("plastic"),
        sweep([(r + 0.17, 0, h + 0.10), (r + 0.32, 0, h + 0.15), (end, 0, h + 0.16)], [0.08, 0.105, 0.08]),
    )
    b.put(
        b.subpart(handle, "hanging ring", "ring"),
        b.paints.draw("metal"),
        ring(0.085, 0.04, (end + 0.08, 0, h + 0.16)),
    )


def _burger(b: Builder) -> None:
    bread, seeds = (
        b.paints.draw("plain", "orange", "beige", "brown"),
        b.paints.draw("snow", "white", "beige", "black", "yellow"),
    )
    meat, cheese = b.paints.draw("plain", "brown", "red", "black"), b.paints.draw("plain", "yellow", "orange")
    r = b.between(0.38, 0.42)
    plate = b.part("plate", "dish")
    b.put(
        plate,
        b.paints.draw("ceramic"),
        lathe([(0, 0), (r * 0.9, 0), (r + 0.12, 0.06), (r + 0.10, 0.075), (0, 0.05)], 36),
    )
    b.put(
        b.subpart(plate, "rim", "edge", at="of"),
        b.paints.draw("ceramic"),
        lathe([(r + 0.03, 0.04), (r + 0.17, 0.065), (r + 0.17, 0.095), (r + 0.04, 0.085)], 36),
    )
    low = b.part("bottom bun", "lower bun")
    b.put(low, bread, lathe([(0, 0.05), (r * 0.92, 0.05), (r, 0.10), (r, 0.17), (0, 0.18)], 32))
    b.put(
        b.subpart(low, "lettuce", "salad leaf"),
        b.paints.draw("plain", "green"),
        *[
            ellipsoid((0.15, 0.18, 0.04)).turned("y", 14).moved(r * 0.94, 0, 0.20).turned("z", a)
            for a in range(0, 360, 45)
        ],
    )
    patty = b.part("patty", "meat")
    b.put(
        patty,
        meat,
        lathe(
            [(0, 0.19), (r * 0.98, 0.20), (r * 1.04, 0.25), (r * 1.04, 0.31), (r * 0.96, 0.35), (0, 0.36)], 32
        ),
    )
    slab = box((r * 1.62, r * 1.62, 0.045), (0, 0, 0.365), 0.01)
    drip = [
        extrude([(-0.16, 0), (0.16, 0), (0, -0.14)], 0.04)
        .turned("z", 90)
        .moved(r * 0.98, 0, 0.385)
        .turned("z", a)
        for a in (0, 90, 180, 270)
    ]
    b.put(b.subpart(patty, "cheese", "cheese slice"), cheese, slab, *drip)
    b.put(
        b.subpart(patty, "tomato", "tomato slices"),
        b.paints.draw("plastic", "red", "pink", "purple"),
        *[
            cylinder(0.20, 0.385, 0.445, 24, 0.02).moved(r * 0.60 * np.cos(a), r * 0.60 * np.sin(a))
            for a in (0.5, 2.6, 4.7)
        ],
    )
    top = b.part("top bun", "upper bun")
    b.put(
        top,
        bread,
        lathe(
            [(0, 0.44), (r * 0.98, 0.45), (r * 1.02, 0.52), (r * 0.92, 0.64), (r * 0.6, 0.75), (0, 0.80)], 32
        ),
    )
    b.put(
        b.subpart(top, "seeds", "sesame"),
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
    pick = b.part("skewer", "toothpick")
    b.put(pick, b.paints.draw("wood"), cylinder(0.03, 0.75, 1.12, 14))
    b.put(
        b.subpart(pick, "flag", "paper flag"),
        b.paints.draw("cloth"),
        box((0.04, 0.24, 0.17), (0, 0.12, 1.02), 0.008),
    )
    b.put(
        b.subpart(pick, "olive", "ball"),
        b.paints.draw("plastic", "green", "red", "purple"),
        sphere(0.085, (0, 0, 0.86)),
    )


def _fruit_basket(b: Builder) -> None:
    straw, trim = b.paints.draw("cloth", "beige", "brown", "orange", "white"), b.paints.draw("wood")
    r, h = b.between(0.38, 0.42), b.between(0.24, 0.28)
    basket = b.part("bowl", "basket")
    b.put(
        basket,
        straw,
        lathe(
            [(0, 0), (r * 0.74, 0), (r * 0.92, h * 0.5), (r, h), (r - 0.05, h), (r * 0.7, 0.10), (0, 0.10)],
            36,
        ),
    )
    b.put(b.subpart(basket, "rim", "edge", at="of"), trim, ring(r - 0.01, 0.052, (0, 0, h), segments=36))
    b.put(
        b.subpart(basket, "band", "stripe"),
        b.paints.draw("cloth"),
        lathe([(r * 0.80, h * 0.24), (r * 0.88, h * 0.25), (r * 0.965, h * 0.56), (r * 0.93, h * 0.57)], 36),
    )
    handle = b.part("handle")
    path = [(0, y, h + z) for y, _, z in arc((r, 0.50), 0, 180)]
    b.put(handle, trim, sweep(path, 0.042))
    knot = b.subpart(handle, "ribbon", "bow")
    b.put(
        knot,
        b.paints.draw("cloth"),
        sphere(0.075, (0, 0, h + 0.50)),
        *[ellipsoid((0.055, 0.14, 0.09)).turned("x", s * 15).moved(0, s * 0.16, h + 0.51) for s in (-1, 1)],
    )
    apple_paint, stem = (
        b.paints.draw("plastic", "red", "green", "yellow", "pink"),
        b.paints.draw("plain", "green", "brown", "black"),
    )
    for x, y in ((0.17, -0.17), (0.20, 0.14)):
        apple = b.part("apple")
        z = h + 0.07
        b.put(apple, apple_paint, ellipsoid((0.16, 0.16, 0.15), (x, y, z)))
        b.put(
            b.subpart(apple, "leaf", "stalk"),
            stem,
            cylinder(0.022, z + 0.12, z + 0.22, 10).moved(x, y),
            ellipsoid((0.10, 0.06, 0.025), (x + 0.07, y, z + 0.19)),
        )
    orange = b.part("orange", "tangerine")
    b.put(orange, b.paints.draw("plain", "orange"), sphere(0.15, (-0.19, -0.13, h + 0.06)))
    b.put(
        b.subpart(orange, "sticker", "label"),
        b.paints.draw("plain", "blue", "white", "green"),
        ellipsoid((0.105, 0.105, 0.035)).turned("y", -30).moved(-0.26, -0.13, h + 0.178),
    )
    banana = b.part("banana", "bananas")
    curve = [
        (-0.19 + 0.13 * np.sin(a), 0.02 + 0.30 * np.sin(1.2 * a) * 0.8, h + 0.30 - 0.24 * np.cos(a))
        for a in np.linspace(-1.1, 1.1, 9)
    ]
    b.put(
        banana,
        b.paints.draw("plain", "yellow", "green"),
        sweep(curve, [0.05, 0.07, 0.085, 0.09, 0.09, 0.09, 0.085, 0.07, 0.05]),
    )
    tips = b.subpart(banana, "tips", "ends", at="of")
    dark = b.paints.draw("plain", "brown", "black")
    b.put(tips, dark, sphere(0.068, tuple(curve[0])), sphere(0.068, tuple(curve[-1])))


def _ice_cream(b: Builder) -> None:
    waffle, cup = b.paints.draw("plain", "orange", "brown", "beige"), b.paints.draw("ceramic")
    r, h = b.between(0.24, 0.28), b.between(0.50, 0.58)
    stand = b.part("holder", "stand")
    b.put(
        stand,
        cup,
        lathe(
            [
                (0, 0),
                (r * 1.25, 0),
                (r * 1.25, 0.05),
                (r * 0.55, 0.10),
                (r * 0.55, 0.22),
                (r * 0.9, 0.34),
                (r * 0.7, 0.34),
                (0, 0.25),
            ],
            32,
        ),
    )
    b.put(
        b.subpart(stand, "ring", "band", at="of"), b.paints.draw("metal"), ring(r * 0.62, 0.055, (0, 0, 0.16))
    )
    cone = b.part("cone", "waffle")
    low = 0.24
    b.put(cone, waffle, lathe([(0, low), (r * 0.45, low + 0.05), (r, low + h)], 32))
    b.put(
        b.subpart(cone, "rim", "edge", at="of"),
        b.paints.draw("plain"),
        lathe(
            [
                (r * 0.86, low + h - 0.12),
                (r * 1.08, low + h - 0.10),
                (r * 1.14, low + h + 0.03),
                (r * 0.8, low + h + 0.03),
            ],
            32,
        ),
    )
    z = low + h + 0.10
    taste, crumb = b.paints.draw("snow"), b.paints.draw("plastic")
    for side in (-1, 1):
        scoop = b.part("scoop", "ball", "lower scoop")
        b.put(scoop, taste, sphere(r * 0.72, (0, side * r * 0.55, z)))
        sprinkles = b.subpart(scoop, "sprinkles", "crumbs")
        for a, e in ((0.2, 0.1), (1.1, 0.5), (2.2, 0.1), (3.3, 0.5), (4.3, 0.1), (5.3, 0.4)):
            place = (
                r * 0.72 * np.cos(a) * np.cos(e),
                side * r * 0.55 + r * 0.72 * np.sin(a) * np.cos(e),
                z + r * 0.72 * np.sin(e),
            )
            b.put(sprinkles, crumb, sphere(0.055, place, 10))
    top = b.part("top scoop", "upper scoop")
    b.put(top, b.paints.draw("snow"), sphere(r * 0.74, (0, 0, z + r * 0.85)))
    sauce = b.subpart(top, "sauce", "syrup")
    b.put(
        sauce,
        b.paints.draw("plastic", "brown", "red", "purple", "black"),
        lathe([(r * 0.80, -0.06), (r * 0.74, 0.05), (r * 0.45, 0.17), (0, 0.21)], 28).moved(
            z=z + r * 0.86 + 0.02
        ),
        *[
            ellipsoid((0.06, 0.06, 0.10), (r * 0.72 * np.cos(a), r * 0.72 * np.sin(a), z + r * 0.72))
            for a in (0.3, 1.6, 2.8, 4.1, 5.2)
        ],
    )
    cherry = b.subpart(top, "cherry", "berry")
    b.put(cherry, b.paints.draw("plastic", "red", "pink", "green"), sphere(0.10, (0, 0, z + r * 1.62 + 0.02)))
    wafer = b.part("wafer", "wafer stick")
    b.put(
        wafer,
        b.paints.draw("plain", "beige", "brown", "yellow"),
        cylinder(0.055, 0, 0.46, 16).turned("y", -24).moved(-0.10, 0.03, z + 0.16),
    )
    b.put(
        b.subpart(wafer, "tip", "end", at="of"),
        b.paints.draw("plain"),
        cylinder(0.07, 0.34, 0.48, 16, 0.01).turned("y", -24).moved(-0.10, 0.03, z + 0.16),
    )


MAKERS: dict[str, Maker] = {
    "frying pan": Maker(_frying_pan, ("skillet",)),
    "burger": Maker(_burger, ("hamburger", "cheeseburger")),
    "fruit basket": Maker(_fruit_basket, ("fruit bowl", "basket of fruit")),
    "ice cream": Maker(_ice_cream, ("ice cream sundae", "gelato")),
}
"""Classes drawn by this module."""
