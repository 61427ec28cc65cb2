"""Kitchen objects and food: each function draws one class of object."""

import numpy as np

from hilsplat_world.objects.builder import Builder
from hilsplat_world.shapes import arc, box, cylinder, ellipsoid, extrude, lathe, ring, sphere, sweep


def mug(b: Builder) -> None:
    glaze, inner, accent = b.paints("ceramic", "ceramic", "ceramic")
    r, h = b.between(0.36, 0.44), b.between(0.8, 1.0)
    top = r * b.between(0.94, 1.08)
    cup = b.part("cup, body", glaze, lathe([(0, 0), (r * 0.92, 0), (r, 0.06), (top, h * 0.86)]))
    cup.subpart("inside, interior", inner, lathe([(top - 0.05, h), (r - 0.05, 0.12), (0, 0.12)]))
    profile = [(top, h * 0.86), (top + 0.035, h * 0.88)]
    profile += [(top + 0.035, h), (top - 0.05, h), (top - 0.06, h - 0.04)]
    cup.subpart("rim, edge", accent, lathe(profile))
    low, high = h * 0.34, h * 0.54
    profile = [(r, low), (r * 1.05, low + 0.02), (r * 1.05, high - 0.02), (r, high)]
    cup.subpart("band, stripe", "ceramic", lathe(profile))
    path = arc((r * 0.75, h * 0.3), -88, 88, (r * 0.94, 0, h * 0.47))
    handle = b.part("handle", accent, sweep(path, 0.065).turned("z", 90))
    handle.subpart("thumb rest, knob", inner, ellipsoid((0.13, 0.14, 0.085), (0, r * 1.5, h * 0.77)))


def kettle(b: Builder) -> None:
    metal, accent, dark = b.paints("metal", "ceramic", "plastic")
    r, h = b.between(0.4, 0.46), b.between(0.5, 0.62)
    profile = [(0, 0.05), (r, 0.05), (r * 1.04, h * 0.35), (r * 0.9, h * 0.75), (r * 0.62, h), (0, h)]
    body = b.part("body, pot", metal, lathe(profile))
    body.subpart("base, bottom ring", dark, lathe([(0, 0), (r * 1.06, 0), (r * 1.08, 0.1), (r * 1.0, 0.13)]))
    profile = [(r * 0.7, h - 0.02), (r * 0.7, h + 0.03), (r * 0.5, h + 0.1), (0, h + 0.13)]
    lid = b.part("lid, cover", accent, lathe(profile))
    lid.subpart("knob, button", dark, ellipsoid((0.12, 0.12, 0.1), (0, 0, h + 0.2)))
    start = np.array([r * 0.85, 0, h * 0.35])
    path = [start, start + np.array([0.18, 0, 0.1]), start + np.array([0.27, 0, 0.26])]
    spout = b.part("spout", metal, sweep(path, [0.14, 0.1, 0.075]))
    lip = [start + np.array([0.255, 0, 0.235]), start + np.array([0.33, 0, 0.37])]
    spout.subpart("tip, mouth", accent, sweep(lip, [0.085, 0.1]))
    radii, centre = (r * 0.92, 0.5), (0, 0, h * 0.72)
    handle = b.part("handle", dark, sweep(arc(radii, 4, 176, centre), 0.045))
    handle.subpart("grip", accent, sweep(arc(radii, 55, 125, centre), 0.075))


def bottle(b: Builder) -> None:
    glass = b.paint("ceramic green teal blue brown purple red")
    label_paint, cap_paint = b.paints("plain white beige yellow orange pink", "metal")
    r, h = b.between(0.22, 0.26), b.between(0.62, 0.72)
    neck_r = b.between(0.085, 0.1)
    profile = [(0, 0), (r * 0.93, 0), (r, 0.04), (r, h * 0.78), (r * 0.86, h * 0.9), (neck_r * 1.15, h)]
    body = b.part("body", glass, lathe(profile))
    profile = [(r, h * 0.28), (r * 1.035, h * 0.29), (r * 1.035, h * 0.64), (r, h * 0.65)]
    body.subpart("label, sticker", label_paint, lathe(profile))
    shape = lathe([(0, -0.005), (r * 1.04, -0.005), (r * 1.05, 0.1), (r, 0.11)]).moved(z=0.005)
    body.subpart("base, bottom", "ceramic", shape)
    top = h + b.between(0.2, 0.26)
    neck = b.part("neck", glass, lathe([(neck_r * 1.15, h), (neck_r, h + 0.04), (neck_r, top)]))
    profile = [(neck_r, h + 0.04), (neck_r + 0.05, h + 0.06), (neck_r + 0.05, h + 0.13), (neck_r, h + 0.15)]
    neck.subpart("collar, ring", "ceramic", lathe(profile))
    cap = b.part("cap, lid", cap_paint, cylinder(neck_r + 0.045, top - 0.03, top + 0.1, bevel=0.015))
    cap.subpart("knob, stopper", "plastic", ellipsoid((neck_r * 0.9, neck_r * 0.9, 0.07), (0, 0, top + 0.13)))


