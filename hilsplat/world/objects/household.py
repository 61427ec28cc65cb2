"""Miniature household objects, gadgets and instruments: each function draws one class of object."""

import numpy as np

from hilsplat.world.objects.builder import CORNERS, Builder
from hilsplat.world.shapes import (
    box,
    cylinder,
    disc,
    ellipsoid,
    extrude,
    lathe,
    loft,
    plate,
    ring,
    roller,
    sphere,
    sweep,
)


def chair(b: Builder) -> None:
    wood, cloth, accent = b.paints("wood", "cloth", "plain")
    w, seat_z, top = b.between(0.5, 0.6), b.between(0.42, 0.5), b.between(1.0, 1.15)
    seat = b.part("seat", wood, box((w, w, 0.07), (0, 0, seat_z), 0.015))
    seat.subpart("cushion, pillow", cloth, box((w * 0.86, w * 0.86, 0.11), (0.01, 0, seat_z + 0.085), 0.04))
    post = box((0.075, 0.085, top - seat_z), bevel=0.015)
    back = b.part("back, backrest", wood, post.both_sides(-w / 2 + 0.04, w / 2 - 0.045, (top + seat_z) / 2))
    shape = box((0.09, w + 0.04, 0.17), (-w / 2 + 0.04, 0, top - 0.05), 0.03)
    back.subpart("top rail, headrest", accent, shape)
    low, high = seat_z + 0.06, top - 0.14
    slat = box((0.05, 0.1, high - low), (-w / 2 + 0.04, 0, (low + high) / 2), 0.01)
    back.subpart("slats, bars", "plain", *[slat.moved(0, i * w * 0.26) for i in (-1, 0, 1)])
    for x, y in CORNERS:
        px, py = x * (w / 2 - 0.05), y * (w / 2 - 0.05)
        leg = b.part("leg", wood, box((0.09, 0.09, seat_z - 0.13), (px, py, (seat_z + 0.07) / 2), 0.012))
        leg.subpart("foot, leg tip", accent, box((0.13, 0.13, 0.16), (px, py, 0.08), 0.02))


def cabinet(b: Builder) -> None:
    wood, front, metal = b.paints("wood", "plain", "metal")
    d, w, h = b.between(0.42, 0.5), b.between(0.62, 0.75), b.between(0.75, 0.9)
    legs = [box((0.09, 0.09, 0.12), (x * (d / 2 - 0.06), y * (w / 2 - 0.06), 0.05)) for x, y in CORNERS]
    body = b.part("body, case, frame", wood, box((d, w, h - 0.1), (0, 0, h / 2 + 0.05), 0.012), *legs)
    body.subpart("top, board", "stone", box((d + 0.08, w + 0.08, 0.08), (0, 0, h + 0.03), 0.02))
    shape = box((0.04, w * 0.8, h * 0.62), (-d / 2 - 0.005, 0, h * 0.52), 0.01)
    body.subpart("back panel, back", "plain", shape)
    shape = box((d * 0.62, 0.04, h * 0.56), bevel=0.01).both_sides(0, w / 2 + 0.003, h * 0.52)
    body.subpart("side panels, sides", "wood", shape)
    x, split = d / 2, h * 0.66
    door_w, door_h = w / 2 - 0.05, split - 0.17
    for side in (-1, 1):
        y, z = side * (w / 4 - 0.003), 0.13 + door_h / 2
        door = b.part("door", front, box((0.05, door_w, door_h), (x + 0.02, y, z), 0.012))
        shape = box((0.05, door_w * 0.52, door_h * 0.66), (x + 0.04, y + side * door_w * 0.13, z), 0.015)
        door.subpart("panel, inlay", "cloth", shape)
        door.subpart("knob, doorknob", metal, sphere(0.072, (x + 0.08, y - side * door_w * 0.34, z)))
    z = (split + h) / 2 - 0.01
    drawer = b.part("drawer", "plain", box((0.05, w - 0.09, h - split - 0.07), (x + 0.02, 0, z), 0.012))
    drawer.subpart("handle, pull", metal, box((0.07, w * 0.4, 0.085), (x + 0.075, 0, z), 0.025))


