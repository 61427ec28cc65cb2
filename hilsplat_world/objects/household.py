"""Miniature household and garden objects, gadgets and belongings: each function draws one class."""

import numpy as np

from hilsplat_world.objects.builder import CORNERS, Builder
from hilsplat_world.shapes import (
    Mesh,
    arc,
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
        position = (size * 0.72 * np.cos(a), size * 0.72 * np.sin(a), top + size * b.between(0.35, 0.75))
        crown.put(leaf, sphere(size * 0.52, position))
    for i in range(5):
        a, up = 2 * np.pi * i / 5 + b.between(0, 0.5), b.between(0.15, 1.0)
        flat = size * 1.1 * np.cos(up)
        position = (flat * np.cos(a), flat * np.sin(a), top + size * 0.75 + size * np.sin(up) * 0.95)
        crown.subpart("flower, blossom", petal, sphere(0.085, position, 16))


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
        position = (0, side * r * 0.62, z + r * 0.86)
        dome = lathe([(0, 0), (0.19, 0), (0.175, 0.09), (0.1, 0.16), (0, 0.18)]).turned("x", -side * 32)
        bell = b.part("bell, alarm bell", metal, dome.moved(*position))
        top = np.array(position) + np.array([0, side * np.sin(np.radians(32)), np.cos(np.radians(32))]) * 0.19
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


def backpack(b: Builder) -> None:
    cloth, second, strap_paint, metal = b.paints("cloth", "cloth", "cloth", "metal")
    w, d, h = b.between(0.52, 0.6), b.between(0.28, 0.33), b.between(0.68, 0.76)
    bag = b.part("bag, main compartment, body", cloth, box((d, w, h), (0, 0, h / 2), 0.09))
    bag.subpart("bottom, base", "plastic", box((d + 0.03, w + 0.03, 0.15), (0, 0, 0.075), 0.04), at="of")
    sides = bag.subpart("side pockets, bottle pockets")
    for side in (-1, 1):
        shape = box((d * 0.66, 0.11, h * 0.34), (0, side * (w / 2 + 0.03), h * 0.32), 0.03)
        sides.put(b.paint("cloth") if side < 0 else strap_paint, shape)
    shapes = [box((d + 0.07, w + 0.05, 0.13), (0.02, 0, h), 0.05)]
    shapes += [box((0.06, w * 0.96, h * 0.24), (d / 2 + 0.03, 0, h * 0.9), 0.02)]
    flap = b.part("flap, top flap, lid", second, *shapes)
    shape = box((0.06, 0.11, 0.2), bevel=0.015).both_sides(d / 2 + 0.07, w * 0.27, h * 0.76)
    flap.subpart("buckles, clasps", metal, shape)
    flap.subpart("loop, carry loop", strap_paint, ring(0.1, 0.038, (-0.02, 0, h + 0.1), "x"), at="of")
    shape = box((0.15, w * 0.72, h * 0.4), (d / 2 + 0.06, 0, h * 0.36), 0.05)
    pocket = b.part("front pocket, pocket", "cloth", shape)
    pocket.subpart("zipper, zip", metal, box((0.05, w * 0.58, 0.075), (d / 2 + 0.13, 0, h * 0.49), 0.015))
    pocket.subpart("badge, patch", "plain", disc(0.09, 0.0, 0.03, 22, 0.008).moved(d / 2 + 0.125, 0, h * 0.3))
    for side in (-1, 1):
        y = side * w * 0.27
        path = [(-d / 2 + 0.02, y, h * 0.92), (-d / 2 - 0.13, y, h * 0.78)]
        path += [(-d / 2 - 0.15, y, h * 0.45), (-d / 2 - 0.02, y, h * 0.16)]
        strap = b.part("strap, shoulder strap", strap_paint, sweep(path, [0.06, 0.075, 0.075, 0.05]))
        strap.subpart("pad, padding", second, ellipsoid((0.075, 0.1, 0.17), (-d / 2 - 0.15, y, h * 0.6)))
    shape = roller(0.115, -w * 0.6, w * 0.6, 24, 0.02).moved(0.0, 0, h + 0.16)
    roll = b.part("bedroll, sleeping mat", "cloth", shape)
    bands = roll.subpart("bands, roll straps")
    for side in (-1, 1):
        shape = roller(0.13, -0.05, 0.05, 24).moved(0, side * w * 0.38, h + 0.16)
        bands.put("cloth brown black red yellow white", shape)


def boot(b: Builder) -> None:
    leather, upper, sole_paint = b.paints("plain", "cloth", "plastic")
    length, w, h = b.between(0.8, 0.9), b.between(0.3, 0.34), b.between(0.72, 0.82)
    heel_x, toe_x = -length * 0.36, length * 0.58

    def outline(z: float, grow: float, toe: float) -> list[tuple[float, float, float]]:
        angle = np.linspace(0, 2 * np.pi, 21)[:-1]
        middle, reach = (heel_x + toe) / 2, (toe - heel_x) / 2
        points = []
        for c, s in zip(np.cos(angle), np.sin(angle), strict=True):
            along = middle + reach * grow * (np.sign(c) * abs(c) ** 0.75)
            points.append((along, w / 2 * grow * (np.sign(s) * abs(s) ** 0.8), z))
        return points

    sole = b.part("sole, bottom", sole_paint, loft([outline(0.06, 1.05, toe_x), outline(0.13, 1.08, toe_x)]))
    sole.subpart("heel", "plastic", box((0.3, w * 1.02, 0.13), (heel_x + 0.15, 0, 0.065), 0.02), at="of")
    sections = [outline(0.12, 1.0, toe_x), outline(0.24, 0.98, toe_x * 0.97)]
    sections += [outline(0.34, 0.88, toe_x * 0.72), outline(0.42, 0.8, toe_x * 0.36)]
    foot = b.part("foot, vamp", leather, loft(sections))
    shape = ellipsoid((0.22, w * 0.5, 0.185), (toe_x - 0.17, 0, 0.15))
    foot.subpart("toe cap, toe", "plastic", shape, at="of")
    cx = heel_x + 0.2
    profile = [(0.175, 0.2), (0.165, 0.42), (0.19, h), (0.15, h), (0.14, 0.5), (0, 0.45)]
    shaft = b.part("shaft, leg", upper, lathe(profile).scaled(1.1, 0.9, 1).moved(cx))
    shaft.subpart("cuff, fur trim", "fur", ring(0.185, 0.07, (0, 0, h - 0.03)).scaled(1.1, 0.92, 1).moved(cx))
    shape = box((0.06, 0.14, 0.26), (heel_x + 0.005, 0, h * 0.66), 0.02)
    shaft.subpart("pull tab, heel loop", "cloth", shape)
    laces = b.part("laces, shoelaces")
    paint = b.paint("cloth")
    for k in range(4):
        z = 0.37 + 0.085 * k
        x = cx + 0.2 + (0.14 - 0.13 * k if k < 2 else 0.0)
        path = [(x - 0.03, -w * 0.34, z), (x + 0.02, 0, z + 0.03), (x - 0.03, w * 0.34, z)]
        laces.put(paint, sweep(path, 0.032))
    bow = laces.subpart("bow, knot")
    bx = cx + 0.26
    for side in (-1, 1):
        shape = ellipsoid((0.05, 0.12, 0.07)).turned("x", side * 20).moved(bx, side * 0.12, h - 0.13)
        bow.put(b.paint("cloth") if side < 0 else paint, shape)
    b.turn(-40)


def lantern(b: Builder) -> None:
    metal, glass = b.paints("metal", "plastic yellow white orange teal")
    glow = b.paint("plain red orange yellow")
    r, h = b.between(0.25, 0.29), b.between(0.4, 0.46)
    low = 0.2
    profile = [(0, 0), (r * 1.15, 0), (r * 1.15, 0.05), (r * 0.95, 0.1), (r * 0.95, low), (0, low)]
    base = b.part("base, oil tank, foot", metal, lathe(profile))
    profile = [(r * 0.95, 0.11), (r * 1.06, 0.12), (r * 1.06, 0.185), (r * 0.95, 0.195)]
    base.subpart("band, ring", "ceramic", lathe(profile))
    base.subpart("knob, wick wheel", "plastic", disc(0.075, 0, 0.16, 20, 0.02).moved(r * 0.92, 0, 0.085))
    profile = [(r * 0.62, low), (r * 0.8, low + h * 0.35), (r * 0.8, low + h * 0.6), (r * 0.6, low + h)]
    lamp = b.part("glass, globe, window", glass, lathe(profile))
    # Each side of the glass shows a flame, because the inside of an opaque globe is never visible.
    flame = lathe([(0, -0.02), (0.085, 0.06), (0.06, 0.14), (0, 0.25)]).scaled(0.3, 1, 1)
    flame = flame.moved(r * 0.8, 0, low + h * 0.28)
    lamp.subpart("flame, light", glow, *[flame.turned("z", a) for a in (45, 135, 225, 315)])
    bar = box((0.05, 0.05, h), (r * 0.92, 0, low + h / 2), 0.012)
    bars = [bar.turned("z", a) for a in range(0, 360, 90)]
    cage = b.part("cage, bars, guard", "plain black grey brown red blue", *bars)
    cage.subpart("hoop, middle ring", "metal", ring(r * 0.95, 0.032, (0, 0, low + h * 0.16)))
    roof, top = b.part("roof, cap, hood"), low + h
    profile = [(0, top - 0.01), (r * 1.2, top), (r * 1.12, top + 0.06)]
    profile += [(r * 0.55, top + 0.2), (0, top + 0.21)]
    roof.put(metal, lathe(profile))
    shape = lathe([(0.085, 0), (0.085, 0.08), (0.14, 0.09), (0.14, 0.145), (0, 0.17)]).moved(z=top + 0.17)
    roof.subpart("chimney, vent", "plastic", shape)
    radii, centre = (r * 1.22, 0.42), (0, 0, top + 0.08)
    handle = b.part("handle, bail", "metal", sweep(arc(radii, -4, 184, centre, "x"), 0.03))
    handle.subpart("grip", "wood", sweep(arc(radii, 58, 122, centre, "x"), 0.065), at="of")


def chest(b: Builder) -> None:
    wood, metal, gold = b.paints("wood", "metal", "metal yellow orange")
    d, w, h = b.between(0.46, 0.54), b.between(0.74, 0.84), b.between(0.34, 0.4)
    walls = [box((0.05, w, h), (side * (d / 2 - 0.025), 0, h / 2 + 0.02)) for side in (-1, 1)]
    ends = box((d, 0.05, h)).both_sides(0, w / 2 - 0.025, h / 2 + 0.02)
    chest = b.part("box, trunk, body", wood, box((d, w, 0.06), (0, 0, 0.05)), *walls, ends)
    band = box((0.05, 0.105, h + 0.02), (0, 0, h / 2 + 0.02), 0.01)
    bands = [band.moved(x * (d / 2 + 0.005), side * w * 0.33) for side, x in CORNERS]
    chest.subpart("bands, straps, iron bands", metal, *bands)
    chest.subpart("lock, padlock", "metal", box((0.08, 0.19, 0.2), (d / 2 + 0.02, 0, h - 0.08), 0.03))
    handles = chest.subpart("handles, side rings")
    for side in (-1, 1):
        handles.put("metal", ring(0.1, 0.035, (0, side * (w / 2 + 0.03), h * 0.52), "y"))
    lid, r = b.part("lid, cover"), d / 2
    half = [(r * np.cos(a), r * np.sin(a) * 0.8) for a in np.linspace(0, np.pi, 13)]

    def opened(mesh: Mesh) -> Mesh:
        """Rotate a mesh by 50 degrees about the hinge at the upper back edge."""
        return mesh.moved(r, 0, 0).turned("y", -50).moved(-d / 2, 0, h + 0.02)

    lid.put("wood", opened(extrude(half, w)))
    lid.subpart("lining, inside", "cloth", opened(box((d * 0.84, w * 0.88, 0.03), (0, 0, -0.01))), at="of")
    wider = [(x * 1.04, z * 1.05) for x, z in half]
    shapes = [opened(extrude(wider, 0.105).moved(0, side * w * 0.33, 0)) for side in (-1, 1)]
    lid.subpart("hoops, lid bands", metal, *shapes)
    shape = ellipsoid((d * 0.42, w * 0.44, 0.16), (0, 0, h - 0.04))
    treasure = b.part("gold, coins, gold coins", gold, shape)
    gems = treasure.subpart("gems, jewels")
    jewel = b.paint("ceramic red green blue purple teal pink")
    for x, y in ((0.1, -0.2), (0.12, 0.06), (0.05, 0.25), (-0.02, -0.04)):
        gems.put(jewel, ellipsoid((0.08, 0.085, 0.075), (x, y * w / 0.8, h + 0.06 + 0.05 * (0.12 - x)), 8, 4))


def cactus(b: Builder) -> None:
    green, pot_paint = b.paints("plain green teal", "ceramic")
    petal = b.paint("plain pink red yellow orange purple white")
    r, h = b.between(0.145, 0.17), b.between(0.72, 0.85)
    pot = b.part("pot, planter", pot_paint, lathe([(0, 0), (0.22, 0), (0.3, 0.3), (0, 0.28)]))
    profile = [(0.29, 0.22), (0.355, 0.23), (0.355, 0.34), (0.25, 0.34), (0.24, 0.29)]
    pot.subpart("rim, edge", "ceramic", lathe(profile), at="of")
    profile = [(0.27, 0.29), (0.15, 0.33), (0, 0.34)]
    pot.subpart("soil, sand", "plain brown beige grey black", lathe(profile), at="in")
    pot.subpart("saucer, dish", "ceramic", lathe([(0, 0), (0.3, 0), (0.35, 0.06), (0.2, 0.06)]), at="under")
    shapes = [sweep([(0, 0, 0.28), (0, 0, h), (0, 0, h + r * 0.7)], [r, r, r * 0.62])]
    shapes += [ellipsoid((r * 0.62, r * 0.62, r * 0.4), (0, 0, h + r * 0.7))]
    stem = b.part("stem, trunk, column", green, *shapes)
    rib = sweep([(r, 0, 0.34), (r, 0, h - 0.05), (r * 0.7, 0, h + r * 0.55)], 0.032)
    ribs = [rib.turned("z", 60 * k) for k in range(6)]
    stem.subpart("ribs, ridges", "plain yellow green white beige teal", *ribs)
    top = h + r * 0.95
    single = ellipsoid((0.1, 0.065, 0.035)).turned("y", -30).moved(0.1, 0, top + 0.03)
    shapes = [single.turned("z", 72 * k) for k in range(5)]
    stem.subpart("flower, blossom", petal, *shapes, sphere(0.07, (0, 0, top + 0.04)))
    tip_paint = b.paint("plain yellow beige pink red white")
    for side, low in ((-1, 0.52), (1, 0.62)):
        low = low * h / 0.8
        out = r + b.between(0.17, 0.21)
        path = [(0, side * r * 0.8, low), (0, side * (out - 0.03), low + 0.015)]
        path += [(0, side * out, low + 0.1), (0, side * out, low + 0.3)]
        arm = b.part("arm, branch", green, sweep(path, [0.085, 0.09, 0.095, 0.085]))
        shape = ellipsoid((0.105, 0.105, 0.1), (0, side * out, low + 0.31))
        arm.subpart("tip, bud", tip_paint, shape, at="of")


def windmill(b: Builder) -> None:
    wall, roof_paint, wood = b.paints(str(b.rng.choice(["brick", "stone", "plain"])), "plain", "wood")
    h, r = b.between(0.72, 0.82), b.between(0.27, 0.31)
    base = b.part("base, terrace, platform", "stone", cylinder(r * 1.45, 0, 0.11, 36, 0.02))
    low_step = box((0.2, 0.34, 0.08), (r * 1.45, 0, 0.04), 0.01)
    step = box((0.13, 0.26, 0.15), (r * 1.33, 0, 0.075), 0.01)
    base.subpart("stairs, steps", "plain", low_step, step, at="of")
    tower = b.part("tower, mill body", wall, lathe([(r, 0.1), (r * 0.68, h)], 32))
    tower.subpart("door, entrance", "wood", box((0.1, 0.26, 0.33), (r * 0.9, 0, 0.27), 0.01))
    shapes = [box((0.08, 0.18, 0.2), (r * 0.83, 0, h * 0.55), 0.01).turned("z", a) for a in (75, 180, 285)]
    tower.subpart("windows", "plastic yellow white blue black", *shapes)
    profile = [(r * 0.75, h - 0.17), (r * 0.98, h - 0.15), (r * 0.98, h - 0.07), (r * 0.7, h - 0.06)]
    tower.subpart("gallery, balcony, railing", "plain", lathe(profile, 32))
    profile = [(0, h - 0.01), (r * 0.82, h), (r * 0.72, h + 0.1), (r * 0.4, h + 0.24), (0, h + 0.3)]
    cap = b.part("roof, mill cap", roof_paint, lathe(profile, 28))
    cap.subpart("ball, finial", "metal", sphere(0.085, (0, 0, h + 0.34)))
    shape = box((0.26, 0.05, 0.17), (-r * 0.95, 0, h + 0.09), 0.012)
    cap.subpart("tail vane, weather vane, tail", "plastic", shape)
    x, z = r * 0.8 + 0.1, h + 0.1
    hub = b.part("hub, axle", wood, disc(0.135, -0.2, 0.08, 24, 0.02).moved(x, 0, z))
    hub.subpart("cap, nut", "plastic", ellipsoid((0.09, 0.11, 0.11), (x + 0.12, 0, z)))
    frame, cloth = b.paints("wood", "cloth")
    turn = b.between(15, 75)
    for angle in (turn, turn + 90, turn + 180, turn + 270):
        shape = box((0.05, 0.075, 0.62), (0, 0, 0.32), 0.012).turned("x", angle).moved(x, 0, z)
        blade = b.part("blade, vane", frame, shape)
        shape = box((0.035, 0.17, 0.44), (0.01, 0.1, 0.4), 0.008).turned("x", angle).moved(x, 0, z)
        blade.subpart("sail, canvas", cloth, shape)


def birdhouse(b: Builder) -> None:
    wood, roof_paint, dark = b.paints("wood", "plain", "plain black")
    w, h, low = b.between(0.44, 0.5), b.between(0.4, 0.46), 0.42
    rise, half = 0.24, w / 2
    post = b.part("post, pole", "wood", box((0.11, 0.11, low), (0, 0, low / 2), 0.015))
    post.subpart("base, foot", "stone", cylinder(0.27, 0, 0.085, 32, 0.02), at="of")
    outline = [(-half, low), (half, low), (half, low + h), (0, low + h + rise), (-half, low + h)]
    body = b.part("box, nest box, walls", wood, extrude(outline, w * 0.86).turned("z", 90))
    x = w * 0.43
    body.subpart("hole, entrance", dark, disc(0.1, -0.01, 0.015, 28).moved(x, 0, low + h * 0.7))
    body.subpart("perch, stick", "plain", disc(0.058, -0.02, 0.22, 16, 0.01).moved(x, 0, low + h * 0.3))
    shape = disc(0.1, -0.03, 0.02, 24).moved(-x, 0, low + h * 0.55)
    body.subpart("heart, back window", "plain red pink yellow", shape)
    roof = b.part("roof")
    slope, angle = float(np.hypot(half, rise)), float(np.degrees(np.arctan2(rise, half)))
    for side in (-1, 1):
        slab = box((w * 1.14, slope + 0.12, 0.05), bevel=0.012).turned("x", -side * angle)
        roof.put(roof_paint, slab.moved(0, side * (half / 2 + 0.035), low + h + rise / 2 + 0.015))
    shape = box((w * 1.18, 0.1, 0.075), (0, 0, low + h + rise + 0.035), 0.02)
    roof.subpart("ridge, ridge beam", "wood", shape)
    z = low + h + rise + 0.18
    path = [(-0.1, 0, z), (-0.28, 0, z + 0.06)]
    shapes = [ellipsoid((0.155, 0.115, 0.115), (0, 0, z))]
    shapes += [sphere(0.095, (0.12, 0, z + 0.115)), sweep(path, [0.075, 0.04])]
    bird = b.part("bird, little bird", "plain red blue yellow orange teal purple", *shapes)
    shape = lathe([(0, 0), (0.075, 0), (0, 0.17)], 14).turned("y", 90).moved(0.195, 0, z + 0.11)
    bird.subpart("beak, bill", "plain orange yellow black", shape)
    bird.subpart("wings", "plain", ellipsoid((0.12, 0.045, 0.07)).both_sides(-0.04, 0.11, z + 0.02))


def watering_can(b: Builder) -> None:
    tin, second = b.paints("metal", "plastic")
    r, h = b.between(0.3, 0.34), b.between(0.46, 0.52)
    body = b.part("body, tank, can", tin, lathe([(0, 0.02), (r, 0.02), (r * 0.88, h), (0, h)], 32))
    profile = [(0, 0), (r * 1.07, 0), (r * 1.07, 0.1), (r * 0.98, 0.11)]
    body.subpart("base, bottom ring", "plastic", lathe(profile, 32), at="of")
    profile = [(r * 0.94, h * 0.46), (r * 0.995, h * 0.47), (r * 0.96, h * 0.74), (r * 0.9, h * 0.75)]
    body.subpart("band, stripe", "plain", lathe(profile, 32))
    profile = [(r * 0.9, h - 0.05), (r * 0.94, h - 0.04)]
    profile += [(r * 0.94, h + 0.03), (r * 0.5, h + 0.05), (0, h + 0.05)]
    body.subpart("collar, top cover", second, lathe(profile, 32), at="of")
    start, end = np.array([r * 0.8, 0, 0.14]), np.array([r + 0.4, 0, h + 0.12])
    path = [start, start + np.array([0.14, 0, 0.05]), end]
    spout = b.part("spout, pipe", "metal", sweep(path, [0.085, 0.075, 0.055]))
    way = (end - start) / np.linalg.norm(end - start)
    tilt = float(np.degrees(np.arctan2(way[0], way[2])))
    rose = lathe([(0, 0), (0.06, 0), (0.145, 0.13), (0.145, 0.17), (0, 0.19)], 24).turned("y", tilt)
    spout.subpart("rose, sprinkler head, nozzle", "plastic", rose.moved(*(end - 0.03 * way)))
    path = [(-r * 0.86, 0, 0.16), (-r - 0.2, 0, 0.26), (-r - 0.17, 0, h * 0.9)]
    path += [(-r * 0.35, 0, h + 0.27), (r * 0.35, 0, h + 0.22), (r * 0.62, 0, h + 0.02)]
    handle = b.part("handle", second, sweep(path, 0.045))
    path = [path[2], tuple(np.add(path[2], path[3]) / 2 + np.array([-0.02, 0, 0.03])), path[3]]
    handle.subpart("grip", "wood", sweep(path, 0.068), at="of")
    bloom = b.part("flower, daisy")
    middle = ellipsoid((0.075, 0.1, 0.1))
    petals = [ellipsoid((0.03, 0.11, 0.075), (0, 0.15, 0)).turned("x", 60 * k) for k in range(6)]
    for node, spec, meshes in (
        (bloom, "plain white pink yellow orange", petals),
        (bloom.subpart("centre, middle", at="of"), "plain yellow orange brown black", [middle]),
    ):
        paint = b.paint(spec)
        for side in (-1, 1):
            shapes = [mesh.turned("z", side * 90).moved(0, side * r * 0.97, h * 0.28) for mesh in meshes]
            node.put(paint, *shapes)