def cake(b: Builder) -> None:
    sponge = b.paint("plain brown beige pink yellow teal")
    icing = b.paint("snow white pink beige purple red teal")
    cream, plate_paint, cherry = b.paints("plain", "ceramic", "plastic red purple orange green")
    r, h = b.between(0.36, 0.42), b.between(0.22, 0.27)
    profile = [(0, 0.0), (r * 0.8, 0.0), (r + 0.1, 0.05), (r + 0.1, 0.07), (0, 0.06)]
    plate = b.part("plate, dish", plate_paint, lathe(profile))
    profile = [(r + 0.03, 0.045), (r + 0.15, 0.06), (r + 0.15, 0.09), (r + 0.04, 0.085)]
    plate.subpart("rim, edge", "ceramic", lathe(profile, 36))
    lower = b.part("bottom tier, lower layer", sponge, cylinder(r, 0.06, 0.06 + h))
    top = 0.06 + h
    profile = [(r, top - 0.09), (r + 0.03, top - 0.08), (r + 0.03, top)]
    profile += [(r - 0.02, top + 0.03), (0, top + 0.03)]
    lower.subpart("icing, frosting", icing, lathe(profile))
    r2, top2 = r * b.between(0.55, 0.64), top + 0.03 + h * 0.85
    upper = b.part("top tier, upper layer", cream, cylinder(r2, top + 0.02, top2))
    profile = [(r2, top2 - 0.07), (r2 + 0.03, top2 - 0.06)]
    profile += [(r2 + 0.03, top2), (r2 - 0.02, top2 + 0.03), (0, top2 + 0.03)]
    upper.subpart("glaze, topping", "snow", lathe(profile))
    away, angles = (r + r2) / 2, [2 * np.pi * i / 6 for i in range(6)]
    places = [(away * np.cos(a) * 1.02, away * np.sin(a) * 1.02, top + 0.075) for a in angles]
    lower.subpart("cherries, berries", cherry, *[sphere(0.068, position, 16) for position in places])
    candle = b.part("candle", "ceramic", cylinder(0.062, top2 + 0.02, top2 + 0.25))
    shape = lathe([(0, 0), (0.09, 0.07), (0.065, 0.14), (0, 0.24)]).moved(z=top2 + 0.25)
    candle.subpart("flame, fire", "plain yellow orange", shape)


def frying_pan(b: Builder) -> None:
    metal, inner = b.paints("metal", "plain black grey teal brown")
    r, h = b.between(0.4, 0.45), b.between(0.13, 0.17)
    pan = b.part("pan, body, dish", metal, lathe([(0, 0), (r * 0.82, 0), (r, h)], 36))
    profile = [(r - 0.02, h - 0.01), (r * 0.8, 0.035), (0, 0.03)]
    pan.subpart("inside, cooking surface", inner, lathe(profile, 36), at="of")
    pan.subpart("rim, edge", "ceramic", ring(r + 0.005, 0.042, (0, 0, h), segments=36), at="of")
    blobs = ((0.2, -0.05, -0.03), (0.14, 0.07, 0.07), (0.13, -0.06, 0.12))
    shapes = [ellipsoid((size, size * 0.85, 0.035), (x, y, 0.055)) for size, x, y in blobs]
    egg = b.part("fried egg, egg", "snow white", *shapes)
    shape = ellipsoid((0.13, 0.13, 0.085), (-0.02, 0.02, 0.085))
    egg.subpart("yolk, egg yellow", "plastic yellow orange", shape)
    places = [(-0.18 + 0.09 * k, -0.26 + 0.02 * (k % 2), 0.075 + 0.02 * (k % 2)) for k in range(5)]
    strips = [box((0.095, 0.13, 0.05), position, 0.01) for position in places]
    bacon = b.part("bacon, bacon strip", "plain red brown pink", *strips)
    fat = box((0.47, 0.075, 0.05), (0, -0.25, 0.115), 0.01)
    bacon.subpart("fat, fat stripe", "plain beige white yellow orange", fat)
    path = [(r * 0.9, 0, h * 0.7), (r + 0.12, 0, h + 0.07), (r + 0.22, 0, h + 0.11)]
    handle = b.part("handle", "metal", sweep(path, [0.07, 0.065, 0.065]))
    end = r + 0.46
    path = [(r + 0.17, 0, h + 0.1), (r + 0.32, 0, h + 0.15), (end, 0, h + 0.16)]
    handle.subpart("grip", "plastic", sweep(path, [0.08, 0.105, 0.08]), at="of")
    handle.subpart("hanging ring, ring", "metal", ring(0.085, 0.04, (end + 0.08, 0, h + 0.16)))


