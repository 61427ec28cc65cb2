"""Kitchen objects: each function draws one class of object."""

import numpy as np

from hilsplat.world.objects.builder import Builder, Maker
from hilsplat.world.shapes import arc, cylinder, ellipsoid, lathe, sphere, sweep


def _mug(b: Builder) -> None:
    glaze, inner, accent = b.paint("ceramic"), b.paint("ceramic"), b.paint("ceramic")
    r, h = b.between(0.36, 0.44), b.between(0.80, 1.0)
    flare = b.between(0.94, 1.08)
    top = r * flare
    cup = b.part("cup", "body").put(glaze, lathe([(0, 0), (r * 0.92, 0), (r, 0.06), (top, h * 0.86)]))
    cup.subpart("inside", "interior").put(inner, lathe([(top - 0.05, h), (r - 0.05, 0.12), (0, 0.12)]))
    profile = [
        (top, h * 0.86),
        (top + 0.035, h * 0.88),
        (top + 0.035, h),
        (top - 0.05, h),
        (top - 0.06, h - 0.04),
    ]
    cup.subpart("rim", "edge").put(accent, lathe(profile))
    low, high = h * 0.34, h * 0.54
    cup.subpart("band", "stripe").put(
        b.paint("ceramic"), lathe([(r, low), (r * 1.05, low + 0.02), (r * 1.05, high - 0.02), (r, high)])
    )
    path = [(x + r * 0.94, y, z + h * 0.47) for x, y, z in arc((r * 0.75, h * 0.30), -88, 88)]
    handle = b.part("handle").put(accent, sweep(path, 0.065).turned("z", 90))
    handle.subpart("thumb rest", "knob").put(inner, ellipsoid((0.13, 0.14, 0.085), (0, r * 1.5, h * 0.77)))


def _kettle(b: Builder) -> None:
    metal, accent, dark = b.paint("metal"), b.paint("ceramic"), b.paint("plastic")
    r, h = b.between(0.40, 0.46), b.between(0.50, 0.62)
    body = b.part("body", "pot").put(
        metal, lathe([(0, 0.05), (r, 0.05), (r * 1.04, h * 0.35), (r * 0.9, h * 0.75), (r * 0.62, h), (0, h)])
    )
    body.subpart("base", "bottom ring").put(
        dark, lathe([(0, 0), (r * 1.06, 0), (r * 1.08, 0.10), (r * 1.0, 0.13)])
    )
    lid = b.part("lid", "cover").put(
        accent, lathe([(r * 0.70, h - 0.02), (r * 0.70, h + 0.03), (r * 0.5, h + 0.10), (0, h + 0.13)])
    )
    lid.subpart("knob", "button").put(dark, ellipsoid((0.12, 0.12, 0.10), (0, 0, h + 0.20)))
    start = np.array([r * 0.85, 0, h * 0.35])
    path = [start, start + np.array([0.18, 0, 0.10]), start + np.array([0.27, 0, 0.26])]
    spout = b.part("spout").put(metal, sweep(path, [0.14, 0.10, 0.075]))
    lip = [start + np.array([0.255, 0, 0.235]), start + np.array([0.33, 0, 0.37])]
    spout.subpart("tip", "mouth").put(accent, sweep(lip, [0.085, 0.10]))
    handle = b.part("handle").put(
        dark, sweep([(x, 0, z + h * 0.72) for x, _, z in arc((r * 0.92, 0.50), 4, 176)], 0.045)
    )
    handle.subpart("grip").put(
        accent, sweep([(x, 0, z + h * 0.72) for x, _, z in arc((r * 0.92, 0.50), 55, 125)], 0.075)
    )


