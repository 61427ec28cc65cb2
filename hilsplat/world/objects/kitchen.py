"""Kitchen objects: each function draws one class of object."""

import numpy as np

from hilsplat.world.objects.builder import Builder, Maker
from hilsplat.world.shapes import arc, cylinder, ellipsoid, lathe, sphere, sweep


def _mug(b: Builder) -> None:
    glaze, inner, accent = b.paints.draw("ceramic"), b.paints.draw("ceramic"), b.paints.draw("ceramic")
    r, h = b.between(0.36, 0.44), b.between(0.80, 1.0)
    flare = b.between(0.94, 1.08)
    cup = b.part("cup", "body")
    top = r * flare
    b.put(cup, glaze, lathe([(0, 0), (r * 0.92, 0), (r, 0.06), (top, h * 0.86)]))
    inside = b.subpart(cup, "inside", "interior")
    b.put(inside, inner, lathe([(top - 0.05, h), (r - 0.05, 0.12), (0, 0.12)]))
    rim = b.subpart(cup, "rim", "edge")
    b.put(
        rim,
        accent,
        lathe(
            [
                (top, h * 0.86),
                (top + 0.035, h * 0.88),
                (top + 0.035, h),
                (top - 0.05, h),
                (top - 0.06, h - 0.04),
            ]
        ),
    )
    band = b.subpart(cup, "band", "stripe")
    low, high = h * 0.34, h * 0.54
    b.put(
        band,
        b.paints.draw("ceramic"),
        lathe([(r, low), (r * 1.05, low + 0.02), (r * 1.05, high - 0.02), (r, high)]),
    )
    handle = b.part("handle")
    path = [(x + r * 0.94, y, z + h * 0.47) for x, y, z in arc((r * 0.75, h * 0.30), -88, 88)]
    b.put(handle, accent, sweep(path, 0.065).turned("z", 90))
    rest = b.subpart(handle, "thumb rest", "knob")
    b.put(rest, inner, ellipsoid((0.13, 0.14, 0.085), (0, r * 1.5, h * 0.77)))


def _kettle(b: Builder) -> None:
    metal, accent, dark = b.paints.draw("metal"), b.paints.draw("ceramic"), b.paints.draw("plastic")
    r, h = b.between(0.40, 0.46), b.between(0.50, 0.62)
    body = b.part("body", "pot")
    b.put(
        body,
        metal,
        lathe([(0, 0.05), (r, 0.05), (r * 1.04, h * 0.35), (r * 0.9, h * 0.75), (r * 0.62, h), (0, h)]),
    )
    base = b.subpart(body, "base", "bottom ring")
    b.put(base, dark, lathe([(0, 0), (r * 1.06, 0), (r * 1.08, 0.10), (r * 1.0, 0.13)]))
    lid = b.part("lid", "cover")
    b.put(
        lid, accent, lathe([(r * 0.70, h - 0.02), (r * 0.70, h + 0.03), (r * 0.5, h + 0.10), (0, h + 0.13)])
    )
    knob = b.subpart(lid, "knob", "button")
    b.put(knob, dark, ellipsoid((0.12, 0.12, 0.10), (0, 0, h + 0.20)))
    spout = b.part("spout")
    start = np.array([r * 0.85, 0, h * 0.35])
    b.put(
        spout,
        metal,
        sweep(
            [start, start + np.array([0.18, 0, 0.10]), start + np.array([0.27, 0, 0.26])],
            [0.14, 0.10, 0.075],
        ),
    )
    tip = b.subpart(spout, "tip", "mouth")
    lip = [start + np.array([0.255, 0, 0.235]), start + np.array([0.33, 0, 0.37])]
    b.put(tip, accent, sweep(lip, [0.085, 0.10]))
    handle = b.part("handle")
    b.put(handle, dark, sweep([(x, 0, z + h * 0.72) for x, _, z in arc((r * 0.92, 0.50), 4, 176)], 0.045))
    grip = b.subpart(handle, "grip")
    b.put(grip, accent, sweep([(x, 0, z + h * 0.72) for x, _, z in arc((r * 0.92, 0.50), 55, 125)], 0.075))