def lamp(b: Builder) -> None:
    metal, cloth, accent = b.paints("metal", "cloth", "ceramic")
    h, shade_r = b.between(0.95, 1.15), b.between(0.32, 0.4)
    base = b.part("base, foot", accent, lathe([(0, 0), (0.28, 0), (0.28, 0.07), (0.2, 0.13), (0, 0.14)]))
    base.subpart("button, switch", "plastic", ellipsoid((0.09, 0.11, 0.075), (0.205, 0, 0.12)))
    pole = b.part("pole, stem", metal, cylinder(0.055, 0.1, h - 0.22))
    pole.subpart("ball, joint", b.paint("ceramic"), sphere(b.between(0.13, 0.155), (0, 0, 0.34)))
    low, upper = h - 0.46, shade_r * b.between(0.55, 0.7)

    def radius(z: float) -> float:
        return shade_r + (upper - shade_r) * (z - low) / 0.46

    profile = [(shade_r, low), (upper, h), (upper - 0.03, h), (shade_r - 0.03, low), (shade_r, low)]
    shade = b.part("shade, lampshade", cloth, lathe(profile))
    profile = [(shade_r - 0.035, low - 0.01), (shade_r + 0.022, low - 0.01)]
    profile += [(radius(low + 0.115) + 0.022, low + 0.115), (radius(low + 0.115), low + 0.12)]
    shade.subpart("border, trim", "cloth", lathe(profile))
    profile = [(0, h - 0.03), (upper - 0.01, h - 0.03), (0.06, h + 0.01), (0.075, h + 0.07), (0, h + 0.12)]
    shade.subpart("finial, top knob", accent, lathe(profile))


def shelf(b: Builder) -> None:
    wood, back = b.paints("wood", "plain")
    d, w, h = b.between(0.32, 0.38), b.between(0.66, 0.8), b.between(0.85, 1.0)
    frame = b.part("frame, case", wood, box((d, 0.06, h), bevel=0.012).both_sides(0, w / 2 - 0.03, h / 2))
    frame.subpart("back wall, backboard", back, box((0.04, w - 0.12, h - 0.04), (-d / 2 + 0.02, 0, h / 2)))
    shapes = [box((0.04, w - 0.04, 0.13), (-d / 2 - 0.005, 0, z), 0.01) for z in (h * 0.28, h * 0.72)]
    frame.subpart("braces, back bars", "plain", *shapes)
    shapes = [box((d + 0.03, w - 0.11, 0.07), (0.015, 0, z), 0.012) for z in (0.05, h * 0.5, h - 0.035)]
    frame.subpart("boards, planks", "wood", *shapes)
    books = b.part("books, row of books")
    y, bottom = -w / 2 + 0.08, h * 0.5 + 0.035
    while y < 0.04:
        thick, tall = b.between(0.085, 0.12), b.between(0.27, 0.34)
        cover, deep = b.paint("cloth"), d * b.between(0.72, 0.9)
        books.subpart("book", cover, box((deep, thick, tall), (0.02, y + thick / 2, bottom + tall / 2), 0.01))
        y += thick + 0.006
    vy, vz = w / 2 - 0.18, bottom
    shape = lathe([(0, 0), (0.08, 0), (0.135, 0.1), (0.11, 0.2), (0.05, 0.25)]).moved(0.03, vy, vz)
    vase = b.part("vase, pot", "ceramic", shape)
    shape = lathe([(0.05, 0.19), (0.14, 0.28), (0.13, 0.345), (0, 0.31)]).moved(0.03, vy, vz)
    vase.subpart("rim, mouth", "ceramic", shape)
    crate_w = w * 0.52
    cy = b.between(-0.06, 0.06)
    shape = box((d * 0.85, crate_w, h * 0.3), (0.03, cy, 0.085 + h * 0.15), 0.015)
    crate = b.part("box, basket", "cloth", shape)
    shape = box((0.03, crate_w * 0.5, h * 0.14), (0.03 + d * 0.425, cy, 0.085 + h * 0.15), 0.008)
    crate.subpart("label, tag", "plain", shape)