def burger(b: Builder) -> None:
    bread, seeds = b.paints("plain orange beige brown", "snow white beige black yellow")
    meat, cheese = b.paints("plain brown red black", "plain yellow orange")
    r = b.between(0.38, 0.42)
    profile = [(0, 0), (r * 0.9, 0), (r + 0.12, 0.06), (r + 0.1, 0.075), (0, 0.05)]
    plate = b.part("plate, dish", "ceramic", lathe(profile, 36))
    profile = [(r + 0.03, 0.04), (r + 0.17, 0.065), (r + 0.17, 0.095), (r + 0.04, 0.085)]
    plate.subpart("rim, edge", "ceramic", lathe(profile, 36), at="of")
    profile = [(0, 0.05), (r * 0.92, 0.05), (r, 0.1), (r, 0.17), (0, 0.18)]
    low = b.part("bottom bun, lower bun", bread, lathe(profile, 32))
    leaf = ellipsoid((0.15, 0.18, 0.04)).turned("y", 14).moved(r * 0.94, 0, 0.2)
    low.subpart("lettuce, salad leaf", "plain green", *[leaf.turned("z", a) for a in range(0, 360, 45)])
    profile = [(0, 0.19), (r * 0.98, 0.2), (r * 1.04, 0.25), (r * 1.04, 0.31), (r * 0.96, 0.35), (0, 0.36)]
    patty = b.part("patty, meat", meat, lathe(profile, 32))
    slab = box((r * 1.62, r * 1.62, 0.045), (0, 0, 0.365), 0.01)
    corner = extrude([(-0.16, 0), (0.16, 0), (0, -0.14)], 0.04).turned("z", 90).moved(r * 0.98, 0, 0.385)
    patty.subpart("cheese, cheese slice", cheese, slab, *[corner.turned("z", a) for a in (0, 90, 180, 270)])
    slab = cylinder(0.2, 0.385, 0.445, 24, 0.02)
    shapes = [slab.moved(r * 0.6 * np.cos(a), r * 0.6 * np.sin(a)) for a in (0.5, 2.6, 4.7)]
    patty.subpart("tomato, tomato slices", "plastic red pink purple", *shapes)
    profile = [(0, 0.44), (r * 0.98, 0.45), (r * 1.02, 0.52), (r * 0.92, 0.64), (r * 0.6, 0.75), (0, 0.8)]
    top = b.part("top bun, upper bun", bread, lathe(profile, 32))
    seed = ellipsoid((0.055, 0.045, 0.03)).turned("y", 38).moved(r * 0.68, 0, 0.73)
    shapes = [seed.turned("z", a) for a in range(0, 360, 45)]
    for a in (0.4, 2.5, 4.6):
        shapes.append(ellipsoid((0.05, 0.06, 0.03), (r * 0.28 * np.cos(a), r * 0.28 * np.sin(a), 0.785)))
    top.subpart("seeds, sesame", seeds, *shapes)
    pick = b.part("skewer, toothpick", "wood", cylinder(0.03, 0.75, 1.12, 14))
    pick.subpart("flag, paper flag", "cloth", box((0.04, 0.24, 0.17), (0, 0.12, 1.02), 0.008))
    pick.subpart("olive, ball", "plastic green red purple", sphere(0.085, (0, 0, 0.86)))