def _bottle(b: Builder) -> None:
    glass, label_paint, cap_paint = (
        b.paints.draw("ceramic", "green", "teal", "blue", "brown", "purple", "red"),
        b.paints.draw("plain", "white", "beige", "yellow", "orange", "pink"),
        b.paints.draw("metal"),
    )
    r, h = b.between(0.22, 0.26), b.between(0.62, 0.72)
    neck_r = b.between(0.085, 0.10)
    body = b.part("body")
    b.put(
        body,
        glass,
        lathe([(0, 0), (r * 0.93, 0), (r, 0.04), (r, h * 0.78), (r * 0.86, h * 0.9), (neck_r * 1.15, h)]),
    )
    label = b.subpart(body, "label", "sticker")
    b.put(
        label,
        label_paint,
        lathe([(r, h * 0.28), (r * 1.035, h * 0.29), (r * 1.035, h * 0.64), (r, h * 0.65)]),
    )
    foot = b.subpart(body, "base", "bottom")
    b.put(
        foot,
        b.paints.draw("ceramic"),
        lathe([(0, -0.005), (r * 1.04, -0.005), (r * 1.05, 0.10), (r, 0.11)]).moved(z=0.005),
    )
    neck = b.part("neck")
    top = h + b.between(0.20, 0.26)
    b.put(neck, glass, lathe([(neck_r * 1.15, h), (neck_r, h + 0.04), (neck_r, top)]))
    ring = b.subpart(neck, "collar", "ring")
    b.put(
        ring,
        b.paints.draw("ceramic"),
        lathe([(neck_r, h + 0.04), (neck_r + 0.05, h + 0.06), (neck_r + 0.05, h + 0.13), (neck_r, h + 0.15)]),
    )
    cap = b.part("cap", "lid")
    b.put(cap, cap_paint, cylinder(neck_r + 0.045, top - 0.03, top + 0.10, bevel=0.015))
    button = b.subpart(cap, "knob", "stopper")
    b.put(button, b.paints.draw("plastic"), ellipsoid((neck_r * 0.9, neck_r * 0.9, 0.07), (0, 0, top + 0.13)))


def _cake(b: Builder) -> None:
    sponge, icing, cream = (
        b.paints.draw("plain", "brown", "beige", "pink", "yellow", "teal"),
        b.paints.draw("snow", "white", "pink", "beige", "purple", "red", "teal"),
        b.paints.draw("plain"),
    )
    plate_paint, cherry = (
        b.paints.draw("ceramic"),
        b.paints.draw("plastic", "red", "purple", "orange", "green"),
    )
    r, h = b.between(0.36, 0.42), b.between(0.22, 0.27)
    plate = b.part("plate", "dish")
    b.put(
        plate, plate_paint, lathe([(0, 0.0), (r * 0.8, 0.0), (r + 0.10, 0.05), (r + 0.10, 0.07), (0, 0.06)])
    )
    rim = b.subpart(plate, "rim", "edge")
    b.put(
        rim,
        b.paints.draw("ceramic"),
        lathe([(r + 0.03, 0.045), (r + 0.15, 0.06), (r + 0.15, 0.09), (r + 0.04, 0.085)], 36),
    )
    lower = b.part("bottom tier", "lower layer")
    b.put(lower, sponge, cylinder(r, 0.06, 0.06 + h))
    frost = b.subpart(lower, "icing", "frosting")
    top = 0.06 + h
    b.put(
        frost,
        icing,
        lathe(
            [
                (r, top - 0.09),
                (r + 0.03, top - 0.08),
                (r + 0.03, top),
                (r - 0.02, top + 0.03),
                (0, top + 0.03),
            ]
        ),
    )
    upper = b.part("top tier", "upper layer")
    r2, top2 = r * b.between(0.55, 0.64), top + 0.03 + h * 0.85
    b.put(upper, cream, cylinder(r2, top + 0.02, top2))
    glaze = b.subpart(upper, "glaze", "topping")
    b.put(
        glaze,
        b.paints.draw("snow"),
        lathe(
            [
                (r2, top2 - 0.07),
                (r2 + 0.03, top2 - 0.06),
                (r2 + 0.03, top2),
                (r2 - 0.02, top2 + 0.03),
                (0, top2 + 0.03),
            ]
        ),
    )
    cherries = b.subpart(lower, "cherries", "berries")
    for i in range(6):
        a = 2 * np.pi * i / 6
        b.put(
            cherries,
            cherry,
            sphere(
                0.068, ((r + r2) / 2 * np.cos(a) * 1.02, (r + r2) / 2 * np.sin(a) * 1.02, top + 0.075), 16
            ),
        )
    candle = b.part("candle")
    b.put(candle, b.paints.draw("ceramic"), cylinder(0.062, top2 + 0.02, top2 + 0.25))
    b.put(
        b.subpart(candle, "flame", "fire"),
        b.paints.draw("plain", "yellow", "orange"),
        lathe([(0, 0), (0.09, 0.07), (0.065, 0.14), (0, 0.24)]).moved(z=top2 + 0.25),
    )


MAKERS: dict[str, Maker] = {
    "mug": Maker(_mug, ("coffee mug", "tea mug")),
    "kettle": Maker(_kettle, ("teapot", "tea kettle")),
    "bottle": Maker(_bottle, ("flask", "glass bottle")),
    "cake": Maker(_cake, ("birthday cake", "torte")),
}
"""Classes drawn by this module."""