def plant(b: Builder) -> None:
    clay, rim_paint, leaf, stem_paint = b.paints("ceramic", "ceramic", "plain green teal", "wood brown")
    petal = b.paint("plain red pink yellow purple orange white blue")
    r, h = b.between(0.24, 0.3), b.between(0.3, 0.38)
    pot = b.part("pot, flowerpot", clay, lathe([(0, 0), (r * 0.72, 0), (r, h)]))
    profile = [(r, h - 0.1), (r + 0.05, h - 0.09), (r + 0.05, h), (r - 0.03, h), (r - 0.04, h - 0.05)]
    pot.subpart("rim, edge", rim_paint, lathe(profile))
    profile = [(r - 0.02, h - 0.04), (r * 0.5, h - 0.015), (0, h)]
    pot.subpart("soil, earth", "plain brown black", lathe(profile))
    top = h + b.between(0.26, 0.34)
    path = [(0, 0, h - 0.05), (0.02, 0.02, (h + top) / 2), (0, 0, top + 0.05)]
    stem = b.part("stem, trunk", stem_paint, sweep(path, [0.06, 0.05, 0.05]))
    shape = lathe([(0.05, -0.065), (0.095, -0.05), (0.095, 0.05), (0.05, 0.065)]).moved(0.01, 0.01, h + 0.11)
    stem.subpart("ring, ribbon", "cloth", shape)
    size = b.between(0.26, 0.31)
    shape = ellipsoid((size, size, size * 0.92), (0, 0, top + size * 0.7))
    crown = b.part("crown, leaves, foliage", leaf, shape)
    for i in range(5):
        a = 2 * np.pi * i / 5 + b.between(0, 0.8)
        place = (size * 0.72 * np.cos(a), size * 0.72 * np.sin(a), top + size * b.between(0.35, 0.75))
        crown.put(leaf, sphere(size * 0.52, place))
    for i in range(5):
        a, up = 2 * np.pi * i / 5 + b.between(0, 0.5), b.between(0.15, 1.0)
        flat = size * 1.1 * np.cos(up)
        place = (flat * np.cos(a), flat * np.sin(a), top + size * 0.75 + size * np.sin(up) * 0.95)
        crown.subpart("flower, blossom", petal, sphere(0.085, place, 16))


def clock(b: Builder) -> None:
    case_paint, face_paint = b.paints("plastic", "plain white beige yellow pink")
    dark, accent, metal = b.paints("plastic black blue red purple", "plastic", "metal")
    r, depth = b.between(0.36, 0.42), b.between(0.22, 0.28)
    z = r + 0.13
    shape = disc(r, -depth / 2, depth / 2 - 0.02, 36, 0.03).moved(z=z)
    case = b.part("case, body, housing", case_paint, shape)
    profile = [(r + 0.01, -0.01), (r + 0.03, 0.0), (r + 0.03, 0.06), (r - 0.07, 0.07), (r - 0.08, 0.0)]
    case.subpart("frame, ring", accent, lathe(profile, 36).turned("y", 90).moved(depth / 2 - 0.03, 0, z))
    feet = case.subpart("feet, stand")
    for side in (-1, 1):
        path = [(0, side * r * 0.55, z - r * 0.72), (0, side * r * 0.72, 0.05)]
        feet.put(metal, sweep(path, [0.06, 0.085]))
    axle = cylinder(0.05, 0, 0.06).turned("y", -90).moved(-depth / 2, 0, z)
    case.subpart("key, winder", metal, box((0.1, 0.24, 0.11), (-depth / 2 - 0.07, 0, z), 0.03), axle)
    shape = disc(r * 0.72, -0.03, 0.0, 32, 0.01).moved(-depth / 2 + 0.005, 0, z)
    case.subpart("back cover, battery cover", "plain", shape)
    x = depth / 2 - 0.015
    face = b.part("face, dial", face_paint, disc(r - 0.07, 0, 0.03, 36).moved(x - 0.02, 0, z))
    mark = box((0.03, 0.075, 0.13), (x + 0.015, 0, r - 0.16))
    face.subpart("hour marks, numbers", dark, *[mark.turned("x", 90 * i).moved(z=z) for i in range(4)])
    hands = face.subpart("hands, pointers")
    for angle, length, width in ((b.between(0, 360), 0.56, 0.07), (b.between(0, 360), 0.36, 0.09)):
        shape = box((0.03, width, r * length), (x + 0.045, 0, r * length / 2 - 0.03), 0.01)
        hands.put(accent, shape.turned("x", angle).moved(z=z))
    hands.put(accent, disc(0.07, 0, 0.05, 16, 0.01).moved(x + 0.02, 0, z))
    for side in (-1, 1):
        place = (0, side * r * 0.62, z + r * 0.86)
        dome = lathe([(0, 0), (0.19, 0), (0.175, 0.09), (0.1, 0.16), (0, 0.18)]).turned("x", -side * 32)
        bell = b.part("bell, alarm bell", metal, dome.moved(*place))
        top = np.array(place) + np.array([0, side * np.sin(np.radians(32)), np.cos(np.radians(32))]) * 0.19
        bell.subpart("knob, button", dark, sphere(0.078, tuple(top)))