def fruit_basket(b: Builder) -> None:
    straw, trim = b.paints("cloth beige brown orange white", "wood")
    r, h = b.between(0.38, 0.42), b.between(0.24, 0.28)
    profile = [(0, 0), (r * 0.74, 0), (r * 0.92, h * 0.5), (r, h), (r - 0.05, h), (r * 0.7, 0.1), (0, 0.1)]
    basket = b.part("bowl, basket", straw, lathe(profile, 36))
    basket.subpart("rim, edge", trim, ring(r - 0.01, 0.052, (0, 0, h), segments=36), at="of")
    profile = [(r * 0.8, h * 0.24), (r * 0.88, h * 0.25), (r * 0.965, h * 0.56), (r * 0.93, h * 0.57)]
    basket.subpart("band, stripe", "cloth", lathe(profile, 36))
    handle = b.part("handle", trim, sweep(arc((r, 0.5), 0, 180, (0, 0, h), "x"), 0.042))
    shapes = [sphere(0.075, (0, 0, h + 0.5))]
    for side in (-1, 1):
        shapes.append(ellipsoid((0.055, 0.14, 0.09)).turned("x", side * 15).moved(0, side * 0.16, h + 0.51))
    handle.subpart("ribbon, bow", "cloth", *shapes)
    apple_paint, stem = b.paints("plastic red green yellow pink", "plain green brown black")
    for x, y in ((0.17, -0.17), (0.2, 0.14)):
        z = h + 0.07
        apple = b.part("apple", apple_paint, ellipsoid((0.16, 0.16, 0.15), (x, y, z)))
        shapes = [cylinder(0.022, z + 0.12, z + 0.22, 10).moved(x, y)]
        shapes += [ellipsoid((0.1, 0.06, 0.025), (x + 0.07, y, z + 0.19))]
        apple.subpart("leaf, stalk", stem, *shapes)
    orange = b.part("orange, tangerine", "plain orange", sphere(0.15, (-0.19, -0.13, h + 0.06)))
    shape = ellipsoid((0.105, 0.105, 0.035)).turned("y", -30).moved(-0.26, -0.13, h + 0.178)
    orange.subpart("sticker, label", "plain blue white green", shape)
    curve = [
        (-0.19 + 0.13 * np.sin(a), 0.02 + 0.3 * np.sin(1.2 * a) * 0.8, h + 0.3 - 0.24 * np.cos(a))
        for a in np.linspace(-1.1, 1.1, 9)
    ]
    shape = sweep(curve, [0.05, 0.07, 0.085, 0.09, 0.09, 0.09, 0.085, 0.07, 0.05])
    banana = b.part("banana, bananas", "plain yellow green", shape)
    shapes = [sphere(0.068, tuple(curve[0])), sphere(0.068, tuple(curve[-1]))]
    banana.subpart("tips, ends", "plain brown black", *shapes, at="of")


def ice_cream(b: Builder) -> None:
    waffle, cup = b.paints("plain orange brown beige", "ceramic")
    r, h = b.between(0.24, 0.28), b.between(0.5, 0.58)
    profile = [(0, 0), (r * 1.25, 0), (r * 1.25, 0.05), (r * 0.55, 0.1)]
    profile += [(r * 0.55, 0.22), (r * 0.9, 0.34), (r * 0.7, 0.34), (0, 0.25)]
    stand = b.part("holder, stand", cup, lathe(profile, 32))
    stand.subpart("ring, band", "metal", ring(r * 0.62, 0.055, (0, 0, 0.16)), at="of")
    low = 0.24
    cone = b.part("cone, waffle", waffle, lathe([(0, low), (r * 0.45, low + 0.05), (r, low + h)], 32))
    profile = [(r * 0.86, low + h - 0.12), (r * 1.08, low + h - 0.1)]
    profile += [(r * 1.14, low + h + 0.03), (r * 0.8, low + h + 0.03)]
    cone.subpart("rim, edge", "plain", lathe(profile, 32), at="of")
    z = low + h + 0.1
    taste, crumb = b.paints("snow", "plastic")
    for side in (-1, 1):
        scoop = b.part("scoop, ball, lower scoop", taste, sphere(r * 0.72, (0, side * r * 0.55, z)))
        sprinkles = scoop.subpart("sprinkles, crumbs")
        for a, e in ((0.2, 0.1), (1.1, 0.5), (2.2, 0.1), (3.3, 0.5), (4.3, 0.1), (5.3, 0.4)):
            x, y = r * 0.72 * np.cos(a) * np.cos(e), side * r * 0.55 + r * 0.72 * np.sin(a) * np.cos(e)
            sprinkles.put(crumb, sphere(0.055, (x, y, z + r * 0.72 * np.sin(e)), 10))
    top = b.part("top scoop, upper scoop", "snow", sphere(r * 0.74, (0, 0, z + r * 0.85)))
    profile = [(r * 0.8, -0.06), (r * 0.74, 0.05), (r * 0.45, 0.17), (0, 0.21)]
    shapes = [lathe(profile, 28).moved(z=z + r * 0.86 + 0.02)]
    for a in (0.3, 1.6, 2.8, 4.1, 5.2):
        position = (r * 0.72 * np.cos(a), r * 0.72 * np.sin(a), z + r * 0.72)
        shapes.append(ellipsoid((0.06, 0.06, 0.1), position))
    top.subpart("sauce, syrup", "plastic brown red purple black", *shapes)
    top.subpart("cherry, berry", "plastic red pink green", sphere(0.1, (0, 0, z + r * 1.62 + 0.02)))
    shape = cylinder(0.055, 0, 0.46, 16).turned("y", -24).moved(-0.1, 0.03, z + 0.16)
    wafer = b.part("wafer, wafer stick", "plain beige brown yellow", shape)
    shape = cylinder(0.07, 0.34, 0.48, 16, 0.01).turned("y", -24).moved(-0.1, 0.03, z + 0.16)
    wafer.subpart("tip, end", "plain", shape, at="of")