def _bottle(b: Builder) -> None:
    glass = b.paint("ceramic", "green", "teal", "blue", "brown", "purple", "red")
    label_paint = b.paint("plain", "white", "beige", "yellow", "orange", "pink")
    cap_paint = b.paint("metal")
    r, h = b.between(0.22, 0.26), b.between(0.62, 0.72)
    neck_r = b.between(0.085, 0.10)
    body = b.part("body").put(
        glass,
        lathe([(0, 0), (r * 0.93, 0), (r, 0.04), (r, h * 0.78), (r * 0.86, h * 0.9), (neck_r * 1.15, h)]),
    )
    body.subpart("label", "sticker").put(
        label_paint, lathe([(r, h * 0.28), (r * 1.035, h * 0.29), (r * 1.035, h * 0.64), (r, h * 0.65)])
    )
    body.subpart("base", "bottom").put(
        b.paint("ceramic"),
        lathe([(0, -0.005), (r * 1.04, -0.005), (r * 1.05, 0.10), (r, 0.11)]).moved(z=0.005),
    )
    top = h + b.between(0.20, 0.26)
    neck = b.part("neck").put(glass, lathe([(neck_r * 1.15, h), (neck_r, h + 0.04), (neck_r, top)]))
    neck.subpart("collar", "ring").put(
        b.paint("ceramic"),
        lathe([(neck_r, h + 0.04), (neck_r + 0.05, h + 0.06), (neck_r + 0.05, h + 0.13), (neck_r, h + 0.15)]),
    )
    cap = b.part("cap", "lid").put(cap_paint, cylinder(neck_r + 0.045, top - 0.03, top + 0.10, bevel=0.015))
    cap.subpart("knob", "stopper").put(
        b.paint("plastic"), ellipsoid((neck_r * 0.9, neck_r * 0.9, 0.07), (0, 0, top + 0.13))
    )


def _cake(b: Builder) -> None:
    sponge = b.paint("plain", "brown", "beige", "pink", "yellow", "teal")
    icing = b.paint("snow", "white", "pink", "beige", "purple", "red", "teal")
    cream = b.paint("plain")
    plate_paint = b.paint("ceramic")
    cherry = b.paint("plastic", "red", "purple", "orange", "green")
    r, h = b.between(0.36, 0.42), b.between(0.22, 0.27)
    plate = b.part("plate", "dish").put(
        plate_paint, lathe([(0, 0.0), (r * 0.8, 0.0), (r + 0.10, 0.05), (r + 0.10, 0.07), (0, 0.06)])
    )
    plate.subpart("rim", "edge").put(
        b.paint("ceramic"),
        lathe([(r + 0.03, 0.045), (r + 0.15, 0.06), (r + 0.15, 0.09), (r + 0.04, 0.085)], 36),
    )
    lower = b.part("bottom tier", "lower layer").put(sponge, cylinder(r, 0.06, 0.06 + h))
    top = 0.06 + h
    profile = [
        (r, top - 0.09),
        (r + 0.03, top - 0.08),
        (r + 0.03, top),
        (r - 0.02, top + 0.03),
        (0, top + 0.03),
    ]
    lower.subpart("icing", "frosting").put(icing, lathe(profile))
    r2, top2 = r * b.between(0.55, 0.64), top + 0.03 + h * 0.85
    upper = b.part("top tier", "upper layer").put(cream, cylinder(r2, top + 0.02, top2))
    profile = [
        (r2, top2 - 0.07),
        (r2 + 0.03, top2 - 0.06),
        (r2 + 0.03, top2),
        (r2 - 0.02, top2 + 0.03),
        (0, top2 + 0.03),
    ]
    upper.subpart("glaze", "topping").put(b.paint("snow"), lathe(profile))
    cherries = lower.subpart("cherries", "berries")
    for i in range(6):
        a = 2 * np.pi * i / 6
        cherries.put(
            cherry,
            sphere(
                0.068, ((r + r2) / 2 * np.cos(a) * 1.02, (r + r2) / 2 * np.sin(a) * 1.02, top + 0.075), 16
            ),
        )
    candle = b.part("candle").put(b.paint("ceramic"), cylinder(0.062, top2 + 0.02, top2 + 0.25))
    candle.subpart("flame", "fire").put(
        b.paint("plain", "yellow", "orange"),
        lathe([(0, 0), (0.09, 0.07), (0.065, 0.14), (0, 0.24)]).moved(z=top2 + 0.25),
    )


MAKERS: dict[str, Maker] = {
    "mug": Maker(_mug, ("coffee mug", "tea mug")),
    "kettle": Maker(_kettle, ("teapot", "tea kettle")),
    "bottle": Maker(_bottle, ("flask", "glass bottle")),
    "cake": Maker(_cake, ("birthday cake", "torte")),
}