def guitar(b: Builder) -> None:
    wood, side_paint, dark, metal = b.paints("wood", "plastic", "plain black brown white", "metal")
    wide, depth = b.between(0.3, 0.34), b.between(0.15, 0.19)
    upper, z, z2 = wide * 0.74, wide + 0.02, wide * 2.15
    x = depth / 2
    body = b.part(
        "body, sound box", wood, disc(wide, -x, x, 36).moved(z=z), disc(upper, -x, x, 32).moved(z=z2)
    )
    shapes = [disc(wide + 0.018, -x + 0.03, x - 0.03, 36).moved(z=z)]
    shapes += [disc(upper + 0.018, -x + 0.03, x - 0.03, 32).moved(z=z2)]
    body.subpart("side, binding", side_paint, *shapes, at="of")
    shape = disc(0.125, x - 0.01, x + 0.012, 24).moved(z=wide * 1.62)
    body.subpart("sound hole, rosette", "plain black", shape)
    body.subpart("bridge, saddle", dark, box((0.07, 0.32, 0.12), (x + 0.02, 0, wide * 0.66), 0.02))
    outline = [(0.02, wide * 0.78), (0.24, wide * 0.85), (0.25, wide * 1.25)]
    outline += [(0.14, wide * 1.5), (0.1, wide * 1.2)]
    body.subpart("pickguard, scratch plate", "plastic", plate(outline, x - 0.01, x + 0.018))
    shape = box((0.03, 0.16, wide * 1.9), (-x - 0.005, 0, wide * 1.5), 0.01)
    body.subpart("back plate, back panel", "plain", shape)
    low, high = z2 + upper * 0.6, z2 + upper + b.between(0.52, 0.6)
    neck = b.part("neck", "wood", box((0.085, 0.125, high - low), (x - 0.05, 0, (low + high) / 2), 0.025))
    start = wide * 2.1
    shape = box((0.035, 0.115, high - start), (x + 0.01, 0, (start + high) / 2), 0.008)
    neck.subpart("fretboard, fingerboard", dark, shape)
    outline = [(-0.075, high - 0.01), (0.075, high - 0.01), (0.13, high + 0.26), (-0.13, high + 0.26)]
    head = b.part("headstock, head", "plain", plate(outline, x - 0.08, x - 0.01))
    pegs = head.subpart("tuning pegs, tuners, pegs")
    for side in (-1, 1):
        for k in range(2):
            y, up = side * (0.14 + 0.025 * k), high + 0.08 + 0.12 * k
            pegs.put(metal, box((0.08, 0.13, 0.095), (x - 0.045, y, up), 0.02))
    shapes = [box((0.42, 0.52, 0.05), (0, 0, 0.025), 0.015)]
    shapes += [box((0.06, 0.06, 0.5), (-x - 0.05, 0, 0.27), 0.01)]
    stand = b.part("stand, foot, support", "metal", *shapes)
    stand.subpart("pads, cushions", "plastic", box((0.3, 0.1, 0.14), bevel=0.03).both_sides(0, 0.2, 0.09))


def radio(b: Builder) -> None:
    case, cloth, metal = b.paints("wood" if b.chance(0.4) else "plastic", "cloth", "metal")
    w, h, d = b.between(0.82, 0.95), b.between(0.46, 0.54), b.between(0.28, 0.34)
    body = b.part("case, cabinet, housing", case, box((d, w, h), (0, 0, h / 2 + 0.05), 0.04))
    x, z = d / 2, h / 2 + 0.05
    body.subpart("feet, base", "plastic", box((d * 0.9, w * 0.92, 0.075), (0, 0, 0.035), 0.01), at="of")
    shape = box((0.04, w * 0.66, h * 0.6), (-x - 0.005, 0, z), 0.012)
    body.subpart("back panel, battery door", "plain", shape)
    y = -w * 0.23
    r = min(h * 0.4, w * 0.22)
    speaker = b.part("speaker, loudspeaker", cloth, disc(r, -0.02, 0.03, 32, 0.01).moved(x, y, z))
    speaker.subpart("ring, frame", metal, ring(r, 0.035, (x + 0.012, y, z), "x", 32), at="around")
    speaker.subpart("cone, centre", "plain", disc(r * 0.42, 0, 0.055, 20, 0.02).moved(x, y, z), at="of")
    y2 = w * 0.24
    shape = box((0.04, w * 0.42, h * 0.82), (x + 0.005, y2, z), 0.012)
    panel = b.part("tuning panel, control panel", "plain", shape)
    shape = box((0.04, w * 0.34, h * 0.26), (x + 0.022, y2, z + h * 0.2), 0.01)
    panel.subpart("display, tuning scale, window", "plastic yellow white teal green black", shape)
    knobs = panel.subpart("knobs, dials")
    for side in (-1, 1):
        knobs.put(metal, disc(0.085, 0, 0.085, 20, 0.015).moved(x + 0.015, y2 + side * 0.1, z - h * 0.17))
    up = h + 0.05
    shape = box((0.07, 0.06, 0.18), bevel=0.015).both_sides(0, w * 0.36, up + 0.07)
    handle = b.part("handle, carrying handle", metal, shape)
    handle.subpart("grip, bar", "plastic", box((0.105, w * 0.78, 0.085), (0, 0, up + 0.17), 0.03), at="of")
    y = w * 0.44
    path = [(-d * 0.35, y, up - 0.02), (-d * 0.35, y + 0.1, up + 0.52)]
    aerial = b.part("antenna, aerial", metal, sweep(path, 0.026))
    aerial.subpart("tip, end", "plastic", sphere(0.065, (-d * 0.35, y + 0.105, up + 0.55)), at="of")


def camera(b: Builder) -> None:
    leather, metal, dark = b.paints("cloth black brown red green blue beige", "metal", "plain black")
    w, h, d = b.between(0.78, 0.9), b.between(0.46, 0.52), b.between(0.26, 0.3)
    body = b.part("body, case", leather, box((d, w, h), (0, 0, h / 2), 0.03))
    shape = box((d + 0.03, w + 0.02, 0.12), (0, 0, h + 0.02), 0.03)
    body.subpart("top plate, top cover", metal, shape, at="of")
    shape = box((0.13, 0.17, h * 0.88), (d / 2 + 0.03, -w * 0.4, h * 0.46), 0.05)
    body.subpart("grip, handgrip", "plastic", shape, at="of")
    shape = box((0.04, w * 0.56, h * 0.62), (-d / 2 - 0.01, -0.04, h * 0.48), 0.012)
    body.subpart("screen, display", "plastic black blue teal grey", shape)
    r, z, x = h * 0.43, h * 0.48, d / 2
    lens = b.part("lens, objective", dark, disc(r, -0.02, 0.3, 32, 0.015).moved(x, 0.05, z))
    lens.subpart("focus ring, zoom ring", "plastic", disc(r + 0.025, 0.06, 0.18, 32).moved(x, 0.05, z))
    shape = lathe([(r * 0.74, 0), (r * 0.5, 0.04), (0, 0.06)], 28).turned("y", 90).moved(x + 0.295, 0.05, z)
    lens.subpart("glass, front glass", "ceramic blue teal purple white green", shape, at="of")
    sections = []
    for back, front, half, high in ((-0.11, 0.13, 0.15, h + 0.06), (-0.09, 0.11, 0.1, h + 0.22)):
        sections.append([(back, -half, high), (front, -half, high), (front, half, high), (back, half, high)])
    finder = b.part("viewfinder, prism", metal, loft(sections).moved(0, 0.05))
    shape = box((0.06, 0.23, 0.12), (0.13, 0, h + 0.14), 0.015).moved(0, 0.05)
    finder.subpart("flash, flash lamp", "plain white yellow", shape)
    shape = box((0.08, 0.2, 0.14), (-0.12, 0, h + 0.13), 0.02).moved(0, 0.05)
    finder.subpart("eyepiece, eyecup", "plastic", shape)
    shape = cylinder(0.105, h + 0.06, h + 0.15, 24, 0.012).moved(0, w * 0.36, 0)
    dial = b.part("dial, mode dial", "metal", shape)
    shape = cylinder(0.08, h + 0.13, h + 0.2, 20, 0.015).moved(0, w * 0.36, 0)
    dial.subpart("cap, centre", "plastic", shape, at="of")
    shape = cylinder(0.085, h + 0.07, h + 0.16, 20, 0.025).moved(0.03, -w * 0.34, 0)
    b.part("shutter button, release button", "plastic red orange yellow green", shape)


def toaster(b: Builder) -> None:
    shell, metal, dark = b.paints("metal" if b.chance(0.5) else "ceramic", "metal", "plain black")
    length, w, h = b.between(0.74, 0.84), b.between(0.46, 0.52), b.between(0.46, 0.52)
    outline = [(-w / 2, 0.09), (w / 2, 0.09), (w / 2, h * 0.82), (w * 0.4, h * 0.96)]
    outline += [(w * 0.3, h), (-w * 0.3, h), (-w * 0.4, h * 0.96), (-w / 2, h * 0.82)]
    body = b.part("body, case", shell, extrude(outline, length))
    body.subpart("base, foot", "plastic", box((w + 0.04, length + 0.04, 0.11), (0, 0, 0.055), 0.02), at="of")
    slots = body.subpart("slots, openings")
    panel, inlay = body.subpart("side panels, panels"), b.paint("plastic")
    for side in (-1, 1):
        slots.put(dark, box((0.1, length * 0.76, 0.03), (side * w * 0.17, 0, h - 0.005)))
        panel.put(inlay, box((0.03, length * 0.62, h * 0.42), (side * w / 2, 0, h * 0.5), 0.01))
    crumb, crust = b.paints("plain beige yellow white", "plain brown orange")
    wide, end = length * 0.62, length / 2
    for side in (-1, 1):
        x, high = side * w * 0.17, h + b.between(0.22, 0.3)
        shape = box((0.075, wide - 0.1, 0.4), (x, 0, high - 0.24), 0.01)
        toast = b.part("toast, bread slice, slice of bread", crumb, shape)
        upper = box((0.065, wide, 0.085), (x, 0, high - 0.02), 0.02)
        sides = box((0.065, 0.085, 0.44), bevel=0.015).both_sides(x, wide / 2 - 0.04, high - 0.22)
        toast.subpart("crust, edge", crust, upper, sides, at="of")
    lever = b.part("lever, push lever", metal, box((0.07, 0.05, h * 0.56), (0, end + 0.015, h * 0.56), 0.012))
    lever.subpart("knob, handle", "plastic", box((0.2, 0.13, 0.1), (0, end + 0.08, h * 0.62), 0.03))
    shape = roller(0.125, 0, 0.07, 24, 0.015).moved(0, -end + 0.01, h * 0.5)
    dial = b.part("dial, timer, browning knob", "metal", shape)
    dial.subpart("pointer, mark", "plastic", box((0.085, 0.06, 0.25), (0, -end - 0.07, h * 0.5), 0.015))
    b.turn(35)  # so that the lever and one side are visible from the front


def headphones(b: Builder) -> None:
    frame, pad, shell, metal = b.paints("plastic", "cloth", "plastic", "metal")
    r, z = b.between(0.34, 0.39), 0.62
    stand = b.part("stand, holder", "wood", box((0.1, 0.12, z + r - 0.06), (0, 0, (z + r) / 2), 0.02))
    stand.subpart("base, foot", "stone", cylinder(0.25, 0, 0.075, 32, 0.02), at="of")
    path = [(0, r * np.cos(a), z + r * np.sin(a)) for a in np.radians(np.linspace(-8, 188, 19))]
    band = b.part("headband, band, bow", frame, sweep(path, 0.055))
    cushion = np.radians(np.linspace(50, 130, 10))
    path = [(0, r * 1.01 * np.cos(a), z + r * 1.01 * np.sin(a)) for a in cushion]
    band.subpart("cushion, padding", pad, sweep(path, 0.09))
    yoke = band.subpart("sliders, hinges")
    for side in (-1, 1):
        yoke.put(metal, box((0.13, 0.1, 0.16), (0, side * r, z + 0.06), 0.025))
        round_cup = roller(0.2, -0.08, 0.08, 28, 0.03).moved(0, side * (r + 0.03), z - 0.18)
        cup = b.part("ear cup, earpiece, speaker", shell, round_cup)
        cup.subpart("pad, ear cushion", pad, ring(0.145, 0.075, (0, side * (r - 0.08), z - 0.18), "y"))
        shape = roller(0.125, -0.025, 0.025, 24, 0.01).moved(0, side * (r + 0.12), z - 0.18)
        cup.subpart("cap, logo plate", metal, shape)
    b.turn(b.between(35, 60))  # so that each cup's outside or inside is visible from the front
